"""Chi-square of directions against a density, with bins that follow both and an integral that knows its own error.

The chart is Mercator's: longitude about ``+z`` (zero at the mirror direction) and ``y = asinh(z / rho)``. It is conformal,
a lobe at any height keeps its shape in it; the horizon is the line ``y = 0``; both a pole and a grazing direction keep the
relative precision that their float32 components have. Near the horizon, within the height of ``wo``, it is widened.

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

TOP = 30.0  # of y: 1e-13 from the pole
COARSEST = 2.0  # side of a cell: in the logarithmic charts the widest lobe is about as wide
Function = Callable[[Tensor], Tensor]  #: directions (3, n) float64 -> values (C, n)


@dataclass(frozen=True)
class Chart:
    """Places ``(2, n)`` of directions ``(3, n)``: ``Y = asinh(y / scale)`` and the longitude.

    Attributes:
        azimuth: where longitude is 0.
        scale: the height up to which the horizon's neighbourhood is widened.
    """

    azimuth: float
    scale: float = 1.0

    def ends(self, below: bool) -> tuple[float, float, float, float]:
        """The rectangle of one half."""
        top = math.asinh(TOP / self.scale)
        return (-top, 0.0, -math.pi, math.pi) if below else (0.0, top, -math.pi, math.pi)

    def covers(self, w: Tensor) -> Tensor:
        """All directions ``(n,)``."""
        return torch.ones_like(w[0], dtype=torch.bool)

    def places(self, w: Tensor) -> Tensor:
        w = w.double()
        rho = (w[0] * w[0] + w[1] * w[1]).sqrt()
        y = torch.asinh(w[2] / rho.clamp_min(1e-300)).clamp(-TOP, TOP)
        turned = torch.atan2(w[1], w[0]) - self.azimuth
        return torch.stack((torch.asinh(y / self.scale), torch.remainder(turned + math.pi, 2 * math.pi) - math.pi))

    def directions(self, places: Tensor) -> Tensor:
        y, phi = self.scale * torch.sinh(places[0]), places[1] + self.azimuth
        rho = 1.0 / torch.cosh(y)
        return torch.stack((rho * torch.cos(phi), rho * torch.sin(phi), torch.tanh(y)))

    def element(self, places: Tensor) -> Tensor:
        """Solid angle over area of the chart ``(n,)``."""
        y = self.scale * torch.sinh(places[0])
        return self.scale * torch.cosh(places[0]) / torch.cosh(y) ** 2


@dataclass(frozen=True)
class SlopeChart:
    """Slopes ``(x / z, y / z)`` of the facets that send ``wo`` to a direction, each as ``asinh(slope / scale)``.

    There every lobe of facets is upright, centred and wide, whatever its roughnesses, at whatever angle.

    Attributes:
        wo: ``(3, 1)`` float64.
        eta: index of the side of ``wi`` over that of ``wo`` for the refracted half; None for the reflected one.
    """

    wo: Tensor
    eta: float | None = None
    scale: float = 3e-5

    def ends(self, below: bool) -> tuple[float, float, float, float]:
        top = math.asinh(1e7 / self.scale)
        return -top, top, -top, top

    def places(self, w: Tensor) -> Tensor:
        h = self.wo + w.double() * (self.eta or 1.0)
        # A horizontal facet has an infinite slope.
        z = torch.copysign(h[2].abs().clamp_min(1e-300), h[2])
        return torch.asinh((h[:2] / z).clamp(-1e7, 1e7) / self.scale)

    def covers(self, w: Tensor) -> Tensor:
        """Directions ``(n,)`` that a facet can send light to: refracted, it crosses the facet."""
        if self.eta is None:
            return torch.ones_like(w[0], dtype=torch.bool)
        h = self.wo + w.double() * self.eta
        return (self.wo * h).sum(0) * (w.double() * h).sum(0) < 0

    def _facets(self, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Facets ``m``, their cosines with ``wo``, and how far they lie along ``wo + eta wi`` (0: they send nothing)."""
        slope = self.scale * torch.sinh(places)
        z = 1.0 / (1.0 + slope[0] ** 2 + slope[1] ** 2).sqrt()
        m = torch.stack((slope[0] * z, slope[1] * z, z))
        o = (self.wo * m).sum(0)
        if self.eta is None:
            return m, o, 2 * o
        root2 = o * o + self.eta**2 - 1
        return m, o, torch.where(root2 > 0, o - torch.sign(o) * root2.clamp_min(0.0).sqrt(), 0.0)

    def directions(self, places: Tensor) -> Tensor:
        m, _, t = self._facets(places)
        return (t * m - self.wo) / (self.eta or 1.0)

    def element(self, places: Tensor) -> Tensor:
        """Solid angle over area of the chart ``(n,)``; 0 where the direction is on the wrong side."""
        m, o, t = self._facets(places)
        wi = (t * m - self.wo) / (self.eta or 1.0)
        area = m[2] ** 3 * self.scale**2 * torch.cosh(places[0]) * torch.cosh(places[1])
        if self.eta is None:
            return torch.where(wi[2] * self.wo[2] > 0, 4 * o.abs() * area, 0.0)
        i = (wi * m).sum(0).abs()
        valid = (wi[2] * self.wo[2] < 0) & (t != 0) & (i > 0)
        return torch.where(valid, t * t * area / (self.eta**2 * torch.where(i > 0, i, 1.0)), 0.0)


