"""Sums of gradients with respect to tables, in an order that neither threads nor places of lanes decide.

A chunk's terms come vertex by vertex, from the last to the first, stage by stage and look-up by look-up. Within a look-up they
come by sample: by the slot that a lane's sample has in its chunk, wherever in an arena the lane lies. What a look-up adds to an
entry is,

- in tables of few numbers (:data:`FEW`), summed by columns: slot s is in column s modulo C
  (:data:`~torchpt.math.sum_kernels.COLUMNS`). An entry's terms of a column are added one after the other, from 0; then each
  column of the second half is added to its fellow of the first, and so on with those that are left, until there is one, which
  is added to the entry. A slot without a term may be left out or count 0. A derivative by all of a table is a term of each lane
  for each of its numbers, and is summed alike;
- in other tables its terms one after the other, each added to the entry itself.

The first suits threads of a GPU that go together, one for each column; the other may be done by a stable sort by entry, and a
thread for each: the bits are the same. Sums are float64, in tables of more than :data:`WIDE` numbers of the lanes' own
precision. Chunks are added in their order: of tables of up to :data:`DENSE` numbers what a chunk comes to, of others its terms
one by one.

A stage that runs by tensor operations knows no slots: the number of a term takes the slot's place. Where chunks run by tensor
operations altogether, the terms of a look-up are added one after the other on a CPU. On other devices they are sorted by entry,
and an entry's terms are added pairwise (:func:`summed_by_entry`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from torchpt.ranks import Group

__all__ = ["ChunkGradientSums", "GradientSums", "summed_by_entry"]

#: Tables of more numbers than this are summed in the lanes' own precision: few paths meet in one of so many places.
WIDE = 1 << 20
#: A chunk sums tables of no more numbers than this by itself.
DENSE = 1 << 15
#: Tables of no more numbers than this are summed by columns of slots: many lanes meet in one of so few entries.
FEW = 1 << 7


class GradientSums:
    """What was added up of the gradients of some tables.

    Args:
        tables: ``(..., M)`` each.
    """

    def __init__(self, tables: Sequence[Tensor]) -> None:
        self.tables = tuple(tables)
        self._numbers = {id(table): number for number, table in enumerate(self.tables)}
        self._totals: list[Tensor | None] = [None] * len(self.tables)

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """See :class:`torchpt.math.gathers.GatherRecorder`: the derivative of the look-up goes straight to the sums."""
        number = self._numbers.get(id(table))
        return None if number is None else _Taken.apply(table, index, self, number)

    def total(self, number: int) -> Tensor:
        """Return the sum of a table as ``(M, R)``, R numbers an entry."""
        found = self._totals[number]
        if found is None:
            table = self.tables[number]
            entries, width = _form(table)
            dtype = torch.float64 if table.numel() <= WIDE else table.dtype
            found = self._totals[number] = torch.zeros(entries, width, dtype=dtype, device=table.device)
        return found

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table, in their order."""
        total = self.total(number)
        if total.device.type == "cpu":
            from torchpt.math.sum_kernels import add_at

            add_at(total.numpy(), index.numpy(), values.reshape(total.shape[1], -1).numpy())
        else:
            self.add_sorted(number, index, values)

    def add_sorted(self, number: int, index: Tensor, values: Tensor) -> None:
        """As :meth:`add_at`, on any device: each entry is added to once, as adding at one place has no order there."""
        total = self.total(number)
        if len(index):
            entries, found = summed_by_entry(index, values.reshape(total.shape[1], -1).to(total.dtype))
            total.index_add_(0, entries, found.T)

    def add(self, number: int, gradient: Tensor) -> None:
        """Add a gradient as large as the table."""
        total = self.total(number)
        total += gradient.reshape(total.shape[1], total.shape[0]).T

    def add_each(self, gradients: Iterable[Tensor | None]) -> None:
        """Add gradients as large as their tables, one a table in their order; None adds nothing."""
        for number, gradient in enumerate(gradients):
            if gradient is not None:
                self.add(number, gradient)

    def join(self, part: GradientSums) -> None:
        """Add the sums of a piece: all of them, or nothing where there is no memory for that."""
        own = [
            total if more is None else more if total is None else total + more
            for total, more in zip(self._totals, part._totals, strict=True)
        ]
        self._totals = own

    def join_ranks(self, ranks: Group) -> None:
        """Add the sums of all ranks, in their order: every one has the same bits then."""
        there = torch.tensor([total is not None for total in self._totals], dtype=torch.uint8)
        for number, count in enumerate(torch.stack(ranks.gather(there)).sum(0).tolist()):
            if count:
                self._totals[number] = ranks.sum(self.total(number))

    def merge(self, part: ChunkGradientSums) -> None:
        """Add the sums of a chunk: its terms of large tables first, as they come where they are added at once."""
        for number, index, values in part.stream:
            self.add_rows(number, index, values)
        for number, total in part.dense.items():
            self.total(number).add_(total)

    def clear(self) -> None:
        """Forget what was added."""
        self._totals = [None] * len(self.tables)

    def add_rows(self, number: int, index: np.ndarray, values: np.ndarray) -> None:
        """Add ``values (R, n)`` to the entries ``index (n,)`` of a table on a CPU, one after the other."""
        from torchpt.math.sum_kernels import add_at

        add_at(self.total(number).numpy(), index, values)

    def gradients(self) -> list[Tensor | None]:
        """Return the sums in the shapes of their tables; None where nothing was added."""
        return [
            None if total is None else total.T.reshape(table.shape).to(table.dtype)
            for total, table in zip(self._totals, self.tables, strict=True)
        ]


