"""Sampling: warps of the unit square, discrete distributions, weights of multiple importance sampling."""

from __future__ import annotations

import math
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
    """Weight ``a^2 / (a^2 + b^2)`` of the strategy with density ``a``, both ``(N,)``; 0 where ``a`` is 0, 1 where it is inf.

    Written as ``1 / (1 + (b/a)^2)``: the densities' own squares would leave float32's range above 1.8e19. The ratio may
    overflow to infinity, which gives the right limit 0.
    """
    ratio = b * safe_reciprocal(a)
    return torch.sign(a) / (1.0 + ratio * ratio)


# ---- Warps of the unit square ``(2, N)`` onto domains, with their densities. Inputs lie in ``[0, 1)``


def concentric_disk(u: Tensor) -> Tensor:
    """Area-preserving map to the unit disk ``(2, N)`` (Shirley and Chiu, *A Low Distortion Map*, 1997)."""
    wide, r, phi = _concentric(u)
    c, s = torch.cos(phi), torch.sin(phi)
    return r * torch.stack((torch.where(wide, c, s), torch.where(wide, s, c)))


def _concentric(u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The concentric map's signed radius and its angle, from the x axis where ``wide``, else from the y axis (mirrored)."""
    a, b = 2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    # The quotient is 0/0 only at the centre, where r = 0 makes the angle irrelevant.
    ratio = torch.where(wide, b, a) / torch.where(r == 0, 1.0, r)
    return wide, r, (math.pi / 4) * ratio


def uniform_polygon(u: Tensor, sides: int) -> Tensor:
    """Points ``(2, N)`` uniform over the regular polygon in the unit circle, one of its corners at ``(0, 1)``.

    The concentric map to the disk, then each sector of the disk onto its triangle: a share of the angle becomes the same
    share of the edge. That preserves area as well and is continuous, so that strata of the square stay compact.
    """
    wide, r, phi = _concentric(u)
    # Anticlockwise from the upper corner: half a turn on where the radius is negative, a quarter back from the x axis.
    turn = phi * (0.5 / math.pi)
    turn = torch.where(wide, turn - 0.25, -turn) + torch.where(r < 0, 0.5, 0.0)
    place = turn * sides
    edge = torch.floor(place)
    middle = (edge + 0.5) * (2.0 * math.pi / sides)
    c, s = torch.cos(middle), torch.sin(middle)
    size = r.abs()
    out = size * math.cos(math.pi / sides)
    along = size * (2.0 * (place - edge) - 1.0) * math.sin(math.pi / sides)
    return torch.stack((-s * out - c * along, c * out - s * along))


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` about ``+z`` with density ``cos(theta) / pi`` (Malley's method)."""
    d = concentric_disk(u)
    z = torch.addcmul(torch.addcmul(torch.ones_like(d[0]), d[0], d[0], value=-1), d[1], d[1], value=-1)
    return torch.stack((d[0], d[1], z.clamp_min(0.0).sqrt()))


def uniform_hemisphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` with density ``1 / 2 pi``."""
    z = u[0]
    r = (1.0 - z * z).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def uniform_sphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` with density ``1 / 4 pi``."""
    z = 1.0 - 2.0 * u[0]
    r = 2.0 * (u[0] * (1.0 - u[0])).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def one_minus_cos(sin2: Tensor) -> Tensor:
    """``1 - sqrt(1 - sin2)`` without cancellation: a series below ``sin2 = 6.9e-4``, where a far light's cone vanishes."""
    series = sin2 * (0.5 + sin2 * (0.125 + sin2 * 0.0625))
    return torch.where(sin2 < 6.9e-4, series, 1.0 - (1.0 - sin2).clamp_min(0.0).sqrt())


def uniform_cone(u: Tensor, width: Tensor) -> Tensor:
    """Directions ``(3, N)`` about ``+z`` within a cone of ``width = 1 - cos(theta_max)``; density ``1 / (2 pi width)``."""
    drop = u[0] * width  # 1 - cos(theta)
    r = (drop * (2.0 - drop)).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), 1.0 - drop))


def uniform_triangle(u: Tensor) -> Tensor:
    """Barycentrics ``(2, N)`` of points uniform by area (Heitz, *A Low-Distortion Map Between Triangle and Square*, 2019)."""
    a, b = u[0], u[1]
    low = torch.minimum(a, b) * 0.5
    return torch.stack((a, b)) - low


# ---- Distributions by their cumulative sums, kept in float64: a float32 sum of many weights collapses


