"""Searches inside a kernel: binary search in sorted tables, and brute-force ray intersection with few primitives.

Both are written as LLVM IR text, by :class:`~torchpt.compiler.block.Block`, whose methods append an instruction and return the
register of its result. A *packet* is the rays of one value: 16 in a vector, else one.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from torch import Tensor

from torchpt.compiler.block import Block
from torchpt.compiler.codegen import MEMORY
from torchpt.compiler.form import Form
from torchpt.compiler.graph import Graph

__all__ = ["KINDS", "ROW", "PacketSearch", "binary_searches", "scene_words"]


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
# Planar primitives are affine rows. A hit is accepted if it is inside, or beyond an edge by no more than its rounding error
# (:func:`torchpt.search.tables.tolerances`). It is *in doubt* if it is that near to an edge, on either side: then the ray is
# searched once more in float64. Spheres are intersected in float64 at once. Primitives are tested by rising id with a strict
# comparison: ties go to the lowest id.
#
# Such a filter before an exact test is that of Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust
# Geometric Predicates", Discrete & Computational Geometry 18, 1997.


#: Primitives that these functions know, in the order of their ids.
KINDS = ("triangle", "rectangle", "disk", "sphere")
#: Length of a planar primitive's row: three affine rows of four numbers, the tolerance, and the gap.
ROW = 14
#: Kinds of which a hit can be in doubt.
_POLYGONS = ("triangle", "rectangle")
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
            for real in "df" if set(_POLYGONS) & set(self.kinds) else "f":
                block = _SearchFunction(self.kinds, any_hit, real, form)
                block.write()
                functions.lines += block.lines
                functions.declarations |= block.declarations
        return functions


def scene_words(rows: Tensor, rows64: Tensor, balls: Tensor, counts: Sequence[int], extent: float) -> Any:
    """Return the scene data that the functions read, as a ctypes array; the tensors must outlive it.

    Its words of 64 bits: addresses of the rows of planar primitives in float32 and in float64, address of the spheres, for each
    of :data:`KINDS` the id after its last primitive, and the scene's extent as a float64.

    Args:
        rows: ``(P, 14)`` float32: ``n c a ca b cb`` of each planar primitive, its tolerance for float32
            (:func:`torchpt.search.tables.tolerances`), and a number that is not read.
        rows64: the same in float64, with the tolerance for float64, and the gap (:func:`torchpt.search.tables.gaps`).
        balls: ``(S, 4)`` float64: centres and radii.
        counts: number of primitives of each kind; kinds after :data:`KINDS` are not searched.
        extent: see :func:`torchpt.search.tables.extent`.
    """
    ends = [sum(counts[: k + 1]) for k in range(len(KINDS))]
    addresses = [x.data_ptr() for x in (rows, rows64, balls)]
    words = (ctypes.c_int64 * (len(addresses) + len(ends) + 1))(*addresses, *ends)
    ctypes.c_double.from_buffer(words, 8 * (len(words) - 1)).value = extent  # in the last word
    return words


class _Best(NamedTuple):
    """Registers of the nearest hits so far: distance, primitive (-1: none), and by how much the hit is out of doubt."""

    t: str
    prim: str
    margin: str


class _SearchFunction(Block):
    """The function ``occluded`` (``any_hit``) or ``nearest``: a loop over the primitives of each kind, one after the other.

    With tests in float32 (``real`` is ``f``) it calls the one with tests in float64 (``d``), named ``nearest_exact``, where
    hits are in doubt. Parameters and results are float32 in both.

    ``f``, ``i``, ``d`` and ``b`` are the LLVM types of a value of float32, int32, float64 and bool, ``r`` that of a number in
    the tests; ``hit`` is that of the result t, prim, u, v. Registers of the loop over a kind begin with its name:
    ``%disk_t`` and ``%disk_p`` are the nearest distance so far and its primitive, ``%disk_m`` the margin by which that hit is
    out of doubt, ``%disk_id`` the primitive that is tested.
    """

    def __init__(self, kinds: Sequence[str], any_hit: bool, real: str, form: Form) -> None:
        super().__init__(form)
        self.f, self.i, self.d, self.b = (self.vector(ty) for ty in "fidb")
        self.hit = f"{{{self.f}, {self.i}, {self.f}, {self.f}}}"
        self.kinds, self.any_hit = kinds, any_hit
        self.real, self.r, self.exact = real, self.vector(real), real == "d"
        self.filters = not self.exact and bool(set(_POLYGONS) & set(kinds))

    def write(self) -> None:
        """Write the function."""
        parameters = ", ".join(f"{self.f} %{name}" for name in (*_RAY, "t_max"))
        name, result = ("occluded", self.b) if self.any_hit else ("nearest", self.hit)
        attributes, suffix = _attributes(self.form), "_exact" if self.exact else ""
        self.lines.append(
            f"define internal {result} @{name}{suffix}({parameters}, ptr %search) {attributes} {{\nentry:"
        )
        self._start()
        best = _Best("%t0", self.constant("i", -1), self.constant("f", 1.0))
        before = "entry"
        for kind in self.kinds:
            best, before = self._loop(kind, best, before)
        found = self._results(best)
        if self.filters:
            doubt = self.compare("olt", "f", best.margin, self.constant("f", 0.0))
            self.lines += [f"  br i1 {self.some(doubt)}, label %doubt, label %end", "doubt:"]
            call = self.op(f"call {result} @{name}_exact({parameters}, ptr %search)")
            exact = [call] if self.any_hit else [self.op(f"extractvalue {self.hit} {call}, {k}") for k in range(4)]
            types = "b" if self.any_hit else "fiff"
            chosen = [self.select(ty, doubt, x, y) for ty, x, y in zip(types, exact, found, strict=True)]
            self.lines += ["  br label %end", "end:"]
            found = [
                self.op(f"phi {self.vector(ty)} [ {x}, %{before} ], [ {y}, %doubt ]")
                for ty, x, y in zip(types, found, chosen, strict=True)
            ]
        value = found[0]
        if not self.any_hit:
            value = "poison"
            for k, (ty, x) in enumerate(zip((self.f, self.i, self.f, self.f), found, strict=True)):
                value = self.op(f"insertvalue {self.hit} {value}, {ty} {x}, {k}")
        self.do(f"ret {result} {value}")
        self.lines.append("}")

    def _start(self) -> None:
        """Load the scene data, and compute what the tests need of the rays.

        ``%t0`` is ``t_max``, or -1 for a ray that cannot hit anything; ``%live`` says whether any ray can. ``%reach`` is the
        scale of the tolerances, see :func:`torchpt.search.tables.tolerances`. For spheres ``%square`` is ``|d|^2`` in float64,
        ``%shrink`` and ``%shrink32`` its reciprocal in both precisions.
        """
        words = ("rows_f", "rows_d", "balls", *(f"end_{kind}" for kind in KINDS))
        for k, word in enumerate(words):
            place = self.at("%search", "i64", k)
            if word.startswith("end"):
                self.let(word, "i64", self.load("i64", place))
            else:
                self.let(word, "ptr", self.load_pointer(place, invariant=True))
        extent = self.load("double", self.at("%search", "i64", len(words)))
        if not self.exact:
            extent = self.op(f"fptrunc double {extent} to float")
        extent = self.splat(self.real, extent)
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
        t_max = self._real("%t_max")
        self.lines.append(
            f"  %t0 = select {self.b} {valid}, {self.r} {t_max}, {self.r} {self.constant(self.real, -1.0)}"
        )
        self.o, self.to = (tuple(self._real(f"%{name}") for name in names) for names in (_RAY[:3], _RAY[3:]))
        size_o, size_d = self._maximum_norm(self.o), self._maximum_norm(self.to)
        self.lines.append(f"  %reach = fmul {self.r} {size_d}, {self._larger(size_o, extent)}")
        self.let("live", "i1", self.some(valid))
        if "sphere" in self.kinds:
            d = [self.convert("fpext", "f", "d", f"%{name}") for name in _RAY[3:]]
            self.lines.append(f"  %square = fadd {self.d} {self._dot(d, d)}, {self.constant('d', 0.0)}")
            self.lines.append(f"  %shrink = fdiv {self.d} {self.constant('d', 1.0)}, %square")
            self.lines.append(f"  %shrink32 = fptrunc {self.d} %shrink to {self.f}")

    def _real(self, x: str) -> str:
        """Return a float32 in the precision of the tests."""
        return self.convert("fpext", "f", "d", x) if self.exact else x

    def _larger(self, a: str, b: str) -> str:
        return self.select(self.real, self.compare("ogt", self.real, a, b), a, b)

    def _smaller(self, a: str, b: str) -> str:
        return self.select(self.real, self.compare("olt", self.real, a, b), a, b)

    def _maximum_norm(self, x: tuple[str, ...]) -> str:
        a, b, c = (self.call("llvm.fabs", self.real, k) for k in x)
        return self._larger(self._larger(a, b), c)

    def _loop(self, kind: str, best: _Best, before: str) -> tuple[_Best, str]:
        """Write a loop over all primitives of a kind.

        Args:
            kind: the kind.
            best: the nearest hits before the loop.
            before: name of the basic block before the loop.

        Returns:
            The nearest hits after the loop, and the name of the basic block behind it.
        """
        index = KINDS.index(kind)
        first = "0" if index == 0 else f"%end_{KINDS[index - 1]}"
        skips = kind == "sphere" and not self.exact  # far spheres, by a branch
        last = f"{kind}_last" if skips else kind  # the last basic block of the loop's body
        # name, type, and value before the loop of what is kept of the nearest hits
        kept = [("t", self.r, best.t), ("p", self.i, best.prim)]
        if self.filters:
            kept.append(("m", self.f, best.margin))
        self.lines += [
            f"  %{kind}_some = icmp slt i64 {first}, %end_{kind}",
            f"  %{kind}_go = and i1 %{kind}_some, %live",
            f"  br i1 %{kind}_go, label %{kind}, label %{kind}_done",
            f"{kind}:",
            f"  %{kind}_id = phi i64 [ {first}, %{before} ], [ %{kind}_next, %{last} ]",
            *(f"  %{kind}_{x} = phi {ty} [ {start}, %{before} ], [ %{kind}_{x}1, %{last} ]" for x, ty, start in kept),
        ]
        if skips:
            self._skip_far_sphere(kind)
        distance, hit, margin = self._sphere() if kind == "sphere" else self._planar(kind)
        tests = [
            self.compare("ogt", self.real, distance, self.constant(self.real, 0.0)),
            self.compare("olt", self.real, distance, f"%{kind}_t"),
        ]
        for test in tests:
            hit = test if hit is None else self.op(f"and {self.b} {hit}, {test}")
        # Any hit ends the ray: no later distance is below -1.
        new = {
            "t": self.constant(self.real, -1.0) if self.any_hit else distance,
            "p": self.splat("i", self.op(f"trunc i64 %{kind}_id to i32")),
            "m": margin,
        }
        tail = "e" if skips else "1"  # of far spheres as the exact test gives it, before the loop's last basic block
        self.lines += [
            f"  %{kind}_{x}{tail} = select {self.b} {hit}, {ty} {new[x]}, {ty} %{kind}_{x}" for x, ty, _ in kept
        ]
        if skips:
            self.lines += [
                f"  br label %{kind}_last",
                f"{kind}_last:",
                *(
                    f"  %{kind}_{x}1 = phi {ty} [ %{kind}_{x}, %{kind} ], [ %{kind}_{x}e, %{kind}_exact ]"
                    for x, ty, _ in kept
                ),
            ]
        self.lines += [
            f"  %{kind}_next = add i64 %{kind}_id, 1",
            f"  %{kind}_more = icmp slt i64 %{kind}_next, %end_{kind}",
            f"  br i1 %{kind}_more, label %{kind}, label %{kind}_done",
            f"{kind}_done:",
            *(f"  %{kind}_{x}2 = phi {ty} [ {start}, %{before} ], [ %{kind}_{x}1, %{last} ]" for x, ty, start in kept),
        ]
        margin = f"%{kind}_m2" if self.filters else best.margin
        return _Best(f"%{kind}_t2", f"%{kind}_p2", margin), f"{kind}_done"

    def _affine(self, row: list[str], x: tuple[str, ...]) -> str:
        """Evaluate ``row[0:3] . x + row[3]``."""
        value = row[3]
        for a, b in zip(row, x, strict=False):
            value = self.fma(self.real, a, b, value)
        return value

    def _planar(self, kind: str) -> tuple[str, str, str]:
        """Intersect a planar primitive.

        Returns:
            t; the mask of the rays whose hit is inside or within its tolerance; and by how much the hit is out of doubt, which
            is negative within the tolerance of an edge.
        """
        ty, element = self.real, "double" if self.exact else "float"
        base = self.op(f"getelementptr [{ROW} x {element}], ptr %rows_{ty}, i64 %{kind}_id")
        row = [
            self.splat(ty, self.load(element, self.at(base, element, k))) for k in range(ROW if self.exact else ROW - 1)
        ]
        o, d, one = self.o, self.to, self.constant(ty, 1.0)
        slope = self.mul(ty, row[0], d[0])
        for k in (1, 2):
            slope = self.fma(ty, row[k], d[k], slope)
        inverse = self.div(ty, one, slope)
        t = self.mul(ty, self.negative(ty, self._affine(row[:4], o)), inverse)
        p = tuple(self.fma(ty, t, d[k], o[k]) for k in range(3))
        u, v = self._affine(row[4:8], p), self._affine(row[8:12], p)
        if kind == "disk":
            square = self.fma(ty, u, u, self.mul(ty, v, v))
            return t, self.compare("ole", ty, square, one), self.constant("f", 1.0)
        size = self.call("llvm.fabs", ty, self.mul(ty, "%reach", inverse))
        slack = self.fma(ty, size, row[12], row[13]) if self.exact else self.mul(ty, size, row[12])
        # how far the hit is inside of its nearest edge
        if kind == "triangle":
            # by half, as the error of a sum is twice as large
            half = self.constant(ty, 0.5)
            other = self.fma(ty, self.negative(ty, half), self.add(ty, u, v), half)
        else:
            other = self.sub(ty, one, self._larger(u, v))
        depth = self._smaller(self._smaller(u, v), other)
        inside = self.compare("oge", ty, depth, self.negative(ty, slack))
        return t, inside, self.sub(ty, depth, slack)

    def _dot(self, a: list[str], b: list[str]) -> str:
        value = self.mul("d", a[0], b[0])
        for x, y in zip(a[1:], b[1:], strict=True):
            value = self.fma("d", x, y, value)
        return value

    def _skip_far_sphere(self, kind: str) -> None:
        """Branch to the test in float64 if any ray comes near the sphere, else to the next one; by a bound of float32's error.

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

    def _sphere(self) -> tuple[str, str | None, str]:
        """Intersect a sphere as ``sphere_distance`` of ``scripts/kernel_sources/tree_leaf.py``; return t, NaN for a miss."""
        own = self.op("sub i64 %sphere_id, %end_disk")
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
        return (t if self.exact else self.convert("fptrunc", "d", "f", t)), None, self.constant("f", 1.0)

    def _results(self, best: _Best) -> list[str]:
        """Return the mask of the rays that hit (``any_hit``), else t, prim, u, v; u and v of planar hits are clamped."""
        prim, ty = best.prim, self.real
        hit = self.op(f"icmp sge {self.i} {prim}, zeroinitializer")
        if self.any_hit:
            return [hit]
        zero, one = self.constant(ty, 0.0), self.constant(ty, 1.0)
        # the ids after the last triangle, rectangle and disk
        ends = {kind: self.splat("i", self.op(f"trunc i64 %end_{kind} to i32")) for kind in KINDS[:3]}
        planar = self.op(f"and {self.b} {hit}, {self.op(f'icmp slt {self.i} {prim}, ' + ends['disk'])}")
        u = v = zero
        if any(kind != "sphere" for kind in self.kinds):
            element = "double" if self.exact else "float"
            place = self.mul("i", self.select("i", planar, prim, "zeroinitializer"), self.constant("i", ROW))
            p = tuple(self.fma(ty, best.t, d, o) for o, d in zip(self.o, self.to, strict=True))
            row = [
                self.gather(element, self.at(f"%rows_{ty}", element, k), place, invariant=True) for k in range(4, 12)
            ]
            u, v = self._affine(row[:4], p), self._affine(row[4:], p)
            polygon = self.op(f"icmp slt {self.i} {prim}, {ends['rectangle']}")
            triangle = self.op(f"icmp slt {self.i} {prim}, {ends['triangle']}")
            clamped_u = self._between(u, zero, one)
            largest_v = self.select(ty, triangle, self.sub(ty, one, clamped_u), one)
            u = self.select(ty, polygon, clamped_u, u)
            v = self.select(ty, polygon, self._between(v, zero, largest_v), v)
            u, v = (self.select(ty, planar, x, zero) for x in (u, v))
        t = self.select(ty, hit, best.t, self.constant(ty, math.inf))
        t, u, v = ((self.convert("fptrunc", "d", "f", x) if self.exact else x) for x in (t, u, v))
        return [t, prim, u, v]

    def _between(self, x: str, low: str, high: str) -> str:
        return self._smaller(self._larger(x, low), high)
