"""Bounds and p-values.

A test that makes ``n`` comparisons takes each at ``SIGNIFICANCE / n`` (Bonferroni; Šidák where they are independent), so
that a right renderer fails it with at most this probability; seeds are fixed, so it does not fail by turns.
"""

from __future__ import annotations

import math

import torch

SIGNIFICANCE = 1e-3


def z_limit(comparisons: int, significance: float = SIGNIFICANCE) -> float:
    """Return the two-sided bound on the largest of ``comparisons`` standard normal deviates."""
    share = torch.tensor(1.0 - 0.5 * significance / comparisons, dtype=torch.float64)
    return float(torch.special.ndtri(share))


def chi_square_p(statistic: float, freedom: int) -> float:
    """Return the probability that chi-square with ``freedom`` degrees exceeds ``statistic``."""
    half = torch.tensor([0.5 * freedom, 0.5 * statistic], dtype=torch.float64)
    return float(torch.special.gammaincc(half[0], half[1]))


def t_limit(comparisons: int, freedom: int, significance: float = SIGNIFICANCE) -> float:
    """Return the bound of :func:`z_limit` for Student's t with ``freedom`` degrees: means over ``freedom + 1`` pictures."""
    share, steps = significance / comparisons, 1 << 19
    # 1 + t^2 / freedom = 1 / cos^2(a): the tail is an integral of a power of a cosine.
    a = torch.linspace(0.0, math.pi / 2, steps + 1, dtype=torch.float64)
    density = a.cos().clamp_min(0.0) ** (freedom - 1)
    tail = torch.cumulative_trapezoid(density.flip(0), dx=math.pi / 2 / steps).flip(0)
    first = int((tail / tail[0] <= share).nonzero()[0])
    return math.sqrt(freedom) * math.tan(float(a[first]))
