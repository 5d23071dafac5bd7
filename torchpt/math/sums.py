"""Sums of gradients of tables, in an order that depends neither on threads nor on the positions of lanes.

A *table* is a parameter or a tensor made of parameters, from which lanes look up *entries*: columns, by an index of the last
axis. A *term* is the derivative of one look-up of one lane. A *chunk* is the samples that a thread traces from the camera to
the ends of their paths; a sample's *slot* is its number in the chunk. Backward engines add terms to :class:`ChunkGradientSums`,
a chunk each, which a pass merges into its :class:`GradientSums`.

The terms of a chunk are ordered by vertex, from the last to the first, then by stage, look-up and slot, wherever the lane of a
sample is in memory at this vertex. The terms of a look-up are added to an entry

- by columns, in tables of few numbers (:data:`MAX_BY_COLUMNS`): slot s is in column s modulo C
  (:data:`~torchpt.math.sum_kernels.COLUMNS`). An entry's terms of a column are added one after the other, from 0; then each
  column of the second half is added to its counterpart in the first half, and so on, until one column is left, which is added
  to the entry. A slot without a term may be left out or count as 0. A derivative by a whole table has a term for each lane and
  number of the table, and is summed in the same way;
- one after the other, in all other tables.

The first suits a GPU's warp, with one thread a column; the second can be done by a stable sort by entry and one thread an
entry: the bits are the same. Sums are float64, in tables of more than :data:`MAX_FLOAT64` numbers of the lanes' precision.
    Chunks
are added in their order: the chunk's sums in tables of up to :data:`MAX_DENSE` numbers, its terms one by one in larger ones.

A stage that runs by tensor operations has no slots: the number of a term is used instead. If all of a chunk runs by tensor
operations, the terms of a look-up are added one after the other on a CPU; on other devices they are sorted by entry, and the
terms of an entry are added pairwise (:func:`summed_by_entry`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from torchpt.ranks import Group

__all__ = [
    "MAX_BY_COLUMNS",
    "MAX_DENSE",
    "ChunkGradientSums",
    "GradientSums",
    "TableSums",
    "entries_and_width",
    "summed_by_entry",
]

#: Tables of at most so many numbers are summed in float64, larger ones in the lanes' precision: their entries have few terms.
MAX_FLOAT64 = 1 << 20
#: Tables of at most so many numbers are summed by chunk: 256 KiB of float64.
MAX_DENSE = 1 << 15
#: Tables of at most so many numbers are summed by columns of slots: each entry has many terms.
MAX_BY_COLUMNS = 1 << 7


class TableSums(ABC):
    """Base of the sums of a whole pass and of a chunk: gradients as large as their tables, and look-ups that add to them.

    Methods name a table by its ``number``, an index into ``tables``. M is the number of entries, R that of components of an
    entry.

    Args:
        tables: the tables, each ``(..., M)``.
    """

    def __init__(self, tables: Sequence[Tensor]) -> None:
        self.tables = tuple(tables)
        self._number_by_id = {id(table): number for number, table in enumerate(self.tables)}

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """Return columns ``index (N,)`` of a table, whose derivative adds to the sums; None for a table that is not among them.

        This makes sums a :class:`torchpt.math.gathers.GatherRecorder`.
        """
        number = self._number_by_id.get(id(table))
        return None if number is None else _LookUp.apply(table, index, self, number)

    @abstractmethod
    def total(self, number: int) -> Tensor:
        """Return the sum of a table as ``(M, R)``; values may be added to it in place."""

    @abstractmethod
    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table, in their order."""

    def add(self, number: int, gradient: Tensor) -> None:
        """Add a gradient in the shape of the table."""
        total = self.total(number)
        total += gradient.reshape(total.shape[1], total.shape[0]).T

    def add_each(self, gradients: Iterable[Tensor | None]) -> None:
        """Add gradients in the shapes of their tables, one for each table in order; None adds nothing."""
        for number, gradient in enumerate(gradients):
            if gradient is not None:
                self.add(number, gradient)


