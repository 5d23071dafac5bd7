"""Stateless samplers: ``(seed, pixel, sample, dimension) -> u``.

A pixel's samples are the points of one or more independent *randomizations* of a sequence, its streams: of R streams sample
``i`` is point ``i // R`` of stream ``i % R``. The spread of streams tells an error; that of points within one Sobol' sequence
would not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchpt.core.dispatch import dispatched
from torchpt.math.hashing import as_int32, mix_int
from torchpt.physics.samplers.base import ADAPTIVE, Points, SamplerTensors
from torchpt.physics.samplers.dimensions import Dimension, salt
from torchpt.spec import Kinds

__all__ = [
    "ADAPTIVE",
    "KINDS",
    "Dimension",
    "Draws",
    "Points",
    "Randomizations",
    "Sampler",
    "SamplerTensors",
    "draw_1d",
    "draw_2d",
    "draw_further",
    "points_of",
    "salts",
]

#: The kinds of samplers.
KINDS: Kinds[Points] = Kinds(
    "torchpt.physics.samplers.kinds", ("sobol", "independent", "stratified", "hammersley", "zsobol")
)  # fmt: skip


def points_of(kind: str | Points) -> Points:
    """A kind by name, all of its parameters at their defaults; or what is one already."""
    return _plain(kind) if isinstance(kind, str) else kind


@lru_cache(maxsize=64)
def _plain(kind: str) -> Points:
    return KINDS[kind]()


@dataclass(frozen=True)
class Randomizations:
    """Randomizations that share samples: ``count`` of them from number ``first`` on."""

    first: int = 0
    count: int = 1


#: Streams beside those of the picture that a sampler has seeds for: two of second values, eight that look again.
SPARE = 10


@dataclass(frozen=True)
class Sampler:
    """A sampler of one kind under one seed.

    Attributes:
        kind: where the points lie; or the name of a kind.
        seed: any integer from 0 to 2^63 - 1.
        randomizations: R, how many streams share the samples of a pixel: ``spp // R`` points each, and one more for the
            first ``spp % R``. Those from R on are there for pixels that are sampled again.
        spp: samples a pixel in all, for the kinds that must know it beforehand; 0 where nobody knows.
        width: of the film in pixels, by which pixels are numbered; for kinds that ask where a pixel lies.
    """

    kind: str | Points
    seed: int
    randomizations: int = 1
    spp: int = 0
    width: int = 1

    def __post_init__(self) -> None:
        if self.points.needs_count and self.spp < self.randomizations:
            raise ValueError(f"{self.points.name} points must know their number, at least one for each randomization")

    @property
    def points(self) -> Points:
        """Return where the points lie."""
        return points_of(self.kind)

    @property
    def streams(self) -> Randomizations:
        """Those of the picture."""
        return Randomizations(0, self.randomizations)

    def key(self, pixel: Tensor, sample: Tensor, streams: Randomizations | None = None) -> Tensor:
        """:meth:`Points.key` for int64 pixel and sample indices ``(N,)``, by the picture's streams or others."""
        streams = streams or self.streams
        group, point = sample % streams.count + streams.first, sample // streams.count
        return self.points.key(self.numbers(pixel.device), pixel, group, point)

    def numbers(self, device: torch.device) -> SamplerTensors:
        """Return what :meth:`Points.key` needs of the sampler."""
        seeds = [
            mix_int(mix_int(mix_int(self.seed) ^ as_int32(self.seed >> 32)) + g)
            for g in range(self.randomizations + SPARE)
        ]
        every, more = divmod(self.spp, self.randomizations)
        most = -(-self.spp // self.randomizations)
        bits = max(most - 1, 0).bit_length()
        return SamplerTensors(
            torch.tensor(seeds, dtype=torch.int32, device=device),
            *(torch.tensor(n, dtype=torch.int64, device=device) for n in (every, more, bits, self.width)),
        )


@dispatched
def draw_1d(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Draw one number a lane, see :meth:`Points.draw_1d`."""
    return points.draw_1d(key, salt)


@dispatched
def draw_2d(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Draw two numbers a lane, see :meth:`Points.draw_2d`."""
    return points.draw_2d(key, salt)


@dispatched
def draw_further(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Draw the two numbers with which a set of two goes on, see :meth:`Points.draw_further`."""
    return points.draw_further(key, salt)


class Draws:
    """The numbers of one path vertex for a batch of lanes: ``draws.one(Dimension.ROULETTE)``, ``draws.two(...)``.

    Args:
        kind: where the points lie; or the name of a kind.
        key: ``(rows, N)`` int32 as given by :meth:`Sampler.key`.
        salts: ``(len(Dimension),)`` int32, the dimensions' names at this depth; a tensor, so that a compiled stage does not
            specialize on the depth.
    """

    def __init__(self, kind: str | Points, key: Tensor, salts: Tensor) -> None:
        self._points, self._key, self._salts = points_of(kind), key, salts

    def one(self, dimension: Dimension) -> Tensor:
        """``(N,)`` float32 in ``[0, 1)``."""
        return draw_1d(self._points, self._key, self._salts[int(dimension)])

    def two(self, dimension: Dimension) -> Tensor:
        """``(2, N)`` float32 in ``[0, 1)``."""
        if dimension is Dimension.LIGHT and self._points.joint:
            return draw_further(self._points, self._key, self._salts[int(Dimension.PREVIOUS_DIRECTION)])
        return draw_2d(self._points, self._key, self._salts[int(dimension)])


@lru_cache(maxsize=4096)
def salts(depth: int, device: torch.device, step: int = 0) -> Tensor:
    """Return the names ``(len(Dimension),)`` int32 of all dimensions at a vertex, or at a step on the way (:func:`salt`)."""
    return torch.tensor([salt(d, depth, step) for d in Dimension], dtype=torch.int32, device=device)
