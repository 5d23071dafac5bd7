"""Noise: octaves of gradient noise (Perlin, *Improving Noise*, 2002) between two colours.

A point lies among four points of a grid. Each has a direction drawn by hashing its place, and brings the product of that and
the way to the point; between them fades ``6 t^5 - 15 t^4 + 10 t^3``, which leaves the slope and its own slope continuous. The
eight directions are those that lie furthest from the axes and the diagonals, along which noise would show the grid. No
table is needed, and nothing repeats but after 2^31 cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, logical_shift, mix, mix_int
from torchpt.physics.textures.computed import Computed
from torchpt.spec import Choice, Color, Integer, Scalar

__all__ = ["Noise"]

#: Cells from the origin beyond which a coordinate says nothing any more.
_FAR = 2.0**30
#: The parts of a direction: the cosine and the sine of 22.5 degrees.
_LONG, _SHORT = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)
#: With these directions an octave lies within -0.661..0.661.
_GAIN = 0.75
_GOLDEN = 0x9E3779B9
_COVERED = 64.0

Values = Mapping[str, Tensor]


@dataclass(frozen=True)
class Noise(Computed):
    """Octaves of gradient noise: smooth spots of two colours without repetition.

    Attributes:
        octaves: how many are added.
    """

    name = "noise"
    parameters: ClassVar = {
        "color0": Color((0.0, 0.0, 0.0), low=None, doc="where the noise is least"),
        "color1": Color((1.0, 1.0, 1.0), low=None, doc="where it is greatest; their mean is the mean of all"),
        "scale": Scalar(8.0, low=1e-6, high=1e6, doc="cells of the first octave in a unit of u and of v"),
        "octaves": Integer(4, low=1, high=16, doc="how many are added, each finer than the one before"),
        "persistence": Scalar(0.5, low=0.0, high=1.0, doc="height of an octave over that of the one before"),
        "lacunarity": Scalar(2.0, low=1.0, high=16.0, doc="cells of an octave over those of the one before"),
        "seed": Integer(0, low=0, high=2**31 - 1, doc="another one gives another noise of the same look"),
        "filter": Choice(
            "none", names=("none", "fade"), doc="fade: octaves whose cells a pixel covers go over into their mean"
        ),
    }
    filters = ("fade",)

    octaves: int = 1

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Noise:
        """See :class:`Computed`."""
        return cls(values["octaves"])

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Of each octave a key for its directions, and how far its grid is moved: else all would be 0 at the same points."""
        keys = [as_int32(mix_int(mix_int(values["seed"] + _GOLDEN) + k * _GOLDEN)) for k in range(self.octaves)]
        shifts = [(mix_int(key + axis) >> 8 & 0xFFFF) / 2**16 for key in keys[1:] for axis in (1, 2)]
        return {"keys": tuple(keys), "shifts": (0.0, 0.0, *shifts)}

    def value(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Tensor:
        """See :class:`Computed`."""
        height, whole = torch.zeros_like(x), torch.zeros_like(x)
        for weight, _, kept, at, key in self._octaves(p, x, y, area):
            whole = whole + weight
            height = torch.addcmul(height, weight if kept is None else weight * kept, _noise(at, key, False)[0])
        return p["color0"] + (p["color1"] - p["color0"]) * (0.5 + _GAIN * (height / whole))

    def slope(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :class:`Computed`."""
        across, along, whole = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x)
        for weight, cells, kept, at, key in self._octaves(p, x, y, area):
            whole = whole + weight
            weight = weight * cells if kept is None else weight * cells * kept
            dx, dy = _noise(at, key, True)
            across, along = torch.addcmul(across, weight, dx), torch.addcmul(along, weight, dy)
        factor = (p["color1"] - p["color0"]) * (_GAIN / whole)
        return across * factor, along * factor

    def _octaves(
        self, p: Values, x: Tensor, y: Tensor, area: Tensor | None
    ) -> Iterator[tuple[Tensor, Tensor, Tensor | None, tuple[Tensor, Tensor], Tensor]]:
        """Of each octave its weight, its cells in a unit, how much a footprint leaves, where in it points lie, and its key."""
        weight, cells, shifts = torch.ones_like(x), p["scale"], p["shifts"]
        if area is not None:  # in cells; of more than these nothing is left of any octave
            area = (area * cells * cells).clamp_max(_COVERED)
        for k in range(self.octaves):
            if k:
                weight, cells = weight * p["persistence"], cells * p["lacunarity"]
                area = None if area is None else area * p["lacunarity"] * p["lacunarity"]
            # The mean over a square of area a is 2^-a of the noise in its middle, by least squares, for any a.
            kept = None if area is None else (area * -math.log(2.0)).exp()
            yield weight, cells, kept, (x * cells + shifts[2 * k], y * cells + shifts[2 * k + 1]), p["keys"][k]


def _noise(at: tuple[Tensor, Tensor], key: Tensor, slope: bool) -> tuple[Tensor, ...]:
    """Gradient noise ``(N,)`` at two coordinates, or its derivatives by them; ``key``: int32 of the lane's noise."""
    x, y = (w.clamp(-_FAR, _FAR) for w in at)
    i, j = x.detach().floor(), y.detach().floor()
    x, y = x - i, y - j
    i, j = i.to(torch.int32), j.to(torch.int32)
    left, right = mix(i ^ key), mix((i + 1) ^ key)
    (ax, ay), (bx, by), (cx, cy), (dx, dy) = (
        _direction(mix(column + row), x) for row in (j, j + 1) for column in (left, right)
    )
    x1, y1 = x - 1.0, y - 1.0
    a, b = torch.addcmul(ax * x, ay, y), torch.addcmul(bx * x1, by, y)
    c, d = torch.addcmul(cx * x, cy, y1), torch.addcmul(dx * x1, dy, y1)
    u, v = _fade(x), _fade(y)
    low, high = _between(a, b, u), _between(c, d, u)
    if not slope:
        return (_between(low, high, v),)
    return (
        torch.addcmul(_between(_between(ax, bx, u), _between(cx, dx, u), v), _between(b - a, d - c, v), _fade_slope(x)),
        torch.addcmul(_between(_between(ay, by, u), _between(cy, dy, u), v), high - low, _fade_slope(y)),
    )


def _between(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    return torch.addcmul(a, b - a, t)


def _direction(bits: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
    """One of eight directions by three bits of a hash: which part is the long one, and the two signs."""
    swap, x, y = (logical_shift(bits, 31 - k) & 1 for k in range(3))
    swap, x, y = (bit.to(like.dtype) for bit in (swap, x, y))
    return (
        (_LONG + (_SHORT - _LONG) * swap) * (1.0 - 2.0 * x),
        (_SHORT + (_LONG - _SHORT) * swap) * (1.0 - 2.0 * y),
    )


def _fade(t: Tensor) -> Tensor:
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


def _fade_slope(t: Tensor) -> Tensor:
    return 30.0 * t * t * (t * (t - 2.0) + 1.0)
