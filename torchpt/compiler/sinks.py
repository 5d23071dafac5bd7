"""What a kernel does with its results: written in place, packed together, scattered to places, noted in lists, stored.

Numbers are named by their nodes in the :class:`~torchpt.compiler.graph.Graph` of the stage.
"""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = ["AppendIndex", "Compact", "Scatter", "Sinks", "Store"]


@dataclass(frozen=True)
class AppendIndex:
    """Places written one after the other into list ``list``, where ``mask`` holds; ``counter`` counts them."""

    mask: int
    list: int
    counter: int


@dataclass(frozen=True)
class Compact:
    """Lanes where ``mask`` holds, written together into rows of the target arena from ``counter`` on.

    The notes name the places where they went.
    """

    mask: int
    rows: tuple[tuple[int, int], ...]  # row, node
    counter: int
    appends: tuple[AppendIndex, ...] = ()


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
        compact: see :class:`Compact`.
        appends: lists of the lanes' own places.
        scatter: see :class:`Scatter`.
        count: masks whose lanes are counted, and by which counter.
        store: result tensors.
        shift: counter whose first value is added to the places of ``write``.
        shadows: how many shadow rays each lane asks for.
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
        """The nodes that are asked for."""
        roots = [node for _, node in self.write]
        for compact in self.compact:
            roots += [compact.mask, *(node for _, node in compact.rows), *(append.mask for append in compact.appends)]
        roots += [append.mask for append in self.appends]
        for scatter in self.scatter:
            roots += [scatter.place, *(node for _, node in scatter.rows)]
            roots += [scatter.mask] if scatter.mask >= 0 else []
        roots += [mask for mask, _ in self.count]
        return roots + [node for store in self.store for node in store.nodes]

    def counters(self) -> int:
        """How many counters there are."""
        numbers = [compact.counter for compact in self.compact] + [counter for _, counter in self.count]
        numbers += [append.counter for compact in self.compact for append in compact.appends] + [
            append.counter for append in self.appends
        ]
        numbers += [] if self.shift is None else [self.shift]
        return max(numbers, default=-1) + 1

    def lists(self) -> int:
        """How many lists there are."""
        appends = [append.list for compact in self.compact for append in compact.appends] + [
            append.list for append in self.appends
        ]
        return max(appends, default=-1) + 1
