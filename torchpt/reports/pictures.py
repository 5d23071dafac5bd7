"""Pictures of the report: at equal time, where errors are largest, and maps of the errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.images import colour
from torchpt.images.false_colour import false_colour
from torchpt.reports.analysis import Line, Step, Topic
from torchpt.reports.errors import error_map

__all__ = ["Panel", "Sheet", "hardest", "sheet_of", "step_near"]

#: Widest map, in pixels; larger ones are means over squares.
_WIDE = 400
#: A crop is so much of the smaller side, within these bounds in pixels.
_PART, _LEAST, _MOST = 5, 16, 64  # 64 pixels are shown at three times their size or more


@dataclass
class Panel:
    """One setting at the common time.

    Attributes:
        line: its curve.
        step: the step nearest in time.
        crop: PNG of the crop.
        errors: PNG of the map.
    """

    line: Line
    step: Step
    crop: bytes
    errors: bytes


@dataclass
class Sheet:
    """A scene's pictures.

    Attributes:
        seconds: the common time.
        place: x, y, width, height of the crop in pixels.
        whole: PNG of the reference.
        crop: PNG of its crop.
        size: width and height of the picture.
        panels: one a curve.
        scale: least and greatest error of the maps' colours.
    """

    seconds: float
    place: tuple[int, int, int, int]
    whole: bytes
    crop: bytes
    size: tuple[int, int]
    panels: list[Panel]
    scale: tuple[float, float]


def step_near(line: Line, seconds: float) -> Step:
    """The step of a curve whose time is nearest, as a ratio."""
    return min(line.steps, key=lambda step: abs(math.log(step.seconds / seconds)))


def hardest(errors: Tensor, side: int) -> tuple[int, int]:
    """Where a square of ``side`` pixels holds most error: x and y of its corner in a map ``(H, W)``.

    Errors count by their root, so that a single firefly does not choose.
    """
    sums = torch.nn.functional.avg_pool2d(errors.sqrt()[None, None], side, stride=1)[0, 0]
    place = int(sums.argmax())
    return place % sums.shape[1], place // sums.shape[1]


def sheet_of(topic: Topic) -> Sheet | None:
    """The pictures of all curves that have the first one's film, at the longest time that each of them has.

    Denoised ones have no say in where the crop lies.
    """
    truth, film = topic.lines[0].truth, topic.film
    lines = [line for line in topic.lines if line.truth.image.shape == truth.image.shape]
    seconds = min(line.steps[-1].seconds for line in lines)
    chosen = [step_near(line, seconds) for line in lines]
    images = [torch.nan_to_num(step.pictures[0](), 0.0, 0.0, 0.0) for step in chosen]
    maps = [error_map(image, line.truth) for image, line in zip(images, lines, strict=True)]
    high, wide = maps[0].shape
    side = min(max(min(high, wide) // _PART, _LEAST), _MOST, high, wide)
    rendered = [found for found, line in zip(maps, lines, strict=True) if line.of is None]
    x, y = hardest(torch.stack(rendered).mean(0), side)
    smaller = [_reduced(found) for found in maps]
    scale = _scale(smaller)
    panels = [
        Panel(line, step, _png(_shown(image[y : y + side, x : x + side], film)), _png(_coloured(found, scale)))
        for line, step, image, found in zip(lines, chosen, images, smaller, strict=True)
    ]
    whole, crop = _png(_shown(truth.image, film)), _png(_shown(truth.image[y : y + side, x : x + side], film))
    return Sheet(seconds, (x, y, side, side), whole, crop, (wide, high), panels, scale)


def _shown(image: Tensor, film: Any) -> np.ndarray:
    levels = colour.display(image, film.exposure, film.tonemap, film.gamma)
    return (levels * 255 + 0.5).to(torch.uint8).numpy()


def _reduced(errors: Tensor) -> Tensor:
    by = -(-max(errors.shape) // _WIDE)
    return torch.nn.functional.avg_pool2d(errors[None, None], by, ceil_mode=True)[0, 0]


def _scale(maps: Sequence[Tensor]) -> tuple[float, float]:
    """Whole powers of ten about most values."""
    values = torch.cat([found.flatten() for found in maps])
    values = values[values > 0].log10()
    if not len(values):
        return 1e-4, 1.0
    ordered = values.sort().values
    low, top = (float(ordered[int(share * (len(ordered) - 1))]) for share in (0.1, 0.995))
    floor, ceiling = math.floor(low), math.ceil(top)
    return 10.0 ** max(floor, ceiling - 4), 10.0 ** max(ceiling, floor + 1)


def _coloured(errors: Tensor, scale: tuple[float, float]) -> np.ndarray:
    """A map in colours, by the logarithm."""
    low, top = (math.log10(x) for x in scale)
    level = (errors.clamp_min(1e-30).log10() - low) / (top - low)
    return (false_colour(level, 1.0).numpy() * 255 + 0.5).astype(np.uint8)


def _png(levels: np.ndarray) -> bytes:
    from PIL import Image

    encoded = BytesIO()
    Image.fromarray(levels).save(encoded, "PNG", optimize=True)
    return encoded.getvalue()
