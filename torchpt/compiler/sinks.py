"""The outputs of a kernel: rows written in place, compacted rows, scattered rows, lists of indices, and result tensors.

Values are given by their nodes in the :class:`~torchpt.compiler.graph.Graph` of the stage.
"""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["AppendIndex", "Compact", "Scatter", "Sinks", "Store"]


@dataclass(frozen=True)
class AppendIndex:
    """An append of lane indices to list ``list`` where ``mask`` is set; ``counter`` is the length of the list."""

    mask: int
    list: int
    counter: int


@dataclass(frozen=True)
class Compact:
    """A stream compaction: lanes where ``mask`` is set are appended to rows of the target arena at index ``counter``.

    The notes list the new indices of these lanes.
    """

    mask: int
    rows: tuple[tuple[int, int], ...]  # row, node
    counter: int
    appends: tuple[AppendIndex, ...] = ()


@dataclass(frozen=True)
class Scatter:
    """A scatter to index ``place`` of rows of the arena or of the slots, where ``mask`` is set (-1: everywhere)."""

    mask: int
    place: int
    rows: tuple[tuple[int, int], ...]  # row, node
    slots: bool = False


@dataclass(frozen=True)
class Store:
    """A result tensor ``(rows, lanes)``: one node a row, and the element type."""

    nodes: tuple[int, ...]
    ty: str


@dataclass
class Sinks:
    """The outputs of a kernel.

    Attributes:
        write: rows of the target arena and their nodes, written at the number of the lane.
        compact: see :class:`Compact`.
        appends: lists of the lanes' indices in the source arena.
        scatter: see :class:`Scatter`.
        count: pairs of a mask whose set lanes are counted and a counter.
        store: result tensors.
        shift: counter whose value at the kernel's start is added to the indices of ``write``.
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
        """Return the number of counters."""
        return max(self.incremented() | ({self.shift} if self.shift is not None else set()), default=-1) + 1

    def lists(self) -> int:
        """Return the number of lists."""
        appends = [append.list for compact in self.compact for append in compact.appends] + [
            append.list for append in self.appends
        ]
        return max(appends, default=-1) + 1
