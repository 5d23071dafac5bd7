"""Pyramids of environment maps, coarser by rows, by columns, or both, so that samples average over their solid angle.

A texel of a coarse level is the mean of the fine map, weighted by the coarse texel's hat function and solid angle: levels
conserve energy, and constants stay constant. Rows and columns are separate because texels near the poles are far narrower
than high.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

__all__ = ["Pyramid", "resampled"]


@dataclass(frozen=True)
class Pyramid:
    """All levels of a pyramid in one table.

    Attributes:
        texels: ``(T, 3)``.
        heights: numbers of rows of the levels 0..A-1.
        widths: numbers of columns of the levels 0..B-1.
        first: ``(A, B)`` int64 on the CPU: index of the first texel of level ``(a, b)``.
    """

    texels: Tensor
    heights: tuple[int, ...]
    widths: tuple[int, ...]
    first: Tensor

    @staticmethod
    def of(map: Tensor) -> Pyramid:
        """Build the pyramid of a map ``(H, W, 3)``; differentiable, linear."""
        height, width, _ = map.shape
        heights = tuple(intervals + 1 for intervals in _halved(height - 1))
        widths = _halved(width)
        parts, first, end = [], [], 0
        for rows in heights:
            lower = _means(map, rows, latitude=True).transpose(0, 1)  # (W, rows, 3)
            for columns in widths:
                parts.append(_means(lower, columns, latitude=False).transpose(0, 1).reshape(-1, 3))
                first.append(end)
                end += rows * columns
        places = torch.tensor(first, dtype=torch.int64).view(len(heights), len(widths))
        return Pyramid(torch.cat(parts), heights, widths, places)


def resampled(map: Tensor, height: int, width: int) -> Tensor:
    """Downsample a map to ``(height, width, 3)`` by means; differentiable, linear."""
    rows = _means(map, height, latitude=True).transpose(0, 1)  # (W, height, 3)
    return _means(rows, width, latitude=False).transpose(0, 1)


def _halved(size: int) -> tuple[int, ...]:
    """Return ``size`` and its halves, rounded up, down to 1."""
    sizes = [size]
    while sizes[-1] > 1:
        sizes.append((sizes[-1] + 1) // 2)
    return tuple(sizes)


def _means(x: Tensor, size: int, latitude: bool) -> Tensor:
    """Downsample a map ``(n, m, 3)`` to ``size`` rows; ``latitude``: they go from pole to pole, else around and wrap."""
    n, m, _ = x.shape
    if n == size:
        return x
    index, weight = _matrix(n, size, latitude)
    matrix = torch.sparse_coo_tensor(
        torch.from_numpy(index),
        torch.from_numpy(weight).to(x.dtype),
        (size, n),
        is_coalesced=True,
        check_invariants=False,
    ).to(x.device)
    return torch.sparse.mm(matrix, x.reshape(n, m * 3)).view(size, m, 3)


@lru_cache(maxsize=64)
def _matrix(fine: int, coarse: int, latitude: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the sparse matrix ``(coarse, fine)`` of means: indices ``(2, K)`` sorted by rows, and values ``(K,)``.

    Integrates products of two hat functions (and the sine of the polar angle) between their kinks by three-point
    Gauss-Legendre quadrature.
    """
    if latitude:
        kinks = np.union1d(np.arange(fine) / (fine - 1), np.arange(coarse) / (coarse - 1))
    else:
        kinks = np.union1d((np.arange(fine) + 0.5) / fine, (np.arange(coarse) + 0.5) / coarse)
        kinks = np.append(kinks, kinks[0] + 1.0)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    low, span = kinks[:-1, None], np.diff(kinks)[:, None]
    t = (low + span * (0.5 + 0.5 * nodes)).ravel()
    mass = (0.5 * span * weights).ravel() * (np.sin(math.pi * t) if latitude else 1.0)

    def hats(size: int) -> list[tuple[np.ndarray, np.ndarray]]:
        # At each node of the quadrature the two texels whose hat functions are not zero, and their values.
        place = t * (size - 1) if latitude else t * size - 0.5
        below = np.floor(place).astype(np.int64)
        if latitude:
            below = np.minimum(below, size - 2)
        share = place - below
        if latitude:
            return [(below, 1.0 - share), (below + 1, share)]
        return [(below % size, 1.0 - share), ((below + 1) % size, share)]

    matrix: dict[str, list[np.ndarray]] = {"key": [], "value": []}
    for row, a in hats(coarse):
        for column, b in hats(fine):
            matrix["key"].append(row * fine + column)
            matrix["value"].append(a * b * mass)
    key, place = np.unique(np.concatenate(matrix["key"]), return_inverse=True)
    value = np.bincount(place, np.concatenate(matrix["value"]))
    row = key // fine
    return np.stack((row, key % fine)), value / np.bincount(row, value)[row]
