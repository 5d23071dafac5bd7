"""Chunks of a backward pass over threads, by kernels: sums are joined in the order of chunks, whichever thread took them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

from torchpt.adjoint.assembly import Assembly
from torchpt.adjoint.replay import replay
from torchpt.adjoint.sums import ChunkSums, Sums
from torchpt.adjoint.sweep import KEPT, Sweep
from torchpt.engines.kernels.chunk import LANES, Chunk
from torchpt.engines.kernels.joint_kernels import JointKernels
from torchpt.forward.schedule import Span
from torchpt.forward.waves import say_once
from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.graph import Unsupported
from torchpt.scene import Scene
from torchpt.settings import Settings
from torchpt.shortage import ran_out

__all__ = ["compiled_replay"]


def compiled_replay(scene: Scene, assembly: Assembly, settings: Settings, asked: Tensor, sums: Sums) -> None:
    """As :func:`torchpt.adjoint.replay.replay`, by kernels where these can be made.

    Args:
        scene: what is rendered.
        assembly: what waves read.
        settings: of the backward pass.
        asked: derivatives by the pixels ``(3, H W)``.
        sums: what is added to.
    """
    if not _looped(assembly, settings):
        replay(assembly, settings, asked, sums)
        return
    wave = assembly.wave
    packets = wave.accel.name == "brute" and not wave.context.world.geometry.counts[4]
    splats = wave.integrator.splats
    cotangent = (asked.float() / settings.render.spp).contiguous() if splats else None
    kernels = JointKernels(wave, assembly.taped, assembly.plain, assembly.leaves, packets, cotangent)
    models = wave.context.world.materials.models
    kernels.eager = kernels.probe([k for k, model in enumerate(models) if any(model is x for x in scene.own_models)])
    threads = _threads(kernels, settings)
    blocks = assembly.blocks(wave.crop[2] * wave.crop[3], settings.render.spp)
    chunks = [Chunk(*span) for span in _spans(blocks, settings.render.spp)]
    sweeps: list[Sweep] = []
    lock = threading.Lock()

    def task(chunk: Chunk) -> ChunkSums:
        with lock:
            sweep = sweeps.pop() if sweeps else Sweep(kernels, assembly, settings)
        with torch.no_grad():
            pixels = asked[:, chunk.first_pixel : chunk.first_pixel + chunk.pixels].float()
            found = sweep.run(chunk, pixels, sums if threads == 1 else None)
        with lock:
            sweeps.append(sweep)
        return found

    reason = ""
    try:
        for part in _in_order(task, chunks, threads):
            sums.merge(part)
    except Exception as error:
        if not isinstance(error, Unsupported) and not ran_out(error):
            raise
        reason = f"no kernel can be made of {error}" if isinstance(error, Unsupported) else "memory ran out"
    for stage, why in kernels.back_eager.items():
        model = f" at {models[stage[1]]}" if stage[0] == "bounce" else ""
        say_once(
            f"torchpt: {stage[0]}{model} is differentiated by tensor operations, as no kernel can be made of {why}"
        )
    if reason:
        say_once(f"torchpt: gradients of this scene are taken by tensor operations, as {reason}")
        sweeps.clear()
        sums.clear()
        replay(assembly, settings, asked, sums)


def _in_order(task: Callable[[Chunk], ChunkSums], chunks: Sequence[Chunk], threads: int) -> Iterator[ChunkSums]:
    """Yield what a task gives for chunks, in their order, by some threads."""
    if threads == 1:
        yield from map(task, chunks)
        return
    waiting: deque[Future[ChunkSums]] = deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix="torchpt")
    try:
        for chunk in chunks:
            waiting.append(pool.submit(task, chunk))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _spans(blocks: Sequence[tuple[int, int]], samples: int) -> Iterator[Span]:
    """The chunks of blocks of pixels, first and how many: always the same."""
    for sample in range(0, samples, LANES):
        count = min(LANES, samples - sample)
        step = max(LANES // count, 1)
        for start, pixels in blocks:
            for pixel in range(start, start + pixels, step):
                yield pixel, min(step, start + pixels - pixel), sample, count


def _threads(kernels: JointKernels, settings: Settings) -> int:
    """Return how many threads there are, fewer where the arenas of all would take more than half of ``render.max_memory``."""
    threads, limit = torch.get_num_threads(), settings.render.max_memory
    if limit is None:
        return threads
    depth = settings.integrator.limits.max_depth
    levels = min(depth, KEPT) if depth >= 0 else KEPT
    return max(1, min(threads, limit // (8 * CAPACITY * (levels + 2) * (kernels.state.count + kernels.models + 2))))


def _looped(assembly: Assembly, settings: Settings) -> bool:
    """Return True where kernels may be made: on a CPU, in float32, without derivatives by weights of modules or opacity."""
    wave = assembly.wave
    plan = wave.context.plan
    if wave.centre.device.type != "cpu" or plan.dtype != torch.float32 or settings.render.compile == "off":
        return False
    return not assembly.held and not assembly.passing
