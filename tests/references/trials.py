"""Statistics and short renders that the tests of the physics share."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from significance import SIGNIFICANCE, chi_square_p, z_limit
from torch import Tensor

import torchpt
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

__all__ = [
    "SIGNIFICANCE",
    "chi_square_p",
    "coarse",
    "estimate",
    "film_of",
    "grid_cells",
    "shoot",
    "spread",
    "uniform_p",
    "z_limit",
]


def shoot(
    scene: Scene | Mapping[str, Any] | str,
    spp: int,
    seed: int = 0,
    sampler: str = "independent",
    integrator: Mapping[str, Any] | None = None,
    film: Mapping[str, Any] | None = None,
    **render: Any,
) -> Rendering:
    """Render eagerly with the box filter; ``integrator`` is a path integrator's keys."""
    scene = scene if isinstance(scene, Scene) else torchpt.load(scene, device="cpu")
    wishes = {
        "film": {"filter": "box", **(film or {})},
        "sampler": {"type": sampler},
        "integrator": {"type": "path", **(integrator or {})},
        "render": {"spp": spp, "seed": seed, "compile": "off", **render},
    }
    result = render_scene(scene, settings(scene.description, wishes))
    assert result.nonfinite_samples == 0
    return result


def film_of(size: int, height: int | None = None) -> dict[str, Any]:
    return {"width": size, "height": height or size}


def estimate(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean ``(C,)`` of a picture whose pixels are independent estimates of one value, and its standard error."""
    pixels = image.double().reshape(-1, image.shape[-1])
    return pixels.mean(0), pixels.std(0) / math.sqrt(len(pixels))


def spread(images: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return the mean of independent pictures and the variance of that mean."""
    stack = torch.stack([image.double() for image in images])
    return stack.mean(0), stack.var(0) / len(stack)


def coarse(picture: Tensor, side: int) -> Tensor:
    """Return means ``(H / side, W / side, C)`` over squares of pixels of a picture ``(H, W, C)``."""
    return torch.nn.functional.avg_pool2d(picture.double().permute(2, 0, 1)[None], side)[0].permute(1, 2, 0)


def uniform_p(cells: Tensor, number: int) -> float:
    """Return the p-value of the hypothesis that cell indices ``(N,)`` are uniform over ``number`` cells."""
    counts = torch.bincount(cells.reshape(-1), minlength=number).double()
    assert len(counts) == number
    expected = counts.sum() / number
    return chi_square_p(float(((counts - expected) ** 2 / expected).sum()), number - 1)


def grid_cells(u: Tensor, side: int) -> Tensor:
    """Return the cell of a ``side^d`` grid that each of the points ``(d, N)`` in [0, 1) falls into."""
    cells = (u.double() * side).long().clamp_max(side - 1)
    index = torch.zeros_like(cells[0])
    for row in cells:
        index = index * side + row
    return index
