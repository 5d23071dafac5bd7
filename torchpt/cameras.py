"""Cameras: from film positions to rays.

A pose is Mitsuba's ``to_world``: the camera looks along its own ``+z``, ``+y`` is up and ``+x`` points to the image's left,
so that image right is ``(target - origin) x up``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import normalize

__all__ = ["FOV_AXES", "Perspective"]

#: What ``fov`` spans: the film's width, height, its smaller or larger side, or its diagonal.
FOV_AXES = ("x", "y", "smaller", "larger", "diagonal")


@dataclass(frozen=True)
class Perspective:
    """A pinhole camera.

    Attributes:
        to_world: pose ``(4, 4)``; its scale is ignored, as only directions and the origin matter.
        fov: full angle of view in degrees, a 0-d tensor.
        fov_axis: one of :data:`FOV_AXES`.
        width: of the whole film in pixels.
        height: of the whole film in pixels.
    """

    to_world: Tensor
    fov: Tensor
    fov_axis: str
    width: int
    height: int

    def _half_width(self) -> Tensor:
        """Tangent of half the horizontal angle of view."""
        half = torch.tan(self.fov * (math.pi / 360.0))
        w, h = self.width, self.height
        if self.fov_axis == "diagonal":
            return half * (w / math.hypot(w, h))
        vertical = (
            self.fov_axis == "y" or (self.fov_axis == "smaller" and h < w) or (self.fov_axis == "larger" and h > w)
        )
        return half * (w / h) if vertical else half

    def lens(self) -> Tensor:
        """How large a pixel is in the world, ``(5,)``: ``e``, ``w``, ``spread``.

        From a point ``p`` the camera lies toward ``e - w p``, and a pixel's footprint there, across the line of sight, is
        ``spread`` times that vector's length on a side. Here ``e`` is the camera's place, ``w`` is 1, and ``spread`` a pixel's
        side at distance 1 in the middle of the picture; of parallel rays ``e`` is the unit direction against them, ``w`` is 0.
        """
        pose = self.to_world
        spread = self._half_width() * (2.0 / self.width)
        return torch.cat((pose[:3, 3], torch.stack((torch.ones_like(spread), spread))))

    def rays(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Origins ``(3, 1)`` and unit directions ``(3, N)`` through film positions in pixels, from the upper left."""
        half = self._half_width()
        right = (x * (2.0 / self.width) - 1.0) * half
        up = (1.0 - y * (2.0 / self.height)) * (half * (self.height / self.width))
        pose = self.to_world
        axes = normalize(pose[:3, :3])
        d = axes[:, 2:3] + axes[:, 1:2] * up - axes[:, 0:1] * right
        return pose[:3, 3:4], normalize(d)
