"""The tail of a distribution: how far a mean of so many values can be trusted.

The largest values are fitted by a generalized Pareto distribution, whose moments below 1 / k exist: from a shape k of 1/2 on it
has no variance, from 1 on no mean. The fit is that of Zhang and Stephens (2009), *A New and Efficient Estimation Method for the
Generalized Pareto Distribution*, Technometrics 51(3). How many values count as the tail, the weak prior and the threshold are
those of Vehtari, Simpson, Gelman, Yao and Gabry (2024), *Pareto Smoothed Importance Sampling*, JMLR 25(72).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

__all__ = ["FEWEST", "heavy_tail"]

#: Fewest values whose tail a shape is fitted to.
FEWEST = 25
#: Weight of the prior, and the shape that it expects.
_PRIOR, _EXPECTED = 10.0, 0.5


def heavy_tail(values: Tensor) -> bool:
    """Return whether the upper tail of ``values (n,)`` is too heavy for their mean to be trusted, n being ``FEWEST`` or more.

    That is, whether its shape exceeds the threshold by more than chance explains: by two standard errors ``(1 + k) / sqrt(m)``
    of a shape fitted to m values.
    """
    ordered = np.sort(values.detach().cpu().double().numpy())
    count = int(min(0.2 * len(ordered), 3.0 * math.sqrt(len(ordered))))
    excess = ordered[-count:] - ordered[-count - 1]
    if not excess[-1] > 0.0:
        return False
    # Values alike have no logarithms of their differences; below this they weigh nothing.
    shape = _fitted(np.maximum(excess, 1e-30 * excess[-1]))
    shape = (count * shape + _PRIOR * _EXPECTED) / (count + _PRIOR)
    least = shape - 2.0 * (1.0 + abs(shape)) / math.sqrt(count + _PRIOR)
    return least > min(1.0 - 1.0 / math.log10(len(ordered)), 0.7)


def _fitted(x: NDArray[np.float64]) -> float:
    """Return the posterior mean of the shape of a generalized Pareto distribution of ``x (n,)``, positive and rising."""
    n = len(x)
    m = 30 + math.isqrt(n)
    quartile = x[int(n / 4 + 0.5) - 1]
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-theta[:, None] * x).mean(1)
    likelihood = n * (np.log(-theta / k) - k - 1.0)
    weight = 1.0 / np.exp(np.minimum(likelihood - likelihood[:, None], 700.0)).sum(1)
    mean = float((theta * weight).sum() / weight.sum())
    return float(np.log1p(-mean * x).mean())
