"""Replace tensors in a scene dict by plain numbers, and remember the keys of those that require gradients.

Readers see plain numbers, lists and arrays, so that ranges and errors are those of a file. The dict itself is kept;
:mod:`torchpt.scene.dict_tensors` computes the scene's parameters from its tensors again, with gradients.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed
from torchpt.core.errors import SceneError

__all__ = ["DictTensors", "Key"]

#: A position in nested mappings and lists: keys and indices.
Key = tuple[str | int, ...]

#: One-dimensional arrays up to this length become lists, like the vectors and pairs of a file; longer ones are data, such as
#: texels.
_MAX_LISTED = 64
#: Types of values that need no look inside.
_PLAIN_TYPES = frozenset({int, float, str, bool, type(None)})


class DictTensors:
    """The tensors of a scene dict that require gradients.

    Attributes:
        raw: the scene dict, tensors included.
        keys: keys of such tensors, in order.
    """

    def __init__(self) -> None:
        self.raw: dict[str, Any] = {}
        self.keys: list[Key] = []

    def extract(self, raw: dict[str, Any]) -> dict[str, Any]:
        """Return a scene dict with numbers in place of tensors, and remember both.

        Args:
            raw: the dict, copied and checked by :func:`torchpt.scene.formats.yaml.plain`.

        Raises:
            SceneError: a tensor whose numbers cannot be read.
        """
        self.raw, self.keys = raw, []
        return self._without_tensors(raw, ())

    def at(self, key: Key) -> Any:
        """Return the value of the dict at a key; None where there is none."""
        found: Any = self.raw
        for part in key:
            if isinstance(found, dict):
                found = found.get(part)  # type: ignore[arg-type]
            elif isinstance(found, list) and isinstance(part, int) and part < len(found):
                found = found[part]
            else:
                return None
        return found

    def under(self, *prefix: str) -> Iterator[Key]:
        """Return the keys of tensors that begin with a prefix, without the prefix."""
        return (key[len(prefix) :] for key in self.keys if key[: len(prefix)] == prefix)

    def _without_tensors(self, item: Any, key: Key) -> Any:
        """Return the value at a key with numbers in place of tensors."""
        if isinstance(item, dict):
            return {
                name: value if value.__class__ in _PLAIN_TYPES else self._without_tensors(value, (*key, name))
                for name, value in item.items()
            }
        if isinstance(item, list):
            if _PLAIN_TYPES.issuperset(map(type, item)):  # the rows of an inline mesh
                return item
            return [self._without_tensors(value, (*key, index)) for index, value in enumerate(item)]
        if isinstance(item, Tensor):
            if item.requires_grad:
                self.keys.append(key)
            return _listed(_numbers(item, key))
        return _listed(item) if isinstance(item, np.ndarray) else item


def _numbers(tensor: Tensor, key: Key) -> np.ndarray:
    """Return a copy of a tensor's values."""
    if is_transformed(tensor):
        expected = "plain numbers: hand tensors under torch.func to render(params=...)"
        raise SceneError(".".join(map(str, key)), "a tensor under a transform of torch.func", expected)
    try:
        values = tensor.detach()
        if values.dtype in (torch.float16, torch.bfloat16):  # readers take float32 and float64; NumPy has no bfloat16
            values = values.float()
        return np.array(values.cpu().numpy())
    except (RuntimeError, TypeError, NotImplementedError):
        shown = f"a {tensor.layout} tensor of {tensor.dtype} on {tensor.device}"
        raise SceneError(".".join(map(str, key)), shown, "a dense tensor of numbers that can be read") from None


def _listed(array: np.ndarray) -> Any:
    """Convert a scalar array to a number and a short vector to a list."""
    return array.tolist() if array.ndim == 0 or (array.ndim == 1 and len(array) <= _MAX_LISTED) else array
