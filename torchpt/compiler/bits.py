"""The order of a number's bits turned around: one instruction or a few, where tensor operations take twenty-five."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from torchpt.compiler.operators.nodes import apply
from torchpt.compiler.tracing import tracer_of

__all__ = ["reverse_bits"]


def reverse_bits(x: Tensor) -> Any:
    """Reverse the 32 bits of int32 lanes that are being traced; NotImplemented for other tensors."""
    tracer = tracer_of(x)
    if tracer is None:
        return NotImplemented
    out = x.clone()  # a trace asks for what is done, not for what comes out
    apply(tracer, out, lambda node: tracer.graph.node("bitreverse", "i", node), x)
    return out
