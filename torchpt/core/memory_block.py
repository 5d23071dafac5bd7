"""Lay tensors into one block of memory, and recognize tensors that lie in one: they are read as one tensor without a copy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.autograd import under_transforms

__all__ = ["MemoryBlock", "common_block", "with_own_memory"]


class MemoryBlock:
    """A block of memory for ``size`` numbers in float32, filled by :meth:`add` and :meth:`reserve`."""

    def __init__(self, size: int) -> None:
        self._numbers, self._end = torch.empty(size, dtype=torch.float32, device="cpu"), 0

    def add(self, array: NDArray[np.float32]) -> Tensor:
        """Return a tensor with the values of ``array``, after those that were added before."""
        return self.reserve(array.shape).copy_(torch.from_numpy(array))

    def reserve(self, shape: tuple[int, ...]) -> Tensor:
        """Return a tensor of this shape, after those that were added before; nothing is written there yet."""
        start, self._end = self._end, self._end + math.prod(shape)
        view = self._numbers[start : self._end].view(shape)
        # A tensor of its own in the same memory: views share their count of changes in place.
        return torch.empty(0, dtype=torch.float32, device="cpu").set_(
            view.untyped_storage(), start, view.shape, view.stride()
        )


def common_block(tensors: Sequence[Tensor]) -> Tensor | None:
    """Return the block ``(T,)`` in which all tensors lie, at their storage offsets; None where there is none.

    There is none either where the block would have no part in derivatives that the tensors have.
    """
    if not tensors or under_transforms() or (torch.is_grad_enabled() and any(x.requires_grad for x in tensors)):
        return None
    kinds = {(x.untyped_storage().data_ptr(), x.dtype, x.device) for x in tensors}
    return tensors[0].new_empty(0).set_(tensors[0].untyped_storage()) if len(kinds) == 1 else None


def with_own_memory(tensor: Tensor) -> Tensor:
    """Return a tensor, as a copy where its memory is part of a larger block, all of which pickle would write."""
    if tensor.untyped_storage().nbytes() == tensor.nbytes:
        return tensor
    return tensor.detach().clone().requires_grad_(tensor.requires_grad)
