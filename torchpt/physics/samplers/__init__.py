"""Stateless samplers: ``(seed, pixel, sample, dimension) -> u``.

The samples of a pixel are points of R independent *randomizations* of a sequence: sample ``i`` is point ``i // R`` of
randomization ``i % R``. The spread between randomizations estimates the error; the spread of points of one Sobol' sequence
would not. Variables that hold a range of randomizations are named ``streams``.

A number is drawn in two steps. :meth:`Sampler.key` makes the *key* of a sample when its path starts (seed of the pixel, index
of the point); stages then draw from the key with the *salt* of a dimension (the hash of what the number is for, and at which
vertex), through :class:`Draws`. ``base.py`` has the base class of kinds; read it first.
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
    return _default_points(kind) if isinstance(kind, str) else kind


@lru_cache(maxsize=64)
def _default_points(kind: str) -> Points:
    return KINDS[kind]()


@dataclass(frozen=True)
class Randomizations:
    """The randomizations that share the samples of a pixel: ``count`` of them, from index ``first`` of the seeds on."""

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
            more for the first ``spp % R``. Those from index R on (``SPARE`` of them) serve pixels that are sampled again.
        spp: total samples a pixel, for kinds that need it beforehand (:attr:`Points.needs_count`); 0 if unknown.
        width: width of the whole film in pixels, for kinds that depend on the position of a pixel (:attr:`Points.of_film`).
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
        """The randomizations of the picture: all but the spare ones."""
        return Randomizations(first=0, count=self.randomizations)

    def key(self, pixel: Tensor, sample: Tensor, streams: Randomizations | None = None) -> Tensor:
        """Return the keys of samples, made by :meth:`Points.key`: ``(rows, N)`` int32.

        Args:
            pixel: index of the pixel on the whole film, row by row ``(N,)`` int64.
            sample: index of the sample within the pixel ``(N,)`` int64.
            streams: the randomizations that share the samples; by default :attr:`streams`.
        """
        streams = streams or self.streams
        randomization, point = sample % streams.count + streams.first, sample // streams.count
        return self.points.key(self.tensors(pixel.device), pixel, randomization, point)

    def tensors(self, device: torch.device) -> SamplerTensors:
        """Return the sampler's tensors for :meth:`Points.key`."""
        # Both halves of the 64-bit seed are hashed into one word; the randomizations count on from there.
        seed = mix_int(mix_int(self.seed) ^ as_int32(self.seed >> 32))
        seeds = [mix_int(seed + randomization) for randomization in range(self.randomizations + SPARE)]
        points_each, with_one_more = divmod(self.spp, self.randomizations)
        most_points = points_each + (with_one_more > 0)
        index_bits = max(most_points - 1, 0).bit_length()

        def number(value: int) -> Tensor:
            # A fill, for which the host does not wait as for a copy to the device.
            return torch.full((), value, dtype=torch.int64, device=device)

        return SamplerTensors(
            seeds=torch.tensor(seeds, dtype=torch.int32, device=device),
            points_each=number(points_each),
            with_one_more=number(with_one_more),
            index_bits=number(index_bits),
            film_width=number(self.width),
        )


# Engines may replace the next three functions by kernels (``torchpt.core.dispatch``); the arguments are those of the methods
# of :class:`Points`: a key (rows, N) int32, and a salt () int32 as a tensor.


@dispatched
def draw_1d(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Return one number for each lane ``(N,)``, by :meth:`Points.draw_1d`."""
    return points.draw_1d(key, salt)


@dispatched
def draw_2d(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Return two numbers for each lane ``(2, N)``, by :meth:`Points.draw_2d`."""
    return points.draw_2d(key, salt)


@dispatched
def draw_further(points: Points, key: Tensor, salt: Tensor) -> Tensor:
    """Return the third and fourth number of a set of four for each lane ``(2, N)``, by :meth:`Points.draw_further`."""
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
        """Return the number ``(N,)`` of a 1D dimension, float32 in ``[0, 1)``."""
        return draw_1d(self._points, self._key, self._salts[int(dimension)])

    def two(self, dimension: Dimension) -> Tensor:
        """Return the two numbers ``(2, N)`` of a 2D dimension, float32 in ``[0, 1)``.

        The point on a light continues the set of four that the direction to this vertex began, where the kind has such sets.
        """
        if dimension is Dimension.LIGHT and self._points.joint:
            return draw_further(self._points, self._key, self._salts[int(Dimension.PREVIOUS_DIRECTION)])
        return draw_2d(self._points, self._key, self._salts[int(dimension)])


@lru_cache(maxsize=4096)
def salts(depth: int, device: torch.device, step: int = 0) -> Tensor:
    """Return the salts of all dimensions ``(len(Dimension),)`` int32; ``depth`` and ``step`` as for :func:`salt`."""
    return torch.tensor([salt(d, depth, step) for d in Dimension], dtype=torch.int32, device=device)
