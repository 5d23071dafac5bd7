"""Sampling: warps of the unit square, discrete distributions, weights of multiple importance sampling (MIS)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.math.vectors import safe_reciprocal, take

__all__ = [
    "Distribution1D",
    "Distribution2D",
    "concentric_disk",
    "cosine_hemisphere",
    "invert_linear",
    "one_minus_cos",
    "power_heuristic",
    "uniform_cone",
    "uniform_hemisphere",
    "uniform_polygon",
    "uniform_sphere",
    "uniform_triangle",
]


# ---- Multiple importance sampling (Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, 1997, section 9.2)


def power_heuristic(a: Tensor, b: Tensor) -> Tensor:
    """Compute the MIS weight ``a^2 / (a^2 + b^2)`` of the strategy with density ``a (N,)``; 0 if ``a`` is 0, 1 if it is inf.

    Computed as ``1 / (1 + (b/a)^2)``: squares of densities above 1.8e19 overflow float32. The ratio may overflow to infinity,
    which gives the right limit 0.
    """
    ratio = b * safe_reciprocal(a)
    return torch.sign(a) / (1.0 + ratio * ratio)


# ---- Warps of the unit square ``(2, N)`` onto domains, with their densities. Inputs lie in ``[0, 1)``


def concentric_disk(u: Tensor) -> Tensor:
    """Map to the unit disk ``(2, N)``, preserving area (Shirley and Chiu, *A Low Distortion Map*, 1997)."""
    wide, r, phi = _concentric(u)
    c, s = torch.cos(phi), torch.sin(phi)
    return r * torch.stack((torch.where(wide, c, s), torch.where(wide, s, c)))


def _concentric(u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return ``wide``, the concentric map's signed radius, and its angle: from +x if ``wide``, else from +y (mirrored)."""
    a, b = 2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0  # in the square [-1, 1]^2
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    # The quotient is 0/0 only at the centre, where r = 0 makes the angle irrelevant.
    ratio = torch.where(wide, b, a) / torch.where(r == 0, 1.0, r)
    return wide, r, (math.pi / 4) * ratio


def uniform_polygon(u: Tensor, sides: int) -> Tensor:
    """Map to points ``(2, N)`` uniform over the regular polygon in the unit circle with a corner at ``(0, 1)``.

    The concentric map to the disk, then each sector of the disk to its triangle: a fraction of the sector's angle becomes the
    same fraction of the edge. The map preserves area and is continuous, so strata of the square stay compact.
    """
    wide, r, phi = _concentric(u)
    # Anticlockwise from the upper corner: half a turn on where the radius is negative, a quarter back from the x axis.
    turn = phi * (0.5 / math.pi)
    turn = torch.where(wide, turn - 0.25, -turn) + torch.where(r < 0, 0.5, 0.0)
    position = turn * sides  # in edges from the upper corner, anticlockwise
    edge = torch.floor(position)
    middle = (edge + 0.5) * (2.0 * math.pi / sides)  # angle of the edge's middle from +y
    c, s = torch.cos(middle), torch.sin(middle)
    # Of the point: across the edge (outward from the centre) and along it.
    size = r.abs()
    out = size * math.cos(math.pi / sides)
    along = size * (2.0 * (position - edge) - 1.0) * math.sin(math.pi / sides)
    return torch.stack((-s * out - c * along, c * out - s * along))


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Map to directions ``(3, N)`` about ``+z`` with density ``cos(theta) / pi`` (Malley's method)."""
    d = concentric_disk(u)
    z = torch.addcmul(torch.addcmul(torch.ones_like(d[0]), d[0], d[0], value=-1), d[1], d[1], value=-1)
    return torch.stack((d[0], d[1], z.clamp_min(0.0).sqrt()))


def uniform_hemisphere(u: Tensor) -> Tensor:
    """Map to directions ``(3, N)`` about ``+z`` with density ``1 / 2 pi``."""
    z = u[0]
    r = (1.0 - z * z).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def uniform_sphere(u: Tensor) -> Tensor:
    """Map to directions ``(3, N)`` with density ``1 / 4 pi``."""
    z = 1.0 - 2.0 * u[0]
    r = 2.0 * (u[0] * (1.0 - u[0])).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def one_minus_cos(sin2: Tensor) -> Tensor:
    """Compute ``1 - sqrt(1 - sin2)`` without cancellation: by a series below ``sin2 = 6.9e-4``, for cones of distant lights."""
    series = sin2 * (0.5 + sin2 * (0.125 + sin2 * 0.0625))
    return torch.where(sin2 < 6.9e-4, series, 1.0 - (1.0 - sin2).clamp_min(0.0).sqrt())


def uniform_cone(u: Tensor, width: Tensor) -> Tensor:
    """Map to directions ``(3, N)`` about ``+z`` in a cone of ``width = 1 - cos(theta_max)``; density ``1 / (2 pi width)``."""
    drop = u[0] * width  # 1 - cos(theta)
    r = (drop * (2.0 - drop)).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), 1.0 - drop))


