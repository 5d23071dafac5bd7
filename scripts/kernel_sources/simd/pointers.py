"""Pointers of kernels: memory on the stack, parts of a buffer, and pointers that lie in memory."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import RequireLiteralValue

from kernel_sources.simd.types import intrinsic

__all__ = ["load_pointer", "part", "stack_memory"]


def _pointer_to(dtype: Any) -> Any:
    """Return the numba type of a pointer to numbers of a type that is given as numpy's, such as ``np.float32``."""
    return types.CPointer(dtype.instance_type) if isinstance(dtype, types.NumberClass) else None


@intrinsic
def part(context, buffer, i, dtype):
    """Return a pointer to element ``i`` of a buffer as a pointer to numbers of type ``dtype``: ``part(p, 16, np.float32)``."""
    kind = _pointer_to(dtype)
    if kind is None or not isinstance(buffer, types.CPointer):
        return None

    def generate(context, builder, signature, args):
        place = builder.gep(args[0], [args[1]], inbounds=True)
        return builder.bitcast(place, context.get_value_type(kind))

    return kind(buffer, types.intp, dtype), generate


@intrinsic
def load_pointer(context, words, i, dtype):
    """Return the pointer that is in the int64 word ``i``, as a pointer to numbers of type ``dtype``."""
    kind = _pointer_to(dtype)
    if kind is None or words != types.CPointer(types.int64):
        return None

    def generate(context, builder, signature, args):
        target = context.get_value_type(kind)
        place = builder.gep(args[0], [args[1]], inbounds=True)
        return builder.load(builder.bitcast(place, target.as_pointer()))

    return kind(words, types.intp, dtype), generate


@intrinsic(prefer_literal=True)
def stack_memory(context, n, dtype):
    """Return a pointer to ``n`` numbers of type ``dtype`` on the stack, which live until the calling function returns."""
    kind = _pointer_to(dtype)
    if kind is None:
        return None
    if not isinstance(n, types.IntegerLiteral):
        raise RequireLiteralValue("the size of memory on the stack must be a constant")
    size = int(n.literal_value)

    def generate(context, builder, signature, args):
        memory = cgutils.alloca_once(builder, ir.ArrayType(context.get_value_type(kind.dtype), size))
        return builder.bitcast(memory, context.get_value_type(kind))

    return kind(n, dtype), generate
