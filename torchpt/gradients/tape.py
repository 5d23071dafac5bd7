"""The plain tape: a chunk of lanes is rendered again under autograd. The reference, and what any integrator can do."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

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


# ---- What a loss asks of single samples, of what it asks of the picture's pixels


def sample_cotangents(settings: Settings, radiance: Tensor, pixels: Tensor) -> Tensor:
    """Derivatives ``(3, samples, n)`` by the radiance of samples, of those ``(3, n)`` by pixels.

    A pixel is the mean of its samples as they are :func:`clamped_samples`.

    Args:
        settings: of the backward pass.
        radiance: of the samples, likewise.
        pixels: of their pixels.
    """
    finite = torch.isfinite(radiance).all(0)
    cotangent = pixels[:, None] * (finite.to(radiance.dtype) / settings.render.spp)
    clamp = settings.integrator.clamp
    if clamp is None:
        return cotangent
    values = torch.where(finite, radiance, 0.0)
    # Of v c / m, m the largest channel: what is asked of v, and what it takes back of the channel that is m.
    most, channel = values.abs().max(0, keepdim=True)
    scale = (clamp / most.clamp_min(clamp)).squeeze(0)
    back = (cotangent * values).sum(0, keepdim=True) * scale / most.clamp_min(clamp)
    back = torch.where(most > clamp, back * values.gather(0, channel).sign(), 0.0)
    return (cotangent * scale).scatter_add(0, channel, -back)


def clamped_samples(settings: Settings, values: Tensor) -> Tensor:
    """Return samples ``(3, ...)`` as pixels count them, differentiable: none that is not finite, each within the clamp."""
    values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
    clamp = settings.integrator.clamp
    return values if clamp is None else values * clamp_scale(values, clamp)


# ---- The plain tape: a chunk of lanes is rendered again under autograd. The reference, and what any integrator can do


#: Lanes of a chunk. Always the same, as sums of others would be rounded otherwise.
LANES = {"cpu": 1 << 16, "cuda": 1 << 18}
#: Bytes of a chunk's tape where memory is not limited.
TAPE_BYTES = 1 << 29
#: Vertices of a path that memory is planned for where its depth is without end.
ASSUMED_DEPTH = 64

#: From a chunk to values that depend on the leaves of an assembly, and what is asked of them.
ChunkLoss = Callable[[Span], tuple[Tensor, Tensor]]


def tape(scene_tape: SceneTape, settings: Settings, cotangent: Tensor, sums: GradientSums) -> None:
    """Reverse mode on a plain tape, a chunk of pixels at a time: memory grows with depth, not with the picture.

    Args:
        scene_tape: what waves read.
        settings: of the backward pass.
        cotangent: derivatives by the pixels ``(3, H W)``.
        sums: what is added to.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """
    wave = scene_tape.taped

    def chunk_loss(span: Span) -> tuple[Tensor, Tensor]:
        splats: list[Splats] = []
        radiance = radiance_of(wave, *span, splats=splats)
        share = sample_cotangents(
            settings, radiance.detach(), cotangent[:, span[0] : span[0] + span[1]].to(radiance.dtype)
        )
        # What is not finite must not meet its share of 0.
        values = torch.where(torch.isfinite(radiance.detach()).all(0), radiance, 0.0)
        if not wave.integrator.splats:
            return values, share
        other = [clamped_samples(settings, one.value) for one in splats]
        pixels = torch.cat([values.new_zeros(0, dtype=torch.int64), *(one.pixel for one in splats)])
        wanted = take(cotangent, pixels).to(share.dtype) / settings.render.spp
        return torch.cat((values.flatten(1), *other), 1), torch.cat((share.flatten(1), wanted), 1)

    chunk_by_chunk(scene_tape, settings, sums, chunk_loss, wave.crop[2] * wave.crop[3], settings.render.spp)


def chunk_by_chunk(
    scene_tape: SceneTape, settings: Settings, sums: GradientSums, chunk_loss: ChunkLoss, count: int, samples: int
) -> None:
    """Add the derivatives of a part of a loss, chunk by chunk.

    Args:
        scene_tape: with the leaves.
        settings: of the backward pass.
        sums: what is added to.
        chunk_loss: makes the tape of a chunk.
        count: of what chunks are made of: pixels, say.
        samples: of each.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """

    def add(span: Span) -> None:
        sums.join(chunk_sums(scene_tape, chunk_loss, span))

    scene_tape.through(_budget(settings, scene_tape), add, count, samples)


def chunk_sums(scene_tape: SceneTape, chunk_loss: ChunkLoss, span: Span) -> GradientSums:
    """Return the sums of a chunk."""
    found = scene_tape.sums()
    with torch.enable_grad(), recording_gathers(found):
        values, cotangent = chunk_loss(span)
    if values.requires_grad:  # else nothing in these pixels depends on the parameters
        leaves = [*scene_tape.leaves, *scene_tape.captured]
        with one_thread():  # several round sums over lanes otherwise
            found.add_each(torch.autograd.grad(values, leaves, cotangent.to(values.dtype), allow_unused=True))
    return found


def _budget(settings: Settings, scene_tape: SceneTape) -> Budget:
    """Chunks of always the same size, or, where that is more than ``render.max_memory`` leaves, of what fits."""
    device, each = scene_tape.wave.centre.device, tape_per_lane(settings)
    lanes = min(LANES.get(device.type, LANES["cpu"]), max(TAPE_BYTES // each, 1))
    limit = settings.render.max_memory
    budget = Budget(device, lanes, what="the tape of a single lane", limit=limit, per_lane=each)
    budget.drop_unneeded_limit()
    return budget


def tape_per_lane(settings: Settings) -> int:
    """Bytes that the tape of a lane is expected to take: each vertex keeps about what a lane takes without one."""
    limits = settings.integrator.limits
    return BYTES_PER_LANE * max(limits.max_depth if 0 <= limits.max_depth < ASSUMED_DEPTH else ASSUMED_DEPTH, 1)
