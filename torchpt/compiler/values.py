"""Write LLVM IR of single lanes with Python's operators, local variables, branches and loops."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeAlias

from torchpt.compiler.block import ELEMENTS, Block

__all__ = ["LaneBlock", "Number", "Value", "Variable"]

_SIGNED = {"lt": "slt", "le": "sle", "gt": "sgt", "ge": "sge", "eq": "eq", "ne": "ne"}
#: A comparison of floats with NaN is false, except ``!=``.
_ORDERED = {"lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge", "eq": "oeq", "ne": "une"}
_FLOATS = "fd"


@dataclass(frozen=True, eq=False)
class Value:
    """A value of one lane; operators append instructions to its block, other operands are of its type or Python numbers.

    Comparisons are methods. Floats have no fast-math flags: each operation rounds once, and nothing is fused.

    Attributes:
        block: builder of the function.
        ty: node type, see :mod:`torchpt.compiler.graph`.
        name: name of the value, or an LLVM constant.
    """

    block: LaneBlock
    ty: str
    name: str

    def _of(self, other: Number) -> str:
        """Return the name of the other operand."""
        if isinstance(other, Value):
            assert other.ty == self.ty, (self.ty, other.ty)
            return other.name
        return self.block.constant(self.ty, other)

    def _new(self, name: str, ty: str | None = None) -> Value:
        return Value(self.block, ty or self.ty, name)

    def _binary(self, op: str, other: Number) -> Value:
        return self._new(self.block.binary(op, self.ty, self.name, self._of(other)))

    def __add__(self, other: Number) -> Value:
        return self._new(self.block.add(self.ty, self.name, self._of(other)))

    def __sub__(self, other: Number) -> Value:
        return self._new(self.block.sub(self.ty, self.name, self._of(other)))

    def __mul__(self, other: Number) -> Value:
        return self._new(self.block.mul(self.ty, self.name, self._of(other)))

    def __truediv__(self, other: Number) -> Value:
        return self._new(self.block.div(self.ty, self.name, self._of(other)))

    def __neg__(self) -> Value:
        return self._new(self.block.negative(self.ty, self.name))

    def __abs__(self) -> Value:
        return self._new(self.block.call("llvm.fabs", self.ty, self.name))

    def __and__(self, other: Number) -> Value:
        return self._binary("and", other)

    def __or__(self, other: Number) -> Value:
        return self._binary("or", other)

    def __lshift__(self, by: int) -> Value:
        return self._binary("shl", by)

    def __rshift__(self, by: int) -> Value:
        """Shift right; zeros come in."""
        return self._binary("lshr", by)

    def __invert__(self) -> Value:
        return self._binary("xor", True if self.ty == "b" else -1)

    def _compared(self, how: str, other: Number) -> Value:
        op = (_ORDERED if self.ty in _FLOATS else _SIGNED)[how]
        return self._new(self.block.compare(op, self.ty, self.name, self._of(other)), "b")

    def lt(self, other: Number) -> Value:
        """Compare: ``self < other``."""
        return self._compared("lt", other)

    def le(self, other: Number) -> Value:
        """Compare: ``self <= other``."""
        return self._compared("le", other)

    def gt(self, other: Number) -> Value:
        """Compare: ``self > other``."""
        return self._compared("gt", other)

    def ge(self, other: Number) -> Value:
        """Compare: ``self >= other``."""
        return self._compared("ge", other)

    def eq(self, other: Number) -> Value:
        """Compare: ``self == other``."""
        return self._compared("eq", other)

    def ne(self, other: Number) -> Value:
        """Compare: ``self != other``; true where either is NaN."""
        return self._compared("ne", other)

    def select(self, a: Value, b: Number) -> Value:
        """Return ``a`` where this condition holds, else ``b``."""
        return a._new(self.block.select(a.ty, self.name, a.name, a._of(b)))

    def call(self, function: str, *others: Number) -> Value:
        """Call an LLVM intrinsic, such as ``llvm.sqrt``, on this value and others of its type."""
        return self._new(self.block.call(function, self.ty, self.name, *map(self._of, others)))

    def to(self, op: str, ty: str) -> Value:
        """Convert by an LLVM cast, such as ``fpext`` or ``bitcast``."""
        return self._new(self.block.convert(op, self.ty, ty, self.name), ty)


Number: TypeAlias = Value | float | int | bool


class Variable:
    """A local variable; LLVM's pass SROA makes a register of it.

    Args:
        block: builder of the function, in its first basic block.
        ty: node type.
    """

    def __init__(self, block: LaneBlock, ty: str) -> None:
        self._block, self._ty = block, ty
        self._pointer = block.op(f"alloca {ELEMENTS[ty]}")

    @property
    def value(self) -> Value:
        """Return the present value."""
        return Value(self._block, self._ty, self._block.op(f"load {ELEMENTS[self._ty]}, ptr {self._pointer}"))

    @value.setter
    def value(self, new: Number) -> None:
        name = new.name if isinstance(new, Value) else self._block.constant(self._ty, new)
        self._block.do(f"store {ELEMENTS[self._ty]} {name}, ptr {self._pointer}")


class LaneBlock(Block):
    """A builder for the body of a function of one lane."""

    def given(self, ty: str, name: str) -> Value:
        """Return an argument of the function, or another named value."""
        return Value(self, ty, name)

    def number(self, ty: str, value: float | int | bool) -> Value:
        """Return a constant."""
        return Value(self, ty, self.constant(ty, value))

    def read(self, ty: str, pointer: str, index: Value | int = 0) -> Value:
        """Load an element of a table, which nothing writes to while the kernel runs."""
        place = f"i32 {index.name}" if isinstance(index, Value) else index
        return Value(self, ty, self.load(ELEMENTS[ty], self.at(pointer, ELEMENTS[ty], place)))

    def begin_block(self, label: str) -> None:
        """Begin a basic block."""
        self.lines.append(f"{label}:")
        self.label = label

    @contextmanager
    def loop(self) -> Iterator[Callable[[Value], None]]:
        """Repeat the lines written inside the ``with``; it gives a function that leaves the loop on a condition."""
        self._count += 1
        number, exits = self._count, 0
        self.do(f"br label %head{number}")
        self.begin_block(f"head{number}")

        def leave(condition: Value) -> None:
            nonlocal exits
            exits += 1
            self.do(f"br i1 {condition.name}, label %exit{number}, label %stay{number}.{exits}")
            self.begin_block(f"stay{number}.{exits}")

        yield leave
        self.do(f"br label %head{number}")
        self.begin_block(f"exit{number}")

    @contextmanager
    def either(self, condition: Value) -> Iterator[Callable[[], None]]:
        """Run the lines written inside the ``with`` where a condition holds, those after ``otherwise()`` elsewhere."""
        self._count += 1
        number = self._count
        self.do(f"br i1 {condition.name}, label %then{number}, label %else{number}")
        self.begin_block(f"then{number}")

        def otherwise() -> None:
            self.do(f"br label %after{number}")
            self.begin_block(f"else{number}")

        yield otherwise
        self.do(f"br label %after{number}")
        self.begin_block(f"after{number}")
