"""The measures of one picture against a reference that is noisy itself.

Of a picture x and a reference r that are independent, ``E (x - r)² = var x + var r + bias²``. The second is known by pixel and
taken off, so that what is left is the picture's own error (and may, by chance, be negative where that is small).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.images import colour, metrics
from torchpt.reports.reference import Truth

__all__ = ["error_map", "measures", "mse", "relmse", "relmse_trimmed"]


def error_map(image: Tensor, truth: Truth) -> Tensor:
    """``(x - r)² / (r² + 0.01)``, the mean of the channels: ``(H, W)``."""
    return metrics.error_map("relmse", image, truth.image)


def relmse(image: Tensor, truth: Truth) -> float:
    """Relative mean squared error without the reference's part."""
    return float((((image - truth.image).square() - truth.variance) * truth.weight).mean())


def relmse_trimmed(image: Tensor, truth: Truth) -> float:
    """The same without the 0.1 % of pixels that are furthest off (rounded down)."""
    found, own = error_map(image, truth).flatten(), (truth.variance * truth.weight).mean(-1).flatten()
    if not torch.isfinite(found).all():
        return math.nan
    return float((found - own)[metrics.trimmed(found)].mean())


def mse(image: Tensor, truth: Truth) -> float:
    """Mean squared error without the reference's part."""
    return float(((image - truth.image).square() - truth.variance).mean())


_SQUARED: dict[str, Callable[[Tensor, Truth], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
}
_SHOWN = ("psnr", "ssim")


def measures(image: Tensor, truth: Truth, names: tuple[str, ...], film: Any) -> Mapping[str, float]:
    """The measures by name; NaN where one has no value, as SSIM of a picture smaller than its window.

    Args:
        image: ``(H, W, 3)`` float64, linear.
        truth: the reference.
        names: which.
        film: how a screen shows it (exposure, tonemap, gamma): what PSNR and SSIM look at.
    """
    found: dict[str, float] = {}
    plain = shown = image, truth.image
    if set(_SHOWN) & set(names):
        shown = colour.display(image, film.exposure, film.tonemap, film.gamma), truth.shown(film)
    for name in names:
        pair = shown if name in _SHOWN else plain
        try:
            found[name] = _SQUARED[name](image, truth) if name in _SQUARED else metrics.METRICS[name](*pair)
        except ValueError:
            found[name] = math.nan
    return found
