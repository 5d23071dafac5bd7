"""Kernels that take one lane at a time, and bitwise comparison of tensors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.compiler import cpu
from torchpt.compiler.form import SCALAR
from torchpt.compiler.target import Target

__all__ = ["differing", "one_lane"]

_BITS = {1: torch.uint8, 4: torch.int32, 8: torch.int64}


def one_lane() -> Target:
    """Return this machine, with kernels that take one lane at a time."""
    return replace(cpu.host(), form=SCALAR)


def differing(a: Tensor, b: Tensor) -> Tensor:
    """Return where two tensors of one shape differ in any bit; all NaNs count as equal."""
    assert a.shape == b.shape and a.dtype == b.dtype
    bits = _BITS[a.element_size()]
    return (a.contiguous().view(bits) != b.contiguous().view(bits)) & ~((a != a) & (b != b))
