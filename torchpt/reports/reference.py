"""The reference: a file, or the mean of independent runs, whose variance is known and taken off squared errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchpt.errors import AssetError
from torchpt.images import colour, read_layers
from torchpt.images.metrics import relative
from torchpt.reports.store import Run

__all__ = ["Truth", "from_file", "from_runs"]


@dataclass(frozen=True)
class Truth:
    """What pictures are compared with.

    Attributes:
        image: ``(H, W, 3)`` float64.
        variance: of ``image`` by value, the same shape; 0 where nobody knows it.
        runs: the independent pictures ``(H, W, 3)`` that it is the mean of; empty for a file.
        told: where it comes from, for the report.
    """

    image: Tensor
    variance: Tensor
    runs: tuple[Tensor, ...]
    told: dict[str, Any]

    @cached_property
    def weight(self) -> Tensor:
        """Of a squared error that becomes relative: ``1 / (ref² + 0.01)``."""
        return relative(1.0, self.image)

    def shown(self, film: Any) -> Tensor:
        """As a screen shows it; the latest is kept."""
        key = (film.exposure, film.tonemap, film.gamma)
        if key not in self._shown:
            self._shown.clear()
            self._shown[key] = colour.display(self.image, *key)
        return self._shown[key]

    @cached_property
    def _shown(self) -> dict[tuple[Any, ...], Tensor]:
        return {}

    @property
    def noise(self) -> float:
        """Its own relMSE, as far as it is known."""
        return float((self.variance * self.weight).mean())


def from_runs(runs: Sequence[Run]) -> Truth:
    """The mean of independent runs; the variance of that mean is their spread over their number."""
    images = tuple(run.image() for run in runs)
    stack = torch.stack(images)
    told = {
        "made": True,
        "spp": runs[0].facts["spp"],
        "seeds": len(runs),
        "seconds": sum(run.seconds for run in runs),
        "settings": runs[0].facts["settings"],
    }
    return Truth(stack.mean(0), stack.var(0) / len(runs), images, told)


def from_file(path: str, size: tuple[int, int]) -> Truth:
    """A picture from a file; its layer ``variance`` (of the mean, as ``film.aovs=[variance]`` writes it) counts.

    Args:
        path: linear, such as ``.exr``.
        size: width and height that it must have.

    Raises:
        AssetError: a file that cannot be read, of another size, or with values that are not finite.
    """
    layers = read_layers(path)
    image = layers["image"] if "image" in layers else next(iter(layers.values()))
    image = image.expand(-1, -1, 3) if image.shape[2] == 1 else image[..., :3]
    if image.shape[2] != 3:
        raise AssetError(path, f"expected a picture of 1, 3 or 4 channels, got {image.shape[2]}")
    high, wide = image.shape[:2]
    if (wide, high) != size:
        raise AssetError(
            path, f"expected a picture of {size[0]} x {size[1]} pixels as the film is, got {wide} x {high}"
        )
    if not torch.isfinite(image).all():
        raise AssetError(path, "expected finite values in a reference")
    variance = layers.get("variance")
    usable = variance is not None and variance.shape == image.shape and bool(torch.isfinite(variance).all())
    spread = variance.double().clamp_min(0.0) if variance is not None and usable else torch.zeros_like(image).double()
    return Truth(image.double(), spread, (), {"made": False, "file": path, "variance": usable})
