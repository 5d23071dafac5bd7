"""From scene-linear radiance to display values and back: exposure, tone curve, transfer function.

All functions take and return float tensors of any shape (colours in the last axis, RGB with the primaries of sRGB).
Linear radiance is unbounded; display values lie in 0..1.

Colour libraries have the same functions, and tests compare these with kornia's. They stand here because every picture needs
them: powers are computed in pieces, so that a picture has the same bits on any number of threads, and importing kornia takes
longer than a small render.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.core.threads import map_in_pieces

__all__ = ["TONEMAPS", "display", "linear_to_srgb", "srgb_to_linear"]

# Above this every curve is white; below it no curve overflows float32 when it squares.
_LARGEST_RADIANCE = 1e9


def _power(x: Tensor, exponent: float) -> Tensor:
    """Return ``x ** exponent``, computed in pieces on several threads."""
    return map_in_pieces(lambda piece: piece**exponent, x)


def linear_to_srgb(x: Tensor) -> Tensor:
    """Encode linear values as sRGB (IEC 61966-2-1); negative values become 0."""
    x = x.clamp(min=0)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * _power(x.clamp(min=0.0031308), 1 / 2.4) - 0.055)


def srgb_to_linear(x: Tensor) -> Tensor:
    """Decode sRGB values to linear values (IEC 61966-2-1)."""
    return torch.where(x <= 0.04045, x / 12.92, _power((x.clamp(min=0.04045) + 0.055) / 1.055, 2.4))


def _reinhard(x: Tensor) -> Tensor:
    """Apply the curve of Reinhard et al. 2002, equation 3, to each channel, so that values stay in 0..1."""
    return x / (1 + x)


def _aces(x: Tensor) -> Tensor:
    """Apply Narkowicz 2015, "ACES filmic tone mapping curve": a fit of the ACES reference transforms."""
    return (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)


def _filmic(x: Tensor) -> Tensor:
    """Apply Hable 2010, "Filmic tonemapping operators" (Uncharted 2), with exposure bias 2 and white point 11.2."""

    def curve(v: Tensor) -> Tensor:
        # Hable's names: shoulder strength, linear strength, linear angle, toe strength, toe numerator, toe denominator.
        a, b, c, d, e, f = 0.15, 0.50, 0.10, 0.20, 0.02, 0.30
        return (v * (a * v + c * b) + d * e) / (v * (a * v + b) + d * f) - e / f

    return curve(2 * x) / curve(torch.tensor(11.2, dtype=x.dtype, device=x.device))


#: Tone curves by name.
TONEMAPS: dict[str, Callable[[Tensor], Tensor]] = {
    "none": lambda x: x,
    "reinhard": _reinhard,
    "aces": _aces,
    "filmic": _filmic,
}


def display(image: Tensor, exposure: float = 0.0, tonemap: str = "none", gamma: str | float = "srgb") -> Tensor:
    """Convert linear radiance to display values in 0..1.

    Args:
        image: linear RGB, any shape. NaN and negative values become black, infinity white.
        exposure: stops; every stop doubles the light before the tone curve.
        tonemap: a key of `TONEMAPS`.
        gamma: ``"srgb"``, or an exponent g: the output is ``linear ** g`` (for example 0.6, or 1/2.2).

    Returns:
        A float tensor of the same shape.

    Raises:
        SceneError: an unknown tone curve or gamma.
    """
    if tonemap not in TONEMAPS:
        raise SceneError("film.tonemap", tonemap, f"one of {', '.join(TONEMAPS)}")
    if gamma != "srgb" and (isinstance(gamma, str) or not gamma > 0):
        raise SceneError("film.gamma", gamma, "'srgb' or an exponent > 0")
    x = torch.nan_to_num(image, nan=0.0, posinf=_LARGEST_RADIANCE).clamp(0, _LARGEST_RADIANCE)
    x = TONEMAPS[tonemap]((x * 2.0**exposure).clamp(max=_LARGEST_RADIANCE)).clamp(0, 1)
    return linear_to_srgb(x) if gamma == "srgb" else _power(x, float(gamma))