class ChunkGradientSums:
    """Sums of one chunk: dense ones of small tables, and of large ones the terms themselves.

    Args:
        tables: ``(..., M)`` each.
        whole: where terms of large tables are added at once, as chunks come one after the other; None: they are kept.

    Attributes:
        dense: sums ``(M, R)`` float64 by the number of a table.
        stream: numbers of tables, indices ``(n,)`` and values ``(R, n)``.
    """

    def __init__(self, tables: Sequence[Tensor], whole: GradientSums | None = None) -> None:
        self.tables, self._whole = tuple(tables), whole
        self._numbers = {id(table): number for number, table in enumerate(self.tables)}
        self.dense: dict[int, Tensor] = {}
        self.stream: list[tuple[int, np.ndarray, np.ndarray]] = []

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """See :class:`torchpt.math.gathers.GatherRecorder`."""
        number = self._numbers.get(id(table))
        return None if number is None else _Taken.apply(table, index, self, number)

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """See :class:`GradientSums`."""
        _, width = _form(self.tables[number])
        terms = np.arange(len(index), dtype=np.int32)
        self.add_rows(number, index.to(torch.int32).numpy(), values.reshape(width, -1).numpy(), terms)

    def add_rows(self, number: int, index: np.ndarray, values: np.ndarray, slots: np.ndarray) -> None:
        """Add ``values (R, n)`` to the entries ``index (n,)`` int32 of a table.

        ``slots (n,)`` int32, rising: of the samples that the terms are of.
        """
        numbers = self.tables[number].numel()
        if numbers > DENSE:
            if self._whole is None:
                self.stream.append((number, index.copy(), values.copy()))
            else:
                self._whole.add_rows(number, index, values)
            return
        from torchpt.math.sum_kernels import add_at, add_by_columns

        if numbers <= FEW:
            add_by_columns(self._total(number).numpy(), index, values, slots)
        else:
            add_at(self._total(number).numpy(), index, values)

    def add_all(self, number: int, values: np.ndarray, slots: np.ndarray) -> None:
        """Add the sums over lanes of ``values (all numbers of a table, n)``; ``slots`` as of :meth:`add_rows`."""
        from torchpt.math.sum_kernels import add_by_columns

        total = torch.zeros(self.tables[number].shape, dtype=torch.float64)
        add_by_columns(total.view(1, -1).numpy(), np.zeros(len(slots), np.int32), values, slots)
        self.add(number, total)

    def add(self, number: int, gradient: Tensor) -> None:
        """Add a gradient as large as the table."""
        total = self._total(number)
        total += gradient.reshape(total.shape[1], total.shape[0]).T

    def add_each(self, gradients: Iterable[Tensor | None]) -> None:
        """See :class:`GradientSums`."""
        for number, gradient in enumerate(gradients):
            if gradient is not None:
                self.add(number, gradient)

    def _total(self, number: int) -> Tensor:
        if number not in self.dense:
            self.dense[number] = torch.zeros(*_form(self.tables[number]), dtype=torch.float64)
        return self.dense[number]


def _form(table: Tensor) -> tuple[int, int]:
    """Return how many entries a table has, and numbers an entry: the last axis is the one that is looked up."""
    return (table.shape[-1], math.prod(table.shape[:-1])) if table.dim() else (1, 1)


def summed_by_entry(index: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Sum terms by entry to the same bits on any device: pairwise, in the order in which an entry's terms come.

    Args:
        index: ``(n,)`` the entries, n > 0.
        values: ``(R, n)``.

    Returns:
        Entries ``(m,)``, rising, and their sums ``(R, m)``.
    """
    keys, order = torch.sort(index, stable=True)
    sums = torch.index_select(values, 1, order)
    entries, counts = torch.unique_consecutive(keys, return_counts=True)
    first = counts.cumsum(0) - counts
    rank = torch.arange(len(keys), device=keys.device) - first.repeat_interleave(counts)
    step, longest = 1, int(counts.max())
    while step < longest:  # terms 0 and 1 of an entry, 2 and 3, ..., then what came out at 0 and 2, ...
        pairs = (rank[:-step] % (2 * step) == 0) & (keys[step:] == keys[:-step])
        sums[:, :-step] += torch.where(pairs, sums[:, step:], 0.0)
        step *= 2
    return entries, torch.index_select(sums, 1, first)


class _Taken(torch.autograd.Function):
    """Columns of a table, whose derivative is added to sums instead of being handed on."""

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
