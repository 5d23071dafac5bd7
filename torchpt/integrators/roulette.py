"""Russian roulette: which paths go on, and by how much more those count."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.samplers import Dimension, Draws

__all__ = ["SURVIVAL_CAP", "survived"]

#: Roulette never lets a path live on for sure: throughput above one would make it immortal.
SURVIVAL_CAP = 0.95


def survived(
    chance: float | None, draws: Draws, alive: Tensor, throughput: Tensor, brightest: Tensor, eta: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Which paths are alive after roulette ``(N,)``, and their throughput ``(3, N)``.

    Args:
        chance: to survive; None: as much as a path can still bring.
        draws: the vertex's random numbers.
        alive: before.
        throughput: before.
        brightest: its largest component ``(N,)``.
        eta: index of refraction along the path ``(N,)``, where there is refraction.
    """
    if chance is None:
        # Radiance is scaled at refraction; what a path can still bring is not.
        expected = brightest if eta is None else brightest * eta * eta
        survival = expected.clamp_max(SURVIVAL_CAP)
    else:
        survival = torch.full_like(brightest, chance)
    alive = alive & (draws.one(Dimension.ROULETTE) < survival)
    return alive, throughput / torch.where(alive, survival, 1.0)
