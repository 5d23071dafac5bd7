"""Bit reversal in kernels, by one LLVM intrinsic. Torch has no operator for it; by shifts and masks it takes twenty-five."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchpt.compiler.operators.nodes import apply
from torchpt.compiler.tracing import tracer_of

__all__ = ["reverse_bits"]


def reverse_bits(x: Tensor) -> Any:
    """Reverse the 32 bits of traced int32 lanes; return NotImplemented for tensors that are not traced."""
    tracer = tracer_of(x)
    if tracer is None:
        return NotImplemented
    out = x.clone()  # only the graph counts in a trace, not the values
    apply(tracer, out, lambda node: tracer.graph.node("bitreverse", "i", node), x)
    return out
