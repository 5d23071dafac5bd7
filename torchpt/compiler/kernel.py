"""A kernel: the loop over lanes around the nodes of a stage, and what it writes at the end of each turn.

A kernel reads lanes of one arena (:mod:`~torchpt.compiler.form`), all of them in order or those that a list of places names;
its sinks (:mod:`~torchpt.compiler.sinks`) say where results go, and its form how many lanes a turn takes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from torchpt.compiler.block import ELEMENTS
from torchpt.compiler.codegen import MEMORY, LoopBody, generate_node
from torchpt.compiler.form import Form
from torchpt.compiler.fusing import fused_products
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.packet import binary_searches, packet_search
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import AppendIndex, Compact, Scatter, Sinks, Store

__all__ = ["HEAD", "SinkWriter", "kernel_ir", "sink_writer"]


# ---- The end of a kernel's loop: LLVM IR that puts the results where the sinks say
#
# Vectors of lanes and single ones differ in how lanes find places behind each other: a vector is compressed and counters are
# held in registers, a single lane takes the next place of a counter in memory and writes behind a branch.


class SinkWriter(ABC):
    """The lines of a kernel's sinks.

    In the loop ``%i`` is the lane's number, or that of a vector's first, ``%mask`` says which lanes there are, and ``%first0``,
    ``%first1``, ... are the counters as the kernel found them.

    Attributes:
        before: lines that begin a turn of the loop.
        after: lines that follow the last turn.
        functions: lines of functions that the loop calls.
    """

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        self.block, self.graph, self.names, self.sinks = block, graph, names, sinks
        self.before: list[str] = []
        self.after: list[str] = []
        self.functions: list[str] = []

    def write(self) -> None:
        """All of them."""
        block, sinks = self.block, self.sinks
        for compact in sinks.compact:
            self._compact(compact)
        for append in sinks.appends:
            self._append_index(append, self._masked(append.mask), "%place" if block.listed else self.block.places("%i"))
        if sinks.write:
            self._write("%i" if sinks.shift is None else block.op(f"add i64 %i, %first{sinks.shift}"))
        for scatter in sinks.scatter:
            self._scatter(scatter)
        for mask, counter in sinks.count:
            self._count(counter, self._masked(mask))
        for k, store in enumerate(sinks.store):
            self._store(k, store)

    @abstractmethod
    def _compact(self, compact: Compact) -> None: ...

    @abstractmethod
    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None: ...

    @abstractmethod
    def _write(self, place: str) -> None:
        """Rows of the target arena from a place on: an i64."""

    @abstractmethod
    def _count(self, counter: int, mask: str) -> None: ...

    def _masked(self, mask: int) -> str:
        return self.block.op(f"and {self.block.each('i1')} {self.names[mask]}, %mask")

    def _stored_value(self, node: int) -> tuple[str, str]:
        """The 32 bits by which the arena holds a number: their type and name."""
        ty, name, block = self.graph.type(node), self.names[node], self.block
        if ty == "d":
            raise Unsupported("a float64 in the state of a path")
        if ty == "b":
            return "i32", block.op(f"zext {block.each('i1')} {name} to {block.each('i32')}")
        return MEMORY[ty], block.convert("trunc", "L", "i", name) if ty == "L" else name

    def _start(self, row: int) -> str:
        """The first byte of a row of the target arena."""
        return self.block.at("%dst", "i8", 4 * self.block.form.row * row) if row else "%dst"

    def _row(self, row: int, element: str, place: str) -> str:
        return self.block.at(self._start(row), element, place)

    def _scatter(self, scatter: Scatter) -> None:
        block = self.block
        mask = "%mask" if scatter.mask < 0 else self._masked(scatter.mask)
        place = self._stored_value(scatter.place)[1]
        for row, node in scatter.rows:
            element, value = self._stored_value(node)
            if scatter.slots:
                start = block.at("%slots", element, block.op(f"mul i64 %stride, {row}")) if row else "%slots"
            else:
                start = self._start(row)
            block.scatter(element, value, start, place, mask)

    def _store(self, number: int, store: Store) -> None:
        block = self.block
        element = {"l": "i64", "L": "i64", "b": "i8", "u": "i8"}.get(store.ty, ELEMENTS[store.ty])
        size = {"i64": 8, "double": 8, "i8": 1}.get(element, 4)
        for k, node in enumerate(store.nodes):
            ty, value = self.graph.type(node), self.names[node]
            if store.ty in "lL" and ty != "L":
                value = block.op(f"sext {block.each('i32')} {value} to {block.each('i64')}")
            elif store.ty == "b":
                value = block.op(f"zext {block.each('i1')} {value} to {block.each('i8')}")
            elif store.ty == "u":
                value = block.op(f"trunc {block.each('i32')} {value} to {block.each('i8')}")
            row = f"%out{number}"
            if k:
                row = block.at(row, "i8", block.op(f"mul i64 %out{number}s, {k * size}"))
            block.masked_store(element, value, block.at(row, element, "%i"), "%mask")


class _VectorSinks(SinkWriter):
    """Lanes of a vector are moved together and stored whole; counters are values that go around the loop."""

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        super().__init__(block, graph, names, sinks)
        self._counters = {k: f"%c{k}" for k in range(sinks.counters())}

    def write(self) -> None:
        """All of them."""
        super().write()
        for k, last in self._counters.items():
            arriving = f"[ %first{k}, %entry ], [ {last}, %{self.block.label} ]"
            self.before.append(f"  %c{k} = phi i64 {arriving}")
            self.after += [
                f"  %end{k} = phi i64 {arriving}",
                f"  %slot{k} = getelementptr i64, ptr %counters, i64 {k}",
                f"  store i64 %end{k}, ptr %slot{k}",
            ]
        self.after.sort(key=lambda line: " phi " not in line)  # which come first in their block

    def _count(self, counter: int, mask: str) -> None:
        by = self.block.count(mask)
        self._counters[counter] = self.block.op(f"add i64 {self._counters[counter]}, {by}")

    def _write(self, place: str) -> None:
        for row, node in self.sinks.write:
            element, value = self._stored_value(node)
            self._put(element, value, self._row(row, element, place))

    def _put(self, element: str, value: str, pointer: str) -> None:
        self.block.do(f"store {self.block.each(element)} {value}, ptr {pointer}, align 4")

    def _compact(self, compact: Compact) -> None:
        block, mask = self.block, self._masked(compact.mask)
        start = self._counters[compact.counter]
        for row, node in compact.rows:
            element, value = self._stored_value(node)
            self._put(element, block.compress(element, value, mask), self._row(row, element, start))
        if compact.appends:
            places = self.block.places(start)
            for append in compact.appends:
                # Which of the packed lanes are meant: their mask packed likewise, no further than there are any.
                both = block.op(f"and {block.each('i1')} {self.names[append.mask]}, {mask}")
                wide = block.op(f"sext {block.each('i1')} {both} to {block.each('i32')}")
                chosen = block.op(f"icmp ne {block.each('i32')} {self._compressed(wide, mask)}, zeroinitializer")
                self._append_index(append, chosen, places)
        self._count(compact.counter, mask)

    def _compressed(self, value: str, mask: str) -> str:
        """Return integers where the mask holds, moved together, with zeros behind."""
        return self.block.compress("i32", value, mask, "zeroinitializer")

    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None:
        together = self._compressed(places, mask)  # zeros behind: whatever reads on past the end reads a place
        self._put("i32", together, self.block.at(f"%list{append.list}", "i32", self._counters[append.counter]))
        self._count(append.counter, mask)


#: ``@take(counter, mask)``: the next place, and the counter goes on where the mask holds.
_TAKE = """define internal i64 @take(ptr %counter, i1 %mask) alwaysinline {
  %place = load i64, ptr %counter
  %by = zext i1 %mask to i64
  %next = add i64 %place, %by
  store i64 %next, ptr %counter
  ret i64 %place
}"""


class _LaneSinks(SinkWriter):
    """One lane takes its places from counters in memory by the function ``take``, all that knows in which order lanes come."""

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        super().__init__(block, graph, names, sinks)
        self.functions.append(_TAKE)

    def _count(self, counter: int, mask: str) -> None:
        self._take(counter, mask)

    def _take(self, counter: int, mask: str) -> str:
        return self.block.op(f"call i64 @take(ptr {self.block.at('%counters', 'i64', counter)}, i1 {mask})")

    def _write(self, place: str) -> None:
        self._put(self.sinks.write, place, "%mask")

    def _put(self, rows: Sequence[tuple[int, int]], place: str, mask: str) -> None:
        stored = [(row, *self._stored_value(node)) for row, node in rows]
        with self.block.when(mask):
            for row, element, value in stored:
                self.block.do(f"store {element} {value}, ptr {self._row(row, element, place)}")

    def _compact(self, compact: Compact) -> None:
        mask = self._masked(compact.mask)
        place = self._take(compact.counter, mask)
        self._put(compact.rows, place, mask)
        for append in compact.appends:
            both = self.block.op(f"and i1 {self.names[append.mask]}, {mask}")
            self._append_index(append, both, self.block.places(place))

    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None:
        end = self._take(append.counter, mask)
        with self.block.when(mask):
            self.block.do(f"store i32 {places}, ptr {self.block.at(f'%list{append.list}', 'i32', end)}")


def sink_writer(block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> SinkWriter:
    """Return what writes the sinks of a stage whose nodes have names, in the block's form."""
    return (_VectorSinks if block.width > 1 else _LaneSinks)(block, graph, names, sinks)


