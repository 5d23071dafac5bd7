"""How far a picture is from its reference, as one number: each measure is a function, and :data:`METRICS` names them.

All take linear RGB ``(H, W, 3)`` of one size, on any device and of any floating type, and count in float64. ``mse relmse
smape flip`` take radiance as it is; ``psnr`` and ``ssim`` are about values from 0 to ``peak``, so hand them what a screen
shows (``torchpt.images.colour.display``). Where a picture holds a value that is not finite, so does the result.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["METRICS", "flip", "mse", "psnr", "relmse", "smape", "ssim"]


def _pair(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    return image.detach().cpu().double(), reference.detach().cpu().double()


def mse(image: Tensor, reference: Tensor) -> float:
    """Mean squared error over pixels and channels: 0 for equal pictures.

    Raises:
        ValueError: pictures of two sizes (so do all of these).
    """
    x, ref = _pair(image, reference)
    return float(((x - ref) ** 2).mean())


def relmse(image: Tensor, reference: Tensor, floor: float = 1e-2) -> float:
    """Relative mean squared error: the mean of ``(x - ref)² / (ref² + floor)`` (Rousselle et al. 2011, section 4.2)."""
    x, ref = _pair(image, reference)
    return float(((x - ref) ** 2 / (ref**2 + floor)).mean())


def smape(image: Tensor, reference: Tensor, floor: float = 1e-2) -> float:
    """Symmetric mean absolute percentage error, 0..1: the mean of ``|x - ref| / (|x| + |ref| + floor)``.

    Vogels et al. 2018, *Denoising with Kernel Prediction and Asymmetric Loss Functions*, equation 3. Unlike `relmse` it is
    not carried by a few bright pixels.
    """
    x, ref = _pair(image, reference)
    return float(((x - ref).abs() / (x.abs() + ref.abs() + floor)).mean())


def psnr(image: Tensor, reference: Tensor, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in decibels, of values 0..``peak``; infinite for equal pictures."""
    from kornia.metrics import psnr as kornia_psnr

    x, ref = _pair(image, reference)
    return float(kornia_psnr(x, ref, float(peak)))


def ssim(image: Tensor, reference: Tensor, peak: float = 1.0, window: int = 11) -> float:
    """Mean structural similarity of values 0..``peak`` (Wang et al. 2004): 1 for equal pictures.

    Over all windows that lie within the picture, of ``window`` pixels (an odd number) and a Gaussian of 1.5 pixels.

    Raises:
        ValueError: a picture smaller than the window.
    """
    from kornia.metrics import ssim as kornia_ssim

    x, ref = _pair(image, reference)
    if min(x.shape[:2]) < window:
        raise ValueError(f"ssim looks through windows of {window} pixels, more than the picture has: {tuple(x.shape)}")
    x, ref = x.movedim(-1, 0)[None], ref.movedim(-1, 0)[None]
    return float(kornia_ssim(x, ref, window, float(peak), eps=0.0, padding="valid").mean())


def flip(image: Tensor, reference: Tensor) -> float:
    """Mean HDR-FLIP, 0..1: how visible differences are when one alternates the two, at the exposures that matter.

    Andersson et al. 2021, *Visualizing Errors in Rendered High Dynamic Range Images*, by the authors' own evaluator, at 67
    pixels a degree. Negative values count as 0.

    Raises:
        ImportError: the package ``flip-evaluator`` (extra ``compare``) is not installed.
        ValueError: a reference that is black: it has no exposure.
    """
    x, ref = _pair(image, reference)
    if not (torch.isfinite(x).all() and torch.isfinite(ref).all()):
        return math.nan
    try:
        import flip_evaluator
    except ImportError:
        raise ImportError(
            "torchpt.metrics.flip needs the package flip-evaluator: pip install 'torchpt-renderer[compare]'"
        ) from None
    arrays = [values.clamp(min=0).float().contiguous().numpy() for values in (ref, x)]
    if not float(arrays[0].max()) > 1e-5:  # below it the evaluator ends the process
        raise ValueError("flip: the reference is black, so there is no exposure to look at it by")
    return float(flip_evaluator.evaluate(arrays[0], arrays[1], "HDR", applyMagma=False)[1])


#: Name -> measure. Smaller is better, except for ``psnr`` and ``ssim``.
METRICS: dict[str, Callable[[Tensor, Tensor], float]] = {
    "relmse": relmse,
    "mse": mse,
    "smape": smape,
    "psnr": psnr,
    "ssim": ssim,
    "flip": flip,
}
