"""Bounds and p-values.

A test that makes ``n`` comparisons takes each at ``SIGNIFICANCE / n`` (Bonferroni; Šidák where they are independent), so
that a right renderer fails it with at most this probability; seeds are fixed, so it does not fail by turns.
"""

from __future__ import annotations

import torch

SIGNIFICANCE = 1e-3


def z_limit(comparisons: int, significance: float = SIGNIFICANCE) -> float:
    """Two-sided bound on the largest of ``comparisons`` standard normal deviates."""
    share = torch.tensor(1.0 - 0.5 * significance / comparisons, dtype=torch.float64)
    return float(torch.special.ndtri(share))


def chi_square_p(statistic: float, freedom: int) -> float:
    """Probability that chi-square with ``freedom`` degrees exceeds ``statistic``."""
    half = torch.tensor([0.5 * freedom, 0.5 * statistic], dtype=torch.float64)
    return float(torch.special.gammaincc(half[0], half[1]))
