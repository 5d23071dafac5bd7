"""Generate a kernel: a loop over lanes whose body computes the nodes of a stage and stores its results.

A kernel reads lanes of one arena (:mod:`~torchpt.compiler.form`): all of them in order, or those at the indices of a list. Its
sinks (:mod:`~torchpt.compiler.sinks`) say where results go, its form how it is called and which lanes an iteration takes.

The IR is written as text. Values are the names of LLVM registers, such as ``%mask``; ``names`` maps nodes of the graph to them.
:class:`~torchpt.compiler.block.Block` appends instructions: ``block.op(text)`` returns the register of the result,
``block.do(text)`` has none, ``block.each("i32")`` is the type of one i32 a lane (``<16 x i32>`` or ``i32``).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

from torchpt.compiler.block import ELEMENTS, Block
from torchpt.compiler.codegen import MEMORY, LoopBody, generate_node
from torchpt.compiler.form import WARP, Form
from torchpt.compiler.fusing import fused_products
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.packet import binary_searches
from torchpt.compiler.program import TracedStage
from torchpt.compiler.remainder import float_remainders
from torchpt.compiler.searching import LoopingSearch, SearchLoop, lone_search
from torchpt.compiler.segments import segment_functions
from torchpt.compiler.sinks import AppendIndex, Compact, Scatter, Sinks, Store

__all__ = ["HEAD", "WORD", "argument_words", "kernel_ir"]


# ---- Stores: the LLVM IR at the end of the loop's body that writes the results to the sinks
#
# Compaction differs by form: vectors are compressed, with counters in registers; a single lane takes the next index from a
# counter in memory and stores behind a branch.


class SinkWriter(ABC):
    """A writer of the stores to a kernel's sinks.

    In the loop ``%i`` is the number of the lane, of a vector its first; ``%mask`` marks the lanes that exist, as a vector may
    reach beyond the last one. ``%first0``, ``%first1``, ... are the values of the counters at the kernel's start.

    Attributes:
        before: lines of IR at the head of the loop.
        after: lines behind the loop.
        functions: definitions of functions that the loop calls.
    """

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        self.block, self.graph, self.names, self.sinks = block, graph, names, sinks
        self.before: list[str] = []
        self.after: list[str] = []
        self.functions: list[str] = []

    def write(self) -> None:
        """Write the stores to all sinks."""
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
    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None:
        """Append the indices ``places`` (one i32 a lane) to a list where the mask is set."""

    @abstractmethod
    def _write(self, place: str) -> None:
        """Write rows of the target arena from index ``place`` (an i64) on."""

    @abstractmethod
    def _count(self, counter: int, mask: str) -> None:
        """Add the number of lanes where the mask is set to a counter."""

    @abstractmethod
    def _put_scattered(self, stores: Sequence[tuple[str, str, str]], place: str, mask: str) -> None:
        """Store at index ``place`` where the mask is set; each store is an LLVM type, a value and the address of index 0."""

    @abstractmethod
    def _put_lanes(self, stores: Sequence[tuple[str, str, str]]) -> None:
        """Store at the lanes' numbers, for lanes that exist; stores as for :meth:`_put_scattered`."""

    def _masked(self, mask: int) -> str:
        """Return the mask of a node, without the lanes that do not exist."""
        return self.block.op(f"and {self.block.each('i1')} {self.names[mask]}, %mask")

    def _stored_value(self, node: int) -> tuple[str, str]:
        """Return type and name of a node's value in the 32 bits that the arena holds it in."""
        ty, name, block = self.graph.type(node), self.names[node], self.block
        if ty == "d":
            raise Unsupported("a float64 in the path state")
        if ty == "b":
            return "i32", block.op(f"zext {block.each('i1')} {name} to {block.each('i32')}")
        return MEMORY[ty], block.convert("trunc", "L", "i", name) if ty == "L" else name

    def _start(self, row: int) -> str:
        """Return the address of a row of the target arena."""
        return self.block.at("%dst", "i8", 4 * self.block.form.row * row) if row else "%dst"

    def _scatter(self, scatter: Scatter) -> None:
        block = self.block
        mask = "%mask" if scatter.mask < 0 else self._masked(scatter.mask)
        place = self._stored_value(scatter.place)[1]
        stores = []
        for row, node in scatter.rows:
            element, value = self._stored_value(node)
            if scatter.slots:
                start = block.at("%slots", element, block.op(f"mul i64 %stride, {row}")) if row else "%slots"
            else:
                start = self._start(row)
            stores.append((element, value, start))
        self._put_scattered(stores, place, mask)

    def _store(self, number: int, store: Store) -> None:
        block = self.block
        element = {"l": "i64", "L": "i64", "b": "i8", "u": "i8"}.get(store.ty, ELEMENTS[store.ty])
        size = {"i64": 8, "double": 8, "i8": 1}.get(element, 4)
        stores = []
        for k, node in enumerate(store.nodes):
            ty, value = self.graph.type(node), self.names[node]
            if store.ty in "lL" and ty != "L":
                value = block.op(f"sext {block.each('i32')} {value} to {block.each('i64')}")
            elif store.ty == "b":
                value = block.op(f"zext {block.each('i1')} {value} to {block.each('i8')}")
            elif store.ty == "u":
                value = block.op(f"trunc {block.each('i32')} {value} to {block.each('i8')}")
            row = f"%out{number}"
            if k:  # %out0s, %out1s, ... are the elements from one row of a result to the next
                row = block.at(row, "i8", block.op(f"mul i64 %out{number}s, {k * size}"))
            stores.append((element, value, row))
        self._put_lanes(stores)


