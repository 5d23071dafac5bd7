"""The vector type for numba: elements of float32, float64, int32 or bool, and a fixed number of lanes."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import types
from numba.core.errors import RequireLiteralValue
from numba.extending import models, register_model

__all__ = ["ELEMENTS", "I32", "Vector", "intrinsic", "lanes_of", "numbers", "splat", "splatted"]

#: Typed as Any: kernels call an intrinsic without its first parameter, which type checkers cannot express.
intrinsic: Any = extending.intrinsic

I32 = ir.IntType(32)
#: LLVM type of each element type.
ELEMENTS = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.int32: I32,
    types.boolean: ir.IntType(1),
}


class Vector(types.Type):
    """A numba type: an LLVM vector of ``lanes`` numbers or booleans.

    Args:
        element: numba's float32, float64, int32 or boolean.
        lanes: number of lanes.
    """

    def __init__(self, element: Any, lanes: int) -> None:
        self.element, self.lanes = element, lanes
        super().__init__(name=f"Vector({element}, {lanes})")

    @property
    def code(self) -> str:
        """Return the type suffix of LLVM's intrinsics, such as ``v8f32``."""
        return f"v{self.lanes}{'f' if isinstance(self.element, types.Float) else 'i'}{self.element.bitwidth}"


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(ELEMENTS[kind.element], kind.lanes))


def lanes_of(n: Any) -> int:
    """Return the number of lanes of a call, which must be a constant."""
    if not isinstance(n, types.IntegerLiteral):
        raise RequireLiteralValue("the number of lanes must be a constant")
    return int(n.literal_value)


def numbers(values: Any) -> Any:
    """Return a constant vector of int32."""
    values = list(values)
    return ir.Constant(ir.VectorType(I32, len(values)), values)


def splatted(builder: Any, x: Any, lanes: int) -> Any:
    """Broadcast an LLVM scalar to a vector."""
    some = ir.Constant(ir.VectorType(x.type, lanes), ir.Undefined)
    one = builder.insert_element(some, x, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, some, numbers([0] * lanes))


@intrinsic(prefer_literal=True)
def splat(context, x, n):
    """Broadcast a float32, float64, int32 or bool to ``n`` lanes: ``splat(x, n)``."""
    element = x.literal_type if isinstance(x, types.Literal) else x
    if element not in ELEMENTS:
        return None
    lanes = lanes_of(n)

    def generate(context, builder, signature, args):
        return splatted(builder, args[0], lanes)

    return Vector(element, lanes)(element, n), generate
