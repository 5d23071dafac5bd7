"""Noise: octaves of gradient noise (Perlin, *Improving Noise*, 2002) between two colours.

Each of the four grid points around a point has a gradient, chosen by a hash of its position. The dot products of gradients and
offsets are blended by ``6 t^5 - 15 t^4 + 10 t^3``, with continuous first and second derivatives. The eight gradients are
farthest from the axes and the diagonals, along which the grid would be visible. No table is needed, and the noise repeats
only after 2^31 cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, logical_shift, mix, mix_int
from torchpt.physics.textures.computed import Computed
from torchpt.spec import Choice, Color, Integer, Scalar

__all__ = ["Noise"]

#: Coordinates are clamped to this distance from the origin in cells, where float32 has no fraction anyway.
_FARTHEST = 2.0**30
#: Components of a gradient: cosine and sine of 22.5 degrees.
_LONG, _SHORT = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)
#: With these gradients an octave lies within -0.661..0.661: times this, plus 0.5, it stays within 0..1.
_GAIN = 0.75
#: 2^32 over the golden ratio: multiples of it have bits that look unrelated, which makes them good seeds of a hash.
_GOLDEN = 0x9E3779B9
#: Footprints of this area in cells leave nothing of an octave: 2^-64.
_MAX_AREA = 64.0

Values = Mapping[str, Tensor]  # parameters by name, per lane


@dataclass(frozen=True)
class Noise(Computed):
    """Octaves of gradient noise: smooth blobs of two colours without repetition.

    Attributes:
        octaves: number of octaves.
    """

    name = "noise"
    parameters: ClassVar = {
        "color0": Color((0.0, 0.0, 0.0), low=None, doc="colour where the noise is least"),
        "color1": Color(
            (1.0, 1.0, 1.0),
            low=None,
            doc="colour where the noise is greatest; the mean of both is the mean of the texture",
        ),
        "scale": Scalar(8.0, low=1e-6, high=1e6, doc="cells of the first octave per unit of u and of v"),
        "octaves": Integer(4, low=1, high=16, doc="number of octaves"),
        "persistence": Scalar(0.5, low=0.0, high=1.0, doc="amplitude of an octave over that of the previous one"),
        "lacunarity": Scalar(2.0, low=1.0, high=16.0, doc="frequency of an octave over that of the previous one"),
        "seed": Integer(0, low=0, high=2**31 - 1, doc="selects another pattern of the same look"),
        "filter": Choice(
            "none", names=("none", "fade"), doc="fade: octaves fade to their mean where a pixel covers their cells"
        ),
    }
    filters = ("fade",)

    octaves: int = 1

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Noise:
        """Return the variant with this number of octaves: its code is compiled with the loop unrolled."""
        return cls(octaves=values["octaves"])

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a hash key for the gradients of each octave and a shift of its grid.

        Noise is 0 at the points of its grid; shifts, in cells, keep octaves from being 0 at the same points.
        """
        keys = [as_int32(mix_int(mix_int(values["seed"] + _GOLDEN) + k * _GOLDEN)) for k in range(self.octaves)]
        # 16 bits of a hash as a fraction in [0, 1), for both axes of each octave after the first.
        shifts = [(mix_int(key + axis) >> 8 & 0xFFFF) / 2**16 for key in keys[1:] for axis in (1, 2)]
        return {"keys": tuple(keys), "shifts": (0.0, 0.0, *shifts)}

    def value(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Tensor:
        """See :meth:`Computed.value`."""
        height, total_weight = torch.zeros_like(x), torch.zeros_like(x)
        for octave in self._octaves(p, x, y, area):
            weight, attenuation = octave.weight, octave.attenuation
            total_weight = total_weight + weight
            if attenuation is not None:
                weight = weight * attenuation
            height = torch.addcmul(height, weight, _noise(octave.x, octave.y, octave.key))
        return p["color0"] + (p["color1"] - p["color0"]) * (0.5 + _GAIN * (height / total_weight))

    def slope(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Computed.slope`."""
        along_x, along_y, total_weight = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
        for octave in self._octaves(p, x, y, area):
            total_weight = total_weight + octave.weight
            weight = octave.weight * octave.frequency
            if octave.attenuation is not None:
                weight = weight * octave.attenuation
            dx, dy = _noise_slope(octave.x, octave.y, octave.key)
            along_x, along_y = torch.addcmul(along_x, weight, dx), torch.addcmul(along_y, weight, dy)
        factor = (p["color1"] - p["color0"]) * (_GAIN / total_weight)
        return along_x * factor, along_y * factor

    def _octaves(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Iterator[_Octave]:
        """Yield the octaves at points; arguments as for :meth:`Computed.value`."""
        weight, frequency, shifts = torch.ones_like(x), p["scale"], p["shifts"]
        if area is not None:  # from here on in cells of the octave
            area = (area * frequency * frequency).clamp_max(_MAX_AREA)
        for k in range(self.octaves):
            if k:
                weight, frequency = weight * p["persistence"], frequency * p["lacunarity"]
                area = None if area is None else area * p["lacunarity"] * p["lacunarity"]
            # The mean over a square of area a is about 2^-a times the noise at its centre (a least-squares fit).
            attenuation = None if area is None else (area * -math.log(2.0)).exp()
            shifted_x, shifted_y = x * frequency + shifts[2 * k], y * frequency + shifts[2 * k + 1]
            yield _Octave(weight, frequency, attenuation, shifted_x, shifted_y, p["keys"][k])


class _Octave(NamedTuple):
    """One octave at N points, each ``(N,)``."""

    weight: Tensor  # amplitude over that of the first octave
    frequency: Tensor  # cells per unit of the coordinates
    attenuation: Tensor | None  # by the footprint; None: unfiltered
    x: Tensor  # coordinates in cells
    y: Tensor
    key: Tensor  # int32 hash key


class _Cell(NamedTuple):
    """The cell of N points: gradients at its four corners, and their products with the offsets from there.

    Corners are a, b (left and right) at the smaller y, and c, d at the larger one; each tensor is ``(N,)``.
    """

    gradients_x: tuple[Tensor, Tensor, Tensor, Tensor]
    gradients_y: tuple[Tensor, Tensor, Tensor, Tensor]
    products: tuple[Tensor, Tensor, Tensor, Tensor]
    x: Tensor  # coordinates within the cell, 0 to 1
    y: Tensor


def _cell(x: Tensor, y: Tensor, key: Tensor) -> _Cell:
    """Return the cells of coordinates ``x, y (N,)``; ``key``: int32 hash key ``(N,)``."""
    x, y = (coordinate.clamp(-_FARTHEST, _FARTHEST) for coordinate in (x, y))
    i, j = x.detach().floor(), y.detach().floor()
    x, y = x - i, y - j
    i, j = i.to(torch.int32), j.to(torch.int32)
    left, right = mix(i ^ key), mix((i + 1) ^ key)
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = (
        _gradient(mix(column + row), x) for row in (j, j + 1) for column in (left, right)
    )
    x1, y1 = x - 1.0, y - 1.0
    a, b = torch.addcmul(ax * x, ay, y), torch.addcmul(bx * x1, by, y)
    c, d = torch.addcmul(cx * x, cy, y1), torch.addcmul(dx * x1, dy, y1)
    return _Cell((ax, bx, cx, dx), (ay, by, cy, dy), (a, b, c, d), x, y)


def _noise(x: Tensor, y: Tensor, key: Tensor) -> Tensor:
    """Return gradient noise ``(N,)``; arguments as for :func:`_cell`."""
    cell = _cell(x, y, key)
    a, b, c, d = cell.products
    u, v = _fade(cell.x), _fade(cell.y)
    return _lerp(_lerp(a, b, u), _lerp(c, d, u), v)


def _noise_slope(x: Tensor, y: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives ``(N,)`` of gradient noise by both coordinates; arguments as for :func:`_cell`."""
    cell = _cell(x, y, key)
    (ax, bx, cx, dx), (ay, by, cy, dy), (a, b, c, d) = cell.gradients_x, cell.gradients_y, cell.products
    u, v = _fade(cell.x), _fade(cell.y)
    low, high = _lerp(a, b, u), _lerp(c, d, u)
    return (
        torch.addcmul(_lerp(_lerp(ax, bx, u), _lerp(cx, dx, u), v), _lerp(b - a, d - c, v), _fade_slope(cell.x)),
        torch.addcmul(_lerp(_lerp(ay, by, u), _lerp(cy, dy, u), v), high - low, _fade_slope(cell.y)),
    )


def _lerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Interpolate linearly from ``a`` at ``t`` 0 to ``b`` at ``t`` 1."""
    return torch.addcmul(a, b - a, t)


def _gradient(bits: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return one of eight gradients by the top three bits of a hash: which component is longer, and the two signs.

    ``like``: a tensor of the dtype of the result.
    """
    swap, negative_x, negative_y = (logical_shift(bits, 31 - k) & 1 for k in range(3))
    swap, negative_x, negative_y = (bit.to(like.dtype) for bit in (swap, negative_x, negative_y))
    return (
        (_LONG + (_SHORT - _LONG) * swap) * (1.0 - 2.0 * negative_x),
        (_SHORT + (_LONG - _SHORT) * swap) * (1.0 - 2.0 * negative_y),
    )


def _fade(t: Tensor) -> Tensor:
    """Return ``6 t^5 - 15 t^4 + 10 t^3``."""
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


def _fade_slope(t: Tensor) -> Tensor:
    """Return the derivative of :func:`_fade`: ``30 t^2 (t - 1)^2``."""
    return 30.0 * t * t * (t * (t - 2.0) + 1.0)
