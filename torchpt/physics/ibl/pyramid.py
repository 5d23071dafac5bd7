"""Pyramids of environment maps, coarser by rows, by columns, or both, so that samples average over their solid angle.

A texel of a coarse level is the mean of the fine map, weighted by the coarse texel's hat function and solid angle: levels
conserve energy, and constants stay constant. Rows and columns are separate because texels near the poles are far narrower
than high. A texel's hat function is its weight in bilinear interpolation: 1 at its centre, 0 at those of its neighbours.

``convolve.py`` reads pyramids where samples of a lobe are far apart compared to texels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

__all__ = ["Pyramid", "downsample"]


@dataclass(frozen=True)
class Pyramid:
    """All levels of a pyramid in one table.

    Attributes:
        texels: ``(T, 3)``.
        heights: numbers of rows; level ``(a, b)`` has ``heights[a]`` rows and ``widths[b]`` columns. A of them.
        widths: numbers of columns. B of them.
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
        # Both poles stay rows of every level, so the intervals between rows are halved.
        heights = tuple(intervals + 1 for intervals in _halvings(height - 1))
        widths = _halvings(width)
        levels, offsets, end = [], [], 0
        for rows in heights:
            fewer_rows = _means(map, rows, latitude=True).transpose(0, 1)  # (W, rows, 3)
            for columns in widths:
                levels.append(_means(fewer_rows, columns, latitude=False).transpose(0, 1).reshape(-1, 3))
                offsets.append(end)
                end += rows * columns
        first = torch.tensor(offsets, dtype=torch.int64).view(len(heights), len(widths))
        return Pyramid(torch.cat(levels), heights, widths, first)


def downsample(map: Tensor, height: int, width: int) -> Tensor:
    """Downsample a map to ``(height, width, 3)`` by means; differentiable, linear."""
    rows = _means(map, height, latitude=True).transpose(0, 1)  # (W, height, 3)
    return _means(rows, width, latitude=False).transpose(0, 1)


def _halvings(size: int) -> tuple[int, ...]:
    """Return ``size`` and its halves, rounded up, down to 1."""
    sizes = [size]
    while sizes[-1] > 1:
        sizes.append((sizes[-1] + 1) // 2)
    return tuple(sizes)


def _means(map: Tensor, size: int, *, latitude: bool) -> Tensor:
    """Downsample a map ``(n, m, 3)`` to ``size`` rows.

    ``latitude``: True: rows go from pole to pole. False: they go around and wrap, as those of a transposed map.
    """
    n, m, _ = map.shape
    if n == size:
        return map
    index, weight = _matrix(n, size, latitude=latitude)
    matrix = torch.sparse_coo_tensor(
        torch.from_numpy(index),
        torch.from_numpy(weight).to(map.dtype),
        (size, n),
        is_coalesced=True,
        check_invariants=False,
    ).to(map.device)
    return torch.sparse.mm(matrix, map.reshape(n, m * 3)).view(size, m, 3)


@lru_cache(maxsize=64)
def _matrix(fine: int, coarse: int, *, latitude: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the sparse matrix ``(coarse, fine)`` of means: indices ``(2, K)`` sorted by rows, and values ``(K,)``.

    ``fine`` and ``coarse`` are numbers of rows; ``latitude`` as for :func:`_means`. Products of two hat functions (and the
    sine of the polar angle) are integrated between their kinks by three-point Gauss-Legendre quadrature.
    """
    if latitude:
        kinks = np.union1d(np.arange(fine) / (fine - 1), np.arange(coarse) / (coarse - 1))
    else:
        kinks = np.union1d((np.arange(fine) + 0.5) / fine, (np.arange(coarse) + 0.5) / coarse)
        kinks = np.append(kinks, kinks[0] + 1.0)  # the interval that wraps around
    nodes, weights = np.polynomial.legendre.leggauss(3)
    low, span = kinks[:-1, None], np.diff(kinks)[:, None]
    t = (
        low + span * (0.5 + 0.5 * nodes)
    ).ravel()  # nodes of the quadrature; 0 to 1 is from pole to pole, or once around
    mass = (0.5 * span * weights).ravel() * (np.sin(math.pi * t) if latitude else 1.0)

    def hats(size: int) -> list[tuple[np.ndarray, np.ndarray]]:
        # At each node of the quadrature the two texels whose hat functions are not zero, and their values.
        position = t * (size - 1) if latitude else t * size - 0.5  # in texels, from the centre of the first
        below = np.floor(position).astype(np.int64)
        if latitude:
            below = np.minimum(below, size - 2)
        fraction = position - below
        if latitude:
            return [(below, 1.0 - fraction), (below + 1, fraction)]
        return [(below % size, 1.0 - fraction), ((below + 1) % size, fraction)]

    # Terms of the integrals by flat index of their entry, which the last lines sum.
    indices, terms = [], []
    for row, coarse_hat in hats(coarse):
        for column, fine_hat in hats(fine):
            indices.append(row * fine + column)
            terms.append(coarse_hat * fine_hat * mass)
    index, entry = np.unique(np.concatenate(indices), return_inverse=True)
    value = np.bincount(entry, np.concatenate(terms))
    row = index // fine
    return np.stack((row, index % fine)), value / np.bincount(row, value)[row]  # each row sums to 1
