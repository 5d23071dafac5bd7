"""Build LLVM IR text, one instruction a line, for values of one lane or of a vector of lanes.

A value is given by the name of its LLVM register, such as ``%v12``, or by a constant in LLVM's syntax. A *node type* ``ty`` is
one letter (:mod:`torchpt.compiler.graph`), an *element* an LLVM type such as ``float``.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from torchpt.compiler.form import Form

__all__ = ["ELEMENTS", "Block"]

#: LLVM type of a register, by node type.
ELEMENTS = {"f": "float", "d": "double", "i": "i32", "l": "i32", "u": "i32", "L": "i64", "b": "i1"}
#: How LLVM writes a type in the names of its intrinsics.
_SUFFIX = {"float": "f32", "double": "f64", "i32": "i32", "i64": "i64", "i1": "i1", "i8": "i8"}


class Block:
    """A builder for the body of one LLVM function.

    Attributes:
        form: layout of lanes in registers.
        width: number of lanes in a value.
        lines: IR of the body.
        declarations: ``declare`` lines of the functions that the body calls.
        label: name of the basic block that lines are appended to.
    """

    def __init__(self, form: Form, names: int = 0) -> None:
        self.form, self.width = form, form.width
        self.lines: list[str] = []
        self.declarations: set[str] = set()
        self.label = "entry"
        self._count = names

    @property
    def names(self) -> int:
        """The number of names that were given; the next one is behind it."""
        return self._count

    def name(self) -> str:
        """Return a fresh name for a value."""
        self._count += 1
        return f"%v{self._count}"

    def op(self, text: str) -> str:
        """Append an instruction and return the name of its result."""
        name = self.name()
        self.lines.append(f"  {name} = {text}")
        return name

    def do(self, text: str) -> None:
        """Append an instruction without a result."""
        self.lines.append(f"  {text}")

    def let(self, name: str, type_: str, value: str) -> None:
        """Bind a value to a chosen name."""
        self.do(f"%{name} = bitcast {type_} {value} to {type_}")

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """Put the lines written inside the ``with`` behind a branch on a condition (an i1); values must have one lane."""
        assert self.width == 1
        self._count += 1
        then, after = f"then{self._count}", f"after{self._count}"
        self.do(f"br i1 {condition}, label %{then}, label %{after}")
        self.lines.append(f"{then}:")
        self.label = then
        yield
        self.do(f"br label %{after}")
        self.lines.append(f"{after}:")
        self.label = after

    # -- types and constants

    def each(self, element: str) -> str:
        """Return the LLVM type of a value with one ``element`` a lane."""
        return f"<{self.width} x {element}>" if self.width > 1 else element

    def vector(self, ty: str) -> str:
        """Return the LLVM type of a value of node type ``ty``."""
        return self.each(ELEMENTS[ty])

    def suffix(self, element: str) -> str:
        """Return the suffix of LLVM's overloaded intrinsics for the type :meth:`each` returns, such as ``v16f32``."""
        return (f"v{self.width}" if self.width > 1 else "") + _SUFFIX[element]

    def numbers(self) -> str:
        """Return the int32 constant 0, 1, 2, ..., one number for each lane of a value."""
        return f"<{', '.join(f'i32 {k}' for k in range(self.width))}>" if self.width > 1 else "0"

    def places(self, first: str) -> str:
        """Return the int32 indices ``first``, ``first + 1``, ..., one a lane; ``first`` is an i64."""
        start = self.splat("i", self.op(f"trunc i64 {first} to i32"))
        return self.op(f"add {self.each('i32')} {start}, {self.numbers()}")

    def constant(self, ty: str, value: float | int | bool) -> str:
        """Return a constant that is the same in all lanes."""
        return f"splat ({ELEMENTS[ty]} {scalar(ty, value)})" if self.width > 1 else scalar(ty, value)

    def splat(self, ty: str, name: str) -> str:
        """Broadcast a scalar to all lanes."""
        if self.width == 1:
            return name
        vector = self.vector(ty)
        one = self.op(f"insertelement {vector} poison, {ELEMENTS[ty]} {name}, i64 0")
        return self.op(f"shufflevector {vector} {one}, {vector} poison, {self.each('i32')} zeroinitializer")

    def some(self, mask: str) -> str:
        """Return an i1 that is true if the mask is set in any lane."""
        if self.width == 1:
            return mask
        bits = self.op(f"bitcast {self.each('i1')} {mask} to i{self.width}")
        return self.op(f"icmp ne i{self.width} {bits}, 0")

    # -- arithmetic

    def call(self, function: str, ty: str, *arguments: str, result: str | None = None) -> str:
        """Call an intrinsic such as ``llvm.fabs`` on values of type ``ty``; the suffix of the type is appended to its name.

        ``result`` is the LLVM type of the result, if it is not that of the arguments.
        """
        vector = self.vector(ty)
        name = f"{function}.{self.suffix(ELEMENTS[ty])}"
        self.declarations.add(f"declare {result or vector} @{name}({', '.join([vector] * len(arguments))})")
        typed = ", ".join(f"{vector} {a}" for a in arguments)
        return self.op(f"call {result or vector} @{name}({typed})")

    def binary(self, op: str, ty: str, a: str, b: str) -> str:
        """Append an LLVM binary instruction, without fast-math flags: LLVM neither fuses nor reorders floats."""
        return self.op(f"{op} {self.vector(ty)} {a}, {b}")

    def add(self, ty: str, a: str, b: str) -> str:
        """Add: ``a + b``."""
        return self.binary("fadd" if ty in "fd" else "add", ty, a, b)

    def sub(self, ty: str, a: str, b: str) -> str:
        """Subtract: ``a - b``."""
        return self.binary("fsub" if ty in "fd" else "sub", ty, a, b)

    def mul(self, ty: str, a: str, b: str) -> str:
        """Multiply: ``a b``."""
        return self.binary("fmul" if ty in "fd" else "mul", ty, a, b)

    def div(self, ty: str, a: str, b: str) -> str:
        """Divide floats: ``a / b``."""
        return self.binary("fdiv", ty, a, b)

    def fma(self, ty: str, a: str, b: str, c: str) -> str:
        """Compute ``a b + c`` rounded once: an instruction, or a call of the C library on machines without one."""
        return self.call("llvm.fma", ty, a, b, c)

    def negative(self, ty: str, a: str) -> str:
        """Negate: ``-a``."""
        if ty in "fd":
            return self.op(f"fneg {self.vector(ty)} {a}")
        return self.op(f"sub {self.vector(ty)} zeroinitializer, {a}")

    def compare(self, op: str, ty: str, a: str, b: str) -> str:
        """Compare by ``fcmp`` or ``icmp``; ``op`` is LLVM's predicate."""
        return self.op(f"{'fcmp' if ty in 'fd' else 'icmp'} {op} {self.vector(ty)} {a}, {b}")

    def select(self, ty: str, condition: str, a: str, b: str) -> str:
        """Select ``a`` in lanes where the condition holds, else ``b``."""
        vector = self.vector(ty)
        return self.op(f"select {self.each('i1')} {condition}, {vector} {a}, {vector} {b}")

    def convert(self, op: str, source: str, target: str, a: str) -> str:
        """Convert between node types by an LLVM cast ``op``: ``sitofp``, ``bitcast``, ..."""
        return self.op(f"{op} {self.vector(source)} {a} to {self.vector(target)}")

    def to_integer(self, source: str, target: str, a: str) -> str:
        """Round a float towards zero; NaN and numbers out of range give the least integer, the result of x86."""
        number = self.convert("fptosi", source, target, a)
        if not self.form.threads:
            # For NaN and numbers out of range LLVM leaves the result open. `freeze` makes it the result of the instruction.
            return self.op(f"freeze {self.vector(target)} {number}")
        top = 2.0 ** (63 if target == "L" else 31)
        low, high = (self.compare(op, source, a, self.constant(source, x)) for op, x in (("oge", -top), ("olt", top)))
        return self.select(target, self.op(f"and i1 {low}, {high}"), number, self.constant(target, -int(top)))

    def polynomial(self, ty: str, x: str, coefficients: tuple[float, ...]) -> str:
        """Evaluate a polynomial by Horner's scheme; coefficients of the highest power first."""
        value = self.constant(ty, coefficients[0])
        for c in coefficients[1:]:
            value = self.fma(ty, value, x, self.constant(ty, c))
        return value

    def extreme(self, op: str, ty: str, a: str, b: str) -> str:
        """Take the ``max`` or ``min``; for floats NaN if either is NaN, as in torch."""
        if ty not in "fd":
            sign = "u" if ty == "b" else "s"  # i1 true is -1 in signed comparisons
            return self.select(ty, self.compare(sign + ("gt" if op == "max" else "lt"), ty, a, b), a, b)
        better = "ogt" if op == "max" else "olt"
        if not b.startswith("%"):  # a constant is not NaN: a NaN in ``a`` is kept
            return self.select(ty, self.compare(better, ty, b, a), b, a)
        chosen = self.select(ty, self.compare(better, ty, a, b), a, b)
        if not a.startswith("%"):
            return chosen
        return self.select(ty, self.compare("uno", ty, a, a), a, chosen)

    # -- memory

    def load(self, element: str, pointer: str, invariant: bool = True) -> str:
        """Load a scalar; ``invariant`` promises LLVM that nothing writes there while the kernel runs."""
        return self.op(f"load {element}, ptr {pointer}{', !invariant.load !0' if invariant else ''}")

    def load_pointer(self, pointer: str, invariant: bool = False) -> str:
        """Load a pointer; that of a GPU points to global memory, which LLVM is told by a cast from that address space."""
        if not self.form.threads:
            return self.load("ptr", pointer, invariant)
        return self.op(f"addrspacecast ptr addrspace(1) {self.load('ptr addrspace(1)', pointer, invariant)} to ptr")

    def at(self, pointer: str, element: str, index: str | int) -> str:
        """Return the address of an element; ``index`` is an i64, or a vector (or i32) with its type before it."""
        index = index if isinstance(index, str) and index.startswith(("<", "i32 ")) else f"i64 {index}"
        return self.op(f"getelementptr {element}, ptr {pointer}, {index}")

    def gather(
        self, element: str, pointer: str, index: str, invariant: bool = False, mask: str = "splat (i1 true)"
    ) -> str:
        """Load an element for each lane at int32 indices; ``invariant`` as in :meth:`load`.

        Vectors load 0 where ``mask`` is not set; a single lane always loads, so its index must be valid.
        """
        if self.width == 1:
            return self.load(element, self.at(pointer, element, f"i32 {index}"), invariant)
        vector, suffix = self.each(element), self.suffix(element)
        name = f"llvm.masked.gather.{suffix}.v{self.width}p0"
        self.declarations.add(f"declare {vector} @{name}({self.each('ptr')}, i32, {self.each('i1')}, {vector})")
        places = self.at(pointer, element, f"{self.each('i32')} {index}")
        size = 8 if element in ("double", "i64") else 4
        return self.op(
            f"call {vector} @{name}({self.each('ptr')} {places}, i32 {size}, {self.each('i1')} {mask}, "
            f"{vector} zeroinitializer)"
        )

    def scatter(self, element: str, value: str, pointer: str, index: str, mask: str) -> None:
        """Store an element for each lane at int32 indices where the mask is set."""
        vector, suffix = self.each(element), self.suffix(element)
        name = f"llvm.masked.scatter.{suffix}.v{self.width}p0"
        self.declarations.add(f"declare void @{name}({vector}, {self.each('ptr')}, i32, {self.each('i1')})")
        places = self.at(pointer, element, f"{self.each('i32')} {index}")
        self.do(f"call void @{name}({vector} {value}, {self.each('ptr')} {places}, i32 4, {self.each('i1')} {mask})")

    def masked_load(self, element: str, pointer: str, mask: str) -> str:
        """Load consecutive elements; 0 where the mask is not set."""
        if self.width == 1:  # a loop over single lanes ends at the last lane, and threads beyond it load that one again
            return self.load(element, pointer, invariant=False)
        vector, suffix = self.each(element), self.suffix(element)
        name = f"llvm.masked.load.{suffix}.p0"
        self.declarations.add(f"declare {vector} @{name}(ptr, i32, {self.each('i1')}, {vector})")
        return self.op(
            f"call {vector} @{name}(ptr {pointer}, i32 1, {self.each('i1')} {mask}, {vector} zeroinitializer)"
        )

    def masked_store(self, element: str, value: str, pointer: str, mask: str) -> None:
        """Store consecutive elements where the mask is set."""
        vector, suffix = self.each(element), self.suffix(element)
        name = f"llvm.masked.store.{suffix}.p0"
        self.declarations.add(f"declare void @{name}({vector}, ptr, i32, {self.each('i1')})")
        self.do(f"call void @{name}({vector} {value}, ptr {pointer}, i32 1, {self.each('i1')} {mask})")

    def compress(self, element: str, value: str, mask: str, rest: str = "poison") -> str:
        """Compress the elements where the mask is set to the front; elements of ``rest`` fill up the vector."""
        vector, suffix = self.each(element), self.suffix(element)
        name = f"llvm.experimental.vector.compress.{suffix}"
        self.declarations.add(f"declare {vector} @{name}({vector}, {self.each('i1')}, {vector})")
        return self.op(f"call {vector} @{name}({vector} {value}, {self.each('i1')} {mask}, {vector} {rest})")

    def count(self, mask: str) -> str:
        """Count the lanes where a mask is set; return an i64."""
        word = f"i{self.width}"
        self.declarations.add(f"declare {word} @llvm.ctpop.{word}({word})")
        bits = self.op(f"bitcast {self.each('i1')} {mask} to {word}")
        return self.op(f"zext {word} {self.op(f'call {word} @llvm.ctpop.{word}({word} {bits})')} to i64")


def scalar(ty: str, value: float | int | bool) -> str:
    """Format a number as an LLVM constant."""
    if ty in "fd":
        value = float(value)
        if math.isnan(value):
            return "0x7FF8000000000000"
        if ty == "f" and math.isfinite(value):
            value = float(np.float32(value))
        return f"0x{struct.unpack('<Q', struct.pack('<d', value))[0]:016X}"
    if ty == "b":
        return "true" if value else "false"
    bits = 64 if ty == "L" else 32
    half = 1 << (bits - 1)
    return str(((int(value) + half) & ((1 << bits) - 1)) - half)
