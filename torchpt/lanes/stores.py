"""The end of a kernel's loop: LLVM IR that puts the results where the sinks say."""

from __future__ import annotations

from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.block import ELEMENTS, WIDTH, Block
from torchpt.lanes.emission import MEMORY
from torchpt.lanes.graph import Graph, Unsupported
from torchpt.lanes.sinks import Note, Pack, Scatter, Sinks, Store

__all__ = ["SinkLines"]


class SinkLines:
    """The lines of a kernel's sinks.

    Attributes:
        after: names of the counters after this turn of the loop.
    """

    def __init__(self, block: Block, graph: Graph, names: dict[int, str], sinks: Sinks) -> None:
        self.block, self.graph, self.names, self.sinks = block, graph, names, sinks
        self.after = {k: f"%c{k}" for k in range(sinks.counters())}

    def write(self) -> None:
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
            place = "%i" if sinks.shift is None else block.op(f"add i64 %i, %first{sinks.shift}")
            for row, node in sinks.write:
                element, value = self._held(node)
                block.do(f"store <{WIDTH} x {element}> {value}, ptr {self._row(row, element, place)}, align 4")
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

    def _row(self, row: int, element: str, place: str) -> str:
        start = self.block.at("%dst", "i8", 4 * CAPACITY * row) if row else "%dst"
        return self.block.at(start, element, place)

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
        end = block.at(f"%list{note.list}", "i32", self.after[note.counter])
        block.do(f"store <{WIDTH} x i32> {together}, ptr {end}, align 4")
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
