"""Path replay backpropagation: paths are traced again from their random numbers, and differentiated vertex by vertex.

The forward half of a replay needs no tape: it keeps the path states of the vertices, and each vertex is differentiated alone,
from the last to the first. If a walk has more vertices than an engine keeps, it is split at marks (checkpoints of the path
state), and each part is traced again; a part that is still too long is split in turn. With at most :data:`MARKS` marks a level,
memory grows with the logarithm of the depth.

A population is an engine's record of all paths of a chunk at one vertex; a chunk, or span, is first pixel, number of pixels,
first sample and number of samples. The VJP of a vertex takes the cotangents of the rays that leave it, adds to the gradient
sums of the parameters, and gives the cotangents of the rays that come to it.

Vicini, Speierer, Jakob 2021, *Path Replay Backpropagation*; for the marks Griewank, Walther 2000, *Revolve*.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.core.errors import warn_once
from torchpt.core.memory import Budget, Span, free_memory, is_out_of_memory, release_memory
from torchpt.core.threads import map_in_order, thread_count
from torchpt.engines.engine import (
    LANES_OF_KERNELS,
    Backward,
    BackwardDevice,
    BackwardKernels,
    Kernels,
    backward_kernels,
    backward_tensors,
    device_backward,
)
from torchpt.gradients.parameters import SceneTape
from torchpt.gradients.tape import budget_of_chunks, sample_cotangents
from torchpt.math.sums import ChunkGradientSums, GradientSums
from torchpt.paths.walk import KEPT, Counts, Observer, Population, walk
from torchpt.paths.wave import Wave
from torchpt.scene import Scene
from torchpt.scene.memory_estimate import BYTES_PER_LANE
from torchpt.scene.prepare import own_models, scene_cache, uses_kernels
from torchpt.scene.settings import Settings

__all__ = ["replay_paths"]

#: Lanes of a chunk of tensors, by device. Fixed, since sums over other chunks would round differently.
LANES = {"cpu": 1 << 16, "cuda": 1 << 20}
#: Bytes of a lane at a vertex that is kept: path state, hit, and its lists of lanes by model.
BYTES_PER_VERTEX = 240
#: Numbers of chunks that kernels of a device trace at once.
CHUNKS_OF_WAVE = (1, 4, 16, 64, 256)
#: Waves of several chunks have fewer lanes than this many times the number of samples.
MAX_LANES_PER_SAMPLE = 4
#: Greatest number of marks of a walk; where there are more, every other one is dropped.
MARKS = 8


# ---- A chunk: forward, and back


class VertexRecorder(Observer[Any]):
    """Records the populations of a walk; of a walk with more vertices than an engine keeps, marks instead.

    Args:
        engine: the engine of the walk.
        first: number of the vertex that the walk starts at.
        mark: the mark of that vertex; None: the walk starts with camera rays.

    Attributes:
        kept: the populations, one a vertex; empty if there are marks.
        marks: numbers of vertices and their marks, the first of the walk included; empty if all vertices were kept.
    """

    def __init__(self, engine: Backward[Any, Any, Any], first: int, mark: Any) -> None:
        self.kept: list[Any] = []
        self.marks: list[tuple[int, Any]] = []
        self._engine, self._first_vertex, self._first_mark, self._vertices_per_mark = engine, first, mark, KEPT

    def on_hits(self, paths: Population) -> bool:
        """See :class:`Observer`."""
        vertices = paths.depth - self._first_vertex
        if vertices > 0 and vertices % self._vertices_per_mark == 0:
            self.marks = self.marks or [(self._first_vertex, self._first_mark)]
            self.marks.append((paths.depth, self._engine.mark(paths)))
            self.kept.clear()
            if len(self.marks) > MARKS:
                self.marks, self._vertices_per_mark = self.marks[::2], 2 * self._vertices_per_mark
        return False

    def on_sorted(self, paths: Population, counts: Counts) -> bool:
        """See :class:`Observer`."""
        if not self.marks:
            self.kept.append(paths)
        return False


class Chunk:
    """Replays a chunk of samples.

    Args:
        engine: the backward engine.
        settings: of the backward pass.
        span: pixels and samples of the chunk.
        sums: gradient sums to add to.
    """

    def __init__(self, engine: Backward[Any, Any, Any], settings: Settings, span: Span, sums: Any) -> None:
        self.engine, self.settings, self.span, self.sums = engine, settings, span, sums

    def run(self, pixels: Tensor) -> None:
        """Add the gradients of the chunk for cotangents ``pixels (3, H W)`` of the picture."""
        first, count, _, samples = self.span
        with torch.no_grad():
            recorder = self._trace(first=1, mark=None, end=None)
            radiance = self.engine.radiance_of_samples().view(3, samples, -1)
            cotangent = sample_cotangents(self.settings, radiance, pixels[:, first : first + count].to(radiance.dtype))
            self.engine.receive(cotangent.reshape(3, -1))
            self._differentiate(recorder, end=None)
            self.engine.vjp_rays()

    def _trace(self, *, first: int, mark: Any, end: int | None) -> VertexRecorder:
        """Trace paths from vertex ``first`` and its mark (None: from the camera) to vertex ``end`` (None: to their ends)."""
        paths = self.engine.begin(self.span, self.sums) if mark is None else self.engine.resume(mark)
        recorder = VertexRecorder(self.engine, first, mark)
        walk(self.engine, paths, self.engine.wave.integrator.limits, recorder, end)
        return recorder

    def _differentiate(self, recorder: VertexRecorder, *, end: int | None) -> None:
        """Differentiate the recorded vertices, last first, or replay the walk from mark to mark, up to vertex ``end``."""
        for paths in reversed(recorder.kept):
            self.engine.vjp(paths)
        recorder.kept.clear()
        while recorder.marks:
            first, mark = recorder.marks.pop()
            self._differentiate(self._trace(first=first, mark=mark, end=end), end=end)
            end = first


# ---- All chunks: by kernels on threads if possible, else one after the other by tensor operations


def replay_paths(
    scene: Scene, scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums
) -> None:
    """Add the gradients of a render to ``sums`` by path replay; memory hardly grows with depth.

    Sums of chunks are merged in the order of chunks, independent of threads. Chunks of tensor operations have fewer lanes only
    where ``render.max_memory`` needs it or an allocation failed.

    Args:
        scene: the scene.
        scene_tape: the wave and its leaves.
        settings: of the backward pass.
        cotangent: of the pixels ``(3, H W)``.
        sums: gradient sums to add to.

    Raises:
        RenderError: not even a single lane fits in memory.
    """
    wave = scene_tape.wave
    # A splat reaches a pixel by itself: its cotangent is the pixel's over spp.
    # A tensor: a GPU multiplies by the reciprocal of a number.
    samples = torch.full((), settings.render.spp, device=cotangent.device)
    splat_cotangent = cotangent / samples if wave.integrator.splats else None
    if _uses_kernels(scene_tape, settings):
        own = own_models(scene, wave)
        if wave.centre.device.type == "cpu":
            kernels = backward_kernels(scene_tape, own, splat_cotangent, scene_cache(scene).kernel_caches)
            reason = _replay_on_threads(kernels, scene_tape, settings, cotangent, sums)
            _warn_of_eager_vjps(kernels, wave)
        else:
            before = scene_cache(scene).kernels
            reason = _replay_on_device(own, scene_tape, settings, cotangent, splat_cotangent, sums, before)
        if not reason:
            return
        warn_once(f"torchpt: gradients of this scene are taken by tensor operations, as {reason}")
        sums.clear()

    def add_chunk(span: Span) -> None:
        sums.join(chunk_sums(scene_tape, settings, cotangent, splat_cotangent, span))

    budget = _budget_of_tensors(wave.centre.device, settings)
    _, _, width, height = wave.crop
    scene_tape.run_in_chunks(budget, add_chunk, width * height, settings.render.spp)


def chunk_sums(
    scene_tape: SceneTape, settings: Settings, cotangent: Tensor, splat_cotangent: Tensor | None, span: Span
) -> GradientSums:
    """Return the gradient sums of a chunk, by tensor operations.

    Args:
        scene_tape: the wave and its leaves.
        settings: of the backward pass.
        cotangent: of the pixels ``(3, H W)``.
        splat_cotangent: of a splat to each pixel ``(3, H W)``; None: the integrator makes none.
        span: pixels and samples of the chunk.
    """
    sums = scene_tape.sums()
    engine = backward_tensors(scene_tape, splat_cotangent)
    Chunk(engine, settings, span, sums).run(cotangent)
    return sums


def _warn_of_eager_vjps(kernels: BackwardKernels | BackwardDevice, wave: Wave) -> None:
    """Warn of stages whose VJP cannot be compiled."""
    models = wave.context.world.materials.models
    for (stage, *details), why in kernels.eager_vjps.items():
        model = f" at {models[details[0]]}" if stage == "bounce" else ""
        warn_once(f"torchpt: {stage}{model} is differentiated by tensor operations, as no kernel can be made of {why}")


def _replay_on_device(
    own: Sequence[int],
    scene_tape: SceneTape,
    settings: Settings,
    cotangent: Tensor,
    splat_cotangent: Tensor | None,
    sums: GradientSums,
    before: Kernels | None,
) -> str:
    """Replay all chunks by kernels on a device, many at once; return why that is not possible, or "".

    Sums are those of chunks whatever the number of lanes, so that waves of fewer lanes, where memory is short, change no bit.
    """
    wave, spp, cotangent = scene_tape.wave, settings.render.spp, cotangent.float()
    _, _, width, height = wave.crop
    blocks = scene_tape.blocks(width * height, spp)
    samples = spp * sum(pixels for _, pixels in blocks)
    fewest, *larger = (LANES_OF_KERNELS * chunks for chunks in CHUNKS_OF_WAVE)
    sizes = [fewest, *(size for size in larger if size < MAX_LANES_PER_SAMPLE * samples)]

    def replay(lanes: int, last: bool) -> bool:
        """Replay all chunks in waves of so many lanes; return False, and do nothing, if memory is too short for them."""
        by_kernels = settings.render.search_by_kernels
        kernels = device_backward(scene_tape, own, splat_cotangent, by_kernels, lanes, before)
        if not last and not _fits(kernels, wave.centre.device, settings):
            return False
        engine = kernels.engine()
        for span in _spans(blocks, spp, lanes // LANES_OF_KERNELS):
            wave_sums = kernels.wave_sums(sums, LANES_OF_KERNELS)
            Chunk(engine, settings, span, wave_sums).run(cotangent)
            wave_sums.merge_into_whole()
        _warn_of_eager_vjps(kernels, wave)
        return True

    while sizes:
        lanes = sizes.pop()
        try:
            if replay(lanes, last=not sizes):
                return ""
            continue
        except Unsupported as error:
            return f"no kernel can be made of {error}"
        except Exception as error:
            if not is_out_of_memory(error):
                raise
        sums.clear()
        release_memory()
    return "memory ran out"


def _fits(kernels: BackwardDevice, device: torch.device, settings: Settings) -> bool:
    """Return True if the paths of a wave take at most half of the free memory, and of ``render.max_memory``."""
    bounds = [bound for bound in (free_memory(device), settings.render.max_memory) if bound is not None]
    return kernels.lanes * kernels.bytes_per_lane(_kept_vertices(settings)) <= min(bounds, default=sys.maxsize) // 2


def _replay_on_threads(
    kernels: BackwardKernels, scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums
) -> str:
    """Replay all chunks by kernels on threads; return why that is not possible, or ""."""
    wave, cotangent = scene_tape.wave, cotangent.float()
    budget = _budget_of_kernels(kernels, settings)
    _, _, width, height = wave.crop
    blocks = scene_tape.blocks(width * height, settings.render.spp)
    engines: list[Backward[Any, Any, Any]] = []  # those that no thread uses
    lock = threading.Lock()
    is_single = settings.render.spp * sum(pixels for _, pixels in blocks) <= LANES_OF_KERNELS  # a single chunk

    def task(span: Span) -> ChunkGradientSums:
        with lock:
            engine = engines.pop() if engines else kernels.engine()
        chunk = ChunkGradientSums(scene_tape.tables, sums if budget.threads == 1 else None)
        Chunk(engine, settings, span, chunk).run(cotangent)
        with lock:
            engines.append(engine)
        return chunk

    def merge(chunk: ChunkGradientSums | None) -> bool:
        if chunk is not None:
            sums.merge(chunk)
        return False  # True would stop the threads

    kernels.prefetch(budget.threads)
    try:
        while True:
            try:
                spans = _spans(blocks, settings.render.spp)
                map_in_order(spans, task, budget.threads, merge, ahead=2 * budget.threads, here=is_single)
                return ""
            except Unsupported as error:
                return f"no kernel can be made of {error}"
            except Exception as error:
                if not is_out_of_memory(error):
                    raise
            engines.clear()
            sums.clear()
            if budget.threads == 1:
                return "memory ran out"
            budget.shrink()
    finally:
        # Without a limit the memory of threads is kept for the next pass.
        kernels.release(engines if settings.render.max_memory is None else ())


def _budget_of_tensors(device: torch.device, settings: Settings) -> Budget:
    """Return the budget of a chunk: a fixed number of lanes, or fewer where ``render.max_memory`` needs it."""
    # One vertex at a time is on a tape, which takes about as much as a wave does.
    per_lane = 2 * BYTES_PER_LANE + BYTES_PER_VERTEX * _kept_vertices(settings)
    lanes, limit = LANES.get(device.type, LANES["cpu"]), settings.render.max_memory
    return budget_of_chunks(device, lanes, what="the vertices of a single lane", limit=limit, per_lane=per_lane)


def _kept_vertices(settings: Settings) -> int:
    """Return the greatest number of vertices that are kept at once."""
    depth = settings.integrator.limits.max_depth
    return min(depth, KEPT) if depth >= 0 else KEPT


def _spans(blocks: Sequence[tuple[int, int]], samples: int, chunks: int = 1) -> Iterator[Span]:
    """Yield the chunks of blocks of pixels, given by first pixel and number; they do not depend on threads.

    ``chunks``: number of consecutive chunks that make one span.
    """
    for sample in range(0, samples, LANES_OF_KERNELS):
        count = min(LANES_OF_KERNELS, samples - sample)
        step = chunks * max(LANES_OF_KERNELS // count, 1)
        for start, pixels in blocks:
            for pixel in range(start, start + pixels, step):
                yield pixel, min(step, start + pixels - pixel), sample, count


def _budget_of_kernels(kernels: BackwardKernels, settings: Settings) -> Budget:
    """Return the budget of threads: fewer than torch has if their arenas would take more than half of ``render.max_memory``."""
    threads = thread_count(None)
    budget = Budget(torch.device("cpu"), LANES_OF_KERNELS, threads, what="a gradient", fallback="one thread")
    limit = settings.render.max_memory
    if limit is not None:
        budget.fit(limit // 2, kernels.bytes_per_lane(_kept_vertices(settings)), LANES_OF_KERNELS)
    return budget


def _uses_kernels(scene_tape: SceneTape, settings: Settings) -> bool:
    """Return True if kernels support this: float32, no gradients with respect to weights of modules or opacity."""
    wave = scene_tape.wave
    device, dtype = wave.centre.device, wave.context.plan.dtype
    if dtype != torch.float32 or not uses_kernels(settings, device, dtype):
        return False
    return not scene_tape.captured and not scene_tape.differentiates_opacity