class _VectorSinks(SinkWriter):
    """Stores of vectors: lanes are compressed and stored as whole vectors; counters are phi nodes of the loop."""

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        super().__init__(block, graph, names, sinks)
        # The register of each, as of the last instruction.
        self._counters = {k: f"%c{k}" for k in range(sinks.counters())}

    def write(self) -> None:
        """See :meth:`SinkWriter.write`; adds the phi nodes of the counters."""
        super().write()
        for k, last in self._counters.items():
            arriving = f"[ %first{k}, %entry ], [ {last}, %{self.block.label} ]"
            self.before.append(f"  %c{k} = phi i64 {arriving}")
            self.after += [
                f"  %end{k} = phi i64 {arriving}",
                f"  %slot{k} = getelementptr i64, ptr %counters, i64 {k}",
                f"  store i64 %end{k}, ptr %slot{k}",
            ]
        self.after.sort(key=lambda line: " phi " not in line)  # phi nodes come first in a basic block

    def _count(self, counter: int, mask: str) -> None:
        by = self.block.count(mask)
        self._counters[counter] = self.block.op(f"add i64 {self._counters[counter]}, {by}")

    def _write(self, place: str) -> None:
        for row, node in self.sinks.write:
            element, value = self._stored_value(node)
            self._put(element, value, self._row(row, element, place))

    def _row(self, row: int, element: str, place: str) -> str:
        """Return the address of index ``place`` in a row of the target arena."""
        return self.block.at(self._start(row), element, place)

    def _put(self, element: str, value: str, pointer: str) -> None:
        self.block.do(f"store {self.block.each(element)} {value}, ptr {pointer}, align 4")

    def _put_scattered(self, stores: Sequence[tuple[str, str, str]], place: str, mask: str) -> None:
        for element, value, start in stores:
            self.block.scatter(element, value, start, place, mask)

    def _put_lanes(self, stores: Sequence[tuple[str, str, str]]) -> None:
        for element, value, start in stores:
            self.block.masked_store(element, value, self.block.at(start, element, "%i"), "%mask")

    def _compact(self, compact: Compact) -> None:
        block, mask = self.block, self._masked(compact.mask)
        start = self._counters[compact.counter]
        for row, node in compact.rows:
            element, value = self._stored_value(node)
            self._put(element, block.compress(element, value, mask), self._row(row, element, start))
        if compact.appends:
            places = self.block.places(start)
            for append in compact.appends:
                # The mask of the list, compressed as the lanes are, and not set behind them.
                both = block.op(f"and {block.each('i1')} {self.names[append.mask]}, {mask}")
                wide = block.op(f"sext {block.each('i1')} {both} to {block.each('i32')}")
                chosen = block.op(f"icmp ne {block.each('i32')} {self._compressed(wide, mask)}, zeroinitializer")
                self._append_index(append, chosen, places)
        self._count(compact.counter, mask)

    def _compressed(self, value: str, mask: str) -> str:
        """Compress int32 lanes where the mask is set; zeros follow them."""
        return self.block.compress("i32", value, mask, "zeroinitializer")

    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None:
        # Zeros follow: a vector load beyond the end of the list still reads valid indices.
        together = self._compressed(places, mask)
        self._put("i32", together, self.block.at(f"%list{append.list}", "i32", self._counters[append.counter]))
        self._count(append.counter, mask)


