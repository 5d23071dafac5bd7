"""Whether pictures converge to their reference: is the error of their mean more than chance explains?

The picture is cut into tiles, since a mean over many pixels is nearly normal where a pixel is not, and independent runs give
a variance of each tile's mean. Without bias

    F = Σ w (mean of runs - reference)² / Σ w (variance of that mean + variance of the reference)

has expectation 1 and nearly the distribution of Fisher's F, whose degrees of freedom follow from the variances (Box 1954,
*Some theorems on quadratic forms*, theorem 3.1; Satterthwaite 1946). It finds what is moved from place to place; light that is
lost everywhere shows sooner in the mean over the picture. A firefly does not alarm either: it raises both sums.

All channels and sizes of tiles are tested; the least chance among them, times their number (Bonferroni), is the verdict's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.images.metrics import relative
from torchpt.reports.reference import Truth
from torchpt.reports.statistics import f_tail, t_quantile

__all__ = ["SIGNIFICANCE", "Verdict", "bias_of", "tiles"]

#: A right renderer is flagged with at most this chance.
SIGNIFICANCE = 1e-3
#: Tiles along each side.
_GRIDS = (1, 4, 16)
#: Share of a value by which equal pictures may differ in rounding.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Verdict:
    """What the test found.

    Attributes:
        biased: whether chance is ruled out.
        chance: of a difference at least as large without bias.
        squared: the mean picture's relative squared error beyond what variance explains: where the error curve ends.
        share: of the picture's light that is too much (negative: missing), with its 95 % interval.
        low: see ``share``.
        high: see ``share``.
    """

    biased: bool
    chance: float
    squared: float
    share: float
    low: float
    high: float

    def plain(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def tiles(image: Tensor, count: int) -> Tensor:
    """Means over ``count x count`` parts of a picture ``(H, W, C)``, no pixel in two of them: ``(C, count²)``."""
    high, wide, channels = image.shape
    rows, columns = torch.arange(high) * count // high, torch.arange(wide) * count // wide
    cells = (rows[:, None] * count + columns).flatten()
    sums = torch.zeros(channels, count * count, dtype=image.dtype).index_add_(1, cells, image.movedim(-1, 0).flatten(1))
    return sums / torch.bincount(cells, minlength=count * count)


def bias_of(runs: Sequence[Tensor], truth: Truth, more: float = 0.0) -> Verdict:
    """Test independent pictures ``(H, W, 3)`` of one setting against their reference.

    Args:
        runs: two or more.
        truth: the reference; a file without variances is taken to be exact.
        more: how many times the samples of all runs together the reference has, where that is known: it has seen rare bright
            paths of which the runs may have had none, so the runs' variance is not believed to be less than its own at as
            many samples.
    """
    high, wide = truth.image.shape[:2]
    grids = [count for count in _GRIDS if count == 1 or min(high, wide) >= 2 * count]
    chances: list[float] = []
    for known_by in (0.0, more):
        sides = [_compared(torch.stack([tiles(x, n) for x in runs]), *_known(truth, n), known_by) for n in grids]
        found = [chance for side in sides[1:] for chance in _of_squares(side)] + _of_sums(sides[0], sides[-1])
        chances = [max(pair) for pair in zip(chances, found, strict=True)] if chances else found
    chance = min(1.0, min(chances) * len(chances))
    stack = torch.stack(list(runs))
    mean, variance = stack.mean(0), stack.var(0) / len(runs)
    squared = float((((mean - truth.image).square() - variance - truth.variance) * truth.weight).mean())
    return Verdict(chance < SIGNIFICANCE, chance, squared, *_share(runs, truth))


def _known(truth: Truth, count: int) -> tuple[Tensor, Tensor, float]:
    """Tiles of the reference, the variance of each, and its degrees of freedom."""
    if len(truth.runs) > 1:
        own = torch.stack([tiles(run, count) for run in truth.runs])
        return own.mean(0), own.var(0) / len(own), len(own) - 1.0
    pixels = truth.image[..., 0].numel() / count**2
    return tiles(truth.image, count), tiles(truth.variance, count) / pixels, math.inf


@dataclass(frozen=True)
class _Side:
    """Tiles ``(C, tiles)`` of both: their difference, its variance with the degrees of freedom, and their weight."""

    away: Tensor
    variance: Tensor
    freedom: Tensor
    weight: Tensor


def _compared(own: Tensor, reference: Tensor, known: Tensor, freedom: float, more: float) -> _Side:
    """``own`` is ``(runs, C, tiles)``; with ``more`` the variance is all the reference's."""
    count, rounding = len(own), (_ROUNDING * reference.abs()).square()
    if more > 0:
        total = (1.0 + more) * known + rounding
        return _Side(own.mean(0) - reference, total, torch.full_like(total, freedom), relative(1.0, reference))
    spread = own.var(0) / count + rounding
    total = spread + known
    freedoms = total.square() / (spread.square() / (count - 1.0) + known.square() / freedom).clamp_min(1e-300)
    freedoms = freedoms.clamp_min(min(count - 1.0, freedom))  # never less; black in all, it would be 0 of 0
    return _Side(own.mean(0) - reference, total, freedoms, relative(1.0, reference))