# ---- A kernel: the loop over lanes around the nodes of a stage


#: What every call is given, in this order; then uniforms, lists, and input and output tensors with their row lengths.
HEAD = ("src", "dst", "list", "slots", "stride", "counters", "tables", "search")


def kernel_ir(stage: TracedStage, form: Form) -> str:
    """Return the IR of ``void kernel(ptr arguments, i64 lanes)``.

    Raises:
        Unsupported: for an operation, or a table that is not there.
    """
    graph, sinks, needed = stage.graph, stage.sinks, stage.needed()
    products = fused_products(graph, needed, sinks.roots())
    body = LoopBody(form, stage.listed, products)
    _enter(body, stage, needed)
    entry, body.lines, body.label = body.lines, [], "loop"
    _begin(body)
    names: dict[int, str] = {}
    within = set(products.values())
    for node in needed:
        if node not in within:
            names[node] = generate_node(body, graph, node, names)
    ends = sink_writer(body, graph, names, sinks)
    ends.write()
    inner = [binary_searches(graph, needed, form)]
    if stage.searched is not None:
        inner.append(packet_search(stage.searched, form))
    declarations = set().union(*(block.declarations for block in (body, *inner)))
    lines = [
        *(line for block in inner for line in block.lines),
        *ends.functions,
        "define void @kernel(ptr noalias %arguments, i64 %n) #0 {",
        "entry:",
        *entry,
        "  %any = icmp slt i64 0, %n",
        "  br i1 %any, label %loop, label %exit",
        "loop:",
        f"  %i = phi i64 [ 0, %entry ], [ %next, %{body.label} ]",
        *ends.before,
        *body.lines,
        f"  %next = add i64 %i, {form.width}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %exit",
        "exit:",
        *ends.after,
        "  ret void",
        "}",
        *sorted(declarations),
        f"attributes #0 = {{ nounwind{_PREFERRED if form.width > 1 else ''} }}",
        "!0 = !{}",
        "",
    ]
    return "\n".join(lines)


