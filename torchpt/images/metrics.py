"""How far a picture is from its reference, as one number: each measure is a function, and :data:`METRICS` names them.

All take linear RGB ``(H, W, 3)`` of one size, on any device and of any floating type, and count in float64. ``mse relmse
relmse_trimmed smape flip`` take radiance as it is; ``psnr`` and ``ssim`` are about values from 0 to ``peak``, so hand them
what a screen shows (``torchpt.images.colour.display``). Where a picture holds a value that is not finite, so does the result.

`error_map` says where the error lies; :data:`MAPS` names the measures that have one. `relative` and `symmetric` are the
formulas value by value, for whoever has another numerator, such as a loss or an estimate of a variance.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

__all__ = [
    "FLOOR",
    "MAPS",
    "METRICS",
    "TRIMMED",
    "error_map",
    "flip",
    "mse",
    "psnr",
    "relative",
    "relmse",
    "relmse_trimmed",
    "smape",
    "ssim",
    "symmetric",
    "trimmed",
]

#: What the denominators of relMSE and SMAPE hold beside radiance, so that black pixels stay finite.
FLOOR = 1e-2
#: Share of the pixels that :func:`relmse_trimmed` leaves out.
TRIMMED = 1e-3


def relative(squared: Tensor | float, radiance: Tensor, floor: float = FLOOR) -> Tensor:
    """Return squared errors over ``radiance² + floor``, value by value: relMSE is their mean.

    Rousselle et al. 2011, *Adaptive Sampling and Reconstruction using Greedy Error Minimization*, section 4.2. Differentiable.
    """
    return squared / (radiance.square() + floor)


def symmetric(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    """Return ``|x - ref| / (|x| + |ref| + floor)``, value by value: SMAPE is their mean. Differentiable."""
    return (image - reference).abs() / (image.abs() + reference.abs() + floor)


def _pair(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    return image.detach().cpu().double(), reference.detach().cpu().double()


def _squared(image: Tensor, reference: Tensor) -> Tensor:
    x, ref = _pair(image, reference)
    return (x - ref).square()


def _relative(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    x, ref = _pair(image, reference)
    return relative((x - ref).square(), ref, floor)


def _symmetric(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    return symmetric(*_pair(image, reference), floor)


def mse(image: Tensor, reference: Tensor) -> float:
    """Mean squared error over pixels and channels: 0 for equal pictures.

    Raises:
        ValueError: pictures of two sizes (so do all of these).
    """
    return float(_squared(image, reference).mean())


def relmse(image: Tensor, reference: Tensor, floor: float = FLOOR) -> float:
    """Relative mean squared error: the mean of ``(x - ref)² / (ref² + floor)`` (Rousselle et al. 2011, section 4.2).

    A few bright outliers carry it; where the reference is black it is ``x² / floor``.
    """
    return float(_relative(image, reference, floor).mean())


def relmse_trimmed(image: Tensor, reference: Tensor, share: float = TRIMMED, floor: float = FLOOR) -> float:
    """`relmse` without the ``share`` of pixels that are furthest off.

    A pixel's error is the mean of its channels' ``(x - ref)² / (ref² + floor)``. Of N pixels the ``⌊share N⌋`` with the
    largest are left out, and the mean is over the others: by default none of fewer than 1,000 pixels, where this is
    `relmse`. Values that are not finite are not trimmed away.

    Args:
        image: ``(H, W, C)``.
        reference: the same.
        share: of the pixels, 0 or more and below 1.
        floor: as of `relmse`.

    Raises:
        ValueError: a share outside ``[0, 1)``.
    """
    if not 0 <= share < 1:
        raise ValueError(f"share: expected 0 or more and below 1, got {share!r}")
    errors = _relative(image, reference, floor).mean(-1).flatten()
    if not torch.isfinite(errors).all():
        return float(errors.mean())
    return float(errors[trimmed(errors, share)].mean())


def trimmed(errors: Tensor, share: float = TRIMMED) -> Tensor:
    """Return where the smallest of ``errors (N,)`` stand, in rising order: all but the ``⌊share N⌋`` largest."""
    left_out = math.floor(share * errors.numel() * (1 + 1e-12))  # 0.001 of 3,000 are 3, whatever the product rounds to
    return errors.argsort()[: errors.numel() - left_out]


def smape(image: Tensor, reference: Tensor, floor: float = FLOOR) -> float:
    """Symmetric mean absolute percentage error, 0..1: the mean of ``|x - ref| / (|x| + |ref| + floor)``.

    Vogels et al. 2018, *Denoising with Kernel Prediction and Asymmetric Loss Functions*, equation 3. Unlike `relmse` it is
    not carried by a few bright pixels.
    """
    return float(_symmetric(image, reference, floor).mean())


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
    return float(_similar(image, reference, peak, window, "valid").mean())


def _similar(image: Tensor, reference: Tensor, peak: float, window: int, padding: str) -> Tensor:
    """Structural similarity ``(H, W, C)`` about each pixel: mirrored at the edges ("same"), or without them ("valid")."""
    from kornia.metrics import ssim as kornia_ssim

    x, ref = _pair(image, reference)
    if min(x.shape[:2]) < window:
        raise ValueError(f"ssim looks through windows of {window} pixels, more than the picture has: {tuple(x.shape)}")
    x, ref = x.movedim(-1, 0)[None], ref.movedim(-1, 0)[None]
    return kornia_ssim(x, ref, window, float(peak), eps=0.0, padding=padding)[0].movedim(0, -1)


def flip(image: Tensor, reference: Tensor) -> float:
    """Mean HDR-FLIP, 0..1: how visible differences are when one alternates the two, at the exposures that matter.

    Andersson et al. 2021, *Visualizing Errors in Rendered High Dynamic Range Images*, by the authors' own evaluator, at 67
    pixels a degree. Negative values count as 0.

    Raises:
        ImportError: the package ``flip-evaluator`` (extra ``compare``) is not installed.
        ValueError: a reference that is black: it has no exposure.
    """
    return _flip(image, reference)[1]


def _flip(image: Tensor, reference: Tensor) -> tuple[Tensor, float]:
    """The error ``(H, W)`` and its mean."""
    x, ref = _pair(image, reference)
    if not (torch.isfinite(x).all() and torch.isfinite(ref).all()):
        return torch.full(x.shape[:2], math.nan, dtype=x.dtype), math.nan
    try:
        import flip_evaluator
    except ImportError:
        raise ImportError(
            "torchpt.metrics.flip needs the package flip-evaluator: pip install '.[compare]' in the checkout of torchpt"
        ) from None
    arrays = [values.clamp(min=0).float().contiguous().numpy() for values in (ref, x)]
    if not float(arrays[0].max()) > 1e-5:  # below it the evaluator ends the process
        raise ValueError("flip: the reference is black, so there is no exposure to look at it by")
    errors, mean, _ = flip_evaluator.evaluate(arrays[0], arrays[1], "HDR", applyMagma=False)
    return torch.from_numpy(errors)[..., 0].double(), float(mean)


#: Name -> measure. Smaller is better, except for ``psnr`` and ``ssim``.
METRICS: dict[str, Callable[[Tensor, Tensor], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
    "smape": smape,
    "psnr": psnr,
    "ssim": ssim,
    "flip": flip,
}

#: Name -> the error of each pixel, ``(H, W)``; 0 where the pictures agree.
MAPS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "relmse": lambda image, reference: _relative(image, reference).mean(-1),
    "mse": lambda image, reference: _squared(image, reference).mean(-1),
    "smape": lambda image, reference: _symmetric(image, reference).mean(-1),
    "ssim": lambda image, reference: 1.0 - _similar(image, reference, 1.0, 11, "same").mean(-1),
    "flip": lambda image, reference: _flip(image, reference)[0],
}


def error_map(metric: str, image: Tensor, reference: Tensor) -> Tensor:
    """Where a picture is off, by one of the measures: the mean over channels of each pixel's error.

    The map's mean is the measure; of ``ssim`` the map is ``1 - ssim``, with the picture mirrored at its edges, and the
    measure the mean of what lies 5 pixels or more inside. Where a pixel is not finite, so is the map: of ``ssim`` a
    window about it, of ``flip`` the whole.

    Args:
        metric: a key of `MAPS`: ``relmse mse smape ssim flip``. ``psnr`` is of the whole picture: see ``mse``.
        image: ``(H, W, C)`` as the measure takes it; of ``flip`` C is 3.
        reference: the same.

    Returns:
        ``(H, W)`` float64 on the CPU.

    Raises:
        ValueError: no such map; and as the measure does.
        ImportError: as `flip`.
    """
    if metric not in MAPS:
        raise ValueError(f"metric: expected one of {', '.join(MAPS)}, got {metric!r}")
    return MAPS[metric](image, reference)
