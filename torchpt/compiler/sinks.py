"""The outputs of a kernel: rows written in place, compacted rows, scattered rows, lists of indices, and result tensors.

Values and masks are given by their nodes in the :class:`~torchpt.compiler.graph.Graph` of the stage. A kernel reads lanes of
one arena, the source, and writes rows of an arena, the target (:mod:`torchpt.compiler.form`). *Counters* are 64-bit integers in
memory, referred to by number; a kernel adds to them how many lanes it has appended or counted. *Slots* are rows of memory
outside of the arenas, which several kernels share; their length is an argument of the kernel.
"""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["AppendIndex", "Compact", "Scatter", "Sinks", "Store"]


@dataclass(frozen=True)
class AppendIndex:
    """An append of lane indices to a list where a mask is set.

    Attributes:
        mask: node of the mask.
        list: number of the list.
        counter: number of the counter that holds the list's length.
    """

    mask: int
    list: int
    counter: int


@dataclass(frozen=True)
class Compact:
    """A stream compaction: lanes where a mask is set are appended to rows of the target arena.

    Attributes:
        mask: node of the mask.
        rows: pairs of a row of the target arena and the node of its value.
        counter: number of the counter that holds the number of lanes in the target arena.
        appends: lists of the new indices of these lanes.
    """

    mask: int
    rows: tuple[tuple[int, int], ...]
    counter: int
    appends: tuple[AppendIndex, ...] = ()


@dataclass(frozen=True)
class Scatter:
    """A scatter of each lane to an index of its own.

    Attributes:
        mask: node of the mask of the lanes that are stored; -1: all are.
        place: node of the index.
        rows: pairs of a row and the node of its value.
        slots: True: rows of the slots; False: of the target arena.
    """

    mask: int
    place: int
    rows: tuple[tuple[int, int], ...]
    slots: bool = False


@dataclass(frozen=True)
class Store:
    """A result tensor ``(rows, lanes)``: one node a row, and the node type of its elements."""

    nodes: tuple[int, ...]
    ty: str


@dataclass
class Sinks:
    """The outputs of a kernel.

    Attributes:
        write: pairs of a row of the target arena and the node of its value, which is written at the index of the lane.
        compact: stream compactions.
        appends: lists of the lanes' indices in the source arena.
        scatter: scatters.
        count: pairs of the node of a mask and the counter to which the number of its set lanes is added.
        store: result tensors.
        shift: number of a counter whose value at the kernel's start is added to the indices of ``write``; None: nothing is.
        shadows: number of shadow rays a lane.
    """

    write: list[tuple[int, int]] = field(default_factory=list)
    compact: list[Compact] = field(default_factory=list)
    appends: list[AppendIndex] = field(default_factory=list)
    scatter: list[Scatter] = field(default_factory=list)
    count: list[tuple[int, int]] = field(default_factory=list)
    store: list[Store] = field(default_factory=list)
    shift: int | None = None
    shadows: int = 0

    def roots(self) -> list[int]:
        """Return the nodes of all outputs."""
        roots = [node for _, node in self.write]
        for compact in self.compact:
            roots += [
                compact.mask,
                *(node for _, node in compact.rows),
                *(append.mask for append in compact.appends),
            ]
        roots += [append.mask for append in self.appends]
        for scatter in self.scatter:
            roots += [scatter.place, *(node for _, node in scatter.rows)]
            roots += [scatter.mask] if scatter.mask >= 0 else []
        roots += [mask for mask, _ in self.count]
        return roots + [node for store in self.store for node in store.nodes]

    def incremented(self) -> set[int]:
        """Return the counters that the kernel increments."""
        appends = [*self.appends, *(append for compact in self.compact for append in compact.appends)]
        numbers = {x.counter for x in (*self.compact, *appends)}
        return numbers | {counter for _, counter in self.count}

    def counters(self) -> int:
        """Return the number of counters that the kernel reads or increments: the largest of their numbers plus 1."""
        return max(self.incremented() | ({self.shift} if self.shift is not None else set()), default=-1) + 1

    def lists(self) -> int:
        """Return the number of lists that the kernel appends to: the largest of their numbers plus 1."""
        appends = [append.list for compact in self.compact for append in compact.appends] + [
            append.list for append in self.appends
        ]
        return max(appends, default=-1) + 1
