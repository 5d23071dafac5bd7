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

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import rows, take

__all__ = ["Guide", "Round", "first_round", "guide_of"]

#: Part of the guided samples that are drawn evenly.
_EVEN = 0.5
#: Times that the cube is halved, and the fewest samples of a box that is.
_HALVINGS, _FEWEST = 9, 24
#: One sample in so many is of the first round, but neither more nor fewer than so many in all.
_FIRST_OF, _MOST_FIRST, _LEAST_FIRST = 8, 1 << 13, 1 << 9
#: So many samples of the first round count as one of the second.
_GAIN = 3.0


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


def guide_of(u: Tensor, brought: Tensor) -> Guide | None:
    """Return the guide that samples teach; None where they brought nothing.

    Args:
        u: their numbers ``(D, N)``, even over the cube.
        brought: what each of them brought ``(N,)``, not negative.
    """
    square, device = brought.double().square().cpu(), u.device
    if not bool((square > 0).any()):
        return None
    u, dimensions = u.cpu(), len(u)
    low, size = torch.zeros(dimensions, 1, dtype=torch.float64), torch.ones(dimensions, 1, dtype=torch.float64)
    box = torch.zeros(u.shape[1], dtype=torch.int64)
    for _ in range(_HALVINGS):
        boxes = low.shape[1]
        upper = u >= take(low + 0.5 * size, box)
        # Of each way to halve each box: the sum of the halves' roots, which is the less the more they differ.
        each = box + boxes * upper.long()
        counts = torch.stack([torch.bincount(row, minlength=2 * boxes) for row in each]).view(dimensions, 2, boxes)
        sums = torch.stack([torch.bincount(row, square, 2 * boxes) for row in each]).view(dimensions, 2, boxes)
        roots = (sums / counts.clamp_min(1)).sqrt().sum(1)
        axis = torch.where((counts > 0).all(1), roots, torch.inf).argmin(0)
        fewest = counts.amin(1).gather(0, axis[None])[0]
        halved = (fewest > 0) & (torch.bincount(box, minlength=boxes) >= _FEWEST)
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
    mean = torch.bincount(box, square, boxes) / torch.bincount(box, minlength=boxes).clamp_min(1)
    weight = volume * mean.sqrt()
    # In the order of the first number, of which the choice is made: what is even over it stays so.
    order = low[0].argsort(stable=True)
    pmf, low, size = rows(((1.0 - _EVEN) * weight / weight.sum() + _EVEN * volume, low, size), order)
    return Guide(Distribution1D.of(pmf.to(device), torch.float64, even=0.0), low.to(device), size.to(device))


@dataclass(frozen=True)
class Round:
    """Samples that are drawn alike.

    Attributes:
        first: number of the first.
        count: how many they are.
        share: of the estimate.
        guide: by which they are drawn; None: evenly.
        lesson: takes the even numbers ``(D, N)`` of a first round's samples, and what each brought ``(N,)``.
    """

    first: int
    count: int
    share: float = 1.0
    guide: Guide | None = None
    lesson: list[tuple[Tensor, Tensor]] | None = None

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return numbers by even ones ``u (D, N)``, and what each of them weighs ``(N,)``."""
        scale = self.share / self.count
        if self.guide is None:
            return u, torch.full_like(u[0], scale)
        u, inverse = self.guide.draw(u)
        return u, inverse * scale

    def then(self, total: int) -> Round:
        """Return the round after this one, of all other samples of ``total``."""
        guide = guide_of(*self.lesson[0]) if self.lesson else None
        return Round(self.count, total - self.count, 1.0 - self.share, guide)


def first_round(total: int) -> Round | None:
    """Return the round of the samples that teach where to draw the others of ``total``; None for too few samples."""
    count = min(total // _FIRST_OF, _MOST_FIRST)
    if count < _LEAST_FIRST:
        return None
    return Round(0, count, count / (count + _GAIN * (total - count)), lesson=[])