def _of_squares(side: _Side) -> list[float]:
    """The chance of each channel's F."""
    found = []
    for x, u, d, w in zip(side.away, side.variance, side.freedom, side.weight, strict=True):
        explained = w * u
        if not float(explained.sum()) > 0:  # black in every run and in the reference
            found.append(0.0 if float(x.abs().max()) > 0 else 1.0)
            continue
        squares = (explained.square() * d / (d + 2.0)).sum()  # u² alone is too large by what u itself varies
        upper = (explained.sum().square() / squares).clamp(1.0, float(len(x)))
        ratio = (w * x.square()).sum() / explained.sum()
        found.append(f_tail(float(ratio), float(upper), _freedom(explained, d)))
    return found


def _of_sums(whole: _Side, fine: _Side) -> list[float]:
    """The chance of each channel's mean over the picture.

    Its variance is known twice: from how the runs' means spread, by few degrees of freedom, and from tiles, by many, where
    those are independent. The larger one counts.
    """
    found = []
    for x, u, parts, d in zip(whole.away, whole.variance, fine.variance, fine.freedom, strict=True):
        pooled = float(parts.sum()) / len(parts) ** 2
        variance = max(float(u), pooled)
        if not variance > 0:
            found.append(0.0 if float(x.abs()) > 0 else 1.0)
            continue
        found.append(f_tail(float(x.square()) / variance, 1.0, _freedom(parts, d)))
    return found


def _freedom(parts: Tensor, freedom: Tensor) -> float:
    """Of a sum of variances (Satterthwaite)."""
    return min(float(parts.sum().square() / (parts.square() / freedom).sum().clamp_min(1e-300)), 1e5)


def _share(runs: Sequence[Tensor], truth: Truth) -> tuple[float, float, float]:
    """How much too bright the whole is, relative, with its interval (Welch)."""
    own = torch.stack([run.mean() for run in runs])
    light = float(truth.image.mean())
    if not light > 0:
        return 0.0, 0.0, 0.0
    spread = float(own.var()) / len(own)
    made = torch.stack([run.mean() for run in truth.runs]) if len(truth.runs) > 1 else None
    known = float(made.var()) / len(made) if made is not None else float(truth.variance.mean()) / truth.image.numel()
    share = float(own.mean()) / light - 1.0
    total = spread + known
    if total == 0:
        return share, share, share
    rest = known**2 / (len(made) - 1.0) if made is not None else 0.0
    freedom = min(total**2 / max(spread**2 / (len(own) - 1.0) + rest, 1e-300), 1e6)
    reach = t_quantile(freedom) * math.sqrt(total) / light
    return share, share - reach, share + reach