_PREFERRED = ' "prefer-vector-width"="512" "min-legal-vector-width"="512"'


def _begin(body: LoopBody) -> None:
    """Begin a turn of the loop: its lanes (``%mask``), and their places in the arena (``%place``)."""
    body.declarations.add("declare i64 @llvm.smin.i64(i64, i64)")
    left = body.op("sub i64 %n, %i")
    few = body.op(f"call i64 @llvm.smin.i64(i64 {left}, i64 {body.width})")
    few = body.splat("i", body.op(f"trunc i64 {few} to i32"))
    body.do(f"%mask = icmp sgt {body.each('i32')} {few}, {body.numbers()}")
    if body.listed:
        listed = body.at("%list", "i32", "%i")
        body.do(f"%place = load {body.each('i32')}, ptr {listed}, align 4")


def _enter(body: LoopBody, stage: TracedStage, needed: list[int]) -> None:
    """Read the arguments before the loop."""
    graph, sinks = stage.graph, stage.sinks
    words = [(name, "i64" if name == "stride" else "ptr") for name in HEAD]
    words += [(f"uniform{k}", "ptr") for k in range(len(stage.uniforms))]
    words += [(f"list{k}", "ptr") for k in range(sinks.lists())]
    for name in [f"in{k}" for k in range(stage.tensors)] + [f"out{k}" for k in range(len(sinks.store))]:
        words += [(name, "ptr"), (f"{name}s", "i64")]
    for place, (name, ty) in enumerate(words):
        body.do(f"%{name} = load {ty}, ptr {body.at('%arguments', 'i64', place)}")
    found = [graph.nodes[node] for node in needed]
    for k in sorted({extra[0] for op, _, _, extra in found if op in ("gather", "element", "search")}):
        if k >= len(stage.tables):
            raise Unsupported("a table that is not there")
        body.do(f"%table{k} = load ptr, ptr {body.at('%tables', 'i64', 2 * k)}")
        body.do(f"%count{k} = load i64, ptr {body.at('%tables', 'i64', 2 * k + 1)}")
        last = body.op(f"sub i32 {body.op(f'trunc i64 %count{k} to i32')}, 1")
        body.let(f"last{k}", body.each("i32"), body.splat("i", last))
    for k in sorted({extra for op, _, _, extra in found if op == "arena"}):
        body.do(f"%row{k} = getelementptr i8, ptr %src, i64 {4 * body.form.row * k}")
    for k in range(sinks.counters()):
        body.do(f"%first{k} = load i64, ptr {body.at('%counters', 'i64', k)}")
