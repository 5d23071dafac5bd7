"""Sizes and positions of shapes before their transform as parameters: ``shapes.NAME.radius`` beside ``shapes.NAME.to_world``.

A shape such as a sphere or a cylinder is a standard primitive under a pose. Loading multiplies the map by the shape's own sizes
(``Shape.own``) into that pose, the parameter ``to_world``: ``to_world = transform @ own(sizes as loaded)``. Where sizes have
other values, the pose of the primitives is ``to_world @ inverse(own(sizes as loaded)) @ own(sizes)``: they act in the shape's
own space, before the transform, as in a scene file, and ``to_world`` is the pose at the sizes of the file.
:meth:`torchpt.scene.scene.Scene.merged` puts this pose in the place of ``to_world``, so nothing below knows of sizes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.math.transforms import tensor_of
from torchpt.physics.shapes.base import Place, Size
from torchpt.scene.formats.description import Description
from torchpt.spec import parameters_of

__all__ = ["SizedShape", "is_size", "size_keys", "sized_shapes", "unchanged_sizes", "with_poses"]


@cache
def size_keys(kind: Any) -> tuple[str, ...]:
    """Return the names of a kind's sizes and positions before the transform."""
    return tuple(key for key, spec in parameters_of(kind).items() if is_size(spec))


def is_size(spec: object) -> bool:
    """Return True for the spec of a size or position that acts before the transform."""
    return isinstance(spec, Size | Place)


@dataclass(frozen=True)
class SizedShape:
    """A shape with sizes of its own.

    Attributes:
        stem: dotted name of the shape, such as ``shapes.ball``.
        kind: its kind, a :class:`~torchpt.physics.shapes.base.Shape`.
        loaded: values of its parameters as loaded; sizes as rounded in ``scene.params``.
        names: dotted names of its sizes.
    """

    stem: str
    kind: Any
    loaded: Mapping[str, Any]
    names: tuple[str, ...]

    @property
    def pose_name(self) -> str:
        """Return the dotted name of its pose."""
        return f"{self.stem}.to_world"

    def is_loaded(self, name: str, value: Tensor) -> bool:
        """Return True if a size has the value as loaded."""
        return value.detach().double().tolist() == self.loaded[name.rpartition(".")[2]]

    def values(self, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the values of the kind's parameters, with sizes as plain numbers from ``tensors``."""
        sizes = {name.rpartition(".")[2]: tensors[name].detach().double().tolist() for name in self.names}
        return {**self.loaded, **sizes}

    def pose(self, tensors: Mapping[str, Tensor]) -> Tensor:
        """Return the pose ``(4, 4)`` of the shape's primitives, differentiable in ``to_world`` and in the sizes."""
        to_world = tensors[self.pose_name]
        sizes = {name.rpartition(".")[2]: tensor_of(tensors[name], to_world.device) for name in self.names}
        loaded = {key: np.asarray(self.loaded[key]) for key in sizes}
        before = np.linalg.inv(self.kind.own({**self.loaded, **loaded}))
        own = self.kind.own({**self.loaded, **sizes})
        return (to_world.double() @ torch.from_numpy(before).to(to_world.device) @ own).to(to_world.dtype)


def sized_shapes(description: Description, params: Mapping[str, Tensor]) -> tuple[SizedShape, ...]:
    """Return the shapes that have sizes; ``params``: the scene's parameters, whose dtypes round the sizes as loaded."""
    found = []
    for name, shape in description.shapes.items():
        keys = size_keys(shape.kind)
        if not keys:
            continue
        stem = f"shapes.{name}"
        dtypes = {key: np.float64 if params[f"{stem}.{key}"].dtype == torch.float64 else np.float32 for key in keys}
        rounded = {key: np.asarray(shape.values[key], dtype).tolist() for key, dtype in dtypes.items()}
        loaded = {**shape.values, **rounded}
        found.append(SizedShape(stem, shape.kind, loaded, tuple(f"{stem}.{key}" for key in keys)))
    return tuple(found)


def unchanged_sizes(shapes: tuple[SizedShape, ...], params: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, int]]:
    """Return the sizes of a scene that have the values as loaded, each with the tensor's version by torch."""
    found = {}
    for shape in shapes:
        for name in shape.names:
            value = params[name]
            if not value.is_inference() and shape.is_loaded(name, value):
                found[name] = value, value._version
    return found


def with_poses(
    tensors: dict[str, Tensor], shapes: tuple[SizedShape, ...], unchanged: Mapping[str, tuple[Tensor, int]]
) -> dict[str, Tensor]:
    """Return parameters in which poses of shapes whose sizes have changed are those of their primitives.

    Args:
        tensors: all parameters by name.
        shapes: the shapes that have sizes.
        unchanged: the sizes that have the values as loaded, from :func:`unchanged_sizes`.
    """
    poses = {shape.pose_name: shape.pose(tensors) for shape in shapes if _changed(shape, tensors, unchanged)}
    return {**tensors, **poses} if poses else tensors


def _changed(shape: SizedShape, tensors: Mapping[str, Tensor], unchanged: Mapping[str, tuple[Tensor, int]]) -> bool:
    """Return True if a size of a shape is differentiated, or is not known to have the value as loaded."""
    for name in shape.names:
        value, known = tensors[name], unchanged.get(name)
        if known is None or value is not known[0] or value.requires_grad or value._version != known[1]:
            return True
    return False
