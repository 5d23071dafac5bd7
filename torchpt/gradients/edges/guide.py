"""Guiding: samples of edges are drawn where the first of them brought something.

A sample is a function of random numbers ``u (D, N)`` in the unit cube: where on the curves, in which direction. A few samples
are drawn evenly over the cube. By what they brought the cube is halved again and again, each box across the side along which
its two halves differ most, and a box is drawn with a probability that goes with its volume and the root of the mean square of
what samples in it brought: that would be the least variance, were the means known (cf. Guo, Bauszat, Bikker, Eisemann,
*Primary Sample Space Path Guiding*, 2018). A part of the samples stays even, so what the first ones missed is drawn as well.

The first samples count for the gradient too, with a weight that does not depend on them: each part has the right mean.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import take

__all__ = ["Guide", "Lesson", "Round"]

#: Part of the guided samples that are drawn evenly.
_EVEN = 0.25
#: Times that the cube is halved, and the fewest samples of a box that is.
_HALVINGS, _FEWEST = 9, 24


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


@dataclass
class Lesson:
    """What samples brought.

    Attributes:
        u: their numbers ``(D, N)``, even over the cube, chunk by chunk.
        brought: ``(N,)`` not negative, chunk by chunk.
    """

    u: list[Tensor] = field(default_factory=list[Tensor])
    brought: list[Tensor] = field(default_factory=list[Tensor])

    def add(self, u: Tensor, brought: Tensor) -> None:
        """Add samples."""
        self.u.append(u)
        self.brought.append(brought)

    def guide(self) -> Guide | None:
        """Return what the samples teach; None where nothing was brought."""
        u, square = torch.cat(self.u, 1), torch.cat(self.brought).double().square()
        return guide_of(u, square) if bool((square > 0).any()) else None


def guide_of(u: Tensor, square: Tensor) -> Guide:
    """Return the guide by numbers ``(D, N)``, even over the cube, and the squares ``(N,)`` of what they brought."""
    dimensions = len(u)
    low, size = torch.zeros(dimensions, 1, dtype=torch.float64), torch.ones(dimensions, 1, dtype=torch.float64)
    box = torch.zeros(u.shape[1], dtype=torch.int64)
    for _ in range(_HALVINGS):
        boxes = low.shape[1]
        count = torch.bincount(box, minlength=boxes)
        middle = low + 0.5 * size
        upper = u >= take(middle, box)  # (D, N)
        # Of each way to halve each box: the sum of both halves' roots, which is the less the more they differ.
        each = box + boxes * upper.long()
        counts = torch.stack([torch.bincount(row, minlength=2 * boxes) for row in each]).view(dimensions, 2, boxes)
        sums = torch.stack([torch.bincount(row, square, 2 * boxes) for row in each]).view(dimensions, 2, boxes)
        roots = (sums / counts.clamp_min(1)).sqrt().sum(1)
        axis = torch.where((counts > 0).all(1), roots, torch.inf).argmin(0)
        halved = (count >= _FEWEST) & (counts.amin(1).gather(0, axis[None])[0] > 0)
        if not bool(halved.any()):
            break
        new = torch.where(halved, torch.cumsum(halved.long(), 0) - 1 + boxes, torch.arange(boxes))
        mine = upper.gather(0, take(axis, box)[None])[0] & take(halved, box)
        box = torch.where(mine, take(new, box), box)
        which = halved.nonzero().squeeze(1)
        along = take(axis, which)
        half = 0.5 * size[along, which]
        size[along, which] = half
        more = take(low, which)
        more[along, torch.arange(len(which))] += half
        low, size = torch.cat((low, more), 1), torch.cat((size, take(size, which)), 1)
    boxes, volume = low.shape[1], size.prod(0)
    mean = torch.bincount(box, square, boxes) / torch.bincount(box, minlength=boxes).clamp_min(1)
    weight = volume * mean.sqrt()
    # In the order of the first number: what is even over it stays so.
    order = low[0].argsort(stable=True)
    pmf = take((1.0 - _EVEN) * weight / weight.sum() + _EVEN * volume, order)
    return Guide(Distribution1D.of(pmf, torch.float64, even=0.0), take(low, order), take(size, order))


@dataclass(frozen=True)
class Round:
    """Samples that are drawn alike.

    Attributes:
        first: number of the first.
        count: how many they are.
        share: of the estimate.
        guide: by which they are drawn; None: evenly.
        lesson: what they teach; None: nothing.
    """

    first: int
    count: int
    share: float
    guide: Guide | None = None
    lesson: Lesson | None = None

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return numbers by even ones ``u (D, N)``, and what each of them weighs ``(N,)``."""
        scale = self.share / self.count
        if self.guide is None:
            return u, torch.full_like(u[0], scale)
        u, inverse = self.guide.draw(u)
        return u, inverse * scale

    def learn(self, u: Tensor, brought: Tensor) -> None:
        """Note what samples brought ``(N,)``, by their even numbers ``(D, N)``, over what each weighs."""
        if self.lesson is not None:
            self.lesson.add(u, brought)
