"""Layers of a picture in forward mode, in which they have no derivatives: only one that is read raises an error.

Backward, autograd asks for derivatives once a loss is known, and passes over layers that it does not read. In forward mode an
operation has its derivatives at once. So the operation of the layers waits there until one of them is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.core.autograd import Backward, custom_vjp, under_transforms
from torchpt.core.errors import TorchptError
from torchpt.gradients import edges
from torchpt.scene.settings import Settings

__all__ = ["constant_layers", "with_derivatives"]


def with_derivatives(
    layers: dict[str, Tensor], differentiable: tuple[str, ...], make: Callable[[], Mapping[str, Tensor]]
) -> dict[str, Tensor]:
    """Return layers with those of them that have derivatives: at once, or in forward mode when one is read.

    Args:
        layers: all of them, as rendered.
        differentiable: names of those that have derivatives.
        make: returns these as functions of the parameters.
    """
    if not differentiable:
        return layers
    if under_transforms():
        return _LayersOnRead(layers, differentiable, make)
    return {**layers, **make()}


def constant_layers(
    layers: dict[str, Tensor], settings: Settings, tensors: tuple[Tensor, ...], backward: Backward
) -> dict[str, Tensor]:
    """Return the layers of parameters that require no gradients: an error in forward mode, in place of a tangent of 0.

    Args:
        layers: all of them, as rendered.
        settings: of the picture.
        tensors: parameters of the picture, which may have tangents.
        backward: of the picture, which raises an error.
    """
    names = edges.followed(settings)

    def copies(*_: Tensor) -> tuple[Tensor, ...]:
        return tuple(layers[name].clone() for name in names)

    return with_derivatives(layers, names, lambda: dict(zip(names, custom_vjp(copies, backward, tensors), strict=True)))


class _LayersOnRead(dict[str, Tensor]):
    """Layers some of which are made when one of these is read."""

    def __init__(
        self, layers: Mapping[str, Tensor], waiting: tuple[str, ...], make: Callable[[], Mapping[str, Tensor]]
    ) -> None:
        super().__init__(layers)
        self._waiting, self._make = waiting, make

    def __getitem__(self, name: str) -> Tensor:
        if name in self._waiting:
            try:
                with torch.enable_grad():
                    self.update(self._make())
            except TorchptError as error:
                raise TorchptError(f"layers.{name}: {error}") from None
            self._waiting = ()
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self else default

    # Python copies a dict without its `__getitem__`, unless its class has an iterator of its own.
    def __iter__(self) -> Iterator[str]:
        return super().__iter__()

    def values(self) -> Any:
        return [self[name] for name in self]

    def items(self) -> Any:
        return [(name, self[name]) for name in self]

    def copy(self) -> dict[str, Tensor]:
        return dict(self.items())

    def __or__(self, other: Any) -> Any:
        return self.copy() | other

    def __ror__(self, other: Any) -> Any:
        return other | self.copy()
