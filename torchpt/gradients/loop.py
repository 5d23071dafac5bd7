"""Chunks of a backward pass over threads, by kernels: sums are joined in the order of chunks, whichever thread took them."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchpt.compiler.form import CAPACITY
from torchpt.compiler.graph import Unsupported
from torchpt.core.errors import warn_once
from torchpt.core.memory import Budget, Span, is_out_of_memory
from torchpt.core.threads import deal
from torchpt.engines.kernels.backward import VjpKernels
from torchpt.engines.kernels.engine import LANES, Chunk
from torchpt.gradients.parameters import SceneTape
from torchpt.gradients.replay import replay
from torchpt.gradients.sums import ChunkSums, Sums
from torchpt.gradients.sweep import KEPT, Sweep
from torchpt.scene import Scene
from torchpt.scene.prepare import own_models, packets_of
from torchpt.scene.settings import Settings

__all__ = ["compiled_replay"]


def compiled_replay(scene: Scene, assembly: SceneTape, settings: Settings, asked: Tensor, sums: Sums) -> None:
    """As :func:`torchpt.gradients.replay.replay`, by kernels where these can be made.

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
    splats = wave.integrator.splats
    cotangent = (asked.float() / settings.render.spp).contiguous() if splats else None
    kernels = VjpKernels(wave, assembly.taped, assembly.plain, assembly.leaves, packets_of(wave), cotangent)
    models = wave.context.world.materials.models
    kernels.eager = kernels.probe(own_models(scene, wave))
    budget = _budget(kernels, settings)
    blocks = assembly.blocks(wave.crop[2] * wave.crop[3], settings.render.spp)
    chunks = [Chunk(*span) for span in _spans(blocks, settings.render.spp)]
    sweeps: list[Sweep] = []
    lock = threading.Lock()

    def task(chunk: Chunk) -> ChunkSums:
        with lock:
            sweep = sweeps.pop() if sweeps else Sweep(kernels, assembly, settings)
        with torch.no_grad():
            pixels = asked[:, chunk.first_pixel : chunk.first_pixel + chunk.pixels].float()
            found = sweep.run(chunk, pixels, sums if budget.threads == 1 else None)
        with lock:
            sweeps.append(sweep)
        return found

    def merge(part: ChunkSums | None) -> bool:
        if part is not None:
            sums.merge(part)
        return False

    reason = ""
    while not reason:
        try:
            deal(chunks, task, budget.threads, merge, ahead=2 * budget.threads)
            break
        except Exception as error:
            if not isinstance(error, Unsupported) and not is_out_of_memory(error):
                raise
            reason = f"no kernel can be made of {error}" if isinstance(error, Unsupported) else "memory ran out"
        sweeps.clear()
        sums.clear()
        if reason == "memory ran out" and budget.threads > 1:
            budget.shrink()
            reason = ""
    for stage, why in kernels.eager_vjps.items():
        model = f" at {models[stage[1]]}" if stage[0] == "bounce" else ""
        warn_once(
            f"torchpt: {stage[0]}{model} is differentiated by tensor operations, as no kernel can be made of {why}"
        )
    if reason:
        warn_once(f"torchpt: gradients of this scene are taken by tensor operations, as {reason}")
        replay(assembly, settings, asked, sums)


def _spans(blocks: Sequence[tuple[int, int]], samples: int) -> Iterator[Span]:
    """Yield the chunks of blocks of pixels, first and how many: always the same."""
    for sample in range(0, samples, LANES):
        count = min(LANES, samples - sample)
        step = max(LANES // count, 1)
        for start, pixels in blocks:
            for pixel in range(start, start + pixels, step):
                yield pixel, min(step, start + pixels - pixel), sample, count


def _budget(kernels: VjpKernels, settings: Settings) -> Budget:
    """Return how many threads there are, fewer where the arenas of all would take more than half of ``render.max_memory``."""
    budget = Budget(torch.device("cpu"), CAPACITY, torch.get_num_threads(), what="a gradient", instead="one thread")
    limit, depth = settings.render.max_memory, settings.integrator.limits.max_depth
    if limit is not None:
        levels = min(depth, KEPT) if depth >= 0 else KEPT
        budget.fit(limit // 2, 4 * (levels + 2) * (kernels.state.count + kernels.models + 2), CAPACITY)
    return budget


def _looped(assembly: SceneTape, settings: Settings) -> bool:
    """Return True where kernels may be made: on a CPU, in float32, without derivatives by weights of modules or opacity."""
    wave = assembly.wave
    plan = wave.context.plan
    if wave.centre.device.type != "cpu" or plan.dtype != torch.float32 or settings.render.compile == "off":
        return False
    return not assembly.held and not assembly.differentiates_opacity
