"""Chi-square of directions against a density, with bins that follow both and an integral that knows its own error.

The chart is Mercator's: longitude about ``+z`` (zero at the mirror direction) and ``y = asinh(z / rho)``. It is conformal,
a lobe at any height keeps its shape in it; the horizon is the line ``y = 0``; both a pole and a grazing direction keep the
relative precision that their float32 components have.

Bins are the leaves of a k-d tree over points that are independent of those tested: samples of the model, and directions
that owe nothing to it, so that a lobe which the sampler forgets is found too. The density is integrated over each leaf by
adaptive Gauss cubature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from significance import chi_square_p
from torch import Tensor

TOP = 30.0  # of the chart: 1e-13 from the pole
Function = Callable[[Tensor], Tensor]  #: directions (3, n) float64 -> values (C, n)


def chart(w: Tensor, azimuth: float) -> Tensor:
    """Places ``(2, n)`` float64 of directions ``(3, n)``; longitude 0 is at ``azimuth``."""
    w = w.double()
    rho = (w[0] * w[0] + w[1] * w[1]).sqrt()
    y = torch.asinh(w[2] / rho.clamp_min(1e-300)).clamp(-TOP, TOP)
    turned = torch.atan2(w[1], w[0]) - azimuth
    return torch.stack((y, torch.remainder(turned + math.pi, 2 * math.pi) - math.pi))


def direction(y: Tensor, phi: Tensor, azimuth: float) -> Tensor:
    """Directions ``(3, n)`` at places of the chart."""
    rho = 1.0 / torch.cosh(y)
    return torch.stack((rho * torch.cos(phi + azimuth), rho * torch.sin(phi + azimuth), torch.tanh(y)))


@dataclass(frozen=True)
class Tree:
    """A k-d tree of ``depth`` levels over one half of the chart, all its leaves at the same depth."""

    axis: list[Tensor]  # of each level, (2^level,)
    split: list[Tensor]
    rects: Tensor  # (4, 2^depth): y0, y1, phi0, phi1

    @staticmethod
    def over(places: Tensor, depth: int, below: bool) -> Tree:
        """Splits at medians along the wider axis; ``places`` is ``(2, m 2^depth)``."""
        ends = [-TOP, 0.0] if below else [0.0, TOP]
        rects = torch.tensor([*ends, -math.pi, math.pi], dtype=torch.float64).reshape(4, 1)
        nodes, axes, splits = places.reshape(2, 1, -1), [], []
        for _ in range(depth):
            half = nodes.shape[2] // 2
            low, high = nodes.quantile(0.15, 2), nodes.quantile(0.85, 2)
            axis = (high - low).argmax(0)
            key = torch.where(axis[:, None] == 0, nodes[0], nodes[1])
            order = key.argsort(1)
            nodes = nodes.gather(2, order.expand(2, -1, -1))
            key = key.gather(1, order)
            split = 0.5 * (key[:, half - 1] + key[:, half])
            first, second = rects.clone(), rects.clone()
            column = torch.arange(rects.shape[1])
            first[2 * axis + 1, column] = split
            second[2 * axis, column] = split
            rects = torch.stack((first, second), 2).reshape(4, -1)
            nodes = torch.stack((nodes[:, :, :half], nodes[:, :, half:]), 2).reshape(2, -1, half)
            axes.append(axis)
            splits.append(split)
        return Tree(axes, splits, rects)

    def leaf(self, places: Tensor) -> Tensor:
        """Index ``(n,)`` of the leaf that holds each place."""
        node = torch.zeros(places.shape[1], dtype=torch.int64)
        for axis, split in zip(self.axis, self.split, strict=True):
            key = torch.where(axis[node] == 0, places[0], places[1])
            node = 2 * node + (key >= split[node])
        return node


_NODES, _WEIGHTS = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(4))


def _gauss(f: Function, rects: Tensor, azimuth: float) -> tuple[Tensor, Tensor]:
    """Integrals ``(C, n)`` over rectangles ``(4, n)`` by one tensor rule of 16 points, and the largest values met."""
    y0, y1, p0, p1 = rects
    y = 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * _NODES[:, None]  # (4, n)
    p = 0.5 * (p0 + p1) + 0.5 * (p1 - p0) * _NODES[:, None]
    shape = (4, 4, rects.shape[1])
    yy, pp = y[:, None].expand(shape).reshape(-1), p[None].expand(shape).reshape(-1)
    parts = zip(yy.split(1 << 16), pp.split(1 << 16), strict=True)
    values = torch.cat([f(direction(a, b, azimuth)) for a, b in parts], 1)
    weight = (_WEIGHTS[:, None, None] * _WEIGHTS[None, :, None]) * (0.25 * (y1 - y0) * (p1 - p0))
    weight = weight.reshape(-1) / torch.cosh(yy) ** 2
    shape = (-1, 16, rects.shape[1])
    return (values * weight).reshape(shape).sum(1), values.reshape(shape).amax(1)


def _children(cells: Tensor) -> Tensor:
    """Four parts ``(4, n, 4)`` of each rectangle: quadrants, or strips across where it is long."""
    y0, y1, p0, p1 = cells
    tall, wide = y1 - y0 > 2 * (p1 - p0), p1 - p0 > 2 * (y1 - y0)
    i = torch.arange(4)[:, None]
    rows = torch.where(tall, 4, torch.where(wide, 1, 2))
    columns = 4 // rows
    row, column = i // columns, i % columns
    step_y, step_p = (y1 - y0) / rows, (p1 - p0) / columns
    parts = (y0 + row * step_y, y0 + (row + 1) * step_y, p0 + column * step_p, p0 + (column + 1) * step_p)
    return torch.stack(parts).transpose(1, 2)


@dataclass(frozen=True)
class Integral:
    """Integrals of ``C`` functions over ``n`` leaves, and a bound of their errors."""

    value: Tensor  # (C, n)
    error: Tensor  # (C, n)


def integrate(
    f: Function,
    rects: Tensor,
    azimuth: float,
    tolerance: float,
    scouts: tuple[Tensor, Tensor] | None = None,
    rounds: int = 24,
) -> Integral:
    """Adaptive cubature over each rectangle: a cell is parted until that changes its integrals by less than ``tolerance``.

    Nor is a cell done while a scout in it has seen a far larger value than any node: else a narrow lobe at the end of a
    long leaf would be passed by. A curve along which the function jumps is followed down to cells whose whole content is
    below the tolerance. The difference of a cell and its parts bounds the error of the parts generously where it is smooth.

    Args:
        f: the functions.
        rects: ``(4, n)`` leaves.
        azimuth: of longitude 0.
        tolerance: absolute, for a cell.
        scouts: places ``(2, m)`` and leaves ``(m,)`` of points where lobes are thought to be.
        rounds: how often at most.
    """
    leaf, cells, (coarse, _) = torch.arange(rects.shape[1]), rects, _gauss(f, rects, azimuth)
    value = torch.zeros(coarse.shape[0], rects.shape[1], dtype=torch.float64)
    error = torch.zeros_like(value)
    places, home = (torch.zeros(2, 0).double(), torch.zeros(0).long()) if scouts is None else scouts
    seen = f(direction(places[0], places[1], azimuth))
    for step in range(rounds):
        n = cells.shape[1]
        parts = _children(cells)
        fine, peak = (x.reshape(len(x), n, 4) for x in _gauss(f, parts.reshape(4, -1), azimuth))
        total = fine.sum(2)
        difference = (total - coarse).abs()
        most = torch.zeros_like(total).scatter_reduce_(1, home.expand_as(seen), seen, "amax")
        y0, y1, p0, p1 = cells
        area = (torch.tanh(y1) - torch.tanh(y0)) * (p1 - p0)
        missed = (most > 1.5 * peak.amax(2)) & (most * area > tolerance)
        again = ((difference > tolerance) | missed).any(0) & (step < rounds - 1)
        value.index_add_(1, leaf[~again], total[:, ~again])
        error.index_add_(1, leaf[~again], difference[:, ~again] * (0.1 if step < rounds - 1 else 1.0))
        if not again.any():
            break
        cells, coarse = parts[:, again].reshape(4, -1), fine[:, again].reshape(fine.shape[0], -1)
        leaf = leaf[again].repeat_interleave(4)
        stay = again[home]
        places, seen = places[:, stay], seen[:, stay]
        home = 4 * (again.cumsum(0) - 1)[home[stay]]
        # A scout belongs to the last part that begins before it.
        begins = [(cells[0, home + i] <= places[0]) & (cells[2, home + i] <= places[1]) for i in range(4)]
        home = home + (torch.stack(begins).long() * torch.arange(4)[:, None]).amax(0)
    return Integral(value, error)


def _p(observed: Tensor, expected: Tensor, doubt: Tensor, least: float = 20.0) -> float:
    """p-value of counts against expectations known up to ``doubt``; small cells are merged with those after them."""
    cells, at = [], torch.zeros(3, dtype=torch.float64)
    for cell in torch.stack((observed.double(), expected, doubt), 1):
        at = at + cell
        if at[1] >= least:
            cells.append(at)
            at = torch.zeros(3, dtype=torch.float64)
    if not cells:
        cells = [torch.zeros(3, dtype=torch.float64)]
    cells[-1] = cells[-1] + at
    o, e, d = torch.stack(cells).T
    # What is impossible has no variance; one count there is one too many for any expectation near 0.
    variance = e.clamp_min(1e-9) + d * d
    return chi_square_p(float(((o - e) ** 2 / variance).sum()), len(cells))


def counts_p(observed: Tensor, expected: Tensor, area: Tensor, number: int, doubt: Tensor) -> float:
    """p-value of leaf counts ``(n,)`` of ``number`` draws against expectations, the draws in no leaf being one more cell.

    Three groupings share it (Bonferroni): the leaves, which see local errors; sixteen groups of leaves of like density,
    which see the shape of any lobe; and all leaves in two and the rest, which sees its share.
    """
    rest = torch.tensor([number - float(observed.sum()), number - float(expected.sum()), float(doubt.sum())])
    o, e, d = (
        torch.cat((a.double(), b.double()[None])) for a, b in zip((observed, expected, doubt), rest, strict=True)
    )
    e[-1] = e[-1].clamp_min(0.0)
    density = expected / area
    order = density.argsort(descending=True)
    share = expected[order].clamp_min(0.0).cumsum(0)
    group = torch.empty_like(order)
    group[order] = (share / share[-1].clamp_min(1e-300) * 16).long().clamp_max(15)
    grouped = [torch.cat((torch.zeros(16).double().index_add_(0, group, a[:-1]), a[-1:])) for a in (o, e, d)]
    half = [torch.stack((a[:8].sum(), a[8:16].sum(), a[16])) for a in grouped]
    # The rest comes first, so that it is merged into a leaf where it is small, and not dropped.
    p = min(_p(*(a.roll(1) for a in cells)) for cells in ((o, e, d), grouped, half))
    return 1.0 - (1.0 - p) ** 3
