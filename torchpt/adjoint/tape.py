"""The plain tape: a chunk of lanes is rendered again under autograd. The reference, and what any integrator can do."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.adjoint.assembly import Assembly
from torchpt.adjoint.samples import asked_of
from torchpt.adjoint.sums import Sums
from torchpt.forward.schedule import BYTES_PER_LANE, Span, budget_of
from torchpt.forward.waves import Waves
from torchpt.math.gathers import gathered_by
from torchpt.settings import Settings

__all__ = ["tape", "tape_per_lane"]

#: Bytes of a chunk's tape where memory is not limited.
TAPE = 1 << 29
#: Vertices of a path that memory is planned for where its depth is without end.
LONGEST = 64


def tape(assembly: Assembly, settings: Settings, asked: Tensor, sums: Sums) -> None:
    """Reverse mode on a plain tape, a chunk of pixels at a time: memory grows with depth, not with the picture.

    Args:
        assembly: what waves read.
        settings: of the backward pass.
        asked: derivatives by the pixels ``(3, H W)``.
        sums: what is added to.

    Raises:
        RenderError: not even the tape of a single lane fits in memory.
    """
    wave = assembly.taped

    def whole(span: Span) -> None:
        sums.join(piece(assembly, settings, asked, span))

    budget = budget_of(settings, wave.centre.device, tape_per_lane(settings))
    budget.most = min(budget.most, max(TAPE // tape_per_lane(settings), 1))
    assembly.through(
        Waves(budget, "the tape of a single lane"), whole, wave.crop[2] * wave.crop[3], settings.render.spp
    )


def piece(assembly: Assembly, settings: Settings, asked: Tensor, span: Span) -> Sums:
    """The sums of a chunk."""
    sums, wave = assembly.sums(), assembly.taped
    with torch.enable_grad(), gathered_by(sums):
        radiance, _ = wave.radiance(*span)
    if not radiance.requires_grad:  # nothing in these pixels depends on the parameters
        return sums
    share = asked_of(settings, radiance.detach(), asked[:, span[0] : span[0] + span[1]].to(radiance.dtype))
    with torch.enable_grad():  # what is not finite must not meet its share of 0
        radiance = torch.where(torch.isfinite(radiance.detach()).all(0), radiance, 0.0)
    found = torch.autograd.grad(radiance, [*assembly.leaves, *assembly.held], share, allow_unused=True)
    for number, gradient in enumerate(found):
        if gradient is not None:
            sums.add(number, gradient)
    return sums


def tape_per_lane(settings: Settings) -> int:
    """Bytes that the tape of a lane is expected to take: each vertex keeps about what a lane takes without one."""
    limits = settings.integrator.limits
    return BYTES_PER_LANE * max(limits.max_depth if 0 <= limits.max_depth < LONGEST else LONGEST, 1)
