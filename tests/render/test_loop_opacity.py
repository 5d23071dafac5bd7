"""Shadow rays past surfaces that let light pass, compiled beside eager: every search structure, with and without instances."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from scene_makers import lit_floor, turned
from trials import film_of

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

MESH = str(Path(__file__).parents[2] / "scenes" / "standin.ply")


def description(copies: bool) -> dict[str, Any]:
    shapes: dict[str, Any] = {
        "pane": turned("film", 90.0, 0.7, [0, 0.9, 0]),
        "tube": {"type": "cylinder", "material": "film", "center": [0.5, 0.4, 0.3], "radius": 0.2, "height": 0.6},
        "ball": {"type": "sphere", "material": "grey", "center": [-0.5, 0.3, 0.2], "radius": 0.3},
    }
    if copies:
        at, there = [{"scale": 3}, {"translate": [-0.3, 0, -0.4]}], [{"translate": [0.2, 0.5, -0.5]}]
        shapes |= {
            "block": {"type": "mesh", "path": MESH, "material": "film", "transform": at},
            "there": {"type": "instance", "of": "block", "material": "film", "transform": there},
        }
    return lit_floor(**shapes)


@pytest.mark.parametrize(
    ("accel", "copies"), few([("brute", False), ("numba", False), ("torch", False), ("numba", True)], 2)
)
def test_light_that_passes_is_the_same_compiled(accel, copies):
    scene = torchpt.load(description(copies), "cpu")
    pictures = []
    for compile in ("on", "off"):
        wish = {
            "film": film_of(24, 16),
            "integrator": {"type": "path", "max_depth": 3},
            "render": {"spp": 16, "seed": 1, "compile": compile, "accel": accel},
        }
        pictures.append(render_scene(scene, settings(scene.description, wish)).image)
    on, off = pictures
    assert float(off.mean()) > 0.01
    far = (on - off).abs() > 1e-3 * (1 + off.abs())
    assert float(far.float().mean()) < 0.01, float((on - off).abs().amax())
    torch.testing.assert_close(on.mean((0, 1)), off.mean((0, 1)), rtol=1e-3, atol=1e-5)
