"""Searches inside a kernel: binary search in sorted tables, and brute-force ray intersection with few primitives.

Both are written as LLVM IR text, by :class:`~torchpt.compiler.block.Block`, whose methods append an instruction and return the
register of its result. A *packet* is the rays of one value: 16 in a vector, else one.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchpt.compiler.block import Block
from torchpt.compiler.codegen import MEMORY
from torchpt.compiler.form import Form
from torchpt.compiler.graph import Graph

__all__ = ["KINDS", "PacketSearch", "binary_searches", "scene_words"]


# ---- Binary searches in sorted tables, as LLVM IR: functions that kernels call


def binary_searches(graph: Graph, needed: list[int], form: Form) -> Block:
    """Generate the binary searches that a graph uses; all lanes take the same number of steps, log2 of the table's length."""
    searches = {extra[1:] for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op == "search"}
    functions = Block(form)
    for ty, right in sorted(searches):
        block, element = Block(form), MEMORY[ty]
        vector, places = block.vector(ty), block.each("i32")
        block.lines += [
            f"define internal {places} @sorted_{ty}_{'right' if right else 'left'}"
            f"(ptr %table, i64 %count, {vector} %value) {_attributes(form)} {{",
            "entry:",
            "  %count32 = trunc i64 %count to i32",
            "  %last = sub i32 %count32, 1",
        ]
        last, most = block.splat("i", "%last"), block.splat("i", "%count32")
        block.lines += [
            "  %none = icmp eq i32 %count32, 0",
            "  br i1 %none, label %exit, label %loop",
            "loop:",
            f"  %base = phi {places} [ zeroinitializer, %entry ], [ %better, %loop ]",
            "  %length = phi i32 [ %count32, %entry ], [ %rest, %loop ]",
            "  %more = add i32 %length, 1",
            "  %half = lshr i32 %more, 1",
            "  %step = sub i32 %half, 1",
        ]
        # the entry in the middle of the `length` entries from `base` on; if it is below the value, the search goes on behind it
        middle = block.call("llvm.umin", "i", block.add("i", "%base", block.splat("i", "%step")), last)
        entry = block.gather(element, "%table", middle, invariant=True)
        # an unordered comparison of floats: for NaN all entries are below, as in torch
        predicate = ("ule" if right else "ult") if ty in "fd" else ("sle" if right else "slt")
        below = block.compare(predicate, ty, entry, "%value")
        further = block.add("i", "%base", block.splat("i", "%half"))
        block.lines += [
            f"  %better = select {block.each('i1')} {below}, {places} {further}, {places} %base",
            "  %rest = lshr i32 %length, 1",
            "  %done = icmp eq i32 %rest, 0",
            "  br i1 %done, label %exit, label %loop",
            "exit:",
            f"  %found = phi {places} [ zeroinitializer, %entry ], [ %better, %loop ]",
        ]
        block.do(f"ret {places} {block.call('llvm.umin', 'i', '%found', most)}")
        block.lines.append("}")
        functions.lines += block.lines
        functions.declarations |= block.declarations
    return functions


def _attributes(form: Form) -> str:
    """Return the attributes of a function that kernels call.

    It is inlined on GPUs, where a call costs a thread registers and local memory; the passes of CPU kernels inline nothing.
    """
    return "alwaysinline #0" if form.threads else "noinline #0"


# ---- Brute-force intersection of a packet of rays with every primitive, as functions inside a kernel, for small scenes
#
# Planar primitives are affine rows, with their rounding error as tolerance (:func:`torchpt.search.tables.tolerances`);
# spheres are intersected in float64. Primitives are tested by rising id with a strict comparison: ties go to the lowest id.


#: Primitives that these functions know, in the order of their ids.
KINDS = ("triangle", "rectangle", "disk", "sphere")
#: Length of a planar primitive's row: three affine rows of four numbers, and the tolerance.
_ROW = 13
#: Parameters of the functions: components of the ray's origin and direction.
_RAY = ("ox", "oy", "oz", "dx", "dy", "dz")


