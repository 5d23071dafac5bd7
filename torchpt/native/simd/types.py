"""The vector type of numba: elements of float32, float64, int32 or bool, known number of lanes."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import extending
from numba.core import types
from numba.core.errors import RequireLiteralValue
from numba.extending import models, register_model

__all__ = ["ELEMENTS", "I32", "Vector", "intrinsic", "lanes_of", "numbers", "splat", "splatted"]

#: Kernels call what this makes without its first parameter, which no checker of types can know.
intrinsic: Any = extending.intrinsic

I32 = ir.IntType(32)
#: What a vector may hold, and how LLVM has it.
ELEMENTS = {
    types.float32: ir.FloatType(),
    types.float64: ir.DoubleType(),
    types.int32: I32,
    types.boolean: ir.IntType(1),
}


class Vector(types.Type):
    """``lanes`` numbers (or truths) side by side, one LLVM value.

    Args:
        element: float32, float64, int32 or boolean of numba.
        lanes: how many.
    """

    def __init__(self, element: Any, lanes: int) -> None:
        self.element, self.lanes = element, lanes
        super().__init__(name=f"Vector({element}, {lanes})")

    @property
    def code(self) -> str:
        """How LLVM's functions name the type: ``v8f32``."""
        return f"v{self.lanes}{'f' if isinstance(self.element, types.Float) else 'i'}{self.element.bitwidth}"


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, ir.VectorType(ELEMENTS[kind.element], kind.lanes))


def lanes_of(n: Any) -> int:
    """The number of lanes that a call asks for, which the compiler must know."""
    if not isinstance(n, types.IntegerLiteral):
        raise RequireLiteralValue("the number of lanes must be a constant")
    return int(n.literal_value)


def numbers(values: Any) -> Any:
    """A constant vector of int32."""
    values = list(values)
    return ir.Constant(ir.VectorType(I32, len(values)), values)


def splatted(builder: Any, x: Any, lanes: int) -> Any:
    """The same scalar in every lane."""
    some = ir.Constant(ir.VectorType(x.type, lanes), ir.Undefined)
    one = builder.insert_element(some, x, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, some, numbers([0] * lanes))


@intrinsic(prefer_literal=True)
def splat(context, x, n):
    """``splat(x, n)``: a float32, float64, int32 or bool in each of ``n`` lanes."""
    element = x.literal_type if isinstance(x, types.Literal) else x
    if element not in ELEMENTS:
        return None
    lanes = lanes_of(n)

    def generate(context, builder, signature, args):
        return splatted(builder, args[0], lanes)

    return Vector(element, lanes)(element, n), generate