class GradientSums(TableSums):
    """Sums of the gradients of tables over a whole pass.

    Args:
        tables: the tables, each ``(..., M)``.
    """

    def __init__(self, tables: Sequence[Tensor]) -> None:
        super().__init__(tables)
        self._totals: list[Tensor | None] = [None] * len(self.tables)

    def total(self, number: int) -> Tensor:
        """Return the sum of a table as ``(M, R)``, made of zeros by the first call; values may be added to it in place."""
        total = self._totals[number]
        if total is None:
            table = self.tables[number]
            entries, width = entries_and_width(table)
            dtype = torch.float64 if table.numel() <= MAX_FLOAT64 else table.dtype
            total = self._totals[number] = torch.zeros(entries, width, dtype=dtype, device=table.device)
        return total

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table, in their order."""
        total = self.total(number)
        if total.device.type == "cpu":
            from torchpt.math.sum_kernels import add_at

            add_at(total.numpy(), index.numpy(), values.reshape(total.shape[1], -1).numpy())
        else:
            self.add_sorted(number, index, values)

    def add_sorted(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add as :meth:`add_at`, on any device: terms are summed by entry first, as ``index_add_`` has no order on GPUs."""
        total = self.total(number)
        if len(index):
            entries, entry_sums = summed_by_entry(index, values.reshape(total.shape[1], -1).to(total.dtype))
            total.index_add_(0, entries, entry_sums.T)  # each entry once: no order to lose

    def join(self, other: GradientSums) -> None:
        """Add the sums of other samples: all of them, or none if memory runs out."""
        joined = [
            total if more is None else more if total is None else total + more
            for total, more in zip(self._totals, other._totals, strict=True)
        ]
        self._totals = joined

    def join_ranks(self, ranks: Group) -> None:
        """Add the sums of all ranks (processes that share the work), in their order: afterwards all have the same bits."""
        has_total = torch.tensor([total is not None for total in self._totals], dtype=torch.uint8)
        # A table is summed if any rank has terms of it: all ranks must take part in the same sums.
        for number, ranks_with_total in enumerate(torch.stack(ranks.gather(has_total)).sum(0).tolist()):
            if ranks_with_total:
                self._totals[number] = ranks.sum(self.total(number))

    def merge(self, chunk: ChunkGradientSums) -> None:
        """Add the sums of a chunk: first the terms of large tables, in the order in which they came."""
        for number, index, values in chunk.large_terms:
            self.add_rows(number, index, values)
        for number, total in chunk.dense.items():
            self.total(number).add_(total)

    def clear(self) -> None:
        """Set all sums to 0."""
        self._totals = [None] * len(self.tables)

    def add_rows(self, number: int, index: np.ndarray, values: np.ndarray) -> None:
        """Add ``values (R, n)`` to the entries ``index (n,)`` of a table on a CPU, one after the other."""
        from torchpt.math.sum_kernels import add_at

        add_at(self.total(number).numpy(), index, values)

    def gradients(self) -> list[Tensor | None]:
        """Return the sums in the shapes of their tables; None for a table to which nothing was added."""
        return [
            None if total is None else total.T.reshape(table.shape).to(table.dtype)
            for total, table in zip(self._totals, self.tables, strict=True)
        ]