@dataclass(frozen=True)
class PacketSearch:
    """The functions ``nearest`` and ``occluded``, which take rays and the address of :func:`scene_words`.

    Attributes:
        kinds: kinds of primitives in the scene, of :data:`KINDS`.
    """

    kinds: tuple[str, ...]

    def __call__(self, form: Form) -> Block:
        """Generate the functions; a packet has ``form.width`` rays."""
        functions = Block(form)
        for any_hit in (False, True):
            block = _SearchFunction(self.kinds, any_hit, form)
            block.write()
            functions.lines += block.lines
            functions.declarations |= block.declarations
        return functions


def scene_words(rows: Tensor, balls: Tensor, counts: Sequence[int], extent: float) -> Any:
    """Return the scene data that the functions read, as a ctypes array; the tensors must outlive it.

    Its words of 64 bits: address of the rows of planar primitives, address of the spheres, for each of :data:`KINDS` the id
    after its last primitive, and the scene's extent as a float64.

    Args:
        rows: ``(P, 13)`` float32: ``n c a ca b cb`` and the tolerance of each planar primitive.
        balls: ``(S, 4)`` float64: centres and radii.
        counts: number of primitives of each kind; kinds after :data:`KINDS` are not searched.
        extent: see :func:`torchpt.search.tables.extent`.
    """
    ends = [sum(counts[: k + 1]) for k in range(len(KINDS))]
    words = (ctypes.c_int64 * (3 + len(ends)))(rows.data_ptr(), balls.data_ptr(), *ends)
    ctypes.c_double.from_buffer(words, 8 * (2 + len(ends))).value = extent  # in the last word
    return words


