"""The tensors that a render's kernels read, by name, and which of them another render has read before."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchpt.core.tree import named_leaves

__all__ = ["Leaves", "State"]

#: A tensor, and which of the contents that it has had.
State = tuple[Tensor, object]


class Leaves:
    """The tensors of some records.

    Args:
        records: by the name that the paths begin with.
        before: those of another render: records that are the same ones are not walked through again.

    Attributes:
        tensors: by path.
        ids: path and tensor by the tensor's id.
        states: by path, the tensor and which of its contents it has.
    """

    def __init__(self, records: dict[str, Any], before: Leaves | None = None) -> None:
        known = {} if before is None else before._walked
        self._walked: dict[str, tuple[Any, list[tuple[str, Tensor]]]] = {}
        for name, record in records.items():
            same = name in known and known[name][0] is record and not isinstance(record, dict)
            self._walked[name] = known[name] if same else (record, list(named_leaves(record, name)))
        self.tensors = dict(leaf for _, leaves in self._walked.values() for leaf in leaves)
        self.ids = {id(tensor): (path, tensor) for path, tensor in self.tensors.items()}
        # A tensor is the same one only as long as nobody wrote into it; of inference tensors that cannot be known.
        self.states: dict[str, State] = {
            path: (tensor, object() if tensor.is_inference() else tensor._version)
            for path, tensor in self.tensors.items()
        }

    def has(self, path: str, state: State) -> bool:
        """Return True where a tensor is one that was read before, with the same numbers."""
        tensor, version = self.states[path]
        return tensor is state[0] and version == state[1]
