"""Emitters far larger or smaller than what they light, by closed forms: a floor's radiance under each of them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from significance import z_limit

import torchpt
from torchpt.core.errors import SceneError
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

UP = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
DOWN = {"rotate": {"axis": [1, 0, 0], "angle": 90}}
ABOVE = {"translate": [0, 5, 0]}
ALBEDO, SPP, SIDE = 0.5, 64, 24


def radiance(lamp: dict[str, Any], compile: str, strategy: str = "mis", emission: float = 1.0) -> tuple[float, float]:
    """Of a floor of albedo one half at the origin, and its standard error; every pixel is an estimate of its own."""
    floor = {"type": "rectangle", "material": {"type": "diffuse", "reflectance": ALBEDO}, "transform": [UP]}
    camera = {"origin": [0.01, 1, 0], "target": [0, 0, 0], "up": [1, 0, 0], "fov": 0.01}
    shapes = {"floor": floor, "lamp": {**lamp, "emission": [emission] * 3}}
    scene = torchpt.load({"camera": camera, "shapes": shapes}, device="cpu")
    wishes = {
        "film": {"filter": "box", "width": SIDE, "height": SIDE},
        "integrator": {"type": "path", "max_depth": 2, "strategy": strategy},
        "render": {"spp": SPP, "compile": compile},
    }
    shot = render_scene(scene, settings(scene.description, wishes))
    assert shot.nonfinite_samples == 0
    pixels = shot.image[..., 0].double()
    return float(pixels.mean()), float(pixels.std()) / SIDE


def large(kind: str, size: float) -> tuple[dict[str, Any], float]:
    """A lamp above the origin (or about it), and the irradiance there over pi."""
    if kind == "disk":
        return {"type": "disk", "transform": [{"scale": size}, DOWN, ABOVE]}, size**2 / (size**2 + 25)
    if kind == "rectangle":
        return {"type": "rectangle", "transform": [{"scale": size}, DOWN, ABOVE]}, 1.0
    if kind == "triangle":
        corners = [[-1, 0, -1], [1, 0, -1], [0, 0, 1]]
        return {"type": "mesh", "vertices": corners, "faces": [[0, 1, 2]], "transform": [{"scale": size}, ABOVE]}, 1.0
    if kind == "shell":
        return {"type": "sphere", "radius": size, "flip_normals": True}, 1.0
    if kind == "egg":
        return {"type": "sphere", "radius": size, "flip_normals": True, "transform": [{"scale": [1, 1, 2]}]}, 1.0
    return {"type": "sphere", "radius": size, "center": [0, 2 * size, 0]}, 0.25


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
@pytest.mark.parametrize("size", few([2e23, 1e20, 1e19, 1e10], 1))
@pytest.mark.parametrize("kind", ["disk", "rectangle", "triangle", "shell", "egg", "far"])
def test_a_lamp_far_larger_than_the_scene(kind, size, compile):
    lamp, share = large(kind, size)
    mean, error = radiance(lamp, compile)
    expected = ALBEDO * share
    assert error < 1e-3 * expected
    assert abs(mean - expected) <= z_limit(48) * error + 1e-6


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
@pytest.mark.parametrize("strategy", ["mis", "light"])
@pytest.mark.parametrize("size", few([1e-6, 1e-12, 1e-18], 2))
def test_a_lamp_far_smaller_than_the_scene(size, strategy, compile):
    # So bright that as much arrives of it: E = pi L (r / d)^2, with L r^2 = 1.
    lamp = {"type": "sphere", "radius": size, "center": [0, 5, 0]}
    mean, _ = radiance(lamp, compile, strategy, min(1 / size**2, 1e38))
    assert mean == pytest.approx(ALBEDO / 25, rel=1e-4)


@pytest.mark.parametrize(("kind", "size"), [("disk", 1e25), ("shell", 1e30), ("far", 1e38)])
def test_what_float32_cannot_hold_beside_the_scene_is_refused(kind, size):
    with pytest.raises(
        SceneError, match=r"shapes\.floor: expected a size of at least .*shapes\.lamp.*float32"
    ) as caught:
        radiance(large(kind, size)[0], "off")
    assert "\n" not in str(caught.value)


def test_dust_that_float32_cannot_hold_beside_the_scene_is_refused():
    shapes = {"floor": {"type": "rectangle"}, "dust": {"type": "sphere", "radius": 1e-30}}
    with pytest.raises(SceneError, match=r"shapes\.dust: expected a size of at least .*got 2e-30"):
        torchpt.load({"camera": {"origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")


def test_vertices_placed_beyond_float32_are_refused():
    mesh = {"type": "mesh", "vertices": [[0, 0, 0], [1e30, 0, 0], [0, 1e30, 0]], "faces": [[0, 1, 2]]}
    shapes = {"s": {**mesh, "transform": [{"scale": 1e20}]}}
    with pytest.raises(SceneError, match=r"shapes\.s: expected a place that is finite in float32"):
        torchpt.load({"camera": {"origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")


@pytest.mark.parametrize("size", [1e-14, 1e-12])
def test_areas_of_small_lights_are_right(size):
    # In a scene of ordinary size: the fourth power of these lengths is below float32.
    corners = [[0, 0, 0], [size, 0, 0], [0, size, 0], [5, 5, 5], [6, 5, 5], [5, 6, 5]]
    mesh = {"type": "mesh", "vertices": corners, "faces": [[0, 1, 2], [3, 4, 5]], "emission": [1, 1, 1]}
    scene = torchpt.load({"camera": {"origin": [0, 0, 4], "target": [0, 0, 0]}, "shapes": {"m": mesh}}, device="cpu")
    lights = scene.world(torch.float32)[0].lights
    assert scene.space.unit == 1.0 and lights is not None
    torch.testing.assert_close(lights.area, torch.tensor([0.5 * size**2, 0.5]), rtol=1e-6, atol=0)