class _SearchFunction(Block):
    """The function ``occluded`` (``any_hit``) or ``nearest``: a loop over the primitives of each kind, one after the other.

    ``f``, ``i``, ``d`` and ``b`` are the LLVM types of a value of float32, int32, float64 and bool; ``hit`` is that of the
    result t, prim, u, v. Registers of the loop over a kind begin with its name: ``%disk_t`` and ``%disk_p`` are the nearest
    distance so far and its primitive, ``%disk_id`` the primitive that is tested.
    """

    def __init__(self, kinds: Sequence[str], any_hit: bool, form: Form) -> None:
        super().__init__(form)
        self.f, self.i, self.d, self.b = (self.vector(ty) for ty in "fidb")
        self.hit = f"{{{self.f}, {self.i}, {self.f}, {self.f}}}"
        self.kinds, self.any_hit = kinds, any_hit

    def write(self) -> None:
        """Write the function."""
        parameters = ", ".join(f"{self.f} %{name}" for name in (*_RAY, "t_max"))
        name, result = ("occluded", self.b) if self.any_hit else ("nearest", self.hit)
        attributes = _attributes(self.form)
        self.lines.append(f"define internal {result} @{name}({parameters}, ptr %search) {attributes} {{\nentry:")
        self._start()
        t, prim, before = "%t0", self.constant("i", -1), "entry"
        for kind in self.kinds:
            t, prim, before = self._loop(kind, t, prim, before)
        if self.any_hit:
            self.do(f"ret {self.b} {self.op(f'icmp sge {self.i} {prim}, zeroinitializer')}")
        else:
            self._finish(t, prim)
        self.lines.append("}")

    def _start(self) -> None:
        """Load the scene data, and compute what the tests need of the rays.

        ``%t0`` is ``t_max``, or -1 for a ray that cannot hit anything; ``%live`` says whether any ray can. ``%reach`` is the
        scale of the tolerances, see :func:`torchpt.search.tables.tolerances`. For spheres ``%square`` is ``|d|^2`` in float64,
        ``%shrink`` and ``%shrink32`` its reciprocal in both precisions.
        """
        words = ("rows", "balls", *(f"end_{kind}" for kind in KINDS))
        for k, word in enumerate(words):
            place = self.at("%search", "i64", k)
            if k < 2:
                self.let(word, "ptr", self.load_pointer(place, invariant=True))
            else:
                self.let(word, "i64", self.load("i64", place))
        extent = self.load("double", self.at("%search", "i64", len(words)))
        extent = self.splat("f", self.op(f"fptrunc double {extent} to float"))
        zero = self.constant("f", 0.0)
        # 0 if all components are finite, else NaN.
        sum_of_zeros = None
        for name in _RAY:
            product = self.mul("f", f"%{name}", zero)
            sum_of_zeros = product if sum_of_zeros is None else self.add("f", sum_of_zeros, product)
        assert sum_of_zeros is not None
        valid = self.op(
            f"and {self.b} {self.compare('oeq', 'f', sum_of_zeros, zero)}, {self.compare('ogt', 'f', '%t_max', zero)}"
        )
        self.lines.append(f"  %t0 = select {self.b} {valid}, {self.f} %t_max, {self.f} {self.constant('f', -1.0)}")
        size_o, size_d = self._maximum_norm(_RAY[:3]), self._maximum_norm(_RAY[3:])
        self.lines.append(f"  %reach = fmul {self.f} {size_d}, {self._larger(size_o, extent)}")
        self.let("live", "i1", self.some(valid))
        if "sphere" in self.kinds:
            d = [self.convert("fpext", "f", "d", f"%{name}") for name in _RAY[3:]]
            self.lines.append(f"  %square = fadd {self.d} {self._dot(d, d)}, {self.constant('d', 0.0)}")
            self.lines.append(f"  %shrink = fdiv {self.d} {self.constant('d', 1.0)}, %square")
            self.lines.append(f"  %shrink32 = fptrunc {self.d} %shrink to {self.f}")

    def _larger(self, a: str, b: str) -> str:
        return self.select("f", self.compare("ogt", "f", a, b), a, b)

    def _maximum_norm(self, names: tuple[str, ...]) -> str:
        a, b, c = (self.call("llvm.fabs", "f", f"%{name}") for name in names)
        return self._larger(self._larger(a, b), c)

    def _loop(self, kind: str, t: str, prim: str, before: str) -> tuple[str, str, str]:
        """Write a loop over all primitives of a kind.

        Args:
            kind: the kind.
            t: nearest distances before the loop.
            prim: their primitives.
            before: name of the basic block before the loop.

        Returns:
            Distances and primitives after the loop, and the name of the basic block behind it.
        """
        index = KINDS.index(kind)
        first = "0" if index == 0 else f"%end_{KINDS[index - 1]}"
        last = f"{kind}_last" if kind == "sphere" else kind  # the last basic block of the loop's body
        self.lines += [
            f"  %{kind}_some = icmp slt i64 {first}, %end_{kind}",
            f"  %{kind}_go = and i1 %{kind}_some, %live",
            f"  br i1 %{kind}_go, label %{kind}, label %{kind}_done",
            f"{kind}:",
            f"  %{kind}_id = phi i64 [ {first}, %{before} ], [ %{kind}_next, %{last} ]",
            f"  %{kind}_t = phi {self.f} [ {t}, %{before} ], [ %{kind}_t1, %{last} ]",
            f"  %{kind}_p = phi {self.i} [ {prim}, %{before} ], [ %{kind}_p1, %{last} ]",
        ]
        if kind == "sphere":
            self._skip_far_sphere(kind)
        distance, hit = self._sphere(kind) if kind == "sphere" else self._planar(kind)
        tests = [
            self.compare("ogt", "f", distance, self.constant("f", 0.0)),
            self.compare("olt", "f", distance, f"%{kind}_t"),
        ]
        for test in tests:
            hit = test if hit is None else self.op(f"and {self.b} {hit}, {test}")
        # Any hit ends the ray: no later distance is below -1.
        new_t = self.constant("f", -1.0) if self.any_hit else distance
        new_prim = self.splat("i", self.op(f"trunc i64 %{kind}_id to i32"))
        tail = (
            "e" if kind == "sphere" else "1"
        )  # of spheres as the exact test gives it, before the loop's last basic block
        self.lines += [
            f"  %{kind}_t{tail} = select {self.b} {hit}, {self.f} {new_t}, {self.f} %{kind}_t",
            f"  %{kind}_p{tail} = select {self.b} {hit}, {self.i} {new_prim}, {self.i} %{kind}_p",
        ]
        if kind == "sphere":
            self.lines += [
                f"  br label %{kind}_last",
                f"{kind}_last:",
                f"  %{kind}_t1 = phi {self.f} [ %{kind}_t, %{kind} ], [ %{kind}_te, %{kind}_exact ]",
                f"  %{kind}_p1 = phi {self.i} [ %{kind}_p, %{kind} ], [ %{kind}_pe, %{kind}_exact ]",
            ]
        self.lines += [
            f"  %{kind}_next = add i64 %{kind}_id, 1",
            f"  %{kind}_more = icmp slt i64 %{kind}_next, %end_{kind}",
            f"  br i1 %{kind}_more, label %{kind}, label %{kind}_done",
            f"{kind}_done:",
            f"  %{kind}_t2 = phi {self.f} [ {t}, %{before} ], [ %{kind}_t1, %{last} ]",
            f"  %{kind}_p2 = phi {self.i} [ {prim}, %{before} ], [ %{kind}_p1, %{last} ]",
        ]
        return f"%{kind}_t2", f"%{kind}_p2", f"{kind}_done"

    def _affine(self, row: list[str], x: tuple[str, ...]) -> str:
        """Evaluate ``row[0:3] . x + row[3]``."""
        value = row[3]
        for a, b in zip(row, x, strict=False):
            value = self.fma("f", a, b, value)
        return value

    def _planar(self, kind: str) -> tuple[str, str]:
        """Intersect a planar primitive; return t, and the mask of the rays whose hit is inside or within its tolerance."""
        base = self.op(f"getelementptr [{_ROW} x float], ptr %rows, i64 %{kind}_id")
        row = [self.splat("f", self.load("float", self.at(base, "float", k))) for k in range(_ROW)]
        o, d = tuple(f"%{name}" for name in _RAY[:3]), tuple(f"%{name}" for name in _RAY[3:])
        slope = self.mul("f", row[0], d[0])
        for k in (1, 2):
            slope = self.fma("f", row[k], d[k], slope)
        inverse = self.div("f", self.constant("f", 1.0), slope)
        t = self.mul("f", self.negative("f", self._affine(row[:4], o)), inverse)
        p = tuple(self.fma("f", t, d[k], o[k]) for k in range(3))
        u, v = self._affine(row[4:8], p), self._affine(row[8:12], p)
        if kind == "disk":
            square = self.fma("f", u, u, self.mul("f", v, v))
            return t, self.compare("ole", "f", square, self.constant("f", 1.0))
        slack = self.mul("f", self.call("llvm.fabs", "f", self.mul("f", "%reach", inverse)), row[12])
        low = self.select("f", self.compare("olt", "f", u, v), u, v)
        inside = self.compare("oge", "f", low, self.negative("f", slack))
        if kind == "triangle":
            most = self.fma("f", slack, self.constant("f", 2.0), self.constant("f", 1.0))
            other = self.compare("ole", "f", self.add("f", u, v), most)
        else:
            other = self.compare("ole", "f", self._larger(u, v), self.add("f", slack, self.constant("f", 1.0)))
        return t, self.op(f"and {self.b} {inside}, {other}")

    def _dot(self, a: list[str], b: list[str]) -> str:
        value = self.mul("d", a[0], b[0])
        for x, y in zip(a[1:], b[1:], strict=True):
            value = self.fma("d", x, y, value)
        return value

    def _skip_far_sphere(self, kind: str) -> None:
        """Branch to the exact test if any ray comes near the sphere, else to the next sphere; in float32 with a bound of error.

        The perpendicular from the centre ``c`` to the ray has an error below ``2^-20 (|f| + |c|)``, with ``f = o - c``: a
        few roundings of terms of that size, including the centre's conversion to float32.
        """
        own = self.op(f"sub i64 %{kind}_id, %end_disk")
        base = self.op(f"getelementptr [4 x double], ptr %balls, i64 {own}")
        loaded = [self.load("double", self.at(base, "double", k)) for k in range(4)]
        c = [self.splat("f", self.op(f"fptrunc double {x} to float")) for x in loaded]
        d = [f"%{name}" for name in _RAY[3:]]
        f = [self.sub("f", f"%{name}", x) for name, x in zip(_RAY[:3], c, strict=False)]
        along = self.mul("f", f[0], d[0])
        size = self.add("f", self.call("llvm.fabs", "f", f[0]), self.call("llvm.fabs", "f", c[0]))
        for k in (1, 2):
            along = self.fma("f", f[k], d[k], along)
            size = self.add("f", size, self.call("llvm.fabs", "f", f[k]))
            size = self.add("f", size, self.call("llvm.fabs", "f", c[k]))
        s = self.negative("f", self.mul("f", along, "%shrink32"))
        off = [self.fma("f", s, y, x) for x, y in zip(f, d, strict=True)]
        square = self.mul("f", off[0], off[0])
        for k in (1, 2):
            square = self.fma("f", off[k], off[k], square)
        reach = self.fma("f", size, self.constant("f", 2.0**-19), self.call("llvm.fabs", "f", c[3]))
        # An unordered comparison, so that overflow and NaN take the exact test.
        near = self.compare("ule", "f", square, self.mul("f", reach, reach))
        near = self.op(f"and {self.b} {near}, {self.compare('ogt', 'f', f'%{kind}_t', self.constant('f', 0.0))}")
        any_near = self.some(near)
        self.lines += [f"  br i1 {any_near}, label %{kind}_exact, label %{kind}_last", f"{kind}_exact:"]

    def _sphere(self, kind: str) -> tuple[str, str | None]:
        """Intersect a sphere as ``sphere_distance`` of ``scripts/kernel_sources/tree_leaf.py``; return t, NaN for a miss."""
        own = self.op(f"sub i64 %{kind}_id, %end_disk")
        base = self.op(f"getelementptr [4 x double], ptr %balls, i64 {own}")
        ball = [self.splat("d", self.load("double", self.at(base, "double", k))) for k in range(4)]
        o, d = ([self.convert("fpext", "f", "d", f"%{name}") for name in names] for names in (_RAY[:3], _RAY[3:]))
        f = [self.sub("d", x, c) for x, c in zip(o, ball, strict=False)]
        a, b = "%square", self.negative("d", self._dot(f, d))
        s = self.mul("d", b, "%shrink")
        off = [self.fma("d", s, y, x) for x, y in zip(f, d, strict=True)]
        square = self.mul("d", ball[3], ball[3])
        discriminant = self.sub("d", square, self._dot(off, off))
        root = self.call("llvm.sqrt", "d", self.mul("d", a, discriminant))
        q = self.add("d", b, self.call("llvm.copysign", "d", root, b))
        near, far = self.div("d", self.sub("d", self._dot(f, f), square), q), self.mul("d", q, "%shrink")
        first = self.compare("olt", "d", near, far)
        low, high = self.select("d", first, near, far), self.select("d", first, far, near)
        t = self.select("d", self.compare("ogt", "d", low, self.constant("d", 0.0)), low, high)
        return self.convert("fptrunc", "d", "f", t), None

    def _finish(self, t: str, prim: str) -> None:
        """Compute ``u, v`` of planar hits, clamped to the primitive, and return the hits."""
        hit = self.op(f"icmp sge {self.i} {prim}, zeroinitializer")
        zero, one = self.constant("f", 0.0), self.constant("f", 1.0)
        # the ids after the last triangle, rectangle and disk
        ends = {kind: self.splat("i", self.op(f"trunc i64 %end_{kind} to i32")) for kind in KINDS[:3]}
        planar = self.op(f"and {self.b} {hit}, {self.op(f'icmp slt {self.i} {prim}, ' + ends['disk'])}")
        u = v = zero
        if any(kind != "sphere" for kind in self.kinds):
            place = self.mul("i", self.select("i", planar, prim, "zeroinitializer"), self.constant("i", _ROW))
            p = tuple(self.fma("f", t, f"%{d}", f"%{o}") for o, d in zip(_RAY[:3], _RAY[3:], strict=True))
            row = [self.gather("float", self.at("%rows", "float", k), place, invariant=True) for k in range(4, 12)]
            u, v = self._affine(row[:4], p), self._affine(row[4:], p)
            polygon = self.op(f"icmp slt {self.i} {prim}, {ends['rectangle']}")
            triangle = self.op(f"icmp slt {self.i} {prim}, {ends['triangle']}")
            clamped_u = self._between(u, zero, one)
            largest_v = self.select("f", triangle, self.sub("f", one, clamped_u), one)
            u = self.select("f", polygon, clamped_u, u)
            v = self.select("f", polygon, self._between(v, zero, largest_v), v)
            u, v = (self.select("f", planar, x, zero) for x in (u, v))
        t = self.select("f", hit, t, self.constant("f", math.inf))
        value = "poison"
        for k, (ty, x) in enumerate(((self.f, t), (self.i, prim), (self.f, u), (self.f, v))):
            value = self.op(f"insertvalue {self.hit} {value}, {ty} {x}, {k}")
        self.do(f"ret {self.hit} {value}")

    def _between(self, x: str, low: str, high: str) -> str:
        x = self._larger(x, low)
        return self.select("f", self.compare("olt", "f", x, high), x, high)
