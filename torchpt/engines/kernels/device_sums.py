"""Sums of gradients on a CUDA device, in the order of :mod:`torchpt.math.sums`, so with the bits of a CPU.

A *wave* of a device has several chunks. The *place* of a sample in it is its chunk times the largest number of slots of a
chunk, plus its slot. Lanes are in random order. So terms are brought in the order of places, sorted by entry without changing
the order of equal entries, and added one after the other by one thread for each entry, by the kernel of
:mod:`torchpt.compiler.segments`. The host does not wait for the device.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.segments import UNROLLED, segment_sums
from torchpt.compiler.target import Target
from torchpt.engines.kernels.driver import Cuda, Function
from torchpt.math import sums
from torchpt.math.sum_kernels import COLUMNS
from torchpt.math.sums import GradientSums, TableSums, entries_and_width

__all__ = ["Order", "Places", "SegmentSums", "Terms", "WaveSums"]


# ---- The order of terms


@dataclass(frozen=True)
class Order:
    """Terms sorted by entry.

    Attributes:
        terms: ``(n,)`` int64, the terms; those of an entry in the order in which they are added.
        first: ``(M,)`` int32, where the terms of each entry begin.
        end: ``(M,)`` int32, where they end.
    """

    terms: Tensor
    first: Tensor
    end: Tensor

    @staticmethod
    def of(entry: Tensor, entries: int) -> Order:
        """Sort terms by entry ``(n,)`` int32, stably; those of the entry ``entries`` are left out."""
        found, terms = torch.sort(entry, stable=True)
        numbers = torch.arange(entries + 1, dtype=torch.int32, device=entry.device)
        bounds = torch.searchsorted(found, numbers, out_int32=True)
        return Order(terms, bounds[:-1], bounds[1:])


@dataclass(frozen=True)
class Places:
    """The places of a wave's samples.

    Attributes:
        of_sample: ``(samples,)`` int64, by the number of the sample in the wave.
        chunks: number of chunks.
        size: places of a chunk.
        chunk: ``(places,)`` int32, the chunk of each place.
        column: ``(places,)`` int32, the column of its slot.
    """

    of_sample: Tensor
    chunks: int
    size: int
    chunk: Tensor
    column: Tensor

    @staticmethod
    def of(pixels: int, samples: int, size: int, device: torch.device) -> Places:
        """Return the places of ``samples`` samples of ``pixels`` pixels each, in chunks of at most ``size`` samples."""
        in_chunk = min(max(size // samples, 1), pixels)  # pixels of a chunk, but for the last one
        chunks = -(-pixels // in_chunk)
        number = torch.arange(pixels * samples, device=device)
        sample = torch.div(number, pixels, rounding_mode="floor")
        pixel = number - sample * pixels
        chunk = torch.div(pixel, in_chunk, rounding_mode="floor")
        width = (pixels - chunk * in_chunk).clamp_max(in_chunk)  # pixels of the sample's own chunk
        place = torch.arange(chunks * size, dtype=torch.int32, device=device)
        of_place = torch.div(place, size, rounding_mode="floor")
        of_sample = chunk * size + sample * width + pixel - chunk * in_chunk
        return Places(of_sample, chunks, size, of_place, (place - of_place * size) % COLUMNS)

    @property
    def count(self) -> int:
        """Return the number of places."""
        return self.chunks * self.size

    def terms(self, sample: Tensor, exists: Tensor) -> Terms:
        """Return the terms of a kernel.

        Args:
            sample: ``(n,)`` int64, number of the sample of each term.
            exists: ``(n,)`` bool; terms that do not exist have any number.
        """
        last = len(self.of_sample) - 1
        place = torch.where(exists, self.of_sample[sample.clamp(0, last)], self.count)
        at = torch.full((self.count + 1,), -1, dtype=torch.int64, device=place.device)
        at.scatter_(0, place, torch.arange(len(place), device=place.device))
        return Terms(at[:-1], self)

    def all_terms(self) -> Terms:
        """Return the terms of a kernel whose lanes are all samples of the wave, in their order."""
        number = torch.arange(len(self.of_sample), device=self.of_sample.device)
        return self.terms(number, torch.ones_like(number, dtype=torch.bool))


class Terms:
    """The terms that a kernel has written, in the order of places.

    Args:
        at: ``(places,)`` int64, the term at each place; -1: none.
        places: of the wave.
    """

    def __init__(self, at: Tensor, places: Places) -> None:
        self._at, self._exists, self._places = at.clamp_min(0), at >= 0, places
        self._orders: dict[Any, Order] = {}

    def entry(self, index: Tensor | None, entries: int) -> Tensor:
        """Return the entry ``(places,)`` int32 of the term at each place; ``entries``: none, or out of range.

        ``index``: ``(n,)`` int32 entries by term; None: all terms are of entry 0.
        """
        if index is None:
            return torch.where(self._exists, 0, entries).int()
        found = index.index_select(0, self._at)
        return torch.where(self._exists & (found >= 0) & (found < entries), found, entries)

    def values(self, values: Tensor) -> Tensor:
        """Return values ``(R, n)`` of terms by place, ``(R, places)``."""
        return values.index_select(1, self._at)

    def order(self, key: Any, index: Tensor | None, entries: int, *, by_columns: bool) -> Order:
        """Return the order of terms by chunk and entry (and column); found once for each ``key`` and number of entries."""
        known = key, entries, by_columns
        if key is None or known not in self._orders:
            entry, places = self.entry(index, entries), self._places
            row, rows = places.chunk * entries + entry, places.chunks * entries
            if by_columns:
                row, rows = row * COLUMNS + places.column, rows * COLUMNS
            found = Order.of(torch.where(entry < entries, row, rows), rows)
            self._orders[known] = Order(self._at.index_select(0, found.terms), found.first, found.end)
        return self._orders[known]


# ---- Sums


#: Most terms that a launch adds: indices are 32-bit, also those that are found to be past the end.
_MOST_TERMS = (1 << 31) - 1 - UNROLLED


class SegmentSums:
    """Adds terms to the rows of a table on a device.

    Args:
        cuda: the device.
        target: the target that kernels are compiled for.
    """

    def __init__(self, cuda: Cuda, target: Target) -> None:
        self._cuda, self._target = cuda, target
        self._functions: dict[torch.dtype, Function] = {}  # by type of the sums
        self._lanes: dict[int, Tensor] = {}  # numbers of lanes, on the device

    def add(self, total: Tensor, order: Order, values: Tensor) -> None:
        """Add terms to a table.

        Args:
            total: ``(M, R)`` float64 or float32, in which terms are added.
            order: of the terms, for M entries.
            values: ``(R, n)`` float32.
        """
        found = total.T.contiguous()
        self._launch(found, order, values)
        total.copy_(found.T)

    def _launch(self, found: Tensor, order: Order, values: Tensor) -> None:
        """Add terms to sums ``found (R, M)``, which are contiguous; a thread adds one number."""
        function = self._functions.get(found.dtype)
        if function is None:
            stage = segment_sums("d" if found.dtype == torch.float64 else "f")
            code = cache.compile_stage(stage, self._target).function
            function = self._functions[found.dtype] = self._cuda.load(code.code, code.key)
        terms = values.index_select(1, order.terms)
        rows = min(len(found), _MOST_TERMS // terms.shape[1])
        starts = torch.arange(rows, dtype=torch.int32, device=found.device)[:, None] * terms.shape[1]
        first, end = starts + order.first, starts + order.end
        for row in range(0, len(found), rows):
            part, count = found[row : row + rows], found[row : row + rows].numel()
            words = (ctypes.c_int64 * (len(HEAD) + 2 * 4))()
            words[WORD["slots"]] = terms[row:].data_ptr()
            words[len(HEAD) :] = [word for x in (first, end, part, part) for word in (x.data_ptr(), count)]
            if count not in self._lanes:
                self._lanes[count] = torch.full((1,), count, dtype=torch.int64, device=found.device)
            self._cuda.enter()
            self._cuda.launch(function, words, self._lanes[count].data_ptr(), count, self._cuda.stream())

    def by_columns(self, order: Order, values: Tensor) -> Tensor:
        """Return the sums ``(M, R)`` float64 of terms, added by column first, see :mod:`torchpt.math.sums`.

        ``order``: for M * :data:`~torchpt.math.sum_kernels.COLUMNS` entries.
        """
        found = torch.zeros(len(values), len(order.first), dtype=torch.float64, device=values.device)
        self._launch(found, order, values)
        columns = found.view(len(values), -1, COLUMNS)
        while columns.shape[2] > 1:
            first, second = columns.chunk(2, 2)
            columns = first + second
        return columns[..., 0].T


class WaveSums(TableSums):
    """Sums of the chunks of a wave on a device; as :class:`torchpt.math.sums.ChunkGradientSums`.

    Args:
        tables: the tables, each ``(..., M)``.
        whole: sums of the pass.
        segments: adds terms.
        size: largest number of samples of a chunk.
    """

    def __init__(self, tables: Sequence[Tensor], whole: GradientSums, segments: SegmentSums, size: int) -> None:
        super().__init__(tables)
        self._whole, self._segments, self._size = whole, segments, size
        self._dense: dict[int, Tensor] = {}  # (chunks, M, R) by number of the table
        #: Entries ``(places,)`` and values ``(R, places)`` of terms of large tables, in the order in which they came.
        self._large: dict[int, list[tuple[Tensor, Tensor]]] = {}

    def begin(self, pixels: int, samples: int, device: torch.device) -> Places:
        """Begin a wave of ``samples`` samples of ``pixels`` pixels each; keep and return their places."""
        self._places = Places.of(pixels, samples, self._size, device)
        return self._places

    def _of_chunks(self, number: int) -> Tensor:
        """Return the dense sums of a table by chunk, ``(chunks, M, R)``."""
        if number not in self._dense:
            table = self.tables[number]
            shape = self._places.chunks, *entries_and_width(table)
            self._dense[number] = torch.zeros(shape, dtype=torch.float64, device=table.device)
        return self._dense[number]

    def total(self, number: int) -> Tensor:
        """Return the dense sum of a table of the first chunk as ``(M, R)``; what has no chunk is added there."""
        return self._of_chunks(number)[0]

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table, one for each sample of the wave, in their order."""
        _, width = entries_and_width(self.tables[number])
        self.add_terms(number, None, index.int(), values.reshape(width, -1).contiguous(), self._places.all_terms())

    def add_terms(self, number: int, key: Any, index: Tensor, values: Tensor, terms: Terms) -> None:
        """Add terms to entries of a table.

        Args:
            number: of the table.
            key: the same for the same ``index`` of ``terms``; None: this ``index`` is used once.
            index: ``(n,)`` int32, the entry of each term; terms out of range are skipped.
            values: ``(R, n)`` float32.
            terms: the order of terms.
        """
        table = self.tables[number]
        entries, width = entries_and_width(table)
        if table.numel() > sums.MAX_DENSE:
            self._large.setdefault(number, []).append((terms.entry(index, entries), terms.values(values)))
            return
        by_columns = table.numel() <= sums.MAX_BY_COLUMNS
        order, total = terms.order(key, index, entries, by_columns=by_columns), self._of_chunks(number)
        if by_columns:
            total += self._segments.by_columns(order, values).reshape(total.shape)
        else:
            self._segments.add(total.view(-1, width), order, values)

    def add_all(self, number: int, values: Tensor, terms: Terms) -> None:
        """Add derivatives by a whole table: the sums of ``values (table.numel(), n)`` over the terms of each chunk."""
        total = self._of_chunks(number)  # (chunks, M, R)
        found = self._segments.by_columns(terms.order("all", None, 1, by_columns=True), values)
        total += found.reshape(len(total), total.shape[2], total.shape[1]).transpose(1, 2)

    def merge_into_whole(self) -> None:
        """Add the sums of chunks to those of the pass, in the order of chunks."""
        for number, terms in self._large.items():
            total, places = self._whole.total(number), self._places
            # By chunk first, then in the order in which terms came.
            entry = torch.stack([entry for entry, _ in terms]).view(-1, places.chunks, places.size).transpose(0, 1)
            values = torch.stack([values for _, values in terms], 1)  # (R, calls, places)
            values = values.view(len(values), -1, places.chunks, places.size).transpose(1, 2).reshape(len(values), -1)
            self._segments.add(total, Order.of(entry.reshape(-1), len(total)), values)
        if not self._dense:
            return
        wholes = [self._whole.total(number) for number in self._dense]
        total = torch.cat([whole.reshape(-1) for whole in wholes])
        for chunk in torch.cat([dense.flatten(1) for dense in self._dense.values()], 1):
            total += chunk
        for whole, part in zip(wholes, total.split([whole.numel() for whole in wholes]), strict=True):
            whole.copy_(part.view(whole.shape))
