"""Render the small scenes of cases by the chosen device, search and engine; non-finite samples are errors."""

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
    """The device, search structure, engine and dtype by which cases are rendered.

    Attributes:
        device: name of the device.
        accel: name of the search structure.
        compile: ``on``, ``off`` or ``auto``.
        dtype: dtype of the lanes.
    """

    device: str = "cpu"
    accel: str = "auto"
    compile: str = "auto"
    dtype: torch.dtype = torch.float32

    def render(
        self, described: Mapping[str, Any], spp: int = 64, size: int = 8, seed: int = 1, **integrator: Any
    ) -> Tensor:
        """Return a picture ``(size, size, 3)`` in float64, with the box filter.

        Args:
            described: the scene as a mapping.
            spp: samples a pixel.
            size: width and height of the film.
            seed: seed of the samples.
            integrator: settings of integrator ``path``.

        Raises:
            RenderError: a sample was not finite.
        """
        result = render(
            load(described, device=self.device),
            spp=spp,
            seed=seed,
            integrator={"type": "path", **integrator},
            film={"width": size, "height": size, "filter": "box"},
            accel=self.accel,
            compile="off" if self.dtype == torch.float64 else self.compile,  # kernels compute in float32 only
            dtype=self.dtype,
            full=True,
        )
        if result.nonfinite_samples:
            raise RenderError(
                f"{result.nonfinite_samples} samples are not finite; the first is {result.nonfinite_first}"
            )
        return result.image.double().cpu()

    def exact(self) -> Harness:
        """Return a copy that renders in float64."""
        return replace(self, dtype=torch.float64)


def relative(found: Tensor | float, expected: Tensor | float) -> float:
    """Return the relative difference of the mean of a picture from that expected; the absolute one if that is 0."""
    found, expected = (x.mean().item() if isinstance(x, Tensor) else x for x in (found, expected))
    return abs(found - expected) / abs(expected) if expected else abs(found)


def relative_difference(a: Tensor, b: Tensor) -> float:
    """Return the difference of two pictures: mean absolute difference over mean absolute value of ``b``."""
    return float((a - b).abs().mean() / b.abs().mean())
