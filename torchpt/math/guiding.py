"""Guiding: samples of edges are drawn where the first of them brought something.

A sample is a function of random numbers ``u (D, N)`` in the unit cube: where on the curves, in which direction. A few samples
are drawn evenly over the cube. By what they brought the cube is halved again and again, each box across the side along which
its two halves differ most, and a box is drawn with a probability that goes with its volume and the root of the mean square of
what samples in it brought: that would be the least variance, were the means known (Guo, Bauszat, Bikker, Eisemann, *Primary
Sample Space Path Sampling*, 2018, guide paths so). A part of the samples stays even, so what the first ones missed is drawn as
well.

The first samples count for the gradient too, with a weight that does not depend on them: each part has the right mean.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import map_leaves, rows, take

__all__ = ["EdgeGuide", "Guide", "Lesson", "Memory", "Round", "guide_of", "rounds"]

#: Part of the guided samples that are drawn evenly.
_EVEN = 0.5
#: Times that the cube is halved, and the fewest samples of a box that is.
_HALVINGS, _FEWEST = 9, 24
#: One sample in so many is of the first round, but neither more nor fewer than so many in all.
_FIRST_OF, _MOST_FIRST, _LEAST_FIRST = 8, 1 << 13, 1 << 9
#: So many samples of an even round count as one of a guided round.
_GAIN = 3.0
#: Samples that a memory keeps.
_KEPT = 1 << 15


@dataclass(frozen=True)
class Guide:
    """Boxes of the unit cube, and the choice of one.

    Attributes:
        choice: of a box.
        low: ``(D, L)`` corners of the boxes.
        size: ``(D, L)`` of their sides.
    """

    choice: Distribution1D
    low: Tensor
    size: Tensor

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return numbers by even ones ``u (D, N)``, and one over their density ``(N,)``."""
        index, rest = self.choice.draw(u[0])
        low, size = take(self.low, index), take(self.size, index)
        u = torch.cat((rest[None], u[1:]))
        return low + u * size, size.prod(0) / take(self.choice.pmf, index)


@dataclass(frozen=True)
class Lesson:
    """What samples teach.

    Attributes:
        u: their numbers ``(D, N)``.
        inverse: one over the density of these ``(N,)``.
        brought: what each of them brought ``(N,)``, not negative.
    """

    u: Tensor
    inverse: Tensor
    brought: Tensor


def guide_of(lesson: Lesson) -> Guide | None:
    """Return the guide that samples teach; None where they brought nothing."""
    u, inverse, square, device = (
        lesson.u.cpu(),
        lesson.inverse.cpu(),
        lesson.brought.double().square().cpu(),
        lesson.u.device,
    )
    square = square * inverse
    if not bool((square > 0).any()):
        return None
    dimensions = len(u)
    low, size = torch.zeros(dimensions, 1, dtype=torch.float64), torch.ones(dimensions, 1, dtype=torch.float64)
    box = torch.zeros(u.shape[1], dtype=torch.int64)
    for _ in range(_HALVINGS):
        boxes = low.shape[1]
        upper = u >= take(low + 0.5 * size, box)
        # Of each way to halve each box: the sum of the halves' roots, which is the less the more they differ.
        each = box + boxes * upper.long()
        sums, volumes = (
            torch.stack([torch.bincount(row, of, 2 * boxes) for row in each]).view(dimensions, 2, boxes)
            for of in (square, inverse)
        )
        drawn = (volumes > 0).all(1)
        roots = torch.where(drawn, (sums / volumes).sqrt().sum(1), torch.inf)
        least, axis = roots.min(0)
        halved = least.isfinite() & (torch.bincount(box, minlength=boxes) >= _FEWEST)
        which = halved.nonzero().squeeze(1)
        if not len(which):
            break
        own = upper.gather(0, take(axis, box)[None])[0] & take(halved, box)
        box = torch.where(own, take(halved.cumsum(0) - 1 + boxes, box), box)
        axis = take(axis, which)
        size[axis, which] *= 0.5
        above = take(low, which)
        above[axis, torch.arange(len(which))] += size[axis, which]
        low, size = torch.cat((low, above), 1), torch.cat((size, take(size, which)), 1)
    boxes, volume = low.shape[1], size.prod(0)
    mean = torch.bincount(box, square, boxes) / torch.bincount(box, inverse, boxes)
    weight = volume * mean.sqrt()
    # In the order of the first number, of which the choice is made: what is even over it stays so.
    order = low[0].argsort(stable=True)
    pmf, low, size = rows(((1.0 - _EVEN) * weight / weight.sum() + _EVEN * volume, low, size), order)
    return Guide(Distribution1D.of(pmf.to(device), torch.float64, even=0.0), low.to(device), size.to(device))