def uniform_triangle(u: Tensor) -> Tensor:
    """Map to barycentrics ``(2, N)`` uniform by area (Heitz, *A Low-Distortion Map Between Triangle and Square*, 2019)."""
    a, b = u[0], u[1]
    low = torch.minimum(a, b) * 0.5
    return torch.stack((a, b)) - low


# ---- Discrete distributions by cumulative sums in float64: a float32 sum of many weights loses small ones


@dataclass(frozen=True)
class Distribution1D:
    """A discrete distribution over K outcomes.

    Attributes:
        cdf: ``(K,)`` float64, upper end of each outcome's interval; the last is 1.
        pmf: ``(K,)`` probabilities in the lanes' dtype.
    """

    cdf: Tensor
    pmf: Tensor

    @staticmethod
    def of(weights: Tensor, dtype: torch.dtype, even: float = 0.01) -> Distribution1D:
        """Build the distribution of non-negative weights ``(K,)``; all zero gives the uniform one.

        Args:
            weights: ``(K,)``.
            dtype: of ``pmf``.
            even: probability that is spread evenly over the outcomes of positive weight. A random number has 24 bits: a rarer
                outcome would be drawn never, or too often.
        """
        w = weights.detach().double()
        total = sum_all(w)
        uniform = torch.full_like(w, 1.0 / max(len(w), 1))
        possible = (w > 0).double()
        floor = possible / possible.sum().clamp_min(1.0)
        w = torch.where(total > 0, (1.0 - even) * w / torch.where(total > 0, total, 1.0) + even * floor, uniform)
        cdf = torch.cumsum(w, 0)
        # 1 from the last possible outcome on, so that rounding never draws an impossible one.
        last = int((w > 0).nonzero().max())
        cdf[last:] = 1.0
        return Distribution1D(cdf=cdf, pmf=w.to(dtype))

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Draw outcomes ``(N,)`` int64 by ``u (N,)`` in ``[0, 1]``; return them and remapped ``u``, float64 in ``[0, 1]``.

        An outcome of probability 0 is never drawn. The remapped ``u`` is uniform and independent of the outcome.
        """
        outcome = torch.searchsorted(self.cdf, u.double().clamp_max(1.0 - 2.0**-53), right=True)
        low = torch.where(outcome > 0, take(self.cdf, (outcome - 1).clamp_min(0)), 0.0)
        width = take(self.cdf, outcome) - low
        return outcome, ((u - low) / torch.where(width > 0, width, 1.0)).clamp(0.0, 1.0)


#: Entries of a block of :attr:`Distribution2D.ends`, and 1 there.
_BLOCK, _ONE = 64, 2.0**31


@dataclass(frozen=True)
class Distribution2D:
    """A discrete distribution over the cells of an R x C grid, by rows, then by columns.

    The preimage of a cell is a rectangle of the unit square, so stratified points stay stratified. Cumulative sums over the
    columns are rounded to 31 bits, random numbers have 24: a grid may be large, and tables that fit into a cache are faster.

    Attributes:
        rows: ``(R + 1,)`` float64 cumulative sums over the rows, from 0 to 1.
        ends: ``(R S,)`` int32 cumulative sums over the columns of each row, times 2^31, rounded down and below 2^31; C of
            them and as many more as fill a whole block. A cell ends where the next one begins.
        blocks: ``(R S / 64,)`` float64: row number plus the last of each 64 ``ends``, as a fraction. They never decrease.
        stride: ``()`` int64, the number S.
    """

    rows: Tensor
    ends: Tensor
    blocks: Tensor
    stride: Tensor

    @staticmethod
    def of(blocks: Iterable[Tensor], rows: int, columns: int, device: torch.device) -> Distribution2D:
        """Return the distribution of non-negative weights, at least one of them positive.

        Args:
            blocks: some of the rows ``(n, columns)`` float64 each, which are overwritten: a grid may be large.
            rows: number of all of them.
            columns: of the grid.
            device: of the weights.
        """
        top = int(_ONE) - 1
        ends = torch.full((rows, columns + -columns % _BLOCK), top, dtype=torch.int32, device=device)
        totals: list[Tensor] = []
        first = 0
        for weights in blocks:
            along = weights.cumsum_(1)
            total = along[:, -1].clone()
            # A row without weight is never drawn.
            along.mul_((_ONE / torch.where(total > 0, total, 1.0))[:, None]).clamp_max_(top)
            ends[first : first + len(along), :columns] = along
            totals.append(total)
            first += len(along)
        down = torch.cat(totals).cumsum(0)
        last = ends[:, _BLOCK - 1 :: _BLOCK].double() / _ONE
        last[:, -1] = 1.0
        last += torch.arange(rows, dtype=last.dtype, device=device)[:, None]
        return Distribution2D(
            rows=torch.cat((down.new_zeros(1), down / down[-1])),
            ends=ends.view(-1),
            blocks=last.view(-1),
            stride=torch.tensor(ends.shape[1], dtype=torch.int64, device=device),
        )

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Draw rows and columns ``(N,)`` int64 by ``u (2, N)`` in ``[0, 1)``; return them and remapped ``u``.

        ``u[0]`` draws columns, ``u[1]`` rows. A cell without weight is never drawn.
        """
        v = u.double().contiguous().clamp_max(1.0 - 2.0**-30)  # below all of what fills a block
        row = torch.searchsorted(self.rows, v[1], right=True) - 1
        across = v[0] * _ONE
        digits = across.to(torch.int32)
        # The first block that ends beyond, then the first cell of it that does.
        cell = torch.searchsorted(self.blocks, row + digits.double() / _ONE, right=True) * _BLOCK
        step = _BLOCK // 2
        while step:
            cell = torch.where(take(self.ends, cell + (step - 1)) <= digits, cell + step, cell)
            step //= 2
        column = cell - row * self.stride
        low = torch.where(column > 0, take(self.ends, (cell - 1).clamp_min(0)), 0).double()
        rest = torch.stack(((across - low) / (take(self.ends, cell).double() - low), _within(self.rows, row, v[1])))
        return row, column, rest.to(u.dtype)


def _within(cdf: Tensor, index: Tensor, v: Tensor) -> Tensor:
    """Return the relative position of ``v`` in interval ``index`` of a CDF, in ``[0, 1)``."""
    low, high = take(cdf, index), take(cdf, index + 1)
    return (v - low) / (high - low)


def invert_linear(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Map ``u`` in ``[0, 1)`` to ``x`` in ``[0, 1]`` with density proportional to ``a (1 - x) + b x``, ``a, b >= 0``.

    Solves the quadratic without cancellation. If rounding has made ``a`` and ``b`` 0, x is 0.
    """
    largest = torch.maximum(a, b)
    scale = torch.where(largest > 0, largest, 1.0)
    a, b = a / scale, b / scale
    # x = u (a + b) / (a + sqrt(a^2 + u (b^2 - a^2))).
    bottom = a + torch.addcmul(a * a, b * b - a * a, u).clamp_min(0.0).sqrt()
    return (u * (a + b) / torch.where(bottom > 0, bottom, 1.0)).clamp_max(1.0)
