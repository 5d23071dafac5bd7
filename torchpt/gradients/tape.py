"""``adjoint=autograd``: chunks of lanes rendered again on an autograd tape. The reference, for any integrator.

A chunk, or span, is what is on the tape at once: first pixel, number of pixels, first sample, number of samples of each. The
scene's tape (``parameters.py``) has the wave (world, camera, integrator) whose tensors are the leaves of these tapes.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
from torchpt.core.memory import Budget, Span
from torchpt.core.threads import one_thread
from torchpt.engines.engine import radiance as radiance_of
from torchpt.gradients.parameters import SceneTape
from torchpt.math.gathers import recording_gathers
from torchpt.math.sums import GradientSums
from torchpt.math.vectors import take
from torchpt.paths.wave import clamp_scale
from torchpt.physics.film.splats import Splats
from torchpt.scene.memory_estimate import BYTES_PER_LANE
from torchpt.scene.settings import Settings

__all__ = ["chunk_by_chunk", "clamped_samples", "sample_cotangents", "tape", "tape_per_lane"]


# ---- From cotangents of pixels to cotangents of samples


def sample_cotangents(settings: Settings, radiance: Tensor, pixels: Tensor) -> Tensor:
    """Return the cotangents of samples ``(3, samples, n)`` from those of their pixels.

    A pixel is the mean of its :func:`clamped_samples`.

    Args:
        settings: of the backward pass.
        radiance: of the samples ``(3, samples, n)``.
        pixels: cotangents of the pixels ``(3, n)``.
    """
    finite = torch.isfinite(radiance).all(0)
    # A tensor: a GPU multiplies by the reciprocal of a number.
    count = torch.full((), settings.render.spp, dtype=radiance.dtype, device=radiance.device)
    cotangent = pixels[:, None] * (finite.to(radiance.dtype) / count)
    clamp = settings.integrator.clamp
    if clamp is None:
        return cotangent
    values = torch.where(finite, radiance, 0.0)
    # VJP of v c / m, with the clamp c, where m is the largest channel in magnitude: `cotangent * scale` through v, and
    # `through_largest` through the channel that is m.
    largest, channel = values.abs().max(0, keepdim=True)
    scale = (clamp / largest.clamp_min(clamp)).squeeze(0)
    through_largest = (cotangent * values).sum(0, keepdim=True) * scale / largest.clamp_min(clamp)
    through_largest = torch.where(largest > clamp, through_largest * values.gather(0, channel).sign(), 0.0)
    return (cotangent * scale).scatter_add(0, channel, -through_largest)


def clamped_samples(settings: Settings, values: Tensor) -> Tensor:
    """Return samples ``(3, ...)`` as they are added to pixels, differentiable: clamped, and 0 where not finite."""
    values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
    clamp = settings.integrator.clamp
    return values if clamp is None else values * clamp_scale(values, clamp)


# ---- The tape, a chunk at a time


#: Lanes of a chunk by device. Fixed, since sums over other chunks would round differently.
LANES = {"cpu": 1 << 16, "cuda": 1 << 18}
#: Bytes that a chunk's tape may take (512 MiB), if ``render.max_memory`` does not set less.
TAPE_BYTES = 1 << 29
#: Most vertices of a path that memory is estimated for, also if ``max_depth`` is -1: hardly a path is longer.
ASSUMED_DEPTH = 64

#: Maps a chunk to values that depend on the leaves of a tape, and their cotangents.
ChunkLoss = Callable[[Span], tuple[Tensor, Tensor]]


def tape(scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums) -> None:
    """Add the gradients of a render to ``sums``, on an autograd tape a chunk at a time: memory grows with depth.

    Args:
        scene_tape: the wave and its leaves.
        settings: of the backward pass.
        cotangent: of the pixels ``(3, H W)``.
        sums: gradient sums to add to.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """
    wave = scene_tape.taped

    def chunk_loss(span: Span) -> tuple[Tensor, Tensor]:
        splats: list[Splats] = []
        first_pixel, pixel_count, _, _ = span
        radiance = radiance_of(wave, *span, splats=splats)
        pixel_cotangents = cotangent[:, first_pixel : first_pixel + pixel_count].to(radiance.dtype)
        cotangents = sample_cotangents(settings, radiance.detach(), pixel_cotangents)
        # Samples that are not finite are 0, since NaN times a cotangent of 0 is NaN.
        values = torch.where(torch.isfinite(radiance.detach()).all(0), radiance, 0.0)
        if not wave.integrator.splats:
            return values, cotangents
        # A splat is clamped on the tape, so its cotangent is that of its pixel over spp.
        splatted = [clamped_samples(settings, splat.value) for splat in splats]
        pixels = torch.cat([values.new_zeros(0, dtype=torch.int64), *(splat.pixel for splat in splats)])
        splat_cotangents = take(cotangent, pixels).to(cotangents.dtype) / settings.render.spp
        return torch.cat((values.flatten(1), *splatted), 1), torch.cat((cotangents.flatten(1), splat_cotangents), 1)

    _, _, width, height = wave.crop
    chunk_by_chunk(scene_tape, settings, sums, chunk_loss, count=width * height, samples=settings.render.spp)


def chunk_by_chunk(
    scene_tape: SceneTape, settings: Settings, sums: GradientSums, chunk_loss: ChunkLoss, count: int, samples: int
) -> None:
    """Add the gradients of values with known cotangents to ``sums``, chunk by chunk.

    Args:
        scene_tape: the wave and its leaves.
        settings: of the backward pass.
        sums: gradient sums to add to.
        chunk_loss: returns the values of a chunk and their cotangents.
        count: number of items that chunks are made of, such as pixels.
        samples: number of samples of each item.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """

    def add(span: Span) -> None:
        sums.join(chunk_sums(scene_tape, chunk_loss, span))

    scene_tape.run_in_chunks(_budget(settings, scene_tape), add, count, samples)


def chunk_sums(scene_tape: SceneTape, chunk_loss: ChunkLoss, span: Span) -> GradientSums:
    """Return the gradient sums of a chunk."""
    chunk = scene_tape.sums()
    # Backward passes of gathers from the leaves add to the sums directly; autograd returns the other gradients.
    with torch.enable_grad(), recording_gathers(chunk):
        values, cotangent = chunk_loss(span)
    if values.requires_grad:  # False: nothing in these pixels depends on the parameters
        leaves = [*scene_tape.leaves, *scene_tape.captured]
        with one_thread():  # several threads would round sums over lanes in another way
            chunk.add_each(gradients_of([values], leaves, [cotangent.to(values.dtype)]))
    return chunk


def _budget(settings: Settings, scene_tape: SceneTape) -> Budget:
    """Return the budget of a chunk: a fixed number of lanes, or fewer where ``render.max_memory`` needs it."""
    device, per_lane = scene_tape.wave.centre.device, tape_per_lane(settings)
    lanes = min(LANES.get(device.type, LANES["cpu"]), max(TAPE_BYTES // per_lane, 1))
    limit = settings.render.max_memory
    return budget_of_chunks(device, lanes, what="the tape of a single lane", limit=limit, per_lane=per_lane)


def budget_of_chunks(device: torch.device, lanes: int, *, what: str, limit: int | None, per_lane: int) -> Budget:
    """Return a budget of ``lanes`` a chunk, and of fewer only if the limit needs it: sums of other chunks round differently.

    Args:
        device: of the lanes.
        lanes: number of lanes of a chunk.
        what: names, in the error, what does not fit even with a single lane.
        limit: ``render.max_memory`` in bytes; None: no limit.
        per_lane: expected bytes of a lane.
    """
    budget = Budget(device, lanes, what=what, limit=limit, bytes_per_lane=per_lane)
    budget.drop_unneeded_limit()
    return budget


def tape_per_lane(settings: Settings) -> int:
    """Return an estimate of the bytes of one lane's tape: each vertex stores about what a lane takes without a tape."""
    limits = settings.integrator.limits
    return BYTES_PER_LANE * max(limits.max_depth if 0 <= limits.max_depth < ASSUMED_DEPTH else ASSUMED_DEPTH, 1)
