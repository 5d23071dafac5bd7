"""Whether pictures converge to their reference: is the error of their mean more than chance explains?

The picture is cut into tiles, since a mean over many pixels is nearly normal where a pixel is not, and independent runs give
a variance of each tile's mean. Without bias

    F = Σ w (mean of runs - reference)² / Σ w (variance of that mean + variance of the reference)

has expectation 1 and nearly the distribution of Fisher's F, whose degrees of freedom follow from the variances (Box 1954,
*Some theorems on quadratic forms*, theorem 3.1; Satterthwaite 1946). One tile as large as the picture finds light that is lost
everywhere, small ones find what is moved from place to place. A firefly does not alarm it: it raises both sums.

All channels and sizes of tiles are tested; the least chance among them, times their number (Bonferroni), is the verdict's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.reports.reference import FLOOR, Truth
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
    """Means over ``count x count`` parts of a picture ``(H, W, C)``: ``(C, count²)``."""
    return torch.nn.functional.adaptive_avg_pool2d(image.movedim(-1, 0), count).flatten(1)


def bias_of(runs: Sequence[Tensor], truth: Truth) -> Verdict:
    """Test independent pictures ``(H, W, 3)`` of one setting against their reference.

    Args:
        runs: two or more.
        truth: the reference; a file without variances is taken to be exact.
    """
    high, wide = truth.image.shape[:2]
    chances = []
    for count in _GRIDS:
        if count == 1 or min(high, wide) >= 2 * count:
            own = torch.stack([tiles(run, count) for run in runs])
            chances += _chances(own, *_known(truth, count))
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


def _chances(own: Tensor, reference: Tensor, known: Tensor, freedom: float) -> list[float]:
    """The chance of each channel's F. ``own`` is ``(runs, C, tiles)``."""
    count = len(own)
    away, spread = own.mean(0) - reference, own.var(0) / count
    spread = spread + (_ROUNDING * reference.abs()).square()
    weight = 1.0 / (reference.square() + FLOOR)
    total = spread + known
    freedoms = total.square() / (spread.square() / (count - 1.0) + known.square() / freedom).clamp_min(1e-300)
    found = []
    for x, u, d, w in zip(away, total, freedoms, weight, strict=True):
        explained = w * u
        if not float(explained.sum()) > 0:  # black in every run and in the reference
            found.append(0.0 if float(x.abs().max()) > 0 else 1.0)
            continue
        squares = (explained.square() * d / (d + 2.0)).sum()  # u² alone is too large by what u itself varies
        upper = (explained.sum().square() / squares).clamp(1.0, float(len(x)))
        lower = explained.sum().square() / (explained.square() / d).sum()
        ratio = (w * x.square()).sum() / explained.sum()
        found.append(f_tail(float(ratio), float(upper), float(lower)))
    return found


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
