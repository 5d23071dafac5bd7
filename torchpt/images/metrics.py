"""Error metrics of an image against a reference: each is a function, and :data:`METRICS` lists them by name.

All take linear RGB ``(H, W, 3)`` of one size, on any device and of any floating type, and compute in float64. ``mse relmse
relmse_trimmed smape flip`` take radiance as it is; ``psnr`` and ``ssim`` expect values from 0 to ``peak``, so pass display
values (``torchpt.images.colour.display``). If an image has a value that is not finite, the result is not finite either.

`error_map` returns the error of each pixel, for the metrics in :data:`MAPS`. `relative` and `symmetric` are the formulas value
by value, for other numerators, such as in a loss or with an estimate of a variance.
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

#: Constant in the denominators of relMSE and SMAPE, so that black pixels stay finite.
FLOOR = 1e-2
#: Fraction of the pixels that :func:`relmse_trimmed` leaves out.
TRIMMED = 1e-3
#: Largest value of a reference up to which the FLIP evaluator ends the process.
_LEAST_FLIP_REFERENCE = 1e-5
#: Width of the windows of SSIM, in pixels (Wang et al. 2004).
SSIM_WINDOW = 11


def relative(squared: Tensor | float, radiance: Tensor, floor: float = FLOOR) -> Tensor:
    """Return squared errors over ``radiance² + floor``, value by value: relMSE is their mean.

    Rousselle et al. 2011, *Adaptive Sampling and Reconstruction using Greedy Error Minimization*, section 4.2. Differentiable.
    """
    return squared / (radiance.square() + floor)


def symmetric(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    """Return ``|x - ref| / (|x| + |ref| + floor)``, value by value: SMAPE is their mean. Differentiable."""
    return (image - reference).abs() / (image.abs() + reference.abs() + floor)


def _float64_pair(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    """Return both images on the CPU in float64, without gradients; raise ValueError if their shapes differ."""
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    return image.detach().cpu().double(), reference.detach().cpu().double()


def _squared(image: Tensor, reference: Tensor) -> Tensor:
    """Return squared errors, value by value."""
    x, ref = _float64_pair(image, reference)
    return (x - ref).square()


def _relative(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    """Return relative squared errors, value by value."""
    x, ref = _float64_pair(image, reference)
    return relative((x - ref).square(), ref, floor)


def _symmetric(image: Tensor, reference: Tensor, floor: float = FLOOR) -> Tensor:
    """Return symmetric relative errors, value by value."""
    return symmetric(*_float64_pair(image, reference), floor)


def mse(image: Tensor, reference: Tensor) -> float:
    """Return the mean squared error over pixels and channels: 0 for equal images.

    Raises:
        ValueError: the shapes differ (as for all metrics).
    """
    return float(_squared(image, reference).mean())


def relmse(image: Tensor, reference: Tensor, floor: float = FLOOR) -> float:
    """Return the relative mean squared error: the mean of ``(x - ref)² / (ref² + floor)`` (Rousselle et al. 2011, 4.2).

    A few bright outliers may dominate it; where the reference is black it is ``x² / floor``.
    """
    return float(_relative(image, reference, floor).mean())


def relmse_trimmed(image: Tensor, reference: Tensor, share: float = TRIMMED, floor: float = FLOOR) -> float:
    """Return `relmse` without the fraction ``share`` of pixels with the largest errors.

    The error of a pixel is the mean of ``(x - ref)² / (ref² + floor)`` over its channels. Of N pixels the ``⌊share N⌋`` with
    the largest errors are left out; below 1,000 pixels the default leaves out none, and the result is `relmse`. Values that are
    not finite are not left out.

    Args:
        image: ``(H, W, C)``.
        reference: of the same shape.
        share: fraction of the pixels, 0 or more and below 1.
        floor: as for `relmse`.

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
    """Return the indices of ``errors (N,)`` in rising order, without the ``⌊share N⌋`` largest."""
    left_out = math.floor(share * errors.numel() * (1 + 1e-12))  # 0.001 of 3,000 is 3, however the product is rounded
    return errors.argsort()[: errors.numel() - left_out]


def smape(image: Tensor, reference: Tensor, floor: float = FLOOR) -> float:
    """Return the symmetric mean absolute percentage error, 0..1: the mean of ``|x - ref| / (|x| + |ref| + floor)``.

    Vogels et al. 2018, *Denoising with Kernel Prediction and Asymmetric Loss Functions*, equation 3. Unlike `relmse` it is
    not dominated by a few bright pixels.
    """
    return float(_symmetric(image, reference, floor).mean())


def psnr(image: Tensor, reference: Tensor, peak: float = 1.0) -> float:
    """Return the peak signal-to-noise ratio in decibels, of values 0..``peak``; infinite for equal images."""
    from kornia.metrics import psnr as kornia_psnr

    x, ref = _float64_pair(image, reference)
    return float(kornia_psnr(x, ref, float(peak)))


