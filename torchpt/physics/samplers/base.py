"""The base class of kinds of samplers, and the tensors that it reads.

A kind turns integers into numbers in [0, 1). Its methods are pure tensor functions of lanes (one lane a path, ``N`` of them);
the lane compiler makes kernels of them, so they neither branch on values nor loop over lanes.
"""

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

#: Parameters of kinds that serve any number of points, so that pixels may have different numbers. The renderer reads them: they
#: are no fields of :class:`Points`.
ADAPTIVE: dict[str, Spec] = {
    "adaptive": Flag(
        False, doc="whether to take more samples where the error is larger; `spp` is then their mean number"
    ),
}


@dataclass(frozen=True)
class SamplerTensors:
    """The numbers of one ``Sampler`` as tensors, so that one compiled kernel serves all samplers of a kind."""

    #: (randomizations,) int32: those of the picture, then spare ones for pixels that are sampled again, as error probes are
    seeds: Tensor
    points_each: Tensor  # () int64 number of points of each randomization; 0 if unknown
    with_one_more: Tensor  # () int64 number of randomizations, the first ones, that have one point more
    index_bits: Tensor  # () int64 number of bits of the largest index of a point
    film_width: Tensor  # () int64 width of the film in pixels


@dataclass(frozen=True)
class Points(ABC):
    """A kind of sampler. Its fields are the values of its parameters, except ``ADAPTIVE``.

    Every number is a pure function of a key (pixel and point) and a salt (dimension), bit for bit the same on all lanes and
    engines: it uses integer operations, or those that round alike everywhere.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters, a field each.
        needs_count: whether the number of points must be known beforehand, so that ``spp`` is the only stop rule.
        rows: number of rows of a key: 2, or 3 with the number of points as the third.
        of_film: whether points depend on the position of a pixel on the whole film, not on its index alone.
        joint: whether :meth:`draw_further` continues sets of two dimensions to four, stratified together.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    needs_count: ClassVar[bool] = False
    rows: ClassVar[int] = 2
    of_film: ClassVar[bool] = False
    joint: ClassVar[bool] = False

    def key(self, tensors: SamplerTensors, pixel: Tensor, randomization: Tensor, point: Tensor) -> Tensor:
        """Return the keys of samples ``(rows, N)`` int32: seed of the pixel, index of the point, number of points (if 3 rows).

        For each seed and randomization the pixel's seed is a bijection of its index, so no two pixels share a sequence.

        Args:
            tensors: those of the sampler.
            pixel: index of the pixel on the whole film, row by row ``(N,)`` int64.
            randomization: index into ``tensors.seeds`` ``(N,)`` int64.
            point: index of the point in its sequence ``(N,)`` int64.
        """
        seed = torch.index_select(tensors.seeds, 0, randomization)
        key = [mix(mix(pixel.to(torch.int32)) ^ seed), point.to(torch.int32)]
        if self.rows > 2:
            key.append((tensors.points_each + (randomization < tensors.with_one_more)).to(torch.int32))
        return torch.stack(key)

    @abstractmethod
    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return one number for each lane: ``(N,)`` float32 in ``[0, 1)``, multiples of ``2^-24``.

        Args:
            key: ``(rows, N)`` int32 from :meth:`key`.
            salt: int32, the hash of the dimension: :func:`~torchpt.physics.samplers.dimensions.salt`.
        """

    @abstractmethod
    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return two numbers for each lane: ``(2, N)`` float32 in ``[0, 1)``; arguments as for :meth:`draw_1d`."""

    def draw_further(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return dimensions three and four ``(2, N)`` of the set that :meth:`draw_2d` begins; called only if ``joint``."""
        raise NotImplementedError(f"sets of {self.name} points end with two dimensions")
