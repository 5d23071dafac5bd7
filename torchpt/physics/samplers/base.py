"""What a kind of sampler must say, and the numbers that its keys are made of."""

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

#: Of kinds whose points may be any number, so that pixels may have more or fewer.
ADAPTIVE: dict[str, Spec] = {
    "adaptive": Flag(False, doc="whether samples go where the error is; `spp` is then their mean number"),
}


@dataclass(frozen=True)
class SamplerTensors:
    """A sampler under one seed as tensors, so that a kernel made for one serves all of its kind."""

    seeds: Tensor  # (R,) int32 of the streams
    every: Tensor  # () int64 points of each randomization
    more: Tensor  # () int64 how many of them have one more
    bits: Tensor  # () int64 of the largest index of a point
    width: Tensor  # () int64 of the film


@dataclass(frozen=True)
class Points(ABC):
    """A kind of sampler: where the points of a pixel lie. Its fields are the values of its parameters, ``ADAPTIVE`` apart.

    Every number is a pure function of a key (which pixel, which point) and a salt (which dimension), the same for a lane
    wherever it stands: integer operations, or such as round alike everywhere.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares; a field each.
        needs_count: whether the number of points must be known before the first is drawn, so that nothing but ``spp`` may
            end a render.
        rows: of a key.
        of_film: whether points depend on where a pixel lies beside others; else on its number alone.
        joint: whether sets of two dimensions go on: :meth:`draw_further` gives two more, stratified with them.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    needs_count: ClassVar[bool] = False
    rows: ClassVar[int] = 2
    of_film: ClassVar[bool] = False
    joint: ClassVar[bool] = False

    def key(self, numbers: SamplerTensors, pixel: Tensor, group: Tensor, point: Tensor) -> Tensor:
        """Return what tells a sample from all others, ``(rows, N)`` int32: a pixel's seed, a point's index, how many there are.

        The seed is a bijection of the pixel's index for each (seed, stream), so no two pixels share a sequence. The
        third row is there only where ``rows`` says so.

        Args:
            numbers: of the sampler.
            pixel: index on the film ``(N,)`` int64, row by row.
            group: stream ``(N,)`` int64.
            point: index in its sequence ``(N,)`` int64.
        """
        seed = torch.index_select(numbers.seeds, 0, group)
        key = [mix(mix(pixel.to(torch.int32)) ^ seed), point.to(torch.int32)]
        if self.rows > 2:
            key.append((numbers.every + (group < numbers.more)).to(torch.int32))
        return torch.stack(key)

    @abstractmethod
    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """``(N,)`` float32 in ``[0, 1)``, multiples of ``2^-24``.

        Args:
            key: ``(rows, N)`` int32 as given by :meth:`key`.
            salt: int32, the dimension's name.
        """

    @abstractmethod
    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """``(2, N)`` float32 in ``[0, 1)``; arguments as in :meth:`draw_1d`."""

    def draw_further(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """The third and fourth dimension of the set whose first two :meth:`draw_2d` gives; where ``joint`` says so."""
        raise NotImplementedError(f"sets of {self.name} points end with two dimensions")