#: ``@take(counter, mask)`` returns the counter, and increments it if the mask is set. For one thread of a CPU.
_TAKE = """define internal i64 @take(ptr %counter, i1 %mask) alwaysinline {
  %place = load i64, ptr %counter
  %by = zext i1 %mask to i64
  %next = add i64 %place, %by
  store i64 %next, ptr %counter
  ret i64 %place
}"""


#: The same for the threads of a GPU, a warp at a time: lanes of the warp where the mask is set take consecutive indices, in
#: their order, by one atomic addition of the first of them. All threads of the warp must call it, whatever their masks.
_TAKE_BY_WARPS = """define internal i64 @take(ptr %counter, i1 %mask) alwaysinline convergent {
entry:
  %set = call i32 @llvm.nvvm.vote.ballot.sync(i32 -1, i1 %mask)
  %below = call i32 @llvm.nvvm.read.ptx.sreg.lanemask.lt()
  %set_below = and i32 %set, %below
  %rank = call i32 @llvm.ctpop.i32(i32 %set_below)
  %is_first = icmp eq i32 %rank, 0
  %adds = and i1 %is_first, %mask
  br i1 %adds, label %add, label %share
add:
  %count = call i32 @llvm.ctpop.i32(i32 %set)
  %by = zext i32 %count to i64
  %old = atomicrmw add ptr %counter, i64 %by syncscope("device") monotonic
  %old_low = trunc i64 %old to i32
  br label %share
share:
  %own = phi i32 [ 0, %entry ], [ %old_low, %add ]
  %first = call i32 @llvm.cttz.i32(i32 %set, i1 false)
  %source = and i32 %first, 31
  %start = call i32 @llvm.nvvm.shfl.sync.idx.i32(i32 -1, i32 %own, i32 %source, i32 31)
  %place = add i32 %start, %rank
  %wide = zext i32 %place to i64
  ret i64 %wide
}"""
_WARP_INTRINSICS = (
    "declare i32 @llvm.nvvm.vote.ballot.sync(i32, i1)",
    "declare i32 @llvm.nvvm.read.ptx.sreg.lanemask.lt()",
    "declare i32 @llvm.nvvm.shfl.sync.idx.i32(i32, i32, i32, i32)",
    "declare i32 @llvm.ctpop.i32(i32)",
    "declare i32 @llvm.cttz.i32(i32, i1)",
)


