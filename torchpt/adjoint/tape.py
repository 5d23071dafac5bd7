"""The plain tape: a chunk of lanes is rendered again under autograd. The reference, and what any integrator can do."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.adjoint.assembly import Assembly
from torchpt.adjoint.samples import asked_of
from torchpt.adjoint.sums import Sums
from torchpt.forward.schedule import BYTES_PER_LANE, lanes_for, pieces
from torchpt.math.gathers import gathered_by
from torchpt.settings import Settings

__all__ = ["tape"]

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
    """
    wave = assembly.taped
    limits = wave.limits
    depth = 1 if limits is None or limits.max_depth == 0 else limits.max_depth
    bytes_ = BYTES_PER_LANE * (depth if 0 <= depth < LONGEST else LONGEST)
    lanes = min(lanes_for(settings, wave.centre.device, bytes_), max(TAPE // bytes_, 1))
    pixels = wave.crop[2] * wave.crop[3]
    tensors = [*assembly.leaves, *assembly.held]
    for first, count, sample, samples in pieces(lanes, pixels, 0, settings.render.spp):
        with torch.enable_grad(), gathered_by(sums):
            radiance, _ = wave.radiance(first, count, sample, samples)
        if not radiance.requires_grad:  # nothing in these pixels depends on the parameters
            continue
        share = asked_of(settings, radiance.detach(), asked[:, first : first + count].to(radiance.dtype))
        with torch.enable_grad():  # what is not finite must not meet its share of 0
            radiance = torch.where(torch.isfinite(radiance.detach()).all(0), radiance, 0.0)
        found = torch.autograd.grad(radiance, tensors, share, allow_unused=True)
        for number, gradient in enumerate(found):
            if gradient is not None:
                sums.add(number, gradient)
