"""One forward render: passes of samples, stop rules, checkpoints and the error estimate.

``render_scene`` is called by ``requests.py`` and the command line; ``many.py`` drives a :class:`Run` task by task. A pass takes
some samples of every pixel. A span is what an engine takes at once: a pixel set, its first sample and the number of samples.
Error probes are pixels that are sampled twice; outliers are pixels that are sampled a third time at the end (``error.py``).
"""

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
from torchpt.engines.engine import Block, Forward, SampleRange, TaskResult, Tasks, forward_tensors
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
from torchpt.scene.prepare import device_engine, is_small, kernel_engine, make_wave, surface_layers, uses_kernels
from torchpt.scene.settings import Settings

__all__ = ["Run", "render_scene"]


# ---- One forward render


#: A last adaptive round of less than 1 / SMALL_ROUND of the samples so far gets no checkpoint: it is cheap to repeat, and from
#: the checkpoint before it a render with any other ``render.spp`` may go on.
SMALL_ROUND = 8


def _upper_bound(estimate: ErrorEstimate | None) -> float:
    """Return the upper end of the estimate's interval; infinite if there is none, or it is not to be trusted."""
    return math.inf if estimate is None or estimate.interval is None or estimate.heavy_tailed else estimate.interval[1]


class Run:
    """One forward render, by one process or by the ranks of ``group``.

    Args:
        scene: the scene.
        settings: the complete settings.
        params: tensors in place of the scene's, by dotted name, without gradients.
        dtype: dtype of the picture and of all lanes.
        group: the ranks that share the render; None: this process alone.
        like: wave of an earlier render of the scene, whose world, search and kernels are reused where they fit.
        threads: number of worker threads; None: torch's.
        rays: origins and directions ``(..., 3)`` in place of the camera's rays.

    Attributes:
        picture: the pixel set of the picture, with its film and those of AOVs.
        surface_layers: the AOVs of first surfaces, by name.
        probes: the error probes; None without an error estimate.
        engine: traces the paths; ``tasks`` is the same engine if it is that of kernels on a CPU, else None.
        unsupported: why a stage cannot be compiled; None: all can, as far as is known.
        taken: samples a pixel of the finished passes.
        done: number of paths traced, by all ranks.
        ray_counts: rays traced, and paths cut off at the hard limit of depth.
        paths_left: number of paths of this pass that are not traced yet.
        nonfinite: the non-finite samples.
        clamp_sums: sum of all samples before and after the firefly clamp ``(2,)`` float64.
        stop_rules: the stop rules.
        stopped_by_caller: True once ``on_progress`` stopped the render.
        has_checkpoint: True if the render has a checkpoint, which the first rank writes.
        distributed: this rank's share; None for a single process.
        eager_reasons: why stages run by tensor operations although kernels were requested.
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
        self._compile_seconds_before = compile_time.seconds()
        self._discarded_compile_seconds = 0.0  # seconds of compiling for an engine that was given up
        self.distributed = None if group is None or group.size == 1 else DistributedRender(group)
        self.done_before_pass, self.sharing_ranks = 0, 1  # paths of all ranks before this pass; ranks that share it
        self.settings, self.device = settings, scene.device
        self.unit = scene.space.unit  # length of the world's unit, in scene units
        self.scene, self.name, self.load_seconds = scene, scene.name, scene.load_seconds
        meter, limit = MemoryMeter(self.device), settings.render.max_memory
        peak_before = 0 if limit is None else meter.peak()  # bytes
        compiled = uses_kernels(settings, self.device, dtype)
        self.wave = retry_out_of_memory(
            lambda: f"a scene of {scene.size_phrase}",
            lambda: make_wave(scene, settings, params, dtype, like=like, rays=rays),
        )
        if self.distributed is not None and self.wave.integrator.merges:
            expected = "one without merges beside ranks, each of which traces light paths for its own pixels alone"
            raise SceneError("integrator.type", settings.integrator.name, expected)
        peak_built = peak_before if limit is None else meter.peak()
        _, _, self.width, self.height = self.wave.crop
        self.params, self.dtype = params, dtype
        self.integrator = settings.integrator
        self.surface_layers = surface_layers(settings)
        self.on_progress: Callable[[Progress], bool | None] | None = None
        self.eager_reasons: list[str] = []
        self.unsupported: Unsupported | None = None
        self.checkpoint_file: CheckpointFile | None = None
        self._warned_of_checkpoint = False  # that one cannot be written
        self.has_checkpoint = settings.render.checkpoint is not None
        if settings.render.checkpoint is not None and (group is None or group.rank == 0):
            self.checkpoint_file = CheckpointFile(settings.render.checkpoint, identity(scene, settings, params, dtype))
            self.checkpoint_file.check(settings.render.resume)
        self.tasks: Tasks | None = None
        self.engine: Forward
        if compiled and self.device.type == "cpu":
            self.engine = self.tasks = kernel_engine(scene, self.wave, self.eager_reasons, threads)
        elif compiled:
            self.engine = device_engine(scene, self.wave, settings, self.eager_reasons)
        else:
            self.engine = self._tensor_engine()
        words_per_lane = self.engine.rows(self.surface_layers)  # 32-bit words of a lane in a worker's memory
        models = len(self.wave.context.world.materials.models)
        self.memory_need = memory_estimate(settings, self.device, self._how(), models, words_per_lane)
        if limit is not None:
            loading = max(scene.peak, peak_built - meter.base() if peak_built > peak_before else 0)
            check_memory(limit, self.device, self.memory_need.least, loading)
            if self.engine.compiled:
                self.engine.budget.fit(
                    self.memory_need.left(limit, meter.above()), 4 * words_per_lane, FEWEST_OF_KERNELS
                )
        films = mb(self.memory_need.films)
        retry_out_of_memory(lambda: f"films of {self.width} x {self.height} pixels, which take {films}", self._reset)
        self._setup_compile_seconds = self.compile_seconds()  # those before the first sample
        self.build_seconds = time.perf_counter() - self.start - self._setup_compile_seconds

    def _how(self) -> str:
        """Return how the render runs: ``compiled`` or ``eager``."""
        return "compiled" if self.engine.compiled else "eager"

    def _tensor_engine(self) -> Forward:
        """Return an engine of tensor operations, with as many lanes at once as memory allows."""
        lanes = LANES.get(self.device.type, LANES["cpu"])
        limit, what = self.settings.render.max_memory, "a wave of a single lane"
        return forward_tensors(
            self.wave, Budget(self.device, lanes, what=what, limit=limit, bytes_per_lane=BYTES_PER_LANE)
        )

    def _reset(self) -> None:
        """Set films and counts to zero."""
        device, randomizations, splats = self.device, self.wave.sampler.streams, self.integrator.splats
        channels = [len(layer.channels) for layer in self.surface_layers.values()]
        check_film(self.width, self.height, randomizations.count, channels, device, splats=splats)
        film = Film(self.width, self.height, randomizations.count, device, splats=splats)
        layers = {
            name: Film(self.width, self.height, 1, device, len(layer.channels))
            for name, layer in self.surface_layers.items()
        }
        self.picture = PixelSet(film, layers, randomizations)
        self.probes = error_probes(self.wave, self.settings, device) if self.settings.pilots else None
        self.ray_counts, self.done, self.paths_left, self.taken, self.stopped_by_caller = RayCounts(), 0, 0, 0, False
        self._final_checkpoint_written = False  # no more are written: a resume repeats the samples after it
        self.round_was_shortened = False  # True once spp or the time limit made an adaptive round less than double
        self.seconds_before_resume = 0.0  # seconds of sampling before the checkpoint that was resumed
        # Checkpoints are written, and lost ranks noticed, between passes: so these must not be long.
        bounded = self.has_checkpoint or self.distributed is not None
        self.stop_rules = StopRules(
            self.settings.render, randomizations.count, longest_pass_seconds=EVERY if bounded else None
        )
        if self.probes is not None:
            self.stop_rules.resampling_share = self.probes.resampling_share(self.width * self.height)
        if self.distributed is not None:
            self.distributed.forget_parts()
        self.nonfinite = NonFinite()
        # Counts, and light before and after the clamp, as they were before outliers were resampled.
        self._before_resampling: tuple[dict[str, Any], Tensor] = ({}, torch.empty(0))
        self.clamp_sums = torch.zeros(2, dtype=torch.float64, device=device)
        self.sampling_start: float | None = None  # of the clock; None before the first sample

    def sample_all(self, on_progress: Callable[[Progress], bool | None] | None) -> Rendering:
        """Take all samples, until a stop rule or ``on_progress`` ends the render, and return the rendering."""
        self.on_progress = on_progress
        # Where nothing looks at the picture between passes, these are as long as possible.
        self.stop_rules.picture_is_watched = (
            on_progress is not None or self.settings.adaptive or self.has_checkpoint or self.distributed is not None
        )
        try:
            with explain_out_of_memory("a render"):
                self._sample_with_fallback()
                self._join_films()
        except LostRankError as error:
            if not self.has_checkpoint:
                raise
            raise LostRankError(f"{error}; render.resume=true goes on from the last checkpoint") from None
        return self._finish()

    def all_spans(self) -> list[SampleRange] | None:
        """Return the spans of the whole render, for a caller (``many.py``) that schedules their tasks.

        The caller passes each result to :meth:`task_finished`, and then calls :meth:`finish`. None if the render must run by
        :meth:`sample_all`: without kernels, with stop rules besides ``spp``, or in bounded memory.
        """
        works_between_passes = (
            self.has_checkpoint
            or self.stop_rules.has_other_rules
            or self.probes is not None
            or self.distributed is not None
            or self.wave.integrator.merging_counts  # samples come one by one, each with a radius of its own
        )
        if self.tasks is None or works_between_passes or self.settings.render.max_memory is not None:
            return None
        self.sampling_start = time.perf_counter()
        return [(self.picture, 0, self.settings.render.spp)]

    def finish(self, unfinished: list[Block]) -> Rendering:
        """Return the rendering of :meth:`all_spans`, after taking the ``unfinished`` blocks, for which memory ran out."""
        with explain_out_of_memory("a render"):
            if self.unsupported is not None:
                self._restart_by_tensors(self.unsupported)
            else:
                if unfinished:
                    assert self.tasks is not None
                    self.tasks.retry_blocks(unfinished, self.task_finished)
                self.taken = self.settings.render.spp
                self.stop_rules.update(self.taken, self.seconds_of_sampling(), None)
        return self._finish()

    def _finish(self) -> Rendering:
        mark_loaded(self._how())  # code is loaded now: later estimates of memory leave it out
        # Without a limit the memory of threads is kept for the next render.
        self.engine.release_workers(keeps=self.settings.render.max_memory is None)
        return finished_rendering(self)

    def _sample_with_fallback(self) -> None:
        """Take all samples; start again by tensor operations where a kernel cannot be made."""
        try:
            self._sample_and_resample()
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
        self.eager_reasons.append(f"all stages: {error}")
        warn_once(f"torchpt: this scene renders by tensor operations, as no kernel can be made of {error}")
        self._discarded_compile_seconds += self.engine.seconds
        self.tasks, self.engine = None, self._tensor_engine()
        self._reset()
        self._sample_and_resample()

    # -- passes

    def _sample_and_resample(self) -> None:
        """Take the samples of the picture, and then those of outliers for the error estimate."""
        self._resume()
        self._sample_picture()
        self._join_films()
        if not self.stopped_by_caller:
            self._resample_outliers()

    def _resample_outliers(self) -> None:
        """Resample outliers for the error estimate, unless that was done at this number of samples."""
        if self.probes is None or self.probes.resampled_at == self._mean_spp():
            return
        self._before_resampling = self._counts_and_light()
        from_first_rank = None if self.distributed is None else self.distributed.from_first_rank
        # The call sets `probes.resampled` too, which holds the third values of the outliers once their samples are taken.
        if not self._take_samples(self.probes.resample_outliers(self.picture.film, from_first_rank)):
            self.probes.resampled = None
        self._join_films()

    def _sample_picture(self) -> None:
        """Take passes until a rule ends the render."""
        self.sampling_start = time.perf_counter()
        while not self._is_adaptive_round() and (spp := self.stop_rules.next_pass_spp(self.taken)):
            if self.settings.adaptive:  # the first round is the same whatever render.spp and the seconds of a pass
                spp = min(spp, FIRST_ROUND - self.taken)
            spans = [(self.picture, self.taken, spp)]
            if self.probes is not None:
                spans.append((self.probes.pixel_set, self.taken, spp))
            if not self._take_samples(spans):
                return
            self.taken += spp
            self._update_stop_rules(self.taken, self.seconds_of_sampling())
            self._write_checkpoint_if_due()
        if self._is_adaptive_round():
            self._sample_adaptively()
        if not self.stopped_by_caller:
            self._write_checkpoint_if_due(last=True)

    def _is_adaptive_round(self) -> bool:
        """Return True once error probes decide where samples go."""
        return self.probes is not None and self.settings.adaptive and self.taken >= FIRST_ROUND

    def _sample_adaptively(self) -> None:
        """Take adaptive rounds, each of which doubles the samples."""
        assert self.probes is not None
        self._join_films()
        allocation = SampleAllocation(
            self.probes.pilots,
            self.picture.film,
            None if self.distributed is None else self.distributed.from_first_rank,
        )
        mean = self._mean_spp()
        while self.stop_rules.should_continue(mean):  # mean samples a pixel so far
            requested = min(2.0 * mean, float(self.settings.render.spp)) - mean
            more = self.stop_rules.affordable_spp(requested)  # mean samples a pixel of this round
            # The last round reaches `render.spp` with less than twice the samples; as no round follows, it gives out all that
            # are left.
            last = more == requested and more < mean and mean + more >= self.settings.render.spp
            spans = allocation.spans(self.picture, self.probes, mean + more, last=last)
            if not spans:  # not enough samples are left for one block
                self.stop_rules.reason = "spp" if more == requested else "time_limit"
                break
            if last and SMALL_ROUND * more < mean and not self.round_was_shortened:  # cheap to repeat, with any spp
                self._write_checkpoint_if_due(last=True)
                self._final_checkpoint_written = True
            self.round_was_shortened |= more < mean
            all_taken = self._take_samples(spans)
            self._join_films()
            allocation.merge()
            if not all_taken:
                break
            mean = self._mean_spp()
            self._update_stop_rules(mean, self.seconds_of_sampling())
            self._write_checkpoint_if_due()

    # -- checkpoints

    def films(self) -> dict[str, Film]:
        """Return all films by name."""
        films = {"picture": self.picture.film}
        films |= {f"layers.{name}": film for name, film in self.picture.layers.items()}
        return films if self.probes is None else films | {"pilots": self.probes.pixel_set.film}

    def _write_checkpoint_if_due(self, *, last: bool = False) -> None:
        """Write a checkpoint if the first rank is due to; ``last``: no samples follow, so it is due."""
        if not self.has_checkpoint or self._final_checkpoint_written:
            return
        due = self.checkpoint_file is not None and (last or self.checkpoint_file.is_due())
        if due if self.distributed is None else self.distributed.is_due(due):
            self._join_films()
            if self.checkpoint_file is not None:
                self._write_checkpoint(self.checkpoint_file)

    def _write_checkpoint(self, checkpoint_file: CheckpointFile) -> None:
        """Write a checkpoint; if that fails, warn and go on: the picture may still be written elsewhere."""
        try:
            checkpoint_file.write(self._render_state())
        except OutputError as problem:
            if not self._warned_of_checkpoint:
                print(f"torchpt: {problem}; the render goes on without it", file=sys.stderr, flush=True)
            self._warned_of_checkpoint = True

    def _render_state(self) -> RenderState:
        """Return the state for a checkpoint."""
        # Third values are not saved: after a resume outliers are resampled, so their counts are left out here.
        is_resampled = self.probes is not None and self.probes.resampled_at == self._mean_spp()
        counted, light = self._before_resampling if is_resampled else self._counts_and_light()
        # `cut` in the file: `round_was_shortened`.
        facts = {
            "taken": self.taken,
            "seconds": self.seconds_of_sampling(),
            "cut": int(self.round_was_shortened),
            **counted,
        }
        arrays = {f"{name}.{key}": value for name, film in self.films().items() for key, value in film.state().items()}
        return RenderState(facts, arrays | {"light": light})

    def _counts_and_light(self) -> tuple[dict[str, Any], Tensor]:
        """Return the counts by name, and the light before and after the clamp."""
        counts = {"done": self.done, "rays": self.ray_counts.rays, "truncated": self.ray_counts.truncated}
        return {**counts, "lost": self.nonfinite.plain()}, self.clamp_sums.clone()

    def _mean_spp(self) -> float:
        """Return the mean samples a pixel of the picture."""
        return float(self.picture.film.counts.double().mean())

    def _resume(self) -> None:
        """Restore the checkpoint if ``render.resume`` is set and there is one."""
        if not self.has_checkpoint or not self.settings.render.resume:
            return
        state = None if self.checkpoint_file is None else self._read_checkpoint(self.checkpoint_file)
        if state is None and self.checkpoint_file is not None:
            warn_once(f"torchpt: there is no checkpoint {self.checkpoint_file.path} yet: the render starts anew")
        if self.distributed is not None:
            state = self.distributed.broadcast_state(state, self._render_state())
        if state is None:
            return
        for name, film in self.films().items():
            film.restore({key: state.arrays[f"{name}.{key}"].to(self.device) for key in film.state()})
        self.nonfinite, self.clamp_sums = NonFinite.read(state.facts["lost"]), state.arrays["light"].to(self.device)
        self.taken, self.done, self.seconds_before_resume = (state.facts[name] for name in ("taken", "done", "seconds"))
        self.ray_counts.rays, self.ray_counts.truncated = state.facts["rays"], state.facts["truncated"]
        self.round_was_shortened = bool(state.facts["cut"])
        mean = self._mean_spp() if self._is_adaptive_round() else self.taken
        self._update_stop_rules(mean, self.seconds_before_resume)

    def _read_checkpoint(self, checkpoint_file: CheckpointFile) -> RenderState | None:
        """Return the validated checkpoint; None if there is none."""
        state = checkpoint_file.read(
            self._render_state(), lambda state: check_samples(self, state, checkpoint_file.path)
        )
        if state is not None:
            check_plausible(self, state, checkpoint_file.path)
        return state

    def _update_stop_rules(self, mean: float, seconds: float) -> None:
        """Update the stop rules with the samples, seconds and error so far, as the first rank has them."""
        if self.settings.render.target_error is not None:
            self._join_films()
        checks_error = self.stop_rules.checks_error(mean, adaptive=self._is_adaptive_round())
        error = self._probe_error_bound() if checks_error else None
        if self.distributed is not None:
            seconds, error = self.distributed.broadcast_numbers(seconds, error)
        target = self.settings.render.target_error
        # Resampling takes samples: only where the probes alone say that the target is reached.
        if error is not None and target is not None and error <= target:
            error = self._error_bound()
            if self.distributed is not None:
                _, error = self.distributed.broadcast_numbers(seconds, error)
            if (error is None or error > target) and not self.stopped_by_caller:
                self._undo_resampling()
        self.stop_rules.update(mean, seconds, error)

    def _join_films(self) -> None:
        """Make the films whole on every rank."""
        if self.distributed is not None:
            self.distributed.join()

    def _probe_error_bound(self) -> float:
        """Return the upper end of the interval of relMSE that the error probes give."""
        assert self.probes is not None
        return _upper_bound(self.probes.probe_estimate(self.picture.film))

    def _error_bound(self) -> float:
        """Return the upper end of the interval of relMSE after resampling outliers, which takes samples."""
        assert self.probes is not None
        self._resample_outliers()
        # Of the picture with the second samples of the probes merged in; `distrust` says why it cannot be trusted, or is empty.
        estimate, distrust = error_estimate_of(self, self.probes.picture(self.picture.film))
        return math.inf if self.stopped_by_caller or distrust else _upper_bound(estimate)

    def _undo_resampling(self) -> None:
        """Restore the counts before outliers were resampled: the picture gets more samples, and they will be again."""
        assert self.probes is not None
        counts, self.clamp_sums = self._before_resampling
        self.done, self.ray_counts = counts["done"], RayCounts(rays=counts["rays"], truncated=counts["truncated"])
        self.nonfinite = NonFinite.read(counts["lost"])
        self.probes.resampled, self.probes.resampled_at = None, None

    def geometry(self) -> Geometry:
        """Return the primitives that the search structure was built from."""
        moved = {name: value for name, value in (self.params or {}).items() if not name.startswith("camera.")}
        return self.scene.world(torch.float32, moved)[1]

    def seconds_of_sampling(self) -> float:
        """Return the seconds of sampling, without compiling kernels and writing checkpoints."""
        if self.sampling_start is None:
            return 0.0
        compiling = self.compile_seconds() - self._setup_compile_seconds  # kernels made at their first call
        elapsed = time.perf_counter() - self.sampling_start
        return self.seconds_before_resume + max(elapsed - compiling - self.write_seconds(), 0.0)

    def compile_seconds(self) -> float:
        """Return the seconds of compiling kernels since the start: of stages and of the search."""
        return (
            self._discarded_compile_seconds
            + self.engine.seconds
            + compile_time.seconds()
            - self._compile_seconds_before
        )

    def write_seconds(self) -> float:
        """Return the seconds of writing checkpoints."""
        return 0.0 if self.checkpoint_file is None else self.checkpoint_file.seconds

    # -- samples of a pass

    def _take_samples(self, spans: list[SampleRange]) -> bool:
        """Take the samples of spans (pixels, first sample, count); return True if all were taken."""
        if not spans:
            return True
        if self.distributed is None:
            return self.take_alone(spans)
        all_taken = self.distributed.take(self, spans)
        if self.settings.render.preview is not None:
            self._join_films()
            self._report_progress(0, pass_finished=True)
        return all_taken

    def take_alone(self, spans: list[SampleRange]) -> bool:
        """Take the samples of spans in this process; return True if all were taken."""
        self.paths_left = sum(pixel_set.film.width * pixel_set.film.height * samples for pixel_set, _, samples in spans)
        return self.engine.run(spans, self.task_finished)

    def task_finished(self, result: TaskResult | None) -> bool:
        """Add the counts of a finished task (None: none finished for a while); return True if the render is to stop."""
        if result is None:
            return self._report_progress(0, pass_finished=False)
        self.ray_counts.rays += result.tally.rays
        self.ray_counts.truncated += result.tally.truncated
        self._add_nonfinite(result.lost)
        if self.integrator.clamp is not None:
            self.clamp_sums += torch.tensor(result.light, dtype=torch.float64, device=self.device)
        self.paths_left -= result.samples
        pass_finished = self.paths_left == 0 and self.distributed is None
        return self._report_progress(result.samples, pass_finished=pass_finished)

    def _report_progress(self, paths: int, *, pass_finished: bool) -> bool:
        """Count ``paths`` as done and call ``on_progress``; return True if the render is to stop."""
        self.done += paths
        if self.on_progress is None or self.stopped_by_caller:  # other threads' tasks still finish after a stop
            return self.stopped_by_caller
        seconds = time.perf_counter() - self.start
        # Other ranks have traced about as many paths of this pass as this one.
        done = self.done_before_pass + self.sharing_ranks * (self.done - self.done_before_pass)
        state = Progress(
            done=done,
            total=max(self._expected_paths(), done),
            rays=self.ray_counts.rays,
            seconds=seconds,
            pass_finished=pass_finished,
            snapshot=self.snapshot,
        )
        stop_requested = bool(self.on_progress(state))
        # Between two passes that ranks share, not every rank reports, but ranks have to stop together: within a pass.
        is_between_shared_passes = self.distributed is not None and self.sharing_ranks == 1 and not paths
        if not is_between_shared_passes:
            self.stopped_by_caller = stop_requested and done < self.requested_paths()
        return self.stopped_by_caller

    def _expected_paths(self) -> int:
        """Return the expected number of paths: fewer than ``spp`` gives where time or error end the render."""
        requested = self.requested_paths()
        if not self.stop_rules.has_other_rules or self.stop_rules.progress <= 0.0:
            return max(requested, self.done)
        return max(min(requested, round(self.done / self.stop_rules.progress)), self.done)

    def requested_paths(self) -> int:
        """Return the number of paths of ``render.spp`` samples, error probes included."""
        pixels = self.width * self.height + (0 if self.probes is None else len(self.probes.pilots))
        return pixels * self.settings.render.spp

    def _add_nonfinite(self, found: NonFinite) -> None:
        """Add the non-finite samples of a task; with ``integrator.strict`` raise RenderError at the first one."""
        if found.count and self.integrator.strict:
            raise RenderError(f"integrator.strict: {describe_sample(self.scene, self.wave, found.samples[0])}")
        self.nonfinite.add(found)

    def snapshot(self) -> Rendering:
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
        on_progress: called after every chunk (the samples that are traced at once); a return value of True ends the render with
            the picture so far.
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
    small = is_small(scene, settings)
    with without_autocast(scene.device), limited_threads(settings.render.threads, small):
        with together(ranks, "what is rendered", lambda: render_fingerprint(scene, settings, params, dtype)):
            return Run(scene, settings, params, dtype, group=ranks, rays=rays).sample_all(on_progress)
