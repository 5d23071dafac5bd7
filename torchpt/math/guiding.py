"""Guiding: draw samples of edges where earlier ones contributed.

A sample is a function of random numbers ``u (D, N)`` in the unit cube: where on the curves, in which direction. A few samples
are drawn evenly over the cube. By what they contributed the cube is halved again and again, each box across the side along
which its two halves differ most, and a box is drawn with a probability that goes with its volume and the root of the mean
square of what samples in it contributed: that would be the least variance, were the means known (Guo, Bauszat, Bikker,
Eisemann, *Primary Sample Space Path Sampling*, 2018, guide paths so). A part of the samples stays even, so what the first ones
missed is drawn as well.

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

__all__ = ["EdgeGuide", "Guide", "Memory", "Observations", "Round", "guide_of", "rounds"]

#: Part of the guided samples that are drawn evenly.
_EVEN = 0.5
#: Times that the cube is halved, and the fewest samples of a box that is.
_HALVINGS, _FEWEST = 9, 24
#: One sample in so many is of the first round, at most and at least so many in all; fewer are not worth one, unless its samples
#: are kept for later calls.
_FIRST_OF, _MOST_FIRST, _LEAST_FIRST = 8, 1 << 13, 1 << 9
#: So many samples of an even round count as one of a guided round.
_GAIN = 3.0
#: Samples that a memory keeps.
_KEPT = 1 << 15
#: Odd number that takes seeds apart (the golden ratio's, as in Steele, Lea, Flood 2014), and the number of seeds.
_STRIDE, _SEEDS = 0x9E3779B97F4A7C15, 1 << 63


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
class Observations:
    """Samples, and what each of them contributed.

    Attributes:
        u: their numbers ``(D, N)``.
        inverse: one over the density of these ``(N,)``.
        contribution: ``(N,)``, not negative.
    """

    u: Tensor
    inverse: Tensor
    contribution: Tensor


def guide_of(seen: Observations) -> Guide | None:
    """Return the guide that is learned from samples; None where they contributed nothing."""
    device = seen.u.device
    u, inverse, square = (x.double().cpu() for x in (seen.u, seen.inverse, seen.contribution.square()))
    square = square * inverse
    if not bool((square > 0).any()):
        return None
    dimensions = len(u)
    low, size = torch.zeros_like(u[:, :1]), torch.ones_like(u[:, :1])
    box = torch.zeros_like(u[0], dtype=torch.int64)
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
        above[axis, torch.arange(len(which), device=u.device)] += size[axis, which]
        low, size = torch.cat((low, above), 1), torch.cat((size, take(size, which)), 1)
    boxes, volume = low.shape[1], size.prod(0)
    mean = torch.bincount(box, square, boxes) / torch.bincount(box, inverse, boxes)
    weight = volume * mean.sqrt()
    # In the order of the first number, of which the choice is made: what is even over it stays so.
    order = low[0].argsort(stable=True)
    pmf, low, size = rows(((1.0 - _EVEN) * weight / weight.sum() + _EVEN * volume, low, size), order)
    return Guide(Distribution1D.of(pmf.to(device), torch.float64, even=0.0), low.to(device), size.to(device))


class Memory:
    """Keeps the latest observations of one estimator, and the guide that is learned from them.

    Attributes:
        guide: None: no sample has contributed anything yet.
    """

    def __init__(self) -> None:
        self.guide: Guide | None = None
        self._kept: Observations | None = None
        self._new = 0  # samples since the guide was made

    def add(self, seen: Observations) -> None:
        """Add observations, and make the guide anew once half of those that are kept are new.

        Each call counts by what its samples contributed beside one another: as a loss falls, all contribute less.
        """
        size = float((seen.contribution.double().square() * seen.inverse).mean().sqrt())
        if not 0.0 < size < math.inf:
            return
        seen = replace(seen, contribution=seen.contribution / size)
        if self._kept is not None:
            seen = map_leaves(lambda *parts: torch.cat(parts, -1)[..., -_KEPT:], self._kept, seen)
        self._new += seen.u.shape[1] - (0 if self._kept is None else self._kept.u.shape[1])
        self._kept = seen
        if self.guide is None or 2 * self._new >= seen.u.shape[1]:
            self.guide, self._new = guide_of(seen), 0


class EdgeGuide:
    """Remembers which samples of edges contributed to earlier gradients, so that later ones draw more of their kind.

    ``edge_guide=`` of :func:`torchpt.render` takes it. One object is for the renders of one optimization, of one scene by the
    same parameters, one after the other; not for several threads at once. No mean changes. But a gradient then depends on
    those before it, also where its seed is the same: a run that begins with a new object repeats, a single call does not.
    """

    def __init__(self) -> None:
        self._memories: dict[tuple[str, torch.device], Memory] = {}
        self._calls = 0

    def next_seed(self, seed: int) -> int:
        """Return the seed of the next call's samples of edges.

        Calls of one seed get different samples: those that a guide was learned from must not be drawn by it again.
        """
        self._calls += 1
        return (seed + (self._calls - 1) * _STRIDE) % _SEEDS

    def memory(self, name: str, device: torch.device) -> Memory:
        """Return the memory of an estimator, whose samples are on a device."""
        return self._memories.setdefault((name, device), Memory())

    def __repr__(self) -> str:
        """Return the number of calls, and the estimators of which something is known."""
        known = ", ".join(name for (name, _), memory in self._memories.items() if memory.guide)
        return f"EdgeGuide({self._calls} calls{': ' if known else ''}{known})"


@dataclass(frozen=True)
class Round:
    """A part of a call's samples, drawn alike.

    Attributes:
        first: number of its first sample.
        count: number of its samples.
        share: weight of its mean in the estimate; those of all rounds add up to 1.
        guide: by which they are drawn; None: evenly.
        memory: the estimator's, if it learns from them; else None.
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

    def record(self, u: Tensor, weight: Tensor, contribution: Tensor) -> None:
        """Let the memory learn what samples contributed ``(N,)``, weights included; ``u`` and ``weight`` are as drawn."""
        assert self.memory is not None
        self.memory.add(Observations(u, weight * (self.count / self.share), contribution / weight))


def rounds(total: int, memory: Memory | None = None) -> Iterator[Round]:
    """Yield the rounds of so many samples; from the first one is learned where to draw the others.

    Args:
        total: number of samples.
        memory: what earlier calls have learned, which goes on to learn; None: nothing is known, and nothing is kept.
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
