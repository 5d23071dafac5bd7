"""A kernel: the loop over lanes around the nodes of a stage, and what it does with the results.

Lanes live in an *arena*, rows of :data:`CAPACITY` numbers of 32 bits, one row for each number of a path's state. A kernel
reads lanes of one arena (all of them in order, or those that a list of places names) and its *sinks* say where results go:
written in place, packed together, scattered to places, noted in lists.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torchpt.lanes.block import ELEMENTS, WIDTH, Block
from torchpt.lanes.emission import MEMORY, emit
from torchpt.lanes.graph import Graph, Unsupported

__all__ = ["CAPACITY", "HEAD", "Note", "Pack", "Scatter", "Sinks", "Store", "text"]

#: Lanes of an arena: a multiple of WIDTH, with WIDTH to spare at the end of each row.
CAPACITY = 16384 + WIDTH
_UMIN = f"declare <{WIDTH} x i32> @llvm.umin.v{WIDTH}i32(<{WIDTH} x i32>, <{WIDTH} x i32>)"
#: What every call is given, in this order; then uniforms, lists, and input and output tensors with their row lengths.
HEAD = ("src", "dst", "list", "slots", "stride", "counters", "tables", "search")


@dataclass(frozen=True)
class Note:
    """Places written one after the other into list ``list``, where ``mask`` holds; ``counter`` counts them."""

    mask: int
    list: int
    counter: int


@dataclass(frozen=True)
class Pack:
    """Lanes where ``mask`` holds, written together into rows of the target arena from ``counter`` on.

    The notes name the places where they went.
    """

    mask: int
    rows: tuple[tuple[int, int], ...]  # row, node
    counter: int
    notes: tuple[Note, ...] = ()


@dataclass(frozen=True)
class Scatter:
    """Numbers written to places of rows where ``mask`` holds (-1: everywhere): of the arena, or of the slots of samples."""

    mask: int
    place: int
    rows: tuple[tuple[int, int], ...]  # row, node
    slots: bool = False


@dataclass(frozen=True)
class Store:
    """A result ``(rows, lanes)`` as a tensor: its nodes, and the type of its elements."""

    nodes: tuple[int, ...]
    ty: str


@dataclass
class Sinks:
    """What a kernel does with its results.

    Attributes:
        write: rows of the target arena and their nodes, each at the lane's own place (of a list: its number in it).
        pack: see :class:`Pack`.
        notes: lists of the lanes' own places.
        scatter: see :class:`Scatter`.
        count: masks whose lanes are counted, and by which counter.
        store: result tensors.
        shift: counter whose first value is added to the places of ``write``.
        shadows: how many shadow rays each lane asks for.
    """

    write: list[tuple[int, int]] = field(default_factory=list)
    pack: list[Pack] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    scatter: list[Scatter] = field(default_factory=list)
    count: list[tuple[int, int]] = field(default_factory=list)
    store: list[Store] = field(default_factory=list)
    shift: int | None = None
    shadows: int = 0

    def roots(self) -> list[int]:
        """The nodes that are asked for."""
        found = [node for _, node in self.write]
        for pack in self.pack:
            found += [pack.mask, *(node for _, node in pack.rows), *(note.mask for note in pack.notes)]
        found += [note.mask for note in self.notes]
        for scatter in self.scatter:
            found += [scatter.place, *(node for _, node in scatter.rows)]
            found += [scatter.mask] if scatter.mask >= 0 else []
        found += [mask for mask, _ in self.count]
        return found + [node for store in self.store for node in store.nodes]

    def counters(self) -> int:
        """How many counters there are."""
        numbers = [pack.counter for pack in self.pack] + [counter for _, counter in self.count]
        numbers += [note.counter for pack in self.pack for note in pack.notes] + [note.counter for note in self.notes]
        numbers += [] if self.shift is None else [self.shift]
        return max(numbers, default=-1) + 1

    def lists(self) -> int:
        """How many lists there are."""
        notes = [note.list for pack in self.pack for note in pack.notes] + [note.list for note in self.notes]
        return max(notes, default=-1) + 1


class _Body(Block):
    """A block that knows whether lanes are read in order or by a list."""

    def __init__(self, listed: bool) -> None:
        super().__init__()
        self.listed = listed


def text(
    graph: Graph, sinks: Sinks, tables: int, uniforms: int, tensors: int, listed: bool, search: Block | None = None
) -> tuple[str, list[int]]:
    """The IR of ``void kernel(ptr arguments, i64 lanes)``, and the nodes in it.

    Args:
        graph: the stage.
        sinks: what becomes of its results.
        tables: how many it may read.
        uniforms: how many inputs are shared by all lanes.
        tensors: how many inputs are tensors.
        listed: whether lanes are those that a list names.
        search: the functions ``nearest`` and ``occluded``, where the stage calls them.
    """
    body, needed = _Body(listed), graph.needed(sinks.roots())
    names: dict[int, str] = {}
    if listed:
        body.lines.append(
            f"  %listed = getelementptr i32, ptr %list, i64 %i\n  %place = load <{WIDTH} x i32>, ptr %listed, align 4"
        )
    for node in needed:
        names[node] = emit(body, graph, node, names)
    ends = _Ends(body, graph, names, sinks)
    ends.all()
    entry = _entry(graph, needed, sinks, tables, uniforms, tensors, listed)
    counters = range(sinks.counters())
    phis = [f"  %c{k} = phi i64 [ %first{k}, %entry ], [ {ends.after[k]}, %loop ]" for k in counters]
    after = [f"  %end{k} = phi i64 [ %first{k}, %entry ], [ {ends.after[k]}, %loop ]" for k in counters]
    for k in counters:
        after += [f"  %slot{k} = getelementptr i64, ptr %counters, i64 {k}", f"  store i64 %end{k}, ptr %slot{k}"]
    numbers = ", ".join(f"i32 {k}" for k in range(WIDTH))
    inner = _sorted(graph, needed)
    declarations = {_UMIN, *body.declarations, *inner.declarations}
    if search is not None:
        declarations |= search.declarations
    lines = [
        *(() if search is None else search.lines),
        *inner.lines,
        "define void @kernel(ptr noalias %arguments, i64 %n) #0 {",
        "entry:",
        *entry,
        "  %any = icmp slt i64 0, %n",
        "  br i1 %any, label %loop, label %exit",
        "loop:",
        "  %i = phi i64 [ 0, %entry ], [ %next, %loop ]",
        *phis,
        "  %left = sub i64 %n, %i",
        f"  %few = call i64 @llvm.smin.i64(i64 %left, i64 {WIDTH})",
        "  %few32 = trunc i64 %few to i32",
        f"  %few1 = insertelement <{WIDTH} x i32> poison, i32 %few32, i64 0",
        f"  %fews = shufflevector <{WIDTH} x i32> %few1, <{WIDTH} x i32> poison, <{WIDTH} x i32> zeroinitializer",
        f"  %mask = icmp sgt <{WIDTH} x i32> %fews, <{numbers}>",
        "  %i32 = trunc i64 %i to i32",
        f"  %i321 = insertelement <{WIDTH} x i32> poison, i32 %i32, i64 0",
        f"  %i32s = shufflevector <{WIDTH} x i32> %i321, <{WIDTH} x i32> poison, <{WIDTH} x i32> zeroinitializer",
        *body.lines,
        f"  %next = add i64 %i, {WIDTH}",
        "  %more = icmp slt i64 %next, %n",
        "  br i1 %more, label %loop, label %exit",
        "exit:",
        *after,
        "  ret void",
        "}",
        "declare i64 @llvm.smin.i64(i64, i64)",
        *sorted(declarations),
        'attributes #0 = { nounwind "prefer-vector-width"="512" "min-legal-vector-width"="512" }',
        "!0 = !{}",
        "",
    ]
    return "\n".join(lines), needed


def _entry(
    graph: Graph, needed: list[int], sinks: Sinks, tables: int, uniforms: int, tensors: int, listed: bool
) -> list[str]:
    """What is read of the arguments before the loop."""
    lines: list[str] = []
    place = 0

    def argument(name: str, ty: str = "ptr") -> None:
        nonlocal place
        lines.append(f"  %a{place} = getelementptr i64, ptr %arguments, i64 {place}")
        lines.append(f"  %{name} = load {ty}, ptr %a{place}")
        place += 1

    for name in HEAD:
        argument(name, "i64" if name == "stride" else "ptr")
    for k in range(uniforms):
        argument(f"uniform{k}")
    for k in range(sinks.lists()):
        argument(f"list{k}")
    for k in range(tensors):
        argument(f"in{k}")
        argument(f"in{k}s", "i64")
    for k in range(len(sinks.store)):
        argument(f"out{k}")
        argument(f"out{k}s", "i64")
    read = {
        extra[0] for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op in ("gather", "element", "search")
    }
    for k in sorted(read):
        if k >= tables:
            raise Unsupported("a table that is not there")
        lines += [
            f"  %t{k}p = getelementptr i64, ptr %tables, i64 {2 * k}",
            f"  %table{k} = load ptr, ptr %t{k}p",
            f"  %t{k}c = getelementptr i64, ptr %tables, i64 {2 * k + 1}",
            f"  %count{k} = load i64, ptr %t{k}c",
            f"  %last{k}w = sub i64 %count{k}, 1",
            f"  %last{k}n = trunc i64 %last{k}w to i32",
            f"  %last{k}o = insertelement <{WIDTH} x i32> poison, i32 %last{k}n, i64 0",
            f"  %last{k} = shufflevector <{WIDTH} x i32> %last{k}o, <{WIDTH} x i32> poison, "
            f"<{WIDTH} x i32> zeroinitializer",
        ]
    rows = {extra for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op == "arena"}
    lines += [f"  %row{k} = getelementptr i8, ptr %src, i64 {4 * CAPACITY * k}" for k in sorted(rows)]
    for k in range(sinks.counters()):
        lines += [f"  %c{k}p = getelementptr i64, ptr %counters, i64 {k}", f"  %first{k} = load i64, ptr %c{k}p"]
    return lines


class _Ends:
    """The lines of the sinks.

    Attributes:
        after: names of the counters after this turn of the loop.
    """

    def __init__(self, block: Block, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        self.block, self.graph, self.names, self.sinks = block, graph, names, sinks
        self.after = {k: f"%c{k}" for k in range(sinks.counters())}

    def all(self) -> None:
        """All of them."""
        block, sinks = self.block, self.sinks
        for pack in sinks.pack:
            self._pack(pack)
        own = "%place" if getattr(block, "listed", False) else None
        for note in sinks.notes:
            mask = self._masked(note.mask)
            places = own or self._places("%i")
            self._note(note, mask, places)
        if sinks.write:
            at = "%i" if sinks.shift is None else block.op(f"add i64 %i, %first{sinks.shift}")
            for row, node in sinks.write:
                element, value = self._held(node)
                block.do(f"store <{WIDTH} x {element}> {value}, ptr {self._row(row, element, at)}, align 4")
        for scatter in sinks.scatter:
            self._scatter(scatter)
        for mask, counter in sinks.count:
            self._advance(counter, block.count(self._masked(mask)))
        for k, store in enumerate(sinks.store):
            self._store(k, store)

    def _masked(self, mask: int) -> str:
        return self.block.op(f"and <{WIDTH} x i1> {self.names[mask]}, %mask")

    def _advance(self, counter: int, by: str) -> None:
        self.after[counter] = self.block.op(f"add i64 {self.after[counter]}, {by}")

    def _places(self, first: str) -> str:
        """Consecutive places from a 64-bit number on."""
        block = self.block
        start = block.splat("i", block.op(f"trunc i64 {first} to i32"))
        numbers = ", ".join(f"i32 {k}" for k in range(WIDTH))
        return block.op(f"add <{WIDTH} x i32> {start}, <{numbers}>")

    def _held(self, node: int) -> tuple[str, str]:
        """The 32 bits by which the arena holds a number: their type and name."""
        ty, name, block = self.graph.type(node), self.names[node], self.block
        if ty == "d":
            raise Unsupported("a float64 in the state of a path")
        if ty == "b":
            return "i32", block.op(f"zext <{WIDTH} x i1> {name} to <{WIDTH} x i32>")
        return MEMORY[ty], block.convert("trunc", "L", "i", name) if ty == "L" else name

    def _row(self, row: int, element: str, at: str) -> str:
        start = self.block.at("%dst", "i8", 4 * CAPACITY * row) if row else "%dst"
        return self.block.at(start, element, at)

    def _pack(self, pack: Pack) -> None:
        block, mask = self.block, self._masked(pack.mask)
        start = self.after[pack.counter]
        for row, node in pack.rows:
            element, value = self._held(node)
            together = block.compress(element, value, mask)
            block.do(f"store <{WIDTH} x {element}> {together}, ptr {self._row(row, element, start)}, align 4")
        if pack.notes:
            places = self._places(start)
            for note in pack.notes:
                # Which of the packed lanes are meant: their mask packed likewise, no further than there are any.
                both = block.op(f"and <{WIDTH} x i1> {self.names[note.mask]}, {mask}")
                wide = block.op(f"sext <{WIDTH} x i1> {both} to <{WIDTH} x i32>")
                chosen = block.op(f"icmp ne <{WIDTH} x i32> {self._packed(wide, mask)}, zeroinitializer")
                self._note(note, chosen, places)
        self._advance(pack.counter, block.count(mask))

    def _packed(self, value: str, mask: str) -> str:
        """As :meth:`Block.compress`, with zeros behind."""
        name = f"llvm.experimental.vector.compress.v{WIDTH}i32"
        vector = f"<{WIDTH} x i32>"
        self.block.declarations.add(f"declare {vector} @{name}({vector}, <{WIDTH} x i1>, {vector})")
        return self.block.op(
            f"call {vector} @{name}({vector} {value}, <{WIDTH} x i1> {mask}, {vector} zeroinitializer)"
        )

    def _note(self, note: Note, mask: str, places: str) -> None:
        block = self.block
        together = self._packed(places, mask)  # zeros behind: whatever reads on past the end reads a place
        at = block.at(f"%list{note.list}", "i32", self.after[note.counter])
        block.do(f"store <{WIDTH} x i32> {together}, ptr {at}, align 4")
        self._advance(note.counter, block.count(mask))

    def _scatter(self, scatter: Scatter) -> None:
        block = self.block
        mask = "%mask" if scatter.mask < 0 else self._masked(scatter.mask)
        place = self._held(scatter.place)[1]
        for row, node in scatter.rows:
            element, value = self._held(node)
            if scatter.slots:
                start = block.at("%slots", element, block.op(f"mul i64 %stride, {row}")) if row else "%slots"
            else:
                start = block.at("%dst", "i8", 4 * CAPACITY * row)
            block.scatter(element, value, start, place, mask)

    def _store(self, number: int, store: Store) -> None:
        block = self.block
        element = {"l": "i64", "L": "i64", "b": "i8", "u": "i8"}.get(store.ty, ELEMENTS[store.ty])
        size = {"i64": 8, "double": 8, "i8": 1}.get(element, 4)
        for k, node in enumerate(store.nodes):
            ty, value = self.graph.type(node), self.names[node]
            if store.ty in "lL" and ty != "L":
                value = block.op(f"sext <{WIDTH} x i32> {value} to <{WIDTH} x i64>")
            elif store.ty == "b":
                value = block.op(f"zext <{WIDTH} x i1> {value} to <{WIDTH} x i8>")
            elif store.ty == "u":
                value = block.op(f"trunc <{WIDTH} x i32> {value} to <{WIDTH} x i8>")
            row = f"%out{number}"
            if k:
                row = block.at(row, "i8", block.op(f"mul i64 %out{number}s, {k * size}"))
            block.masked_store(element, value, block.at(row, element, "%i"), "%mask")


def _sorted(graph: Graph, needed: list[int]) -> Block:
    """Binary searches: all lanes take as many steps, which are as many as the table's length asks for."""
    found = {extra[1:] for op, _, _, extra in map(graph.nodes.__getitem__, needed) if op == "search"}
    whole = Block()
    for ty, right in sorted(found):
        block, element = Block(), MEMORY[ty]
        vector, places = block.vector(ty), f"<{WIDTH} x i32>"
        block.lines += [
            f"define internal {places} @sorted_{ty}_{'right' if right else 'left'}"
            f"(ptr %table, i64 %count, {vector} %value) #0 {{",
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
        at = block.call("llvm.umin", "i", block.add("i", "%base", block.splat("i", "%step")), last)
        entry = block.gather(element, "%table", at)
        below = block.compare(
            ("ule" if right else "ult") if ty in "fd" else ("sle" if right else "slt"), ty, entry, "%value"
        )
        further = block.add("i", "%base", block.splat("i", "%half"))
        block.lines += [
            f"  %better = select <{WIDTH} x i1> {below}, {places} {further}, {places} %base",
            "  %rest = lshr i32 %length, 1",
            "  %done = icmp eq i32 %rest, 0",
            "  br i1 %done, label %exit, label %loop",
            "exit:",
            f"  %found = phi {places} [ zeroinitializer, %entry ], [ %better, %loop ]",
        ]
        block.do(f"ret {places} {block.call('llvm.umin', 'i', '%found', most)}")
        block.lines.append("}")
        whole.lines += block.lines
        whole.declarations |= block.declarations
    return whole
