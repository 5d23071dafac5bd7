"""Russian roulette: end paths at random, and divide the throughput of the survivors by their survival probability."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.physics.samplers import Dimension, Draws

__all__ = ["DEEP", "DEEP_CAP", "LEAST", "russian_roulette", "survival_probability"]

#: With ``max_depth`` -1 paths of more vertices than this have a survival probability of at most ``DEEP_CAP``, whatever their
#: throughput. For shorter paths a cap below 1 only adds noise: each vertex of a path that loses nothing multiplies its variance
#: by 1 / cap.
DEEP = 1000
#: Bound of the survival probability beyond ``DEEP`` vertices. A path that loses the fraction ``a`` of its light at each vertex
#: has finite variance if the cap is above ``(1 - a)^2``; one that loses nothing ends after another 1 / (1 - 0.999) = 1000
#: vertices on average.
DEEP_CAP = 0.999
#: Lower bound of the survival probability under differentiation. A small throughput does not mean a small derivative: with
#: respect to a reflectance of 0 the derivative is the throughput that a reflectance of 1 would give. A quarter bounds the
#: factor by which roulette scales such a derivative by 4.
LEAST = 0.25


def russian_roulette(chance: Tensor, draws: Draws, alive: Tensor, throughput: Tensor) -> tuple[Tensor, Tensor]:
    """Play roulette; return the mask of paths that are alive ``(N,)`` and their throughput ``(3, N)``.

    Args:
        chance: survival probability ``(N,)``, from :func:`survival_probability`.
        draws: random numbers of the vertex.
        alive: ``(N,)`` bool before roulette.
        throughput: ``(3, N)`` before roulette.
    """
    alive = alive & (draws.one(Dimension.ROULETTE) < chance)
    return alive, throughput / torch.where(alive, chance, 1.0)


def survival_probability(
    rr_prob: float | None, cap: float | Tensor, brightest: Tensor, eta: Tensor | None, *, tape: bool = False
) -> Tensor:
    """Return the survival probability of paths ``(N,)``.

    Args:
        rr_prob: the integrator's constant probability; None: ``min(cap, brightest * eta^2)``.
        cap: upper bound: 1, or :data:`DEEP_CAP` for deep paths. A tensor ``(1,)`` may also be 0: no roulette, probability 1.
        brightest: largest component of the throughput ``(N,)``.
        eta: index of refraction at the path's end over that at the camera ``(N,)``; None where nothing refracts.
        tape: True under differentiation: the probability is then at least :data:`LEAST`.
    """
    if isinstance(cap, Tensor):
        bounded = brightest if rr_prob is None else torch.full_like(brightest, rr_prob)
        if rr_prob is None:
            bounded = torch.minimum(bounded if eta is None else bounded * eta * eta, cap)
            bounded = torch.maximum(bounded, cap.clamp_max(LEAST)) if tape else bounded
        return torch.where(cap > 0, bounded, 1.0)
    if rr_prob is not None:
        return torch.full_like(brightest, rr_prob)
    # Refraction scales radiance by 1 / eta^2, which the path gets back when it leaves the glass.
    expected = brightest if eta is None else brightest * eta * eta
    expected = expected.clamp_max(float(cap))
    return expected.clamp_min(min(LEAST, cap)) if tape else expected
