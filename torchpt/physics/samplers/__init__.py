"""Stateless samplers: ``(seed, pixel, sample, dimension) -> u``.

The samples of a pixel are points of R independent *randomizations* of a sequence: sample ``i`` is point ``i // R`` of
randomization ``i % R``. The spread between randomizations estimates the error; the spread of points of one Sobol' sequence
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
    """Return a kind of sampler by name, with default parameters; return an instance as it is."""
    return _plain(kind) if isinstance(kind, str) else kind


@lru_cache(maxsize=64)
def _plain(kind: str) -> Points:
    return KINDS[kind]()


@dataclass(frozen=True)
class Randomizations:
    """The randomizations that share samples: ``count`` of them from index ``first`` on."""

    first: int = 0
    count: int = 1


#: Number of randomizations beyond those of the picture that have seeds: two for error probes, eight for resampled pixels.
SPARE = 10


@dataclass(frozen=True)
class Sampler:
    """A sampler: a kind of points and a seed.

    Attributes:
        kind: an instance of :class:`Points`, or the name of a kind.
        seed: an integer from 0 to 2^63 - 1.
        randomizations: R, the number of randomizations that share the samples of a pixel: ``spp // R`` points each, and one
            more for the first ``spp % R``. Those from index R on serve pixels that are sampled again.
        spp: total samples a pixel, for kinds that need it beforehand; 0 if unknown.
        width: width of the film in pixels, for kinds that depend on the position of a pixel.
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
        """The kind of points."""
        return points_of(self.kind)

    @property
    def streams(self) -> Randomizations:
        """The randomizations of the picture."""
        return Randomizations(0, self.randomizations)

    def key(self, pixel: Tensor, sample: Tensor, streams: Randomizations | None = None) -> Tensor:
        """Return :meth:`Points.key` for int64 pixel and sample indices ``(N,)``, by default in :attr:`streams`."""
        streams = streams or self.streams
        group, point = sample % streams.count + streams.first, sample // streams.count
        return self.points.key(self.numbers(pixel.device), pixel, group, point)

    def numbers(self, device: torch.device) -> SamplerTensors:
        """Return the sampler's tensors for :meth:`Points.key`."""
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
    """Return one number for each lane; see :meth:`Points.draw_1d`."""
    return points.draw_1d(key, salt)


@dispatched
def draw_2d(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Return two numbers for each lane; see :meth:`Points.draw_2d`."""
    return points.draw_2d(key, salt)


@dispatched
def draw_further(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Return the third and fourth number of a set of four for each lane; see :meth:`Points.draw_further`."""
    return points.draw_further(key, salt)


class Draws:
    """The random numbers of a path vertex for N lanes: ``draws.one(Dimension.ROULETTE)``, ``draws.two(...)``.

    Args:
        kind: an instance of :class:`Points`, or the name of a kind.
        key: ``(rows, N)`` int32 from :meth:`Sampler.key`.
        salts: ``(len(Dimension),)`` int32 from :func:`salts`; a tensor, so that compiled stages do not specialize on the depth.
    """

    def __init__(self, kind: str | Points, key: Tensor, salts: Tensor) -> None:
        self._points, self._key, self._salts = points_of(kind), key, salts

    def one(self, dimension: Dimension) -> Tensor:
        """Return ``(N,)`` float32 in ``[0, 1)``."""
        return draw_1d(self._points, self._key, self._salts[int(dimension)])

    def two(self, dimension: Dimension) -> Tensor:
        """Return ``(2, N)`` float32 in ``[0, 1)``."""
        if dimension is Dimension.LIGHT and self._points.joint:
            return draw_further(self._points, self._key, self._salts[int(Dimension.PREVIOUS_DIRECTION)])
        return draw_2d(self._points, self._key, self._salts[int(dimension)])


@lru_cache(maxsize=4096)
def salts(depth: int, device: torch.device, step: int = 0) -> Tensor:
    """Return :func:`salt` of all dimensions ``(len(Dimension),)`` int32, at a vertex or a step on the way to it."""
    return torch.tensor([salt(d, depth, step) for d in Dimension], dtype=torch.int32, device=device)
