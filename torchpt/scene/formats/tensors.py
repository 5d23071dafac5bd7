"""Tensors and arrays in a scene given as a dict: the numbers that are read, and where tensors that want gradients stood.

Whatever reads a scene sees plain numbers, lists and arrays, so that ranges and errors are those of a file. What was written is
kept beside them; :mod:`torchpt.scene.dict_tensors` makes the scene's parameters of it once more, on torch's tape.
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

#: Where something stands: keys of mappings, and indices of lists.
Key = tuple[str | int, ...]

#: One-dimensional arrays up to this length are read as lists, as the vectors and pairs of a file are.
_LISTED = 64
_PLAIN = frozenset({int, float, str, bool, type(None)})


class DictTensors:
    """What of one scene was written as tensors that require gradients.

    Attributes:
        raw: the scene as written, tensors included.
        keys: where in it such tensors stand, in order.
    """

    def __init__(self) -> None:
        self.raw: dict[str, Any] = {}
        self.keys: list[Key] = []

    def extract(self, raw: dict[str, Any]) -> dict[str, Any]:
        """The scene with numbers in place of tensors, once :func:`torchpt.scene.formats.yaml.plain` has bounded it.

        Raises:
            SceneError: a tensor that holds no numbers that can be read.
        """
        self.raw, self.keys = raw, []
        return self._read(raw, ())

    def at(self, key: Key) -> Any:
        """What was written at a key; None where nothing was."""
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
        """The keys that begin with a prefix, without it."""
        return (key[len(prefix) :] for key in self.keys if key[: len(prefix)] == prefix)

    def _read(self, item: Any, key: Key) -> Any:
        if isinstance(item, dict):
            return {name: self._read(value, (*key, name)) for name, value in item.items()}
        if isinstance(item, list):
            if _PLAIN.issuperset(map(type, item)):  # the rows of an inline mesh
                return item
            return [self._read(value, (*key, index)) for index, value in enumerate(item)]
        if isinstance(item, Tensor):
            if item.requires_grad:
                self.keys.append(key)
            return _listed(_numbers(item, key))
        return _listed(item) if isinstance(item, np.ndarray) else item


def _numbers(tensor: Tensor, key: Key) -> np.ndarray:
    """A tensor's values, apart from it: what is done to the tensor later does not change them."""
    if is_transformed(tensor):
        expected = "plain numbers: hand tensors under torch.func to render(params=...)"
        raise SceneError(".".join(map(str, key)), "a tensor under a transform of torch.func", expected)
    try:
        values = tensor.detach()
        if values.dtype in (torch.float16, torch.bfloat16):
            values = values.float()
        return np.array(values.cpu().numpy())
    except (RuntimeError, TypeError, NotImplementedError):
        shown = f"a {tensor.layout} tensor of {tensor.dtype} on {tensor.device}"
        raise SceneError(".".join(map(str, key)), shown, "a dense tensor of numbers that can be read") from None


def _listed(array: np.ndarray) -> Any:
    """A number of an array without dimensions, a list of a short one with one."""
    return array.tolist() if array.ndim == 0 or (array.ndim == 1 and len(array) <= _LISTED) else array
