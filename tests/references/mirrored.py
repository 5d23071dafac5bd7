"""A user-defined integrator that contributes to other pixels than the sample's own.

It needs no change to the package. Contributions of light samples go to the mirrored pixel on the other side of the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.state import Field, Shadow, Splat, StageContext, VertexInput, VertexOutput, no_shadow


class Mirrored(Path):
    """A path tracer whose light samples contribute to the mirrored pixel."""

    name = "mirrored"
    fields = (Field("pixel", start=-1, whole=True),)
    splats = True

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        output = super().bounce(context, model, vertex)
        assert context.camera is not None and context.crop is not None
        seen = context.camera.film_of(output.at.p)
        assert seen is not None
        left, top, width, height = context.crop
        column = (seen[0] / seen[2] - left).to(torch.int64).clamp(0, width - 1)
        row = (seen[1] / seen[2] - top).to(torch.int64).clamp(0, height - 1)
        own = vertex.state.extra["pixel"]
        pixel = torch.where(own < 0, row * width + (width - 1 - column), own)
        leaving = replace(output.leaving, extra={"pixel": pixel})
        light = no_shadow(vertex.state) if output.shadow is None else output.shadow
        return replace(output, leaving=leaving, shadow=None, splat=Splat(pixel, self.sent(light)))

    def sent(self, light: Shadow) -> Shadow:
        return light


def room(opacity: float = 1.0) -> dict[str, Any]:
    """Return a room with a lamp outside the camera's view, and a ball that shades the right side."""
    return {
        "camera": {"type": "perspective", "origin": [0, 0, -0.5], "target": [0, 0, 1], "fov": 60.0},
        "materials": {
            "wall": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]},
            "ball": {"type": "diffuse", "reflectance": [0.2, 0.5, 0.8], "opacity": opacity},
        },
        "shapes": {
            "room": {"type": "sphere", "radius": 1.5, "material": "wall", "flip_normals": True},
            "ball": {"type": "sphere", "center": [0.3, 0.1, 0.6], "radius": 0.25, "material": "ball"},
            "lamp": {"type": "sphere", "center": [-0.4, 0.3, -0.9], "radius": 0.2, "emission": [5, 4, 3]},
        },
    }


KEYS: Mapping[str, Any] = {"film": {"width": 16, "height": 12, "filter": "box"}, "spp": 8}


def lights(**more: Any) -> dict[str, Any]:
    return {"strategy": "light", "max_depth": 4, "rr_depth": 9, **more}