@dataclass(frozen=True)
class Tree:
    """A k-d tree of ``depth`` levels over one half of the chart, all its leaves at the same depth."""

    split: list[Tensor]  # of each level, (2^level,)
    rects: Tensor  # (4, 2^depth): y0, y1, phi0, phi1

    @staticmethod
    def over(places: Tensor, depth: int, ends: tuple[float, float, float, float]) -> Tree:
        """Splits at medians, across and along by turns; ``places`` is ``(2, m 2^depth)``, ``ends`` the rectangle."""
        rects = torch.tensor(ends, dtype=torch.float64).reshape(4, 1)
        nodes, splits = places.reshape(2, 1, -1), []
        for level in range(depth):
            half = nodes.shape[2] // 2
            axis = level % 2
            key = nodes[axis]
            order = key.argsort(1)
            nodes = nodes.gather(2, order.expand(2, -1, -1))
            key = key.gather(1, order)
            split = 0.5 * (key[:, half - 1] + key[:, half])
            first, second = rects.clone(), rects.clone()
            first[2 * axis + 1] = split
            second[2 * axis] = split
            rects = torch.stack((first, second), 2).reshape(4, -1)
            nodes = torch.stack((nodes[:, :, :half], nodes[:, :, half:]), 2).reshape(2, -1, half)
            splits.append(split)
        return Tree(splits, rects)

    def leaf(self, places: Tensor) -> Tensor:
        """Index ``(n,)`` of the leaf that holds each place."""
        node = torch.zeros(places.shape[1], dtype=torch.int64)
        for level, split in enumerate(self.split):
            node = 2 * node + (places[level % 2] >= split[node])
        return node


_NODES, _WEIGHTS = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(4))


def _gauss(f: Function, rects: Tensor, chart: Chart | SlopeChart) -> tuple[Tensor, Tensor]:
    """Integrals ``(C, n)`` over rectangles ``(4, n)`` by one tensor rule of 16 points, and the largest values met."""
    y0, y1, p0, p1 = rects
    y = 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * _NODES[:, None]  # (4, n)
    p = 0.5 * (p0 + p1) + 0.5 * (p1 - p0) * _NODES[:, None]
    shape = (4, 4, rects.shape[1])
    places = torch.stack((y[:, None].expand(shape).reshape(-1), p[None].expand(shape).reshape(-1)))
    values = torch.cat([f(chart.directions(part)) for part in places.split(1 << 16, 1)], 1)
    weight = (_WEIGHTS[:, None, None] * _WEIGHTS[None, :, None]) * (0.25 * (y1 - y0) * (p1 - p0))
    element = chart.element(places)
    values = torch.where(element > 0, values * element, 0.0).reshape(-1, 16, rects.shape[1])
    return (values * weight.reshape(16, -1)).sum(1), values.amax(1)


def _parts(cells: Tensor, rows: Tensor) -> Tensor:
    """Four parts ``(4, n, 4)`` of each rectangle, in ``rows (n,)`` of 1, 2 or 4."""
    y0, y1, p0, p1 = cells
    i = torch.arange(4)[:, None]
    columns = 4 // rows
    row, column = i // columns, i % columns
    step_y, step_p = (y1 - y0) / rows, (p1 - p0) / columns
    parts = (y0 + row * step_y, y0 + (row + 1) * step_y, p0 + column * step_p, p0 + (column + 1) * step_p)
    return torch.stack(parts).transpose(1, 2)


def _shape(cells: Tensor) -> Tensor:
    """Rows into which to part a rectangle ``(n,)``: 4 where it is tall, 1 where it is wide, else 2."""
    y0, y1, p0, p1 = cells
    return torch.where(y1 - y0 > 2 * (p1 - p0), 4, torch.where(p1 - p0 > 2 * (y1 - y0), 1, 2))


