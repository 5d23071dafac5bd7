"""The base class of kinds of samplers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.hashing import mix
from torchpt.spec import Flag, Spec

__all__ = ["ADAPTIVE", "Points", "SamplerTensors"]

#: Parameters of kinds with any number of points, so that numbers may differ by pixel.
ADAPTIVE: dict[str, Spec] = {
    "adaptive": Flag(
        False, doc="whether to take more samples where the error is larger; `spp` is then their mean number"
    ),
}


@dataclass(frozen=True)
class SamplerTensors:
    """Tensors of a sampler, so that a compiled kernel serves all samplers of a kind."""

    seeds: Tensor  # (R,) int32 seeds of the randomizations
    every: Tensor  # () int64 number of points of each randomization
    more: Tensor  # () int64 number of randomizations that have one more
    bits: Tensor  # () int64 number of bits of the largest index of a point
    width: Tensor  # () int64 width of the film


@dataclass(frozen=True)
class Points(ABC):
    """A kind of sampler. Its fields are the values of its parameters, except ``ADAPTIVE``.

    Every number is a pure function of a key (pixel and point) and a salt (dimension), bit for bit the same on all lanes and
    engines: it uses integer operations, or those that round alike everywhere.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters, a field each.
        needs_count: whether the number of points must be known beforehand, so that ``spp`` is the only stop rule.
        rows: number of rows of a key.
        of_film: whether points depend on the position of a pixel, not on its index alone.
        joint: whether :meth:`draw_further` continues sets of two dimensions to four, stratified together.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    needs_count: ClassVar[bool] = False
    rows: ClassVar[int] = 2
    of_film: ClassVar[bool] = False
    joint: ClassVar[bool] = False

    def key(self, numbers: SamplerTensors, pixel: Tensor, group: Tensor, point: Tensor) -> Tensor:
        """Return the keys of samples ``(rows, N)`` int32: seed of the pixel, index of the point, number of points (if 3 rows).

        For each seed and randomization the pixel's seed is a bijection of its index, so no two pixels share a sequence.

        Args:
            numbers: the sampler's tensors.
            pixel: index on the film ``(N,)`` int64, row by row.
            group: randomization ``(N,)`` int64.
            point: index in the sequence ``(N,)`` int64.
        """
        seed = torch.index_select(numbers.seeds, 0, group)
        key = [mix(mix(pixel.to(torch.int32)) ^ seed), point.to(torch.int32)]
        if self.rows > 2:
            key.append((numbers.every + (group < numbers.more)).to(torch.int32))
        return torch.stack(key)

    @abstractmethod
    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return ``(N,)`` float32 in ``[0, 1)``, multiples of ``2^-24``.

        Args:
            key: ``(rows, N)`` int32 from :meth:`key`.
            salt: int32 from :func:`~torchpt.physics.samplers.dimensions.salt`.
        """

    @abstractmethod
    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return ``(2, N)`` float32 in ``[0, 1)``; arguments as for :meth:`draw_1d`."""

    def draw_further(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return dimensions three and four ``(2, N)`` of the set that :meth:`draw_2d` begins; called only if ``joint``."""
        raise NotImplementedError(f"sets of {self.name} points end with two dimensions")
