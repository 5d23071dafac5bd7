"""How adaptive sampling shares samples out: more for blocks of pixels whose error falls most by them.

A pixel of n samples whose relative variance is ``e`` has ``s = sqrt(e n)`` a sample; for so many samples in all the sum of
``s² / n`` over pixels is least where n goes with s. What ``e`` is, pilots say, one a block (:func:`foreseen`).
Other pixels are not asked, so none of them owes its number of samples to its own value. Numbers are powers of two times the
first one, as Sobol' points are at their best there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.core.threads import sum_all

__all__ = ["foreseen", "shared_out"]

#: No block of pixels takes more than this many times its samples at once: it is known by few pilots.
GROWTH = 4
#: Errors below this part of the mean count as much: what no pilot has met yet may be there all the same.
FLOOR = 0.05
#: Errors up to this quantile are taken as what pilots around have, too.
ORDINARY = 0.95


def foreseen(errors: Tensor, known: Tensor) -> Tensor:
    """What blocks are expected to have of an error ``(R, C)`` that single pilots tell, where blocks are ``known (R, C)``.

    Most pilots tell of the noise around them. The few large ones may be an edge, or rare samples that are as likely elsewhere:
    where they gathered by chance, samples would be taken from where the next ones will be. So what errors have above the 95th
    percentile is believed only as far as the pilots around foretell it, by regression; the rest of it all blocks share. Where
    no block is known nothing is expected of any.
    """
    if not bool(known.any()):
        return torch.zeros_like(errors)
    body = torch.minimum(errors, errors[known].quantile(ORDINARY))
    tail = torch.where(known, errors - body, 0.0)
    mean = sum_all(tail) / sum_all(known.double())
    told = _smoothed(tail, known, own=False) - mean
    apart = torch.where(known, told, 0.0)
    below = float(sum_all(apart.square()))
    trust = min(max(float(sum_all(apart * (tail - mean))) / below, 0.0), 1.0) if below > 0.0 else 0.0
    return _smoothed(body, known) + mean + trust * (_smoothed(tail, known) - mean)


def _smoothed(values: Tensor, known: Tensor, own: bool = True) -> Tensor:
    """Means ``(R, C)`` over 5 x 5 blocks with binomial weights, of the blocks that are ``known``; the mean of all elsewhere.

    Without ``own`` a block has no part in its own mean.
    """
    kernel = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=values.dtype)

    def spread(x: Tensor) -> Tensor:
        for axis in (0, 1):
            wide = torch.nn.functional.pad(x, (2, 2, 0, 0) if axis else (0, 0, 2, 2))
            size = x.shape[axis]
            parts = [kernel[k] * wide.narrow(axis, k, size) for k in range(5)]
            x = parts[0] + parts[1] + parts[2] + parts[3] + parts[4]
        return x

    there = known.to(values.dtype)
    weight, total = spread(there), spread(values * there)
    if not own:
        centre = kernel[2].square() * there
        weight, total = weight - centre, total - centre * values
    mean = sum_all(values * there) / sum_all(there).clamp_min(1.0)
    return torch.where(weight > 0, total / weight.clamp_min(1e-30), mean)


def shared_out(error: Tensor, counts: Tensor, pixels: Tensor, mean: float, last: bool = False) -> Tensor:
    """Samples a pixel that blocks are to have ``(B,)`` int64: those they have, twice or four times as many.

    In the ``last`` round what cannot double any more is filled up by halves, quarters, ... of what blocks have, so that less is
    left over than a sample of the smallest block's pixels.

    Args:
        error: relative variance of the pixels of each block ``(B,)`` float64, at its present number of samples.
        counts: that number ``(B,)`` int64.
        pixels: of each block ``(B,)``.
        mean: samples a pixel over the picture that there are to be, at most.
        last: whether no round follows.
    """
    positive = error.clamp_min(0.0)
    floor = FLOOR * sum_all(positive * pixels) / sum_all(pixels.double())
    need = (positive.clamp_min(floor) * counts).sqrt()
    have, most = counts.double(), (GROWTH * counts).double()
    total = mean * float(sum_all(pixels.double()))
    if not bool((need > 0).any()):
        need = torch.ones_like(need)
    low, high = 0.0, float((most / need.clamp_min(1e-30)).max())
    for _ in range(60):  # the number of samples a unit of need at which they come to the total
        middle = 0.5 * (low + high)
        if float(sum_all(torch.minimum(torch.maximum(have, middle * need), most) * pixels)) < total:
            low = middle
        else:
            high = middle
    wanted = torch.minimum(torch.maximum(have, low * need), most) / have
    doubled = wanted.log2().add(1e-9).floor().clamp(0, 2).long()
    aims = counts << doubled
    # What is left goes to those that are furthest below what they want, as far as it reaches.
    order = (wanted / (1 << doubled)).argsort(descending=True, stable=True)
    order = order[doubled[order] < 2]
    spent = ((aims * pixels)[order]).cumsum(0)
    left = total - float((aims * pixels).sum())
    aims[order[spent <= left]] *= 2
    return _filled_up(aims, wanted * have, pixels, total) if last else aims


def _filled_up(aims: Tensor, wanted: Tensor, pixels: Tensor, total: float) -> Tensor:
    """Numbers of samples ``(B,)`` that come to ``total`` over all pixels, as nearly as whole samples of blocks do.

    Args:
        aims: to begin with.
        wanted: what blocks would have if that need not be whole: those that are furthest below it come first.
        pixels: of each block.
        total: samples in all.
    """
    order, halvings = (wanted / aims).argsort(descending=True, stable=True), 0
    while True:
        halvings += 1
        more = (aims >> halvings).clamp_min(1)
        spent = (more * pixels)[order].cumsum(0)
        fits = order[spent <= total - float((aims * pixels).sum())]
        aims[fits] += more[fits]
        if not len(fits) and int(more.max()) == 1:
            return aims