def ssim(image: Tensor, reference: Tensor, peak: float = 1.0, window: int = SSIM_WINDOW) -> float:
    """Return the mean structural similarity of values 0..``peak`` (Wang et al. 2004): 1 for equal images.

    The mean is over all windows of ``window`` pixels (odd) inside the image, with a Gaussian of 1.5 pixels.

    Raises:
        ValueError: an image smaller than the window.
    """
    return float(_ssim_map(image, reference, peak=peak, window=window, padding="valid").mean())


def _ssim_map(image: Tensor, reference: Tensor, *, peak: float, window: int, padding: str) -> Tensor:
    """Return the structural similarity ``(H, W, C)`` of each pixel; ``padding``: "same" mirrors at the edges, "valid" crops."""
    from kornia.metrics import ssim as kornia_ssim

    x, ref = _float64_pair(image, reference)
    if min(x.shape[:2]) < window:
        raise ValueError(f"ssim looks through windows of {window} pixels, more than the picture has: {tuple(x.shape)}")
    x, ref = x.movedim(-1, 0)[None], ref.movedim(-1, 0)[None]
    return kornia_ssim(x, ref, window, float(peak), eps=0.0, padding=padding)[0].movedim(0, -1)


def flip(image: Tensor, reference: Tensor) -> float:
    """Return the mean HDR-FLIP error, 0..1: the visibility of differences when the images alternate, over exposures.

    Andersson et al. 2021, *Visualizing Errors in Rendered High Dynamic Range Images*, by the authors' own evaluator, at 67
    pixels a degree. Negative values count as 0.

    Raises:
        ImportError: the package ``flip-evaluator`` (extra ``compare``) is not installed.
        ValueError: a reference that is black: it has no exposure.
    """
    _, mean = _flip(image, reference)
    return mean


def _flip(image: Tensor, reference: Tensor) -> tuple[Tensor, float]:
    """Return the FLIP error ``(H, W)`` and its mean."""
    x, ref = _float64_pair(image, reference)
    if not (torch.isfinite(x).all() and torch.isfinite(ref).all()):
        return torch.full(x.shape[:2], math.nan, dtype=x.dtype), math.nan
    try:
        import flip_evaluator
    except ImportError:
        raise ImportError(
            "torchpt.metrics.flip needs the package flip-evaluator: pip install '.[compare]' in the checkout of torchpt"
        ) from None
    arrays = [values.clamp(min=0).float().contiguous().numpy() for values in (ref, x)]
    if not float(arrays[0].max()) > _LEAST_FLIP_REFERENCE:
        raise ValueError("flip: the reference is black, so there is no exposure to look at it by")
    errors, mean, _ = flip_evaluator.evaluate(arrays[0], arrays[1], "HDR", applyMagma=False)
    return torch.from_numpy(errors)[..., 0].double(), float(mean)


#: Metrics by name. Smaller is better, except for ``psnr`` and ``ssim``.
METRICS: dict[str, Callable[[Tensor, Tensor], float]] = {
    "relmse": relmse,
    "relmse_trimmed": relmse_trimmed,
    "mse": mse,
    "smape": smape,
    "psnr": psnr,
    "ssim": ssim,
    "flip": flip,
}

#: Functions by name that return the error of each pixel, ``(H, W)``; 0 where the images agree.
MAPS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "relmse": lambda image, reference: _relative(image, reference).mean(-1),
    "mse": lambda image, reference: _squared(image, reference).mean(-1),
    "smape": lambda image, reference: _symmetric(image, reference).mean(-1),
    "ssim": lambda image, reference: (
        1.0 - _ssim_map(image, reference, peak=1.0, window=SSIM_WINDOW, padding="same").mean(-1)
    ),
    "flip": lambda image, reference: _flip(image, reference)[0],
}


def error_map(metric: str, image: Tensor, reference: Tensor) -> Tensor:
    """Return the error of each pixel by one of the metrics: the mean over channels.

    The mean of the map is the metric. The map of ``ssim`` is ``1 - ssim``, with the image mirrored at its edges; there the
    metric is the mean over pixels at least 5 pixels inside. Where a pixel is not finite the map is not finite: with ``ssim`` in
    a window about it, with ``flip`` everywhere.

    Args:
        metric: a key of `MAPS`: ``relmse mse smape ssim flip``. ``psnr`` has no map; use ``mse``.
        image: ``(H, W, C)`` as for the metric; C is 3 for ``flip``.
        reference: of the same shape.

    Returns:
        ``(H, W)`` float64 on the CPU.

    Raises:
        ValueError: an unknown metric, or as the metric raises.
        ImportError: as `flip`.
    """
    if metric not in MAPS:
        raise ValueError(f"metric: expected one of {', '.join(MAPS)}, got {metric!r}")
    return MAPS[metric](image, reference)
