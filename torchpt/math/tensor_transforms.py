"""The transforms of :mod:`torchpt.math.transforms` of tensors, float64 and differentiable: the same numbers, on torch's tape.

Nothing is checked here: what is given was read as numbers before. Arguments are as written: tensors where the caller wrote
tensors, numbers, lists and arrays elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

__all__ = ["compose", "look_at", "placed", "tensor_of"]


def tensor_of(value: Any, device: torch.device) -> Tensor:
    """Numbers, and lists of them, with tensors anywhere among them, as one float64 tensor on a device."""
    if isinstance(value, Tensor):
        return value.to(device, torch.float64)
    if isinstance(value, list | tuple):
        return torch.stack([tensor_of(item, device) for item in value])
    return torch.as_tensor(np.asarray(value, np.float64), device=device)


def placed(linear: Tensor, origin: Tensor) -> Tensor:
    """``(4, 4)`` of a linear part ``(3, 3)`` and a translation ``(3,)``."""
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=linear.dtype, device=linear.device)
    return torch.cat((torch.cat((linear, origin[:, None]), 1), last))


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """See :func:`torchpt.math.transforms.look_at`."""
    direction = _unit(target - eye)
    left = _unit(torch.linalg.cross(up / up.detach().abs().max(), direction))
    return placed(torch.stack((left, torch.linalg.cross(direction, left), direction), 1), eye)


def compose(operations: Any, device: torch.device) -> Tensor:
    """One ``(4, 4)`` of a transform as written, a matrix or a list; see :func:`torchpt.math.transforms.compose`."""
    if not isinstance(operations, list | tuple) or not isinstance(operations[0], Mapping):
        return _affine(operations, device)
    total = torch.eye(4, dtype=torch.float64, device=device)
    for entry in operations:
        ((name, argument),) = entry.items()
        total = _OPERATIONS[name](argument, device) @ total
    return total


def _unit(vector: Tensor) -> Tensor:
    scaled = vector / vector.detach().abs().max()
    return scaled / torch.linalg.vector_norm(scaled)


def _affine(rows: Any, device: torch.device) -> Tensor:
    matrix = tensor_of(rows, device)
    return placed(matrix[:3, :3], matrix[:3, 3])  # the last row is no number of the scene


def _translate(offset: Any, device: torch.device) -> Tensor:
    return placed(torch.eye(3, dtype=torch.float64, device=device), tensor_of(offset, device))


def _scale(factor: Any, device: torch.device) -> Tensor:
    factors = tensor_of(factor, device).expand(3)
    return placed(torch.diag(factors), torch.zeros_like(factors))


def _rotate(argument: Mapping[str, Any], device: torch.device) -> Tensor:
    x, y, z = _unit(tensor_of(argument["axis"], device)).unbind()
    none = torch.zeros_like(x)
    cross = torch.stack((none, -z, y, z, none, -x, -y, x, none)).reshape(3, 3)
    turn = (tensor_of(argument["angle"], device) % 360.0) * (math.pi / 180.0)
    one = torch.eye(3, dtype=torch.float64, device=device)
    linear = one + torch.sin(turn) * cross + (1.0 - torch.cos(turn)) * (cross @ cross)
    return placed(linear, torch.zeros_like(linear[0]))


def _look_at(argument: Mapping[str, Any], device: torch.device) -> Tensor:
    up: Sequence[float] = (0.0, 1.0, 0.0)
    numbers = (argument["origin"], argument["target"], argument.get("up", up))
    eye, target, above = (tensor_of(value, device) for value in numbers)
    return look_at(eye, target, above)


_OPERATIONS: dict[str, Callable[[Any, torch.device], Tensor]] = {
    "translate": _translate,
    "scale": _scale,
    "rotate": _rotate,
    "matrix": _affine,
    "look_at": _look_at,
}
