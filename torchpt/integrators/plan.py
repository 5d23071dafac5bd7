"""What a render asks of the stages."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchpt.samplers import Points

__all__ = ["FOREVER", "STRATEGIES", "Plan"]

#: mis: light and BSDF sampling combined; bsdf, light: one of them; uniform: directions uniform over the hemisphere.
STRATEGIES = ("mis", "bsdf", "light", "uniform")
#: ``t_max`` of a path that goes on; times 0 it is that of one that ended.
FOREVER = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Plan:
    """What a render asks of the stages; static."""

    sampler: Points
    strategy: str
    rr_prob: float | None
    dtype: torch.dtype
    tape: bool  # whether derivatives are wanted
    attached: bool  # whether they are wanted with respect to geometry
