"""Two pictures side by side: every measure, or why there is none, their means, and what in them is no number."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchpt.images.colour import display
from torchpt.images.metrics import METRICS, error_map

__all__ = ["Comparison", "DisplayTransform", "compare", "comparison_map"]

#: Measures of what a screen shows.
OF_SHOWN = ("psnr", "ssim")
#: Measures that only colours have.
OF_COLOURS = (*OF_SHOWN, "flip")


@dataclass(frozen=True)
class DisplayTransform:
    """How a screen shows radiance, for the measures of `OF_SHOWN`: see `colour.display`."""

    exposure: float = 0.0
    tonemap: str = "none"
    gamma: str | float = "srgb"

    def of(self, image: Tensor) -> Tensor:
        """Display values 0..1; what is not finite is NaN, and not black or white as on a screen."""
        shown = display(image.double(), self.exposure, self.tonemap, self.gamma)
        return torch.where(torch.isfinite(image), shown, math.nan)


@dataclass(frozen=True)
class Comparison:
    """What is to say about a picture and its reference.

    Attributes:
        metrics: name to value, for each of `METRICS`; NaN or infinite where there is none.
        reasons: name to why it has no finite value.
        nonfinite: pixels with a value that is not finite, in the picture and in the reference.
        means: of each channel ``(C,)``, of the picture and of the reference, over the pixels that are finite in both.
        ratio: of the mean of all channels to the reference's; NaN where that is 0.
    """

    metrics: dict[str, float]
    nonfinite: tuple[int, int]
    means: tuple[list[float], list[float]]
    ratio: float
    reasons: dict[str, str] = field(default_factory=dict)


def compare(
    image: Tensor, reference: Tensor, shown: DisplayTransform | None = None, colours: bool = True
) -> Comparison:
    """Take all measures.

    Args:
        image: ``(H, W, C)`` linear; of colours C is 1 or 3.
        reference: the same.
        shown: how a screen shows it, for ``psnr`` and ``ssim``; as it is, encoded for sRGB, where nothing is said.
        colours: whether it is light or colour; other numbers (normals, depth) have no ``psnr``, ``ssim`` and ``flip``.

    Raises:
        ValueError: pictures of two shapes.
    """
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    values: dict[str, float] = {}
    reasons: dict[str, str] = {}
    fit = [torch.isfinite(picture).all(-1) for picture in (image, reference)]
    for name in METRICS:
        values[name] = math.nan
        if not colours and name in OF_COLOURS:
            reasons[name] = "a measure of colours, which this layer is not"
            continue
        try:
            values[name] = METRICS[name](*_seen(name, image, reference, shown or DisplayTransform()))
        except (ImportError, ValueError) as problem:
            reasons[name] = (
                str(problem).removeprefix("torchpt.metrics.").removeprefix(f"{name}: ").removeprefix(f"{name} ")
            )
            continue
        if math.isfinite(values[name]):
            continue
        equal = values[name] == math.inf and name == "psnr"
        reasons[name] = "infinite: a screen shows both alike" if equal else "a picture holds values that are not finite"
    both = fit[0] & fit[1]
    means = [picture[both].double().mean(0) for picture in (image, reference)]
    totals = [float(mean.mean()) for mean in means]
    return Comparison(
        metrics=values,
        nonfinite=(int((~fit[0]).sum()), int((~fit[1]).sum())),
        means=(means[0].tolist(), means[1].tolist()),
        ratio=totals[0] / totals[1] if totals[1] else math.nan,
        reasons=reasons,
    )


def comparison_map(name: str, image: Tensor, reference: Tensor, shown: DisplayTransform | None = None) -> Tensor:
    """The error map ``(H, W)`` of a measure as `compare` takes it: see `metrics.error_map`."""
    return error_map(name, *_seen(name, image, reference, shown or DisplayTransform()))


def _seen(name: str, image: Tensor, reference: Tensor, shown: DisplayTransform) -> tuple[Tensor, Tensor]:
    """The pictures as a measure takes them."""
    if name in OF_COLOURS and image.shape[-1] == 1:
        image, reference = image.expand(*image.shape[:2], 3), reference.expand(*image.shape[:2], 3)
    return (shown.of(image), shown.of(reference)) if name in OF_SHOWN else (image, reference)
