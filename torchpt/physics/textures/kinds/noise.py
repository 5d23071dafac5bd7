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
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, logical_shift, mix, mix_int
from torchpt.physics.textures.computed import Computed
from torchpt.spec import Choice, Color, Integer, Scalar

__all__ = ["Noise"]

#: Coordinates are clamped to this distance from the origin in cells, where float32 has no fraction anyway.
_FAR = 2.0**30
#: Components of a gradient: cosine and sine of 22.5 degrees.
_LONG, _SHORT = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)
#: With these gradients an octave lies within -0.661..0.661.
_GAIN = 0.75
_GOLDEN = 0x9E3779B9
_COVERED = 64.0

Values = Mapping[str, Tensor]


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
        """See :meth:`Computed.of`."""
        return cls(values["octaves"])

    def constants(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a hash key for the gradients of each octave and a shift of its grid, as unshifted octaves share zeros."""
        keys = [as_int32(mix_int(mix_int(values["seed"] + _GOLDEN) + k * _GOLDEN)) for k in range(self.octaves)]
        shifts = [(mix_int(key + axis) >> 8 & 0xFFFF) / 2**16 for key in keys[1:] for axis in (1, 2)]
        return {"keys": tuple(keys), "shifts": (0.0, 0.0, *shifts)}

    def value(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> Tensor:
        """See :meth:`Computed.value`."""
        height, whole = torch.zeros_like(x), torch.zeros_like(x)
        for weight, _, kept, at, key in self._octaves(p, x, y, area):
            whole = whole + weight
            height = torch.addcmul(height, weight if kept is None else weight * kept, _noise(at, key, False)[0])
        return p["color0"] + (p["color1"] - p["color0"]) * (0.5 + _GAIN * (height / whole))

    def slope(self, p: Values, x: Tensor, y: Tensor, area: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Computed.slope`."""
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
        """Yield for each octave weight, frequency, attenuation by the footprint, coordinates in cells, and hash key."""
        weight, cells, shifts = torch.ones_like(x), p["scale"], p["shifts"]
        if area is not None:  # in cells; footprints above this size attenuate every octave to nothing
            area = (area * cells * cells).clamp_max(_COVERED)
        for k in range(self.octaves):
            if k:
                weight, cells = weight * p["persistence"], cells * p["lacunarity"]
                area = None if area is None else area * p["lacunarity"] * p["lacunarity"]
            # The mean over a square of area a is about 2^-a times the noise at its centre (a least-squares fit).
            kept = None if area is None else (area * -math.log(2.0)).exp()
            yield weight, cells, kept, (x * cells + shifts[2 * k], y * cells + shifts[2 * k + 1]), p["keys"][k]


def _noise(at: tuple[Tensor, Tensor], key: Tensor, slope: bool) -> tuple[Tensor, ...]:
    """Return gradient noise ``(N,)`` at coordinates ``at``, or with ``slope`` its derivatives; ``key``: int32 hash key."""
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
    """Return one of eight gradients by three bits of a hash: which component is longer, and the two signs."""
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
