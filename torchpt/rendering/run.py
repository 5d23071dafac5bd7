"""One forward render: passes of samples, stop rules, checkpoints and the error estimate."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.core.errors import LostRankError, OutputError, RenderError, SceneError, warn_once
from torchpt.core.memory import Budget, MemoryMeter, check_memory, explain_out_of_memory, mb, retry_out_of_memory
from torchpt.core.threads import limited_threads, without_autocast
from torchpt.engines.engine import Block, Forward, TaskResult, Tasks, forward_tensors
from torchpt.native import compile_time
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts, Wave
from torchpt.physics.film import ErrorEstimate, Film
from torchpt.physics.shapes.geometry import Geometry
from torchpt.ranks import Group, together
from torchpt.rendering.checkpoint import EVERY, CheckpointFile, RenderState, check_plausible, check_samples, identity
from torchpt.rendering.error import FIRST_ROUND, SampleAllocation, error_probes
from torchpt.rendering.nonfinite import describe_sample
from torchpt.rendering.picture import error_estimate_of, finished_rendering, rendering_of
from torchpt.rendering.result import Progress, Rendering
from torchpt.rendering.split import DistributedRender, render_fingerprint
from torchpt.rendering.stopping import StopRules
from torchpt.scene import Scene
from torchpt.scene.memory_estimate import (
    BYTES_PER_LANE,
    FEWEST_OF_KERNELS,
    LANES,
    check_film,
    mark_loaded,
    memory_estimate,
)
from torchpt.scene.prepare import kernel_engine, make_wave, surface_layers, uses_kernels
from torchpt.scene.settings import Settings

__all__ = ["Run", "render_scene"]


# ---- One forward render


#: A last adaptive round of less than 1 / SMALL_ROUND of the samples is not kept: the checkpoint before it serves any spp.
SMALL_ROUND = 8


def _upper_bound(estimate: ErrorEstimate | None) -> float:
    """Return the upper end of the estimate's interval; infinite if there is none, or it is not to be trusted."""
    return math.inf if estimate is None or estimate.interval is None or estimate.heavy_tailed else estimate.interval[1]


