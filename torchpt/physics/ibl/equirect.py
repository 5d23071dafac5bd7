"""Equirectangular environment maps: latitude by rows, longitude by columns, as in the light ``envmap``.

``u = atan2(x, -z) / 2 pi`` (wrapped), ``v = acos(y) / pi``. Texel centres lie at ``u = (j + 1/2) / W`` and ``v = i / (H - 1)``:
the first row is the pole +y, the last one -y. Between them a map is interpolated bilinearly: a texel counts by its hat
function, 1 at its centre and 0 at those of its neighbours. Convolutions, cube maps and the light ``envmap`` use this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.vectors import azimuth

__all__ = ["Cell", "angles", "check_map", "coordinates", "corners", "directions", "look_up", "solid_angles"]


def check_map(map: Tensor, key: str = "map") -> Tensor:
    """Return the map after checking it: ``(H, W, 3)`` floats, finite, not negative, at least two rows.

    Raises:
        SceneError: any other map; ``key`` names it.
    """
    if not isinstance(map, Tensor) or not map.is_floating_point():
        raise SceneError(key, type(map).__name__ if not isinstance(map, Tensor) else map.dtype, "a tensor of floats")
    if map.dim() != 3 or map.shape[2] != 3 or map.shape[0] < 2 or map.shape[1] < 1:
        raise SceneError(key, tuple(map.shape), "the shape (H, W, 3) with H >= 2")
    values = map.detach()
    if not bool(torch.isfinite(values).all()):
        raise SceneError(key, "NaN or infinity", "finite radiance")
    if bool((values < 0).any()):
        raise SceneError(key, float(values.min()), "radiance that is not negative")
    return map


def directions(height: int, width: int) -> Tensor:
    """Return unit directions ``(3, H, W)`` float64 of the texel centres."""
    theta = torch.linspace(0.0, math.pi, height, dtype=torch.float64)[:, None]
    phi = ((torch.arange(width, dtype=torch.float64) + 0.5) * (2.0 * math.pi / width))[None]
    sine = theta.sin()
    sine[-1] = 0.0  # sin(pi) is not quite 0 in floating point
    return torch.stack((sine * phi.sin(), theta.cos().expand(height, width), -sine * phi.cos()))


def solid_angles(height: int, width: int) -> Tensor:
    """Return the solid angle ``(H,)`` float64 of one texel of each row: the integral of its hat function over the sphere.

    A hat from ``theta - h`` to ``theta + h`` has the integral ``2 sin(theta) (1 - cos h) / h``, a half hat at a pole has
    ``1 - sin(h) / h``, both times the width of a column. All texels sum to 4 pi exactly.
    """
    h = math.pi / (height - 1)
    theta = torch.linspace(0.0, math.pi, height, dtype=torch.float64)
    rows = theta.sin() * (2.0 * (1.0 - math.cos(h)) / h)
    rows[0] = rows[-1] = 1.0 - math.sin(h) / h
    return rows * (2.0 * math.pi / width)


def angles(d: Tensor | Sequence[Tensor], min_sin2: float) -> tuple[Tensor, Tensor]:
    """Return longitude in ``[0, 2 pi]`` and angle from +y, each ``(N,)``, of unit directions ``(3, N)`` or three ``(N,)``.

    Not by acos, which near the poles is accurate only to the square root of rounding. ``min_sin2``: lower bound of the squared
    sine of the angle from +y; above 0, derivatives are finite at the poles too.
    """
    sine = torch.addcmul(d[0] * d[0], d[2], d[2]).clamp_min(min_sin2).sqrt()
    return azimuth(-d[2], d[0]), azimuth(d[1], sine)


def coordinates(d: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``u, v``, each ``(N,)`` in ``[0, 1]``, of unit directions ``(3, N)``; derivatives are finite at the poles too."""
    longitude, polar = angles(d, min_sin2=1e-14)  # the square of float32's rounding of a unit direction
    return longitude * (0.5 / math.pi), polar * (1.0 / math.pi)


class Cell(NamedTuple):
    """Cells of a map in which points lie, each ``(N,)``: row and column of the upper left texel, and fractions ``x, y``."""

    row: Tensor
    column: Tensor
    x: Tensor
    y: Tensor

    @staticmethod
    def of(x: Tensor, y: Tensor, height: int | Tensor, width: int | Tensor) -> Cell:
        """Return the cells of points ``x, y (N,)``, in texels from the centre of the first one; maps may differ by lane.

        Columns wrap around. A point in the last row has ``y`` 1 in the cells above it.
        """
        column, row = x.detach().floor(), y.detach().floor().clamp_min(0.0)
        row = row.clamp_max(height - 2) if isinstance(height, int) else torch.minimum(row, (height - 2).to(row.dtype))
        x, y, column = x - column, y - row, column.to(torch.int64)
        return Cell(row.to(torch.int64), torch.where(column < 0, width - 1, column), x, y)

    def texels(self, width: int | Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return indices ``(N,)`` of the four texels in a flat map: two of the upper row, two of the lower one."""
        left, right = self.column, torch.where(self.column == width - 1, 0, self.column + 1)
        top = self.row * width
        return top + left, top + right, top + width + left, top + width + right


def corners(
    u: Tensor, v: Tensor, height: int | Tensor, width: int | Tensor
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return the four texels around points ``u, v (N,)`` with bilinear weights; sizes may differ by lane.

    Returns:
        Four indices ``(N,)`` int64 into the flat map, and four weights ``(N,)`` that sum to 1.
    """
    cell = Cell.of(u * width - 0.5, (v * (height - 1)).clamp_min(0.0), height, width)
    x, y = 1.0 - cell.x, 1.0 - cell.y
    return cell.texels(width), (y * x, y * cell.x, cell.y * x, cell.y * cell.x)


def look_up(map: Tensor, d: Tensor) -> Tensor:
    """Return radiance ``(..., 3)`` of a map ``(H, W, 3)`` in unit directions ``(..., 3)``; differentiable in both."""
    height, width, _ = map.shape
    flat = map.reshape(-1, 3)
    texels, weights = corners(*coordinates(d.reshape(-1, 3).T), height, width)
    value = sum(weight[:, None] * flat.index_select(0, texel) for texel, weight in zip(texels, weights, strict=True))
    assert isinstance(value, Tensor)
    return value.reshape(d.shape)
