"""The numbers of primitives of several scenes among those of all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from torchpt.math.vectors import take

__all__ = ["Numbers"]


@dataclass(frozen=True)
class Numbers:
    """Primitives by kind, and of a kind scene by scene; those of copies (which exist by their numbers alone) after all others.

    Attributes:
        counts: how many of each of :data:`torchpt.records.KINDS` there are in all scenes.
        first: where each scene's primitives begin, were scenes to follow each other, and the end.
        of: by that place the number among all ``(P,)`` int64.
        order: the places by those numbers ``(P,)`` int64.
        shifts: by how much numbers of copies' primitives are moved, by scene; None where there are no copies.
    """

    counts: tuple[int, int, int, int, int]
    first: tuple[int, ...]
    of: Tensor
    order: Tensor
    shifts: tuple[int, ...] | None = None

    @staticmethod
    def by_kind(counts: Sequence[Sequence[int]], device: torch.device, ends: Sequence[int] | None = None) -> Numbers:
        """Of scenes with so many primitives of each kind.

        Args:
            counts: by scene and kind.
            device: where the tensors lie.
            ends: by scene, a number that no primitive of its copies reaches; None where there are no copies.
        """
        sizes = [sum(own) for own in counts]
        first = [0, *accumulate(sizes)]
        begin = [
            [start + before for before in accumulate(own, initial=0)] for start, own in zip(first, counts, strict=False)
        ]
        kinds = range(len(counts[0]))
        runs = [
            torch.arange(start[k], start[k] + own[k]) for k in kinds for start, own in zip(begin, counts, strict=True)
        ]
        order = torch.cat(runs).to(device)
        of = torch.empty_like(order)
        of[order] = torch.arange(len(order), device=device)
        shifts = None
        if ends is not None:
            spans = [end - size for end, size in zip(ends, sizes, strict=True)]
            shifts = tuple(first[-1] + b - n for b, n in zip(accumulate(spans, initial=0), sizes, strict=False))
        a, b, c, d, e = (sum(own[k] for own in counts) for k in kinds)
        return Numbers((a, b, c, d, e), tuple(first), of, order, shifts)

    def own(self, scene: int) -> Tensor:
        """By number in a scene, the number among all ``(P,)``; copies not counted."""
        return self.of[self.first[scene] : self.first[scene + 1]]

    def among_all(self, scene: int, prim: Tensor) -> Tensor:
        """The numbers among all of primitives ``(N,)`` int64 as a scene's own search gives them; -1 stays."""
        own = self.own(scene)
        if not len(own):
            return prim
        number = take(own, prim.clamp(0, len(own) - 1))
        if self.shifts is not None:
            number = torch.where(prim >= len(own), prim + self.shifts[scene], number)
        return torch.where(prim < 0, prim, number)

    def primitives(self, columns: Sequence[Tensor]) -> Tensor:
        """What scenes have by primitive ``(..., P)``, of all scenes."""
        return torch.cat(list(columns), -1)[..., self.order]

    def slots(self, columns: Sequence[Tensor]) -> Tensor:
        """What scenes have by primitive and copy ``(P + I,)``, of all scenes."""
        sizes = [after - before for before, after in zip(self.first, self.first[1:], strict=False)]
        own = self.primitives([column[:n] for column, n in zip(columns, sizes, strict=True)])
        if self.shifts is None:
            return own
        return torch.cat((own, *(column[n:] for column, n in zip(columns, sizes, strict=True))))