class Run:
    """One forward render, by one process or by the ranks of ``group``.

    ``like``, ``rays``: see :func:`torchpt.scene.prepare.make_wave`. ``threads``: number of worker threads; None: torch's.

    Attributes:
        picture: films of the picture and its AOVs.
        probes: the error probes; None without an error estimate.
        engine: traces the paths; ``tasks`` is the same engine if it is compiled, else None.
        taken: samples a pixel of the finished passes.
        done: number of paths traced, by all ranks.
        left: number of paths of this pass that are not traced yet.
        lost: the non-finite samples.
        light: sum of all samples before and after the firefly clamp ``(2,)`` float64.
        stop: the stop rules.
        ended: True once ``on_progress`` stopped the render.
        keeps: True if the render has a checkpoint, which the first rank writes.
        split: this rank's share; None for a single process.
        eager: why stages run by tensor operations although kernels were requested.
    """

    def __init__(
        self,
        scene: Scene,
        settings: Settings,
        params: Mapping[str, Tensor] | None,
        dtype: torch.dtype,
        group: Group | None = None,
        like: Wave | None = None,
        threads: int | None = None,
        rays: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        self.start = time.perf_counter()
        self._compiled_before = compile_time.seconds()
        self._kernels = 0.0  # seconds of compiling for an engine that was given up
        self.split = None if group is None or group.size == 1 else DistributedRender(group)
        self.shared: tuple[int, int] = 0, 1  # samples before this pass, and the number of ranks that share it
        self.settings, self.device, self.unit = settings, scene.device, scene.space.unit
        self.scene, self.name, self.load_seconds = scene, scene.name, scene.load_seconds
        meter, limit = MemoryMeter(self.device), settings.render.max_memory
        before = 0 if limit is None else meter.peak()
        compiled = uses_kernels(settings, self.device, dtype)
        self.wave = retry_out_of_memory(
            lambda: f"a scene of {scene.size_phrase}",
            lambda: make_wave(scene, settings, params, dtype, like=like, rays=rays),
        )
        built = before if limit is None else meter.peak()
        _, _, self.width, self.height = self.wave.crop
        self.params, self.dtype = params, dtype
        self.integrator = settings.integrator
        self.seen = surface_layers(settings)
        self.on_progress: Callable[[Progress], bool | None] | None = None
        self.eager: list[str] = []
        self.unsupported: Unsupported | None = None
        self.checkpoint_file: CheckpointFile | None = None
        self.warned = False  # of a checkpoint that cannot be written
        self.keeps = settings.render.checkpoint is not None
        if settings.render.checkpoint is not None and (group is None or group.rank == 0):
            self.checkpoint_file = CheckpointFile(settings.render.checkpoint, identity(scene, settings, params, dtype))
            self.checkpoint_file.check(settings.render.resume)
        self.tasks: Tasks | None = kernel_engine(scene, self.wave, self.eager, threads) if compiled else None
        self.engine: Forward = self._by_tensors() if self.tasks is None else self.tasks
        rows = self.engine.rows(self.seen)
        how = "compiled" if self.engine.compiled else "eager"
        self.need = memory_estimate(settings, self.device, how, len(self.wave.context.world.materials.models), rows)
        if limit is not None:
            loading = max(scene.peak, built - meter.base() if built > before else 0)
            check_memory(limit, self.device, self.need.least, loading)
            if self.engine.compiled:
                self.engine.budget.fit(self.need.left(limit, meter.above()), 4 * rows, FEWEST_OF_KERNELS)
        films = mb(self.need.films)
        retry_out_of_memory(lambda: f"films of {self.width} x {self.height} pixels, which take {films}", self._begin)
        self._compiled = self.compile_seconds()
        self.build_seconds = time.perf_counter() - self.start - self._compiled

    def _by_tensors(self) -> Forward:
        lanes = LANES.get(self.device.type, LANES["cpu"])
        limit, what = self.settings.render.max_memory, "a wave of a single lane"
        return forward_tensors(
            self.wave, Budget(self.device, lanes, what=what, limit=limit, bytes_per_lane=BYTES_PER_LANE)
        )

    def _begin(self) -> None:
        """Set films and counts to zero."""
        device, streams = self.device, self.wave.sampler.streams
        splats, channels = self.integrator.splats, [len(x.channels) for x in self.seen.values()]
        check_film(self.width, self.height, streams.count, channels, device, splats=splats)
        film = Film(self.width, self.height, streams.count, device, splats=splats)
        layers = {
            name: Film(self.width, self.height, 1, device, len(layer.channels)) for name, layer in self.seen.items()
        }
        self.picture = PixelSet(film, layers, streams)
        self.probes = error_probes(self.wave, self.settings, device) if self.settings.pilots else None
        self.tally, self.done, self.left, self.taken, self.ended = RayCounts(), 0, 0, 0, False
        self._final_checkpoint_written = False  # later samples are taken again after a resume
        self.cut = False  # True once spp or the time limit shortened an adaptive round
        self.before = 0.0  # seconds of sampling before the checkpoint that was resumed
        bounded = self.keeps or self.split is not None  # a lost rank is noticed between passes
        self.stop = StopRules(self.settings.render, streams.count, EVERY if bounded else None)
        if self.probes is not None:
            self.stop.after = self.probes.resampling_share(self.width * self.height)
        if self.split is not None:
            self.split.begin()
        self.lost = NonFinite()
        self._before_resampling: tuple[dict[str, Any], Tensor] = (
            {},
            torch.empty(0),
        )  # counts before outliers were resampled
        self.light = torch.zeros(2, dtype=torch.float64, device=device)  # before and after the clamp
        self.begun: float | None = None

    def sample_all(self, on_progress: Callable[[Progress], bool | None] | None) -> Rendering:
        """Take all samples, until a stop rule or ``on_progress`` ends the render, and return the rendering."""
        self.on_progress = on_progress
        self.stop.watched = on_progress is not None or self.settings.adaptive or self.keeps or self.split is not None
        try:
            with explain_out_of_memory("a render"):
                self._all()
                self._join()
        except LostRankError as error:
            if not self.keeps:
                raise
            raise LostRankError(f"{error}; render.resume=true goes on from the last checkpoint") from None
        return self._final()

    def all_spans(self) -> list[tuple[PixelSet, int, int]] | None:
        """Return the spans of the whole render; their results go to :meth:`task_finished`, and then :meth:`finish` ends it.

        None if it must run by :meth:`sample_all`: without kernels, with stop rules besides ``spp``, or in bounded memory.
        """
        ends = self.keeps or self.stop.open or self.probes is not None or self.split is not None
        if self.tasks is None or ends or self.settings.render.max_memory is not None:
            return None
        self.begun = time.perf_counter()
        return [(self.picture, 0, self.settings.render.spp)]

    def finish(self, rest: list[Block]) -> Rendering:
        """Return the rendering of :meth:`all_spans`, after taking the blocks in ``rest``, put back when memory ran out."""
        with explain_out_of_memory("a render"):
            if self.unsupported is not None:
                self._restart_by_tensors(self.unsupported)
            else:
                if rest:
                    assert self.tasks is not None
                    self.tasks.retry_blocks(rest, self.task_finished)
                self.taken = self.settings.render.spp
                self.stop.update(self.taken, self.seconds_of_sampling(), None)
        return self._final()

    def _final(self) -> Rendering:
        mark_loaded("compiled" if self.engine.compiled else "eager")
        self.engine.release_workers(keeps=self.settings.render.max_memory is None)
        return finished_rendering(self)

    def _all(self) -> None:
        """Take all samples; by tensor operations if kernels cannot be made."""
        try:
            self._complete()
        except Unsupported as error:
            if not self.engine.compiled:
                raise
            self._restart_by_tensors(error)

    def _restart_by_tensors(self, error: Unsupported) -> None:
        """Take all samples again from the start, by tensor operations.

        Raises:
            SceneError: ``render.compile`` is ``on``.
        """
        if self.settings.render.compile == "on":
            raise SceneError("render.compile", "on", f"auto or off (no kernel can be made of {error})")
        self.eager.append(f"all stages: {error}")
        warn_once(f"torchpt: this scene renders by tensor operations, as no kernel can be made of {error}")
        self._kernels += self.engine.seconds
        self.tasks, self.engine = None, self._by_tensors()
        self._begin()
        self._complete()

    # -- passes

    def _complete(self) -> None:
        """Take the samples of the picture, and then those of outliers for the error estimate."""
        self._resume()
        self._sample()
        self._join()
        if not self.ended:
            self._resample_outliers()

    def _resample_outliers(self) -> None:
        """Resample outliers for the error estimate, unless that was done at this number of samples."""
        if self.probes is None or self.probes.resampled_at == self._mean():
            return
        self._before_resampling = self._counted()
        again = self.probes.resample_outliers(self.picture.film, None if self.split is None else self.split.places)
        if not self._take(again):
            self.probes.resampled = None
        self._join()

    def _sample(self) -> None:
        """Take passes until a rule ends the render."""
        self.begun = time.perf_counter()
        while not self._adapts() and (size := self.stop.step(self.taken)):
            if self.settings.adaptive:  # the first round is the same whatever spp and the seconds of a pass
                size = min(size, FIRST_ROUND - self.taken)
            spans = [(self.picture, self.taken, size)]
            if self.probes is not None:
                spans.append((self.probes.pixel_set, self.taken, size))
            if not self._take(spans):
                return
            self.taken += size
            self._reached(self.taken, self.seconds_of_sampling())
            self._keep()
        if self._adapts():
            self._adapt()
        if not self.ended:
            self._keep(last=True)

    def _adapts(self) -> bool:
        """Return True once error probes decide where samples go."""
        return self.probes is not None and self.settings.adaptive and self.taken >= FIRST_ROUND

    def _adapt(self) -> None:
        """Take adaptive rounds, each of which doubles the samples."""
        assert self.probes is not None
        self._join()
        allocation = SampleAllocation(
            self.probes.pilots, self.picture.film, None if self.split is None else self.split.places
        )
        mean = self._mean()
        while self.stop.should_continue(mean):
            requested = min(2.0 * mean, float(self.settings.render.spp)) - mean
            more = self.stop.affordable(requested)
            last = more == requested and more < mean and mean + more >= self.settings.render.spp
            spans = allocation.spans(self.picture, self.probes, mean + more, last)
            if not spans:  # not enough samples are left for one block
                self.stop.reason = "spp" if more == requested else "time_limit"
                break
            if last and SMALL_ROUND * more < mean and not self.cut:  # cheap to repeat, with any spp
                self._keep(last=True)
                self._final_checkpoint_written = True
            self.cut |= more < mean
            whole = self._take(spans)
            self._join()
            allocation.merge()
            if not whole:
                break
            mean = self._mean()
            self._reached(mean, self.seconds_of_sampling())
            self._keep()

    # -- checkpoints

    def films(self) -> dict[str, Film]:
        """Return all films by name."""
        films = {"picture": self.picture.film}
        films |= {f"layers.{name}": film for name, film in self.picture.layers.items()}
        return films if self.probes is None else films | {"pilots": self.probes.pixel_set.film}

    def _keep(self, last: bool = False) -> None:
        """Write a checkpoint if one is due."""
        if not self.keeps or self._final_checkpoint_written:
            return
        due = self.checkpoint_file is not None and (last or self.checkpoint_file.due())
        if due if self.split is None else self.split.due(due):
            self._join()
            if self.checkpoint_file is not None:
                self._write(self.checkpoint_file)

    def _write(self, checkpoint_file: CheckpointFile) -> None:
        """Write a checkpoint; if that fails, warn and go on: the picture may still be written elsewhere."""
        try:
            checkpoint_file.write(self._state())
        except OutputError as problem:
            if not self.warned:
                print(f"torchpt: {problem}; the render goes on without it", file=sys.stderr, flush=True)
            self.warned = True

    def _state(self) -> RenderState:
        """Return the state for a checkpoint."""
        resampled_at = (
            self.probes is not None and self.probes.resampled_at == self._mean()
        )  # outliers are resampled after a resume
        counted, light = self._before_resampling if resampled_at else self._counted()
        facts = {"taken": self.taken, "seconds": self.seconds_of_sampling(), "cut": int(self.cut), **counted}
        arrays = {f"{name}.{key}": value for name, film in self.films().items() for key, value in film.state().items()}
        return RenderState(facts, arrays | {"light": light})

    def _counted(self) -> tuple[dict[str, Any], Tensor]:
        """Return the counts by name, and the light before and after the clamp."""
        counts = {"done": self.done, "rays": self.tally.rays, "truncated": self.tally.truncated}
        return {**counts, "lost": self.lost.plain()}, self.light.clone()

    def _mean(self) -> float:
        """Return the mean samples a pixel of the picture."""
        return float(self.picture.film.counts.double().mean())

    def _resume(self) -> None:
        """Restore the checkpoint if ``render.resume`` is set and there is one."""
        if not self.keeps or not self.settings.render.resume:
            return
        state = None if self.checkpoint_file is None else self._kept(self.checkpoint_file)
        if state is None and self.checkpoint_file is not None:
            warn_once(f"torchpt: there is no checkpoint {self.checkpoint_file.path} yet: the render starts anew")
        if self.split is not None:
            state = self.split.state(state, self._state())
        if state is None:
            return
        for name, film in self.films().items():
            film.restore({key: state.arrays[f"{name}.{key}"].to(self.device) for key in film.state()})
        self.lost, self.light = NonFinite.read(state.facts["lost"]), state.arrays["light"].to(self.device)
        self.taken, self.done, self.before = (state.facts[name] for name in ("taken", "done", "seconds"))
        self.tally.rays, self.tally.truncated = state.facts["rays"], state.facts["truncated"]
        self.cut = bool(state.facts["cut"])
        mean = self._mean() if self._adapts() else self.taken
        self._reached(mean, self.before)

    def _kept(self, checkpoint_file: CheckpointFile) -> RenderState | None:
        """Return the validated checkpoint; None if there is none."""
        state = checkpoint_file.read(self._state(), lambda state: check_samples(self, state, checkpoint_file.path))
        if state is not None:
            check_plausible(self, state, checkpoint_file.path)
        return state

    def _reached(self, mean: float, seconds: float) -> None:
        """Update the stop rules with the samples, seconds and error so far, as the first rank has them."""
        if self.settings.render.target_error is not None:
            self._join()
        error = self._probe_error_bound() if self.stop.checks_error(mean, self._adapts()) else None
        if self.split is not None:
            seconds, error = self.split.broadcast_numbers(seconds, error)
        target = self.settings.render.target_error
        if error is not None and target is not None and error <= target:
            error = self._error_bound()
            if self.split is not None:
                _, error = self.split.broadcast_numbers(seconds, error)
            if (error is None or error > target) and not self.ended:
                self._undo_resampling()
        self.stop.update(mean, seconds, error)

    def _join(self) -> None:
        """Make the films whole on every rank."""
        if self.split is not None:
            self.split.join()

    def _probe_error_bound(self) -> float:
        """Return the upper end of the interval of relMSE that the error probes give."""
        assert self.probes is not None
        return _upper_bound(self.probes.probe_estimate(self.picture.film))

    def _error_bound(self) -> float:
        """Return the upper end of the interval of relMSE after resampling outliers, which takes samples."""
        assert self.probes is not None
        self._resample_outliers()
        estimate, unknown = error_estimate_of(self, self.probes.picture(self.picture.film))
        return math.inf if self.ended or unknown else _upper_bound(estimate)

    def _undo_resampling(self) -> None:
        """Restore the counts before outliers were resampled: the picture gets more samples, and they will be again."""
        assert self.probes is not None
        counts, self.light = self._before_resampling
        self.done, self.tally = counts["done"], RayCounts(counts["rays"], counts["truncated"])
        self.lost = NonFinite.read(counts["lost"])
        self.probes.resampled, self.probes.resampled_at = None, None

    def geometry(self) -> Geometry:
        """Return the primitives that the search structure was built from."""
        moved = {name: value for name, value in (self.params or {}).items() if not name.startswith("camera.")}
        return self.scene.world(torch.float32, moved)[1]

    def seconds_of_sampling(self) -> float:
        """Return the seconds of sampling, without compiling kernels and writing checkpoints."""
        if self.begun is None:
            return 0.0
        made = self.compile_seconds() - self._compiled
        return self.before + max(time.perf_counter() - self.begun - made - self.write_seconds(), 0.0)

    def compile_seconds(self) -> float:
        """Return the seconds of compiling kernels since the start: of stages and of the search."""
        return self._kernels + self.engine.seconds + compile_time.seconds() - self._compiled_before

    def write_seconds(self) -> float:
        """Return the seconds of writing checkpoints."""
        return 0.0 if self.checkpoint_file is None else self.checkpoint_file.seconds

    # -- samples of a pass

    def _take(self, spans: list[tuple[PixelSet, int, int]]) -> bool:
        """Take the samples of spans (pixels, first sample, count); return True if all were taken."""
        if not spans:
            return True
        if self.split is None:
            return self.take_alone(spans)
        whole = self.split.take(self, spans)
        if self.settings.render.preview is not None:
            self._join()
            self._advanced(0, True)
        return whole

    def take_alone(self, spans: list[tuple[PixelSet, int, int]]) -> bool:
        """Take the samples of spans in this process; return True if all were taken."""
        self.left = sum(pixel_set.film.width * pixel_set.film.height * samples for pixel_set, _, samples in spans)
        return self.engine.run(spans, self.task_finished)

    def task_finished(self, share: TaskResult | None) -> bool:
        """Add the counts of a finished task; return True if the render is to stop."""
        if share is None:
            return self._advanced(0, False)
        self.tally.rays += share.tally.rays
        self.tally.truncated += share.tally.truncated
        self._count(share.lost)
        if self.integrator.clamp is not None:
            self.light += torch.tensor(share.light, dtype=torch.float64, device=self.device)
        self.left -= share.samples
        return self._advanced(share.samples, self.left == 0 and self.split is None)

    def _advanced(self, samples: int, ends: bool) -> bool:
        """Count samples and call ``on_progress``; return True if the render is to stop."""
        self.done += samples
        if self.on_progress is None or self.ended:  # other threads' tasks still finish after a stop
            return self.ended
        seconds = time.perf_counter() - self.start
        before, ranks = self.shared  # other ranks have taken about as many
        done = before + ranks * (self.done - before)
        state = Progress(done, max(self._total(), done), self.tally.rays, seconds, ends, self.result)
        requested = bool(self.on_progress(state))
        if samples or ranks > 1 or self.split is None:  # ranks stop together, after a pass
            self.ended = requested and self.done < self.asked()
        return self.ended

    def _total(self) -> int:
        """Return the expected number of paths: fewer than ``spp`` gives where time or error end the render."""
        asked = self.asked()
        if not self.stop.open or self.stop.share <= 0.0:
            return max(asked, self.done)
        return max(min(asked, round(self.done / self.stop.share)), self.done)

    def asked(self) -> int:
        """Return the number of paths of ``render.spp`` samples, error probes included."""
        pixels = self.width * self.height + (0 if self.probes is None else len(self.probes.pilots))
        return pixels * self.settings.render.spp

    def _count(self, lost: NonFinite) -> None:
        """Count non-finite samples; with ``integrator.strict`` raise RenderError at the first one."""
        if lost.count and self.integrator.strict:
            raise RenderError(f"integrator.strict: {describe_sample(self.scene, self.wave, lost.samples[0])}")
        self.lost.add(lost)

    def result(self) -> Rendering:
        """Return the rendering so far."""
        return rendering_of(self)


# ---- One render with complete settings, for all callers


def render_scene(
    scene: Scene,
    settings: Settings,
    on_progress: Callable[[Progress], bool | None] | None = None,
    params: Mapping[str, Tensor] | None = None,
    dtype: torch.dtype = torch.float32,
    ranks: Group | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
) -> Rendering:
    """Render a scene with complete settings.

    Args:
        scene: the scene.
        settings: the complete settings.
        on_progress: called after every chunk; a return value of True ends the render with the picture so far.
        params: tensors in place of the scene's, without gradients.
        dtype: dtype of the picture and of all lanes.
        ranks: processes that share the work; each returns the whole picture.
        rays: rays in place of the camera's, see :func:`torchpt.scene.prepare.make_wave`; by one process only.

    Raises:
        SceneError: this scene cannot be rendered with these settings.
        RenderError: with ``integrator.strict``, the first sample that is not finite.
        AssetError: the checkpoint is damaged, or is of another render.
        OutputError: the checkpoint cannot be written, or exists without ``render.resume``.
    """
    with without_autocast(scene.device), limited_threads(settings.render.threads):
        with together(ranks, "what is rendered", lambda: render_fingerprint(scene, settings, params, dtype)):
            return Run(scene, settings, params, dtype, group=ranks, rays=rays).sample_all(on_progress)
