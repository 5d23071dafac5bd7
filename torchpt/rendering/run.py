"""One forward render: takes chunks, adds them up in films, and says what they come to."""

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
from torchpt.rendering.nonfinite import told
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


# ---- One forward render: takes chunks and adds them up in films


#: A last round of adaptive sampling of less than this part of the samples is not kept: the checkpoint before serves any spp.
SMALL_ROUND = 8


def _upper_bound(estimate: ErrorEstimate | None) -> float:
    """The upper end of an interval; infinite where there is none that is to be trusted."""
    return math.inf if estimate is None or estimate.interval is None or estimate.heavy_tailed else estimate.interval[1]


class Run:
    """One forward render: accumulates chunks into films; by several ranks where there is a ``group`` of them.

    ``like``, ``rays``: see :func:`torchpt.scene.prepare.make_wave`. ``threads``: that will take samples; None: torch's number.
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
        self._kernels = 0.0  # seconds of kernels that were given up
        self.split = None if group is None or group.size == 1 else DistributedRender(group)
        self.shared: tuple[int, int] = 0, 1  # samples before this pass, and how many ranks take it
        self.settings, self.device, self.unit = settings, scene.device, scene.space.unit
        self.scene, self.name, self.load_seconds = scene, scene.name, scene.load_seconds
        meter, limit = MemoryMeter(self.device), settings.render.max_memory
        before = 0 if limit is None else meter.peak()
        compiled = uses_kernels(settings, self.device, dtype)
        self.wave = retry_out_of_memory(
            lambda: f"a scene of {scene.told}",
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
        self.warned = False  # that it cannot write
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
        return forward_tensors(self.wave, Budget(self.device, lanes, what=what, limit=limit, per_lane=BYTES_PER_LANE))

    def _begin(self) -> None:
        """Nothing is sampled yet."""
        device, streams = self.device, self.wave.sampler.streams
        splats, channels = self.integrator.splats, [len(x.channels) for x in self.seen.values()]
        check_film(self.width, self.height, streams.count, channels, device, splats)
        film = Film(self.width, self.height, streams.count, device, splats=splats)
        layers = {
            name: Film(self.width, self.height, 1, device, len(layer.channels)) for name, layer in self.seen.items()
        }
        self.picture = PixelSet(film, layers, streams)
        self.probes = error_probes(self.wave, self.settings, device) if self.settings.pilots else None
        self.tally, self.done, self.left, self.taken, self.ended = RayCounts(), 0, 0, 0, False
        self._final_checkpoint_written = False  # what follows is done again by whoever goes on
        self.cut = False  # whether a round of adaptive sampling was shortened
        self.before = 0.0  # seconds of sampling up to the checkpoint that this goes on from
        bounded = self.keeps or self.split is not None  # a rank that is gone is noticed after a pass
        self.stop = StopRules(self.settings.render, streams.count, EVERY if bounded else None)
        if self.probes is not None:
            self.stop.after = self.probes.resampling_share(self.width * self.height)
        if self.split is not None:
            self.split.begin()
        self.lost = NonFinite()
        self._before_resampling: tuple[dict[str, Any], Tensor] = (
            {},
            torch.empty(0),
        )  # counted before pixels were looked at again
        self.light = torch.zeros(2, dtype=torch.float64, device=device)  # before and after the clamp
        self.begun: float | None = None

    def sample_all(self, on_progress: Callable[[Progress], bool | None] | None) -> Rendering:
        """Take all samples, or as many as the rules or ``on_progress`` let."""
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
        """All samples, to be handed to :meth:`task_finished` as they come, and then :meth:`finish`.

        None where that cannot be: there are no kernels, something but their number may end them, or memory is bounded.
        """
        ends = self.keeps or self.stop.open or self.probes is not None or self.split is not None
        if self.tasks is None or ends or self.settings.render.max_memory is not None:
            return None
        self.begun = time.perf_counter()
        return [(self.picture, 0, self.settings.render.spp)]

    def finish(self, rest: list[Block]) -> Rendering:
        """The picture of samples that were taken at once, but for the blocks for which there was no memory."""
        with explain_out_of_memory("a render"):
            if self.unsupported is not None:
                self._restart_by_tensors(self.unsupported)
            else:
                if rest:
                    assert self.tasks is not None
                    self.tasks.retry_blocks(rest, self.task_finished)
                self.taken = self.settings.render.spp
                self.stop.told(self.taken, self.seconds_of_sampling(), None)
        return self._final()

    def _final(self) -> Rendering:
        mark_loaded("compiled" if self.engine.compiled else "eager")
        self.engine.release_workers(keeps=self.settings.render.max_memory is None)
        return finished_rendering(self)

    def _all(self) -> None:
        """All samples, by tensor operations where there can be no kernels."""
        try:
            self._complete()
        except Unsupported as error:
            if not self.engine.compiled:
                raise
            self._restart_by_tensors(error)

    def _restart_by_tensors(self, error: Unsupported) -> None:
        """All samples, once more, by tensor operations.

        Raises:
            SceneError: kernels alone were asked for.
        """
        if self.settings.render.compile == "on":
            raise SceneError("render.compile", "on", f"auto or off (no kernel can be made of {error})")
        self.eager.append(f"all stages: {error}")
        warn_once(f"torchpt: this scene renders by tensor operations, as no kernel can be made of {error}")
        self._kernels += self.engine.seconds
        self.tasks, self.engine = None, self._by_tensors()
        self._begin()
        self._complete()

    # -- which samples

    def _complete(self) -> None:
        """The picture, and then what it takes to know its error."""
        self._resume()
        self._sample()
        self._join()
        if not self.ended:
            self._resample_outliers()

    def _resample_outliers(self) -> None:
        """Sample what it takes to know the picture's error better, unless that was done with as many samples."""
        if self.probes is None or self.probes.resampled_at == self._mean():
            return
        self._before_resampling = self._counted()
        again = self.probes.resample_outliers(self.picture.film, None if self.split is None else self.split.places)
        if not self._take(again):
            self.probes.resampled = None
        self._join()

    def _sample(self) -> None:
        """Pass by pass, until a rule says that it is enough."""
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
        """Return True where pilots say from now on where samples go."""
        return self.probes is not None and self.settings.adaptive and self.taken >= FIRST_ROUND

    def _adapt(self) -> None:
        """Rounds that double the samples there are, each where pilots say."""
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
            if not spans:  # a sample of one block's pixels is more than what is left
                self.stop.reason = "spp" if more == requested else "time_limit"
                break
            if last and SMALL_ROUND * more < mean and not self.cut:  # quickly done again, and then for any spp
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

    # -- what a killed render goes on from

    def films(self) -> dict[str, Film]:
        """Return all that samples are added to, by name."""
        films = {"picture": self.picture.film}
        films |= {f"layers.{name}": film for name, film in self.picture.layers.items()}
        return films if self.probes is None else films | {"pilots": self.probes.pixel_set.film}

    def _keep(self, last: bool = False) -> None:
        """Write a checkpoint where it is time for one."""
        if not self.keeps or self._final_checkpoint_written:
            return
        due = self.checkpoint_file is not None and (last or self.checkpoint_file.due())
        if due if self.split is None else self.split.due(due):
            self._join()
            if self.checkpoint_file is not None:
                self._write(self.checkpoint_file)

    def _write(self, checkpoint_file: CheckpointFile) -> None:
        """Write a checkpoint; where that fails the render goes on, as its picture may have a better place."""
        try:
            checkpoint_file.write(self._state())
        except OutputError as problem:
            if not self.warned:
                print(f"torchpt: {problem}; the render goes on without it", file=sys.stderr, flush=True)
            self.warned = True

    def _state(self) -> RenderState:
        """Return where the render is."""
        resampled_at = (
            self.probes is not None and self.probes.resampled_at == self._mean()
        )  # whoever goes on looks once more
        counted, light = self._before_resampling if resampled_at else self._counted()
        facts = {"taken": self.taken, "seconds": self.seconds_of_sampling(), "cut": int(self.cut), **counted}
        arrays = {f"{name}.{key}": value for name, film in self.films().items() for key, value in film.state().items()}
        return RenderState(facts, arrays | {"light": light})

    def _counted(self) -> tuple[dict[str, Any], Tensor]:
        """Return what is counted beside the films, by name, and the light before and after the clamp."""
        counts = {"done": self.done, "rays": self.tally.rays, "truncated": self.tally.truncated}
        return {**counts, "lost": self.lost.plain()}, self.light.clone()

    def _mean(self) -> float:
        """Samples a pixel that the picture holds."""
        return float(self.picture.film.counts.double().mean())

    def _resume(self) -> None:
        """Go on from the checkpoint, where that is wished and there is one."""
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
        """Return the checkpoint, once it is known to be one that this render can go on from; None where there is none."""
        state = checkpoint_file.read(self._state(), lambda state: check_samples(self, state, checkpoint_file.path))
        if state is not None:
            check_plausible(self, state, checkpoint_file.path)
        return state

    def _reached(self, mean: float, seconds: float) -> None:
        """Tell the rules what was reached; where ranks share a render, as the first one sees it."""
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
        self.stop.told(mean, seconds, error)

    def _join(self) -> None:
        """Let the films hold what all ranks took."""
        if self.split is not None:
            self.split.join()

    def _probe_error_bound(self) -> float:
        """The relMSE that pilots alone hold possible: the upper end of its interval."""
        assert self.probes is not None
        return _upper_bound(self.probes.probe_estimate(self.picture.film))

    def _error_bound(self) -> float:
        """The relMSE that the picture itself holds possible, once suspects were looked at again; it takes some samples."""
        assert self.probes is not None
        self._resample_outliers()
        estimate, unknown = error_estimate_of(self, self.probes.picture(self.picture.film))
        return math.inf if self.ended or unknown else _upper_bound(estimate)

    def _undo_resampling(self) -> None:
        """Count as if no pixel had been looked at again: the picture gets more samples, and will be then."""
        assert self.probes is not None
        counts, self.light = self._before_resampling
        self.done, self.tally = counts["done"], RayCounts(counts["rays"], counts["truncated"])
        self.lost = NonFinite.read(counts["lost"])
        self.probes.resampled, self.probes.resampled_at = None, None

    def geometry(self) -> Geometry:
        """The primitives as the search sees them."""
        moved = {name: value for name, value in (self.params or {}).items() if not name.startswith("camera.")}
        return self.scene.world(torch.float32, moved)[1]

    def seconds_of_sampling(self) -> float:
        """Since the first sample, without what was spent on kernels and checkpoints."""
        if self.begun is None:
            return 0.0
        made = self.compile_seconds() - self._compiled
        return self.before + max(time.perf_counter() - self.begun - made - self.write_seconds(), 0.0)

    def compile_seconds(self) -> float:
        """Since the start, for kernels: those of stages, and others that a first call makes, such as those of searches."""
        return self._kernels + self.engine.seconds + compile_time.seconds() - self._compiled_before

    def write_seconds(self) -> float:
        """For checkpoints."""
        return 0.0 if self.checkpoint_file is None else self.checkpoint_file.seconds

    # -- how they are taken

    def _take(self, spans: list[tuple[PixelSet, int, int]]) -> bool:
        """Samples of plates, with the first one and how many; returns whether all were taken."""
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
        """The same by this process alone."""
        self.left = sum(pixel_set.film.width * pixel_set.film.height * samples for pixel_set, _, samples in spans)
        return self.engine.run(spans, self.task_finished)

    def task_finished(self, share: TaskResult | None) -> bool:
        """Count what a task brought; returns whether the render is to stop."""
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
        """Tell of progress; returns whether to stop."""
        self.done += samples
        if self.on_progress is None or self.ended:  # tasks of other threads still come in after the wish to stop
            return self.ended
        seconds = time.perf_counter() - self.start
        before, ranks = self.shared  # the others are about as far
        done = before + ranks * (self.done - before)
        state = Progress(done, max(self._total(), done), self.tally.rays, seconds, ends, self.result)
        requested = bool(self.on_progress(state))
        if samples or ranks > 1 or self.split is None:  # between passes ranks do not part
            self.ended = requested and self.done < self.asked()
        return self.ended

    def _total(self) -> int:
        """Camera samples that there will be, as far as one can tell: fewer where time or error end the render."""
        asked = self.asked()
        if not self.stop.open or self.stop.share <= 0.0:
            return max(asked, self.done)
        return max(min(asked, round(self.done / self.stop.share)), self.done)

    def asked(self) -> int:
        """Camera samples that ``render.spp`` comes to."""
        pixels = self.width * self.height + (0 if self.probes is None else len(self.probes.pilots))
        return pixels * self.settings.render.spp

    def _count(self, lost: NonFinite) -> None:
        """Count samples that are not finite; with ``integrator.strict`` the first one ends the render."""
        if lost.count and self.integrator.strict:
            raise RenderError(f"integrator.strict: {told(self.scene, self.wave, lost.places[0])}")
        self.lost.add(lost)

    def result(self) -> Rendering:
        """The picture so far."""
        return rendering_of(self)


# ---- One render with complete settings: what every way to a picture comes down to


def render_scene(
    scene: Scene,
    settings: Settings,
    on_progress: Callable[[Progress], bool | None] | None = None,
    params: Mapping[str, Tensor] | None = None,
    dtype: torch.dtype = torch.float32,
    ranks: Group | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
) -> Rendering:
    """Render with complete settings.

    Args:
        scene: what.
        settings: how.
        on_progress: called after every chunk; returning True stops early with the picture so far.
        params: tensors in place of the scene's, without gradients.
        dtype: of the lanes.
        ranks: those that share the work; each gets all of the picture.
        rays: in place of the camera's, see :func:`torchpt.scene.prepare.make_wave`; by one process.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
        RenderError: with ``integrator.strict``, the first sample that is not finite.
        AssetError: a checkpoint that is damaged, or of another render.
        OutputError: a checkpoint that cannot be written, or that is there although nobody wishes to go on from it.
    """
    with without_autocast(scene.device), limited_threads(settings.render.threads):
        with together(ranks, "what is rendered", lambda: render_fingerprint(scene, settings, params, dtype)):
            return Run(scene, settings, params, dtype, group=ranks, rays=rays).sample_all(on_progress)