@dataclass(frozen=True)
class Distribution1D:
    """Choice among K outcomes.

    Attributes:
        cdf: ``(K,)`` float64, the upper end of each outcome's interval; the last is 1.
        pmf: ``(K,)`` probabilities in the lanes' dtype.
    """

    cdf: Tensor
    pmf: Tensor

    @staticmethod
    def of(weights: Tensor, dtype: torch.dtype, even: float = 0.01) -> Distribution1D:
        """From non-negative weights ``(K,)``; all zero gives the uniform choice.

        Args:
            weights: ``(K,)``.
            dtype: of ``pmf``.
            even: share of the draws that is even among the outcomes with any weight. A draw has 24 bits: an outcome rarer
                than that would never come up, or too often.
        """
        w = weights.detach().double()
        total = sum_all(w)
        uniform = torch.full_like(w, 1.0 / max(len(w), 1))
        possible = (w > 0).double()
        floor = possible / possible.sum().clamp_min(1.0)
        w = torch.where(total > 0, (1.0 - even) * w / torch.where(total > 0, total, 1.0) + even * floor, uniform)
        cdf = torch.cumsum(w, 0)
        # From the last possible outcome on the sum is 1, so that rounding never lets a draw fall on an impossible one.
        last = int((w > 0).nonzero().max())
        cdf[last:] = 1.0
        return Distribution1D(cdf, w.to(dtype))

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return outcomes ``(N,)`` int64 for ``u (N,)`` in ``[0, 1]``, and what is left of ``u``, float64 in ``[0, 1]``.

        One of probability 0 is never drawn. What is left is uniform whatever was chosen.
        """
        outcome = torch.searchsorted(self.cdf, u.double().clamp_max(1.0 - 2.0**-53), right=True)
        low = torch.where(outcome > 0, take(self.cdf, (outcome - 1).clamp_min(0)), 0.0)
        width = take(self.cdf, outcome) - low
        return outcome, ((u - low) / torch.where(width > 0, width, 1.0)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class Distribution2D:
    """Choice of a cell of an R x C grid, rows first; what a draw leaves over is a fresh number within the cell.

    The cells' preimages are rectangles of the unit square, so points that are stratified there stay so.

    Attributes:
        rows: ``(R + 1,)`` float64 cumulative sums over the rows, from 0 to 1.
        columns: ``(R C + 1,)`` float64: row number plus the cumulative sums within that row. It never falls, so that one
            binary search finds a cell of any row.
        width: ``()`` int64 C.
    """

    rows: Tensor
    columns: Tensor
    width: Tensor

    @staticmethod
    def of(weights: Tensor) -> Distribution2D:
        """From non-negative weights ``(R, C)`` of which one is positive."""
        w = weights.detach().double()
        number = w.shape[0]
        along = torch.cumsum(w, 1)
        total = along[:, -1:]
        # A row without weight is never asked.
        along = torch.where(total > 0, along / torch.where(total > 0, total, 1.0), 1.0)
        along += torch.arange(number, dtype=w.dtype, device=w.device)[:, None]
        down = torch.cumsum(total[:, 0], 0)
        zero = down.new_zeros(1)
        width = torch.tensor(w.shape[1], dtype=torch.int64, device=w.device)
        return Distribution2D(torch.cat((zero, down / down[-1])), torch.cat((zero, along.reshape(-1))), width)

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns ``(N,)`` int64 for ``u (2, N)`` in ``[0, 1)``, and what is left ``(2, N)``: columns by ``u[0]``.

        A cell without weight is never drawn.
        """
        # Just below 1 a row number plus u would round to the next row.
        v = u.double().contiguous().clamp_max(1.0 - 2.0**-32)
        row = torch.searchsorted(self.rows, v[1], right=True) - 1
        across = v[0] + row
        cell = torch.searchsorted(self.columns, across, right=True) - 1
        rest = torch.stack((_within(self.columns, cell, across), _within(self.rows, row, v[1])))
        return row, cell - row * self.width, rest.to(u.dtype)


def _within(cdf: Tensor, index: Tensor, v: Tensor) -> Tensor:
    """Where ``v`` lies in the interval ``index``, in ``[0, 1)``."""
    low, high = take(cdf, index), take(cdf, index + 1)
    return (v - low) / (high - low)


def invert_linear(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """``x`` in ``[0, 1]`` distributed as ``a (1 - x) + b x``, for ``u`` in ``[0, 1)``; ``a, b >= 0`` and not both 0.

    The root of the quadratic in the form that does not cancel. Where rounding made both 0, x is 0.
    """
    largest = torch.maximum(a, b)
    scale = torch.where(largest > 0, largest, 1.0)
    a, b = a / scale, b / scale
    bottom = a + torch.addcmul(a * a, b * b - a * a, u).clamp_min(0.0).sqrt()
    return (u * (a + b) / torch.where(bottom > 0, bottom, 1.0)).clamp_max(1.0)
