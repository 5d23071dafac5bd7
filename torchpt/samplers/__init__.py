"""Stateless samplers: ``(seed, pixel, sample, dimension) -> u``.

A picture is the mean over several independent *randomizations*: sample ``i`` is point ``i // R`` of randomization
``i % R``. Their spread gives the picture's own error; the spread of points within one Sobol' sequence would not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType

import torch
from torch import Tensor

from torchpt.lanes.tracing import tracing
from torchpt.math.hashing import as_int32, mix, mix_int
from torchpt.native.operators import choose, operator
from torchpt.samplers import hammersley, independent, sobol, stratified, zsobol
from torchpt.samplers.dimensions import Dimension, salt

__all__ = ["KINDS", "Dimension", "Draws", "Numbers", "Sampler", "key_of", "salts"]

#: Sampler types by name: modules with ``draw_1d(key, salt)``, ``draw_2d(key, salt)`` and ``NEEDS_COUNT``.
KINDS: dict[str, ModuleType] = {
    "sobol": sobol,
    "independent": independent,
    "stratified": stratified,
    "hammersley": hammersley,
    "zsobol": zsobol,
}


@dataclass(frozen=True)
class Sampler:
    """A sampler of one type under one seed.

    Attributes:
        kind: name of the type, from :data:`KINDS`.
        seed: any integer from 0 to 2^63 - 1.
        randomizations: R, how many independent sequences share the samples of a pixel: ``spp // R`` points each, and one
            more for the first ``spp % R``.
        spp: samples a pixel in all, for the kinds that must know it beforehand; 0 where nobody knows.
        width: of the film in pixels, by which pixels are numbered; for kinds that ask where a pixel lies.
    """

    kind: str
    seed: int
    randomizations: int = 1
    spp: int = 0
    width: int = 1

    def __post_init__(self) -> None:
        if KINDS[self.kind].NEEDS_COUNT and self.spp < self.randomizations:
            raise ValueError(f"{self.kind} points must know their number, at least one for each randomization")

    def key(self, pixel: Tensor, sample: Tensor) -> Tensor:
        """:func:`key_of` for int64 pixel and sample indices ``(N,)``."""
        group, point = sample % self.randomizations, sample // self.randomizations
        return key_of(self.kind, self.numbers(pixel.device), pixel, group, point)

    def numbers(self, device: torch.device) -> Numbers:
        """What :func:`key_of` needs of the sampler."""
        seeds = [
            mix_int(mix_int(mix_int(self.seed) ^ as_int32(self.seed >> 32)) + g) for g in range(self.randomizations)
        ]
        every, more = divmod(self.spp, self.randomizations)
        most = -(-self.spp // self.randomizations)
        bits = max(most - 1, 0).bit_length()
        return Numbers(
            torch.tensor(seeds, dtype=torch.int32, device=device),
            *(torch.tensor(n, dtype=torch.int64, device=device) for n in (every, more, bits, self.width)),
        )


@dataclass(frozen=True)
class Numbers:
    """A sampler as tensors, so that a kernel made for one serves all of its kind."""

    seeds: Tensor  # (R,) int32 of the randomizations
    every: Tensor  # () int64 points of each randomization
    more: Tensor  # () int64 how many of them have one more
    bits: Tensor  # () int64 of the largest index of a point
    width: Tensor  # () int64 of the film


def key_of(kind: str, numbers: Numbers, pixel: Tensor, group: Tensor, point: Tensor) -> Tensor:
    """``(2, N)`` int32: a pixel's seed and a point's index.

    The seed is a bijection of the pixel index for each (seed, randomization), so no two pixels share a sequence.
    ``stratified`` and ``hammersley`` have a third row, how many points there are; ``zsobol`` has :func:`zsobol.key`.

    Args:
        kind: type of the sampler.
        numbers: of the sampler.
        pixel: index on the film ``(N,)`` int64.
        group: randomization ``(N,)`` int64.
        point: index in its sequence ``(N,)`` int64.
    """
    seed = torch.index_select(numbers.seeds, 0, group)
    if kind == "zsobol":
        return zsobol.key(pixel, point, seed, numbers.bits, numbers.width)
    key = [mix(mix(pixel.to(torch.int32)) ^ seed), point.to(torch.int32)]
    if KINDS[kind].NEEDS_COUNT:
        key.append((numbers.every + (group < numbers.more)).to(torch.int32))
    return torch.stack(key)


class Draws:
    """The numbers of one path vertex for a batch of lanes: ``draws.one(Dimension.ROULETTE)``, ``draws.two(...)``.

    Args:
        kind: type of the sampler.
        key: ``(rows, N)`` int32 as given by :meth:`Sampler.key`.
        salts: ``(len(Dimension),)`` int32, the dimensions' names at this depth; a tensor, so that a compiled stage does not
            specialize on the depth.
    """

    def __init__(self, kind: str, key: Tensor, salts: Tensor) -> None:
        self._kind, self._key, self._salts = kind, key, salts

    def one(self, dimension: Dimension) -> Tensor:
        """``(N,)`` float32 in ``[0, 1)``."""
        if self._key.device.type == "cpu" and not tracing():
            return choose(_draw_on_cpu, _draw_operator)(self._kind, 1, self._key, self._salts, int(dimension))[0]
        return KINDS[self._kind].draw_1d(self._key, self._salts[int(dimension)])

    def two(self, dimension: Dimension) -> Tensor:
        """``(2, N)`` float32 in ``[0, 1)``."""
        if self._key.device.type == "cpu" and not tracing():
            return choose(_draw_on_cpu, _draw_operator)(self._kind, 2, self._key, self._salts, int(dimension))
        return KINDS[self._kind].draw_2d(self._key, self._salts[int(dimension)])


def _draw_on_cpu(kind: str, rows: int, key: Tensor, salts: Tensor, dimension: int) -> Tensor:
    """``(rows, N)`` numbers from the kernels."""
    from torchpt.samplers import kernels

    return kernels.draw(kind, rows, key, int(salts[dimension]))


_draw_operator = operator("torchpt::draw", _draw_on_cpu)


@_draw_operator.register_fake
def _(kind: str, rows: int, key: Tensor, salts: Tensor, dimension: int) -> Tensor:
    return torch.empty(rows, key.shape[1], dtype=torch.float32, device=key.device)


@lru_cache(maxsize=4096)
def salts(depth: int, device: torch.device) -> Tensor:
    """The dimensions' names at path vertex ``depth``: ``(len(Dimension),)`` int32; 0 is the camera."""
    return torch.tensor([salt(d, depth) for d in Dimension], dtype=torch.int32, device=device)