class _LaneSinks(SinkWriter):
    """Stores of single lanes: the function ``take`` returns the next index from a counter in memory."""

    def __init__(self, block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        super().__init__(block, graph, names, sinks)
        if block.form.threads:
            block.declarations.update(_WARP_INTRINSICS)
        self.functions.append(_TAKE_BY_WARPS if block.form.threads else _TAKE)

    def _count(self, counter: int, mask: str) -> None:
        self._take(counter, mask)

    def _take(self, counter: int, mask: str) -> str:
        """Return the value of a counter, an i64, and increment it where the mask is set."""
        return self.block.op(f"call i64 @take(ptr {self.block.at('%counters', 'i64', counter)}, i1 {mask})")

    def _write(self, place: str) -> None:
        self._put(self._rows(self.sinks.write), place, "%mask")

    def _rows(self, rows: Sequence[tuple[int, int]]) -> list[tuple[str, str, str]]:
        """Return the stores to rows of the target arena, as for :meth:`_put_scattered`."""
        return [(*self._stored_value(node), self._start(row)) for row, node in rows]

    def _put(self, stores: Sequence[tuple[str, str, str]], place: str, mask: str) -> None:
        """Store at index ``place`` (an i64, or an i32 with its type) where the mask is set."""
        with self.block.when(mask):
            for element, value, start in stores:
                self.block.do(f"store {element} {value}, ptr {self.block.at(start, element, place)}")

    def _put_scattered(self, stores: Sequence[tuple[str, str, str]], place: str, mask: str) -> None:
        self._put(stores, f"i32 {place}", mask)

    def _put_lanes(self, stores: Sequence[tuple[str, str, str]]) -> None:
        self._put(stores, "%i", "%mask")

    def _compact(self, compact: Compact) -> None:
        mask = self._masked(compact.mask)
        place = self._take(compact.counter, mask)
        self._put(self._rows(compact.rows), place, mask)
        for append in compact.appends:
            both = self.block.op(f"and i1 {self.names[append.mask]}, {mask}")
            self._append_index(append, both, self.block.places(place))

    def _append_index(self, append: AppendIndex, mask: str, places: str) -> None:
        self._put([("i32", places, f"%list{append.list}")], self._take(append.counter, mask), mask)


def sink_writer(block: LoopBody, graph: Graph, names: dict[int, str], sinks: Sinks) -> SinkWriter:
    """Return the writer of a stage's sinks for the form of ``block``; ``names`` maps nodes to their values."""
    return (_VectorSinks if block.width > 1 else _LaneSinks)(block, graph, names, sinks)


# ---- The whole kernel


#: First words of a kernel's arguments; uniforms, lists, and input and output tensors with their row lengths follow.
#: ``src``, ``dst``: source and target arena; ``list``: indices of the lanes to read, if the stage is listed; ``slots``,
#: ``stride``: address of the slots, and elements from one row of them to the next; ``counters``: the counters; ``tables``: for
#: each table address and number of entries; ``search``: data for ray searches (:func:`torchpt.compiler.packet.scene_words`).
HEAD = ("src", "dst", "list", "slots", "stride", "counters", "tables", "search")
#: Index of each of these words.
WORD = {name: k for k, name in enumerate(HEAD)}


def argument_words(stage: TracedStage) -> list[tuple[str, str]]:
    """Return name and LLVM type (``ptr`` or ``i64``) of each word of a kernel's arguments, in order."""
    words = [(name, "i64" if name == "stride" else "ptr") for name in HEAD]
    words += [(f"uniform{k}", "ptr") for k in range(len(stage.uniforms))]
    words += [(f"list{k}", "ptr") for k in range(stage.sinks.lists())]
    for name in [f"in{k}" for k in range(stage.tensors)] + [f"out{k}" for k in range(len(stage.sinks.store))]:
        words += [(name, "ptr"), (f"{name}s", "i64")]  # a tensor's address, and elements from one row to the next
    return words


def kernel_ir(stage: TracedStage, form: Form) -> str:
    """Return the IR of a module with the function ``kernel``, whose calling convention :class:`Form` defines.

    Raises:
        Unsupported: an unknown operation, a table that does not exist, or for threads a counter that both shifts the results
            and is incremented.
    """
    graph, sinks, needed = stage.graph, stage.sinks, stage.needed()
    if form.threads and sinks.shift in sinks.incremented():
        raise Unsupported("a counter that shifts the results while other threads increment it")
    products = fused_products(graph, needed, sinks.roots())
    body = LoopBody(form, stage.listed, products)
    _load_arguments(body, stage, needed)
    entry, body.lines, body.label = body.lines, [], "loop"  # what was written so far comes before the loop
    _begin_body(body)
    names: dict[int, str] = {}
    fused = set(products.values())  # computed with their sums
    lone = lone_search(stage, needed) if form.threads and isinstance(stage.search, LoopingSearch) else None
    loaded = 0  # lines before the lone search
    for node in needed:
        if node == lone:
            loaded, names[node] = len(body.lines), "%found"
        elif node not in fused:
            names[node] = generate_node(body, graph, node, names)
    writer = sink_writer(body, graph, names, sinks)
    writer.write()
    functions = [
        binary_searches(graph, needed, form),
        float_remainders(graph, needed, form),
        segment_functions(graph, needed, form),
    ]
    inner: Block = body
    if lone is not None and isinstance(stage.search, LoopingSearch):
        op, _, ray, _ = graph.nodes[lone]
        load, store = body.lines[:loaded], body.lines[loaded:]
        own = SearchLoop(form, op == "occluded", load, [names[k] for k in ray], store, body.names)
        inner = stage.search.lane_loop(own)
    elif stage.search is not None:
        functions.append(stage.search(form))
    declarations = set().union(*(block.declarations for block in (body, inner, *functions)))
    count = len(argument_words(stage))
    lines = [
        *(line for block in functions for line in block.lines),
        *writer.functions,
        *(_gpu_kernel(entry, inner, lone is None, count) if form.threads else _cpu_loop(entry, body, writer)),
        *sorted(declarations | (_THREAD_NUMBERS if form.threads else set())),
        f"attributes #0 = {{ nounwind{_PREFERRED if form.width > 1 else ''} }}",
        "!0 = !{}",
        "",
    ]
    return "\n".join(lines)


#: Attributes by which LLVM uses the 512-bit registers of AVX-512 where it would choose 256 bits.
_PREFERRED = ' "prefer-vector-width"="512" "min-legal-vector-width"="512"'


def _cpu_loop(entry: list[str], body: LoopBody, writer: SinkWriter) -> list[str]:
    """Return the function of a CPU's kernel: a loop over all lanes.

    Args:
        entry: lines before the loop.
        body: the loop's body.
        writer: the writer of the stores in the body.
    """
    return [
        "define void @kernel(ptr noalias %arguments, i64 %n) #0 {",
        "entry:",
        *entry,
        "  %any = icmp slt i64 0, %n",
        "  br i1 %any, label %loop, label %exit",
        "loop:",
        f"  %i = phi i64 [ 0, %entry ], [ %next, %{body.label} ]",
        *writer.before,
        *body.lines,
        f"  %next = add i64 %i, {body.width}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %exit",
        "exit:",
        *writer.after,
        "  ret void",
        "}",
    ]


#: Numbers of thread and block, and their counts.
_REGISTERS = ("tid", "ntid", "ctaid", "nctaid")
_THREAD_NUMBERS = {f"declare i32 @llvm.nvvm.read.ptx.sreg.{name}.x()" for name in _REGISTERS}


def _gpu_kernel(entry: list[str], body: Block, strides: bool, words: int) -> list[str]:
    """Return the function of a GPU's kernel.

    Args:
        entry: lines before the loop.
        body: the loop's body, or the loop.
        strides: True: the body is of a loop that is added here; False: it is the loop.
        words: number of words of the arguments, which the kernel takes by value.
    """
    return [
        f"define ptx_kernel void @kernel(ptr byval([{words} x i64]) align 8 %arguments, ptr addrspace(1) %lanes) #0 {{",
        "entry:",
        *entry,
        "  %n = load i64, ptr addrspace(1) %lanes, !invariant.load !0",
        *(f"  %{name} = call i32 @llvm.nvvm.read.ptx.sreg.{name}.x()" for name in _REGISTERS),
        *(f"  %{name}_wide = zext i32 %{name} to i64" for name in _REGISTERS),
        "  %block_start = mul i64 %ctaid_wide, %ntid_wide",
        "  %thread = add i64 %block_start, %tid_wide",
        "  %threads = mul i64 %nctaid_wide, %ntid_wide",
        *(_grid_stride_loop(body) if strides else body.lines),
        "  ret void",
        "}",
    ]


def _grid_stride_loop(body: Block) -> list[str]:
    """Return a loop in which each thread takes the lanes of its number plus multiples of the number of threads.

    The loop's condition is that of the warp's first thread, so that all threads of a warp meet in the calls of ``take``.
    """
    return [
        "  %last_lane = sub i64 %n, 1",
        "  br label %head",
        "head:",
        f"  %lane = phi i64 [ %thread, %entry ], [ %next, %{body.label} ]",
        f"  %first_of_warp = and i64 %lane, {-WARP}",
        "  %more = icmp slt i64 %first_of_warp, %n",
        "  br i1 %more, label %loop, label %exit",
        "loop:",
        "  %mask = icmp slt i64 %lane, %n",
        "  %i = select i1 %mask, i64 %lane, i64 %last_lane",
        *body.lines,
        "  %next = add i64 %lane, %threads",
        "  br label %head",
        "exit:",
    ]


def _begin_body(body: LoopBody) -> None:
    """Write the head of the loop's body: the mask of the lanes (``%mask``), and for a list their indices (``%place``)."""
    if not body.form.threads:
        body.declarations.add("declare i64 @llvm.smin.i64(i64, i64)")
        left = body.op("sub i64 %n, %i")
        existing = body.op(f"call i64 @llvm.smin.i64(i64 {left}, i64 {body.width})")  # lanes of this iteration
        existing = body.splat("i", body.op(f"trunc i64 {existing} to i32"))
        body.do(f"%mask = icmp sgt {body.each('i32')} {existing}, {body.numbers()}")
    if body.listed:
        listed = body.at("%list", "i32", "%i")
        body.do(f"%place = load {body.each('i32')}, ptr {listed}, align 4")


def _load_arguments(body: LoopBody, stage: TracedStage, needed: list[int]) -> None:
    """Load the kernel's arguments before the loop, to registers of their names.

    For a table k that the graph reads these are ``%table0``, its address, ``%count0``, its number of entries, and ``%last0``,
    the last of its entries in each lane; for a row of the source arena its address, ``%row0``.
    """
    graph, sinks = stage.graph, stage.sinks
    for place, (name, ty) in enumerate(argument_words(stage)):
        _load_word(body, name, ty, body.at("%arguments", "i64", place))
    nodes = [graph.nodes[node] for node in needed]
    for k in sorted({extra[0] for op, _, _, extra in nodes if op in ("gather", "element", "search")}):
        if k >= len(stage.tables):
            raise Unsupported("a table that does not exist")
        invariant = body.form.threads
        _load_word(body, f"table{k}", "ptr", body.at("%tables", "i64", 2 * k), invariant)
        _load_word(body, f"count{k}", "i64", body.at("%tables", "i64", 2 * k + 1), invariant)
        last = body.op(f"sub i32 {body.op(f'trunc i64 %count{k} to i32')}, 1")
        body.let(f"last{k}", body.each("i32"), body.splat("i", last))
    for k in sorted({extra for op, _, _, extra in nodes if op == "arena"}):
        body.do(f"%row{k} = getelementptr i8, ptr %src, i64 {4 * body.form.row * k}")
    # Vectors keep counters in registers. Single lanes read only the one that shifts what they write, and which none of them
    # increments: other threads may have begun already.
    for k in range(sinks.counters()) if body.width > 1 else () if sinks.shift is None else (sinks.shift,):
        body.do(f"%first{k} = load i64, ptr {body.at('%counters', 'i64', k)}")


def _load_word(body: LoopBody, name: str, ty: str, pointer: str, invariant: bool = False) -> None:
    """Load a word of the arguments or of the tables, and bind it to ``%name``; ``invariant`` as in :meth:`Block.load`."""
    body.let(name, ty, body.load_pointer(pointer, invariant) if ty == "ptr" else body.load(ty, pointer, invariant))