class ChunkGradientSums(TableSums):
    """Sums of one chunk: dense sums of small tables, and the terms of large tables.

    Args:
        tables: the tables, each ``(..., M)``.
        whole: sums of the pass, to which terms of large tables are added at once, if chunks run one after the other; None: such
            terms are kept, until :meth:`GradientSums.merge` takes them.

    Attributes:
        dense: sums ``(M, R)`` float64 by number of the table.
        large_terms: kept terms: number of the table, indices ``(n,)`` and values ``(R, n)``.
    """

    def __init__(self, tables: Sequence[Tensor], whole: GradientSums | None = None) -> None:
        super().__init__(tables)
        self._whole = whole
        self.dense: dict[int, Tensor] = {}
        self.large_terms: list[tuple[int, np.ndarray, np.ndarray]] = []

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table; a term's number serves as its slot."""
        _, width = entries_and_width(self.tables[number])
        term_numbers = np.arange(len(index), dtype=np.int32)
        self.add_rows(number, index.to(torch.int32).numpy(), values.reshape(width, -1).numpy(), term_numbers)

    def add_rows(self, number: int, index: np.ndarray, values: np.ndarray, slots: np.ndarray) -> None:
        """Add ``values (R, n)`` to the entries ``index (n,)`` int32 of a table.

        ``slots (n,)`` int32, rising: slots of the samples to which the terms belong.
        """
        size = self.tables[number].numel()
        if size > MAX_DENSE:
            if self._whole is None:
                self.large_terms.append((number, index.copy(), values.copy()))
            else:
                self._whole.add_rows(number, index, values)
            return
        from torchpt.math.sum_kernels import add_at, add_by_columns

        if size <= MAX_BY_COLUMNS:
            add_by_columns(self.total(number).numpy(), index, values, slots)
        else:
            add_at(self.total(number).numpy(), index, values)

    def add_all(self, number: int, values: np.ndarray, slots: np.ndarray) -> None:
        """Add derivatives by a whole table: the sums over lanes of ``values (table.numel(), n)``.

        ``slots``: as for :meth:`add_rows`.
        """
        from torchpt.math.sum_kernels import add_by_columns

        total = torch.zeros(self.tables[number].shape, dtype=torch.float64)
        # The table as a single entry, number 0, to which all lanes belong.
        add_by_columns(total.view(1, -1).numpy(), np.zeros(len(slots), np.int32), values, slots)
        self.add(number, total)

    def total(self, number: int) -> Tensor:
        """Return the dense sum of a table as ``(M, R)``."""
        if number not in self.dense:
            self.dense[number] = torch.zeros(*entries_and_width(self.tables[number]), dtype=torch.float64)
        return self.dense[number]


def entries_and_width(table: Tensor) -> tuple[int, int]:
    """Return M and R: the numbers of entries of a table, and of components of an entry. Look-ups index the last axis."""
    return (table.shape[-1], math.prod(table.shape[:-1])) if table.dim() else (1, 1)


def summed_by_entry(index: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Sum terms by entry, with the same bits on any device: pairwise, in the order of the terms of an entry.

    Args:
        index: ``(n,)`` entries of the terms, n > 0.
        values: ``(R, n)``.

    Returns:
        Entries ``(m,)``, rising, and their sums ``(R, m)``.
    """
    keys, order = torch.sort(index, stable=True)
    sums = torch.index_select(values, 1, order)
    entries, counts = torch.unique_consecutive(keys, return_counts=True)
    first = counts.cumsum(0) - counts  # position of the first term of each entry
    number_in_entry = torch.arange(len(keys), device=keys.device) - first.repeat_interleave(counts)
    step, max_terms = 1, int(counts.max())
    while step < max_terms:  # terms 0 and 1 of an entry, 2 and 3, ..., then the sums at 0 and 2, ...
        pairs = (number_in_entry[:-step] % (2 * step) == 0) & (keys[step:] == keys[:-step])
        sums[:, :-step] += torch.where(pairs, sums[:, step:], 0.0)
        step *= 2
    return entries, torch.index_select(sums, 1, first)


class _LookUp(torch.autograd.Function):
    """A look-up of columns of a table, whose derivative is added to sums instead of being returned."""

    @staticmethod
    def forward(ctx, table: Tensor, index: Tensor, sums: GradientSums | ChunkGradientSums, number: int) -> Tensor:
        ctx.save_for_backward(index)
        ctx.sums, ctx.number = sums, number
        return torch.index_select(table, table.dim() - 1, index)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[None, None, None, None]:  # pyright: ignore
        (index,) = ctx.saved_tensors
        ctx.sums.add_at(ctx.number, index, gradient)
        return None, None, None, None
