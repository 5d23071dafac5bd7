"""Russian roulette: which paths go on, and by how much more those count."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.physics.samplers import Dimension, Draws

__all__ = ["DEEP", "DEEP_CAP", "LEAST", "russian_roulette", "survival_probability"]

#: Where nothing else ends paths, those of more vertices than this may be ended whatever they carry. Before it a cap below 1
#: would only cost: each vertex of a path that loses nothing multiplies its variance by one over the cap.
DEEP = 1000
#: The most that those survive with. A path that loses the share ``a`` of its light has finite variance where the cap is above
#: ``(1 - a)^2``, and a thousand more vertices on average end one that loses nothing.
DEEP_CAP = 0.999
#: The least chance that paths survive with where derivatives are wanted. What a path carries says little of its derivative:
#: that by a colour of 0 is all of what a path would carry if the colour were 1.
LEAST = 0.25


def russian_roulette(chance: Tensor, draws: Draws, alive: Tensor, throughput: Tensor) -> tuple[Tensor, Tensor]:
    """Return which paths are alive after roulette ``(N,)``, and their throughput ``(3, N)``.

    Args:
        chance: to survive ``(N,)``, see :func:`survival_probability`.
        draws: the vertex's random numbers.
        alive: before.
        throughput: before.
    """
    alive = alive & (draws.one(Dimension.ROULETTE) < chance)
    return alive, throughput / torch.where(alive, chance, 1.0)


def survival_probability(
    chance: float | None, cap: float, brightest: Tensor, eta: Tensor | None, tape: bool = False
) -> Tensor:
    """Return the chance with which paths survive ``(N,)``.

    Args:
        chance: a constant one; None: as much as a path can still bring, ``min(cap, throughput * eta^2)``.
        cap: of that.
        brightest: largest component of the throughput ``(N,)``.
        eta: index of refraction along the path ``(N,)``, where there is refraction.
        tape: whether derivatives are wanted: no path is then ended because it carries little, see :data:`LEAST`.
    """
    if chance is not None:
        return torch.full_like(brightest, chance)
    # Radiance is scaled at refraction; what a path can still bring is not.
    expected = brightest if eta is None else brightest * eta * eta
    expected = expected.clamp_max(float(cap))
    return expected.clamp_min(min(LEAST, cap)) if tape else expected