@dataclass(frozen=True)
class Integral:
    """Integrals of ``C`` functions over ``n`` leaves, and a bound of their errors."""

    value: Tensor  # (C, n)
    error: Tensor  # (C, n)


def integrate(
    f: Function,
    rects: Tensor,
    chart: Chart | SlopeChart,
    tolerance: float,
    scouts: tuple[Tensor, Tensor] | None = None,
    rounds: int = 24,
) -> Integral:
    """Adaptive cubature over each rectangle: a cell is parted until that changes its integrals by less than ``tolerance``.

    Nor is a cell done while a scout in it has seen a far larger value than any node: else a narrow lobe at the end of a
    long leaf would be passed by. A curve along which the function jumps is followed down to cells whose whole content is
    below the tolerance, and no cell is larger than ``COARSEST``: two that see nothing agree as well. The difference of a
    cell and its parts bounds the error of the parts: generously where it is smooth, about rightly across a jump.

    Args:
        f: the functions.
        rects: ``(4, n)`` leaves.
        chart: of the leaves.
        tolerance: absolute, for a cell.
        scouts: places ``(2, m)`` and leaves ``(m,)`` of points where lobes are thought to be.
        rounds: how often at most.
    """
    leaf, cells, (coarse, _) = torch.arange(rects.shape[1]), rects, _gauss(f, rects, chart)
    value = torch.zeros(coarse.shape[0], rects.shape[1], dtype=torch.float64)
    error = torch.zeros_like(value)
    places, home = (torch.zeros(2, 0).double(), torch.zeros(0).long()) if scouts is None else scouts
    seen = f(chart.directions(places)) * chart.element(places)
    for step in range(rounds):

        def parted(cells: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            parts = _parts(cells, rows)
            fine, peak = _gauss(f, parts.reshape(4, -1), chart)
            return parts, fine.reshape(len(fine), -1, 4), peak.reshape(len(fine), -1, 4)

        last = step == rounds - 1
        rows = _shape(cells)
        parts, fine, peak = parted(cells, rows)
        difference = (fine.sum(2) - coarse).abs()
        most = torch.zeros_like(coarse).scatter_reduce_(1, home.expand_as(seen), seen, "amax")
        extent = (cells[1] - cells[0]) * (cells[3] - cells[2])
        longest = (cells[1] - cells[0]).maximum(cells[3] - cells[2])
        missed = (most > 1.5 * peak.amax(2)) & (most * extent > tolerance)
        again = ((difference > tolerance) | missed).any(0) | (longest > COARSEST)
        # Strips one way say nothing of the other way.
        cross = (~again & (rows != 2)).nonzero()[:, 0]
        if len(cross):
            other, across, _ = parted(cells[:, cross], 4 // rows[cross])
            apart = (across.sum(2) - coarse[:, cross]).abs()
            parts[:, cross], fine[:, cross] = other, across
            difference[:, cross] = difference[:, cross].maximum(apart)
            again[cross] = (apart > tolerance).any(0)
        done = ~again | last
        value.index_add_(1, leaf[done], fine[:, done].sum(2))
        error.index_add_(1, leaf[done], difference[:, done])
        again = ~done
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


def counts_p(observed: Tensor, expected: Tensor, density: Tensor, number: int, doubt: Tensor) -> float:
    """p-value of leaf counts ``(n,)`` of ``number`` draws against expectations, the draws in no leaf being one more cell.

    Three groupings share it (Bonferroni): the leaves, which see local errors; sixteen groups of leaves of like density,
    which see the shape of any lobe; and all leaves in two and the rest, which sees its share.
    """
    rest = torch.tensor([number - float(observed.sum()), number - float(expected.sum()), float(doubt.sum())])
    o, e, d = (
        torch.cat((a.double(), b.double()[None])) for a, b in zip((observed, expected, doubt), rest, strict=True)
    )
    e[-1] = e[-1].clamp_min(0.0)
    order = density.argsort(descending=True)
    share = expected[order].clamp_min(0.0).cumsum(0)
    group = torch.empty_like(order)
    group[order] = (share / share[-1].clamp_min(1e-300) * 16).long().clamp_max(15)
    grouped = [torch.cat((torch.zeros(16).double().index_add_(0, group, a[:-1]), a[-1:])) for a in (o, e, d)]
    half = [torch.stack((a[:8].sum(), a[8:16].sum(), a[16])) for a in grouped]
    # The rest comes first, so that it is merged into a leaf where it is small, and not dropped.
    p = min(_p(a.roll(1), b.roll(1), c.roll(1)) for a, b, c in ((o, e, d), grouped, half))
    return 1.0 - (1.0 - p) ** 3
