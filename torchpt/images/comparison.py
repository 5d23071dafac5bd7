"""Compare two images: all metrics (or the reason why one has no value), means, and counts of non-finite pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchpt.images.colour import display
from torchpt.images.metrics import METRICS, error_map

__all__ = ["Comparison", "DisplayTransform", "compare", "comparison_map"]

#: Metrics of display values.
DISPLAY_METRICS = ("psnr", "ssim")
#: Metrics that are defined for colours only.
COLOUR_METRICS = (*DISPLAY_METRICS, "flip")


@dataclass(frozen=True)
class DisplayTransform:
    """Exposure, tone curve and gamma for the metrics of `DISPLAY_METRICS`: see `colour.display`."""

    exposure: float = 0.0
    tonemap: str = "none"
    gamma: str | float = "srgb"

    def apply(self, image: Tensor) -> Tensor:
        """Return display values 0..1; values that are not finite become NaN, not black or white."""
        shown = display(image.double(), self.exposure, self.tonemap, self.gamma)
        return torch.where(torch.isfinite(image), shown, math.nan)


@dataclass(frozen=True)
class Comparison:
    """Result of comparing an image with a reference.

    Attributes:
        metrics: value of each of `METRICS` by name; NaN or infinite where there is none.
        reasons: by name, the reason why a metric has no finite value.
        nonfinite: number of pixels with a value that is not finite, in the image and in the reference.
        means: mean of each channel ``(C,)``, of the image and of the reference, over pixels that are finite in both.
        ratio: mean over all channels of the image divided by that of the reference; NaN where that is 0.
    """

    metrics: dict[str, float]
    nonfinite: tuple[int, int]
    means: tuple[list[float], list[float]]
    ratio: float
    reasons: dict[str, str] = field(default_factory=dict)


def compare(
    image: Tensor, reference: Tensor, shown: DisplayTransform | None = None, colours: bool = True
) -> Comparison:
    """Compute all metrics.

    Args:
        image: ``(H, W, C)`` linear; C is 1 or 3 for colours.
        reference: of the same shape.
        shown: display transform for ``psnr`` and ``ssim``; None: sRGB encoding alone.
        colours: True: radiance or colours. False: other data (normals, depth), without ``psnr``, ``ssim`` and ``flip``.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    finite = [torch.isfinite(picture).all(-1) for picture in (image, reference)]  # (H, W) each
    for name in METRICS:
        values[name] = math.nan
        if not colours and name in COLOUR_METRICS:
            reasons[name] = "a measure of colours, which this layer is not"
            continue
        try:
            values[name] = METRICS[name](*_as_metric_takes(name, image, reference, shown or DisplayTransform()))
        except (ImportError, ValueError) as problem:
            # Without the name of the metric, which the caller prints.
            reasons[name] = (
                str(problem).removeprefix("torchpt.metrics.").removeprefix(f"{name}: ").removeprefix(f"{name} ")
            )
            continue
        if math.isfinite(values[name]):
            continue
        if values[name] == math.inf and name == "psnr":
            reasons[name] = "infinite: a screen shows both alike"
        elif bool(finite[0].all()) and bool(finite[1].all()):
            reasons[name] = "an error is beyond the range of float64"
        else:
            reasons[name] = "a picture holds values that are not finite"
    finite_in_both = finite[0] & finite[1]
    means = [picture[finite_in_both].double().mean(0) for picture in (image, reference)]
    totals = [float(mean.mean()) for mean in means]
    return Comparison(
        metrics=values,
        nonfinite=(int((~finite[0]).sum()), int((~finite[1]).sum())),
        means=(means[0].tolist(), means[1].tolist()),
        ratio=totals[0] / totals[1] if totals[1] else math.nan,
        reasons=reasons,
    )


def comparison_map(name: str, image: Tensor, reference: Tensor, shown: DisplayTransform | None = None) -> Tensor:
    """Return the error map ``(H, W)`` of a metric, with the display transform of `compare`: see `metrics.error_map`."""
    return error_map(name, *_as_metric_takes(name, image, reference, shown or DisplayTransform()))


def _as_metric_takes(name: str, image: Tensor, reference: Tensor, shown: DisplayTransform) -> tuple[Tensor, Tensor]:
    """Return both images as a metric takes them: with three channels, or as display values."""
    if name in COLOUR_METRICS and image.shape[-1] == 1:
        image, reference = image.expand(*image.shape[:2], 3), reference.expand(*image.shape[:2], 3)
    return (shown.apply(image), shown.apply(reference)) if name in DISPLAY_METRICS else (image, reference)
