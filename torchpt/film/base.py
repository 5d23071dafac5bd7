"""What a kind of reconstruction filter must say."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.spec import Spec

__all__ = ["Filter"]


class Filter(ABC):
    """A separable, symmetric reconstruction filter that is sampled: a sample's place is drawn from it.

    Args:
        values: of its parameters by name, all of them.
        device: where the lanes live.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares.
        values: of its parameters.
        radius: half width in pixels, beyond which it is zero.
        signed: whether it is negative anywhere, so that samples have weights; else every weight is 1.
        tabulated: whether lanes read its inverse from a table.
        jumps: whether it ends at its radius by a jump.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    tabulated: ClassVar[bool] = False
    jumps: ClassVar[bool] = False
    signed: bool = False

    def __init__(self, values: Mapping[str, Any], device: torch.device) -> None:
        self.values = dict(values)
        self.radius = self.half_width()
        self._radius = torch.tensor(self.radius, dtype=torch.float32, device=device)

    @abstractmethod
    def half_width(self) -> float:
        """In pixels."""

    @abstractmethod
    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The filter along one axis at distances ``x`` from the middle, in pixels; any scale, zero beyond its radius."""

    @abstractmethod
    def offset(self, u: Tensor) -> Tensor:
        """Places in pixels from the pixel's centre for ``u`` in [0, 1), any shape, as dense as the profile's magnitude."""

    def weight(self, u: Tensor) -> Tensor:
        """Weights ``(N,)`` of the samples at the offsets of ``u (2, N)``; asked for only where it is ``signed``."""
        return torch.ones_like(u[0])

    def kind(self) -> tuple[object, ...]:
        """What is not a tensor: kernels are made anew where it differs."""
        return self.name, self.signed

    def tensors(self) -> dict[str, Tensor]:
        """What lanes read."""
        return {"radius": self._radius}
