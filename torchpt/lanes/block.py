"""Writing LLVM IR as text: vectors of 16 numbers, one operation a line."""

from __future__ import annotations

import math
import struct

import numpy as np

__all__ = ["ELEMENTS", "WIDTH", "Block"]

#: Lanes of a vector. Where the machine's are narrower, LLVM takes several of them for one.
WIDTH = 16
#: How a node's type is held in a register.
ELEMENTS = {"f": "float", "d": "double", "i": "i32", "l": "i32", "u": "i32", "L": "i64", "b": "i1"}
_SUFFIX = {"float": "f32", "double": "f64", "i32": "i32", "i64": "i64", "i1": "i1", "i8": "i8"}


class Block:
    """Lines of IR in the body of a function, and the declarations that they need.

    Attributes:
        lines: of the body.
        declarations: of the functions that it calls.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.declarations: set[str] = set()
        self._count = 0

    def name(self) -> str:
        """A name for a new value."""
        self._count += 1
        return f"%v{self._count}"

    def op(self, text: str) -> str:
        """A line that gives a value; returns its name."""
        name = self.name()
        self.lines.append(f"  {name} = {text}")
        return name

    def do(self, text: str) -> None:
        """A line that gives none."""
        self.lines.append(f"  {text}")

    # -- types and constants

    def vector(self, ty: str, width: int = WIDTH) -> str:
        """The type of a vector of numbers of type ``ty``."""
        return f"<{width} x {ELEMENTS[ty]}>"

    def constant(self, ty: str, value: float | int | bool) -> str:
        """The same number in all lanes."""
        return f"splat ({ELEMENTS[ty]} {scalar(ty, value)})"

    def splat(self, ty: str, name: str) -> str:
        """A scalar in all lanes."""
        vector = self.vector(ty)
        one = self.op(f"insertelement {vector} poison, {ELEMENTS[ty]} {name}, i64 0")
        return self.op(f"shufflevector {vector} {one}, {vector} poison, <{WIDTH} x i32> zeroinitializer")

    # -- arithmetic

    def call(self, function: str, ty: str, *arguments: str, result: str | None = None) -> str:
        """An intrinsic on vectors of one type, such as ``llvm.fabs``; the suffix is put behind it."""
        vector = self.vector(ty)
        name = f"{function}.v{WIDTH}{_SUFFIX[ELEMENTS[ty]]}"
        self.declarations.add(f"declare {result or vector} @{name}({', '.join([vector] * len(arguments))})")
        flags = " contract" if ty in "fd" and result is None else ""
        given = ", ".join(f"{vector} {a}" for a in arguments)
        return self.op(f"call{flags} {result or vector} @{name}({given})")

    def binary(self, op: str, ty: str, a: str, b: str) -> str:
        """An instruction of LLVM; those on floats may be contracted."""
        return self.op(f"{op}{' contract' if ty in 'fd' else ''} {self.vector(ty)} {a}, {b}")

    def add(self, ty: str, a: str, b: str) -> str:
        """``a + b``."""
        return self.binary("fadd" if ty in "fd" else "add", ty, a, b)

    def sub(self, ty: str, a: str, b: str) -> str:
        """``a - b``."""
        return self.binary("fsub" if ty in "fd" else "sub", ty, a, b)

    def mul(self, ty: str, a: str, b: str) -> str:
        """``a b``."""
        return self.binary("fmul" if ty in "fd" else "mul", ty, a, b)

    def div(self, ty: str, a: str, b: str) -> str:
        """``a / b`` of floats."""
        return self.binary("fdiv", ty, a, b)

    def fma(self, ty: str, a: str, b: str, c: str) -> str:
        """``a b + c``, rounded once where the machine can do that in one instruction."""
        return self.call("llvm.fmuladd", ty, a, b, c)

    def negative(self, ty: str, a: str) -> str:
        """``-a``."""
        if ty in "fd":
            return self.op(f"fneg {self.vector(ty)} {a}")
        return self.op(f"sub {self.vector(ty)} zeroinitializer, {a}")

    def compare(self, op: str, ty: str, a: str, b: str) -> str:
        """``fcmp`` or ``icmp``."""
        return self.op(f"{'fcmp' if ty in 'fd' else 'icmp'} {op} {self.vector(ty)} {a}, {b}")

    def select(self, ty: str, condition: str, a: str, b: str) -> str:
        """``a`` in lanes where the condition holds, else ``b``."""
        vector = self.vector(ty)
        return self.op(f"select <{WIDTH} x i1> {condition}, {vector} {a}, {vector} {b}")

    def convert(self, op: str, source: str, target: str, a: str) -> str:
        """``sitofp``, ``bitcast``, ..."""
        return self.op(f"{op} {self.vector(source)} {a} to {self.vector(target)}")

    def polynomial(self, ty: str, x: str, coefficients: tuple[float, ...]) -> str:
        """Horner's scheme, the highest power first."""
        value = self.constant(ty, coefficients[0])
        for c in coefficients[1:]:
            value = self.fma(ty, value, x, self.constant(ty, c))
        return value

    def extreme(self, op: str, ty: str, a: str, b: str) -> str:
        """``max`` or ``min``; of floats NaN where either is, as torch has it."""
        if ty not in "fd":
            sign = "u" if ty == "b" else "s"  # a bit that is set is -1 to signed comparisons
            return self.select(ty, self.compare(sign + ("gt" if op == "max" else "lt"), ty, a, b), a, b)
        better = "ogt" if op == "max" else "olt"
        if b.startswith("splat"):  # no NaN: the other one is kept where it is
            return self.select(ty, self.compare(better, ty, b, a), b, a)
        chosen = self.select(ty, self.compare(better, ty, a, b), a, b)
        if a.startswith("splat"):
            return chosen
        return self.select(ty, self.compare("uno", ty, a, a), a, chosen)

    # -- memory

    def load(self, element: str, pointer: str, invariant: bool = True) -> str:
        """A scalar; ``invariant``: nothing writes there while the kernel runs."""
        return self.op(f"load {element}, ptr {pointer}{', !invariant.load !0' if invariant else ''}")

    def at(self, pointer: str, element: str, index: str | int) -> str:
        """The address of an element; ``index`` is a 64-bit number, or a vector's text with its type."""
        index = index if isinstance(index, str) and index.startswith("<") else f"i64 {index}"
        return self.op(f"getelementptr {element}, ptr {pointer}, {index}")

    def gather(self, element: str, pointer: str, index: str) -> str:
        """Elements at a vector of indices."""
        vector, suffix = f"<{WIDTH} x {element}>", f"v{WIDTH}{_SUFFIX[element]}"
        name = f"llvm.masked.gather.{suffix}.v{WIDTH}p0"
        self.declarations.add(f"declare {vector} @{name}(<{WIDTH} x ptr>, i32, <{WIDTH} x i1>, {vector})")
        places = self.at(pointer, element, f"<{WIDTH} x i32> {index}")
        size = 8 if element in ("double", "i64") else 4
        return self.op(
            f"call {vector} @{name}(<{WIDTH} x ptr> {places}, i32 {size}, <{WIDTH} x i1> splat (i1 true), "
            f"{vector} zeroinitializer)"
        )

    def scatter(self, element: str, value: str, pointer: str, index: str, mask: str) -> None:
        """Writes elements at a vector of indices where the mask holds."""
        vector, suffix = f"<{WIDTH} x {element}>", f"v{WIDTH}{_SUFFIX[element]}"
        name = f"llvm.masked.scatter.{suffix}.v{WIDTH}p0"
        self.declarations.add(f"declare void @{name}({vector}, <{WIDTH} x ptr>, i32, <{WIDTH} x i1>)")
        places = self.at(pointer, element, f"<{WIDTH} x i32> {index}")
        self.do(f"call void @{name}({vector} {value}, <{WIDTH} x ptr> {places}, i32 4, <{WIDTH} x i1> {mask})")

    def masked_load(self, element: str, pointer: str, mask: str) -> str:
        """Consecutive elements; zero where the mask does not hold."""
        vector, suffix = f"<{WIDTH} x {element}>", f"v{WIDTH}{_SUFFIX[element]}"
        name = f"llvm.masked.load.{suffix}.p0"
        self.declarations.add(f"declare {vector} @{name}(ptr, i32, <{WIDTH} x i1>, {vector})")
        return self.op(f"call {vector} @{name}(ptr {pointer}, i32 1, <{WIDTH} x i1> {mask}, {vector} zeroinitializer)")

    def masked_store(self, element: str, value: str, pointer: str, mask: str) -> None:
        """Consecutive elements where the mask holds."""
        vector, suffix = f"<{WIDTH} x {element}>", f"v{WIDTH}{_SUFFIX[element]}"
        name = f"llvm.masked.store.{suffix}.p0"
        self.declarations.add(f"declare void @{name}({vector}, ptr, i32, <{WIDTH} x i1>)")
        self.do(f"call void @{name}({vector} {value}, ptr {pointer}, i32 1, <{WIDTH} x i1> {mask})")

    def compress(self, element: str, value: str, mask: str) -> str:
        """The elements where the mask holds, moved together; what follows them is left open."""
        vector, suffix = f"<{WIDTH} x {element}>", f"v{WIDTH}{_SUFFIX[element]}"
        name = f"llvm.experimental.vector.compress.{suffix}"
        self.declarations.add(f"declare {vector} @{name}({vector}, <{WIDTH} x i1>, {vector})")
        return self.op(f"call {vector} @{name}({vector} {value}, <{WIDTH} x i1> {mask}, {vector} poison)")

    def count(self, mask: str) -> str:
        """How many lanes of a mask hold: an i64."""
        self.declarations.add("declare i16 @llvm.ctpop.i16(i16)")
        bits = self.op(f"bitcast <{WIDTH} x i1> {mask} to i16")
        return self.op(f"zext i16 {self.op(f'call i16 @llvm.ctpop.i16(i16 {bits})')} to i64")


def scalar(ty: str, value: float | int | bool) -> str:
    """A number in LLVM's notation."""
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
