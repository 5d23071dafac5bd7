"""Renders small scenes for cases, by the backend that is asked for, and lets no sample be lost on the way."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.rendering.api import render
from torchpt.scene import load

__all__ = ["Harness", "relative", "relative_difference"]


@dataclass(frozen=True)
class Harness:
    """How cases are rendered.

    Attributes:
        device: where.
        accel: the search structure.
        compile: ``on`` or ``off``.
        dtype: of the lanes.
    """

    device: str = "cpu"
    accel: str = "auto"
    compile: str = "auto"
    dtype: torch.dtype = torch.float32

    def render(
        self, described: Mapping[str, Any], spp: int = 64, size: int = 8, seed: int = 1, **integrator: Any
    ) -> Tensor:
        """A picture ``(size, size, 3)`` in float64, box filter.

        Args:
            described: a scene.
            spp: samples a pixel.
            size: of the film.
            seed: of the samples.
            integrator: keys of ``path``.

        Raises:
            RenderError: a sample was not finite.
        """
        found = render(
            load(described, device=self.device),
            spp=spp,
            seed=seed,
            integrator={"type": "path", **integrator},
            film={"width": size, "height": size, "filter": "box"},
            accel=self.accel,
            compile="off" if self.dtype == torch.float64 else self.compile,
            dtype=self.dtype,
            full=True,
        )
        if found.nonfinite_samples:
            raise RenderError(f"{found.nonfinite_samples} samples are not finite; the first is {found.nonfinite_first}")
        return found.image.double().cpu()

    def exact(self) -> Harness:
        """The same in float64."""
        return replace(self, dtype=torch.float64)


def relative(found: Tensor | float, expected: Tensor | float) -> float:
    """How far the mean of a picture is from what it is to be, relative to that."""
    found, expected = (x.mean().item() if isinstance(x, Tensor) else x for x in (found, expected))
    return abs(found - expected) / abs(expected) if expected else abs(found)


def relative_difference(a: Tensor, b: Tensor) -> float:
    """How far two pictures of the same numbers are apart: mean difference over mean value."""
    return float((a - b).abs().mean() / b.abs().mean())