class Memory:
    """Keeps the latest lessons of one estimator, and the guide that they taught.

    Attributes:
        guide: None: nothing was brought yet.
    """

    def __init__(self) -> None:
        self.guide: Guide | None = None
        self._kept: Lesson | None = None
        self._new = 0  # samples since the guide was made

    def add(self, lesson: Lesson) -> None:
        """Add a lesson, and make a guide of all that are kept once half of their samples are new.

        Each lesson counts by what its samples brought beside one another: as a loss falls, all of them bring less.
        """
        size = float((lesson.brought.double().square() * lesson.inverse).mean().sqrt())
        if not 0.0 < size < math.inf:
            return
        lesson = replace(lesson, brought=lesson.brought / size)
        if self._kept is None or len(self._kept.u) != len(lesson.u):
            self.guide, self._kept = None, lesson
        else:
            self._kept = map_leaves(lambda *parts: torch.cat(parts, -1)[..., -_KEPT:], self._kept, lesson)
        self._new += lesson.u.shape[1]
        if self.guide is None or 2 * self._new >= self._kept.u.shape[1]:
            self.guide, self._new = guide_of(self._kept), 0


class EdgeGuide:
    """Keeps what samples of edges brought from one gradient to the next: ``edge_guide=`` of :func:`torchpt.render`.

    One object is for the renders of one optimisation, one after the other, of one scene by the same parameters: their backward
    passes draw samples where those of earlier ones brought something. No mean changes, but the gradient of a seed then depends
    on the gradients before it; those that begin with a new object are the same in each run.
    """

    def __init__(self) -> None:
        self._memories: dict[str, Memory] = {}

    def memory(self, name: str) -> Memory:
        """Return the memory of an estimator."""
        return self._memories.setdefault(name, Memory())

    def __repr__(self) -> str:
        """Return the estimators of which something is known."""
        return f"EdgeGuide({', '.join(name for name, memory in self._memories.items() if memory.guide)})"


@dataclass(frozen=True)
class Round:
    """Samples that are drawn alike.

    Attributes:
        first: number of the first.
        count: how many they are.
        share: of the estimate.
        guide: by which they are drawn; None: evenly.
        memory: that of the estimator, which they teach; None: they teach nothing.
    """

    first: int
    count: int
    share: float = 1.0
    guide: Guide | None = None
    memory: Memory | None = None

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return numbers by even ones ``u (D, N)``, and what each of them weighs ``(N,)``."""
        scale = self.share / self.count
        if self.guide is None:
            return u, torch.full_like(u[0], scale)
        u, inverse = self.guide.draw(u)
        return u, inverse * scale

    def teach(self, u: Tensor, weight: Tensor, brought: Tensor) -> None:
        """Remember what samples brought ``(N,)``, their weights included; ``u`` and ``weight`` are as drawn."""
        if self.memory is not None:
            self.memory.add(Lesson(u, weight * (self.count / self.share), brought / weight))


def rounds(total: int, memory: Memory | None = None) -> Iterator[Round]:
    """Yield the rounds of so many samples; the first one teaches where to draw the others.

    Args:
        total: number of samples.
        memory: that of the estimator, which goes on to learn; None: nothing is known, and nothing remembered.
    """
    count = min(total // _FIRST_OF, _MOST_FIRST)
    if memory is None:
        if count < _LEAST_FIRST:
            yield Round(0, total)
            return
        memory = Memory()
    count = min(max(count, _LEAST_FIRST), total)
    rest = total - count
    gain = _GAIN if memory.guide is None else 1.0
    share = count / (count + gain * rest)
    yield Round(0, count, share, memory.guide, memory)
    if rest:
        yield Round(count, rest, 1.0 - share, memory.guide)
