"""Pictures through each camera: blur, scale, crops, layers, and the same bits however the work is cut."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from optics import CAMERAS, LENS, POSE
from trials import film_of, shoot

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

AHEAD = {"origin": [0, 0, 0], "target": [0, 0, -1]}
SIZE, BALL = 64, 0.03
ROOM: dict[str, Any] = {
    "shapes": {
        "ball": {"type": "sphere", "center": [0, 0.4, 0], "radius": 0.9},
        "near": {"type": "cube", "transform": [{"scale": 0.3}, {"translate": [0.8, 0, 1.5]}]},
        "lamp": {"type": "sphere", "center": [1, 4, 2], "radius": 0.8, "emission": 8},
    },
    "lights": {"sky": {"type": "constant", "radiance": [0.2, 0.3, 0.4]}},
}


def room(name: str) -> Any:
    return torchpt.load({**ROOM, "camera": {**POSE, **CAMERAS[name]}}, "cpu")


def spot(depth: float, camera: dict[str, Any]) -> torch.Tensor:
    """The picture ``(SIZE, SIZE)`` of a ball of radius ``BALL * depth`` straight ahead; a pinhole's would sum to 1."""
    small = BALL * depth
    shape = {"type": "sphere", "center": [0, 0, -depth], "radius": small, "emission": 1}
    scene = torchpt.load({"camera": {**AHEAD, **camera}, "shapes": {"spot": shape}}, "cpu")
    image = shoot(scene, 64, 1, "sobol", {"max_depth": 1}, film_of(SIZE)).image[..., 0].double()
    return image / (math.pi * (BALL * slope_pixels(camera["fov"])) ** 2)


def slope_pixels(fov: float) -> float:
    """Pixels a unit of slope."""
    return SIZE / (2 * math.tan(math.radians(fov / 2)))


def moments(image: torch.Tensor) -> tuple[float, float, float]:
    """Total, mean square distance from the middle in pixels, and mean cube of the height above it."""
    at = torch.arange(SIZE, dtype=torch.float64) + 0.5 - SIZE / 2
    x, y = at[None, :], -at[:, None]
    total = float(image.sum())
    return total, float((image * (x**2 + y**2)).sum()) / total, float((image * y**3).sum()) / total


@pytest.mark.parametrize("blades", [0, 3, 6])
@pytest.mark.parametrize("depth", [2.0, 8.0])
def test_the_circle_of_confusion(depth, blades):
    camera = {"type": "thinlens", "fov": 30, "aperture_radius": 0.5, "focus_distance": 4, "blades": blades}
    total, square, cube = moments(spot(depth, camera))
    radius = 0.5 * abs(1 / 4 - 1 / depth) * slope_pixels(30)
    assert radius > 7
    # Mean square of the aperture and of the ball's own disk; of a pixel's square too, over which the box filter spreads.
    share = 0.5 if blades == 0 else (2 + math.cos(2 * math.pi / blades)) / 6
    own = 0.5 * (BALL * slope_pixels(30)) ** 2
    assert square == pytest.approx(share * radius**2 + own + 1 / 6, rel=0.03)
    # A lens of any size gives the same sum: radiance is averaged over it.
    assert total == pytest.approx(1, rel=0.03)
    # The triangle's corner is up behind the plane in focus, down in front of it; over it y^3 averages 1/40.
    expected = 0.0 if blades != 3 else math.copysign(1 / 40, depth - 4)
    assert cube / radius**3 == pytest.approx(expected, abs=0.01)


def test_what_lies_in_the_plane_in_focus_is_as_sharp_as_in_a_pinhole():
    board = {
        "type": "rectangle",
        "transform": [{"scale": 2}, {"translate": [0, 0, -4]}],
        "emission": 1,
        "material": {"type": "diffuse", "opacity": {"type": "checkerboard", "scale": 8, "color0": 1, "color1": 0}},
    }
    pictures = []
    for camera in ({"type": "perspective"}, {"type": "thinlens", "aperture_radius": 1, "focus_distance": 4}):
        scene = torchpt.load({"camera": {**AHEAD, **camera, "fov": 30}, "shapes": {"board": board}}, "cpu")
        pictures.append(shoot(scene, 4, 1, "sobol", {"max_depth": 1}, film_of(SIZE)).image)
    # Through a wide lens, the same film positions: only rays that graze an edge may end on its other side.
    assert ((pictures[0] - pictures[1]).abs() > 1e-5).double().mean() < 0.003
    assert 0.4 < pictures[0].mean() < 0.6


@pytest.mark.parametrize("blades", [0, 6])
def test_a_lens_without_extent_gives_the_pinholes_picture(blades):
    pictures = [
        shoot(torchpt.load({**ROOM, "camera": {**POSE, **camera}}, "cpu"), 4, 3, "sobol", {"max_depth": 3}, film_of(24))
        for camera in (CAMERAS["perspective"], {**LENS, "aperture_radius": 0, "blades": blades})
    ]
    assert torch.equal(pictures[0].image, pictures[1].image)


@pytest.mark.parametrize("depth", [0.5, 40.0])
def test_a_parallel_projection_shows_the_same_size_at_any_depth(depth):
    board = {
        "type": "rectangle",
        "transform": [{"scale": [1.5, 0.5, 1]}, {"translate": [0.5, 0, -depth]}],
        "emission": 2,
    }
    camera = {**AHEAD, "type": "orthographic", "width": 8}
    scene = torchpt.load({"camera": camera, "shapes": {"board": board}}, "cpu")
    image = shoot(scene, 1, 0, "sobol", {"max_depth": 1}, film_of(32, 16)).image[..., 0]
    expected = torch.zeros(16, 32)  # 4 pixels a unit: x from -1 to 2, y from -0.5 to 0.5
    expected[6:10, 12:24] = 2
    assert torch.equal(image, expected)


def test_layers():
    wish = {"film": {**film_of(16), "filter": "box", "aovs": ["depth", "position", "object_id", "normal", "albedo"]}}
    for name in CAMERAS:
        scene = room(name)
        found = render_scene(
            scene, settings(scene.description, {**wish, "integrator": "aov", "render": {"spp": 16}})
        ).layers
        assert set(found) == set(wish["film"]["aovs"])
        ball = found["object_id"][..., 0] == 1
        assert ball.any() and not ball.all()
        assert float(found["depth"][ball].max()) < 6
    board = {"type": "rectangle", "transform": [{"scale": 9}, {"translate": [0, 0, -4]}]}
    for camera, low, high in (({"type": "orthographic"}, 4, 4), ({**LENS, "focus_distance": 4}, 4, 4.5)):
        scene = torchpt.load({"camera": {**AHEAD, **camera}, "shapes": {"board": board}}, "cpu")
        quick = settings(scene.description, {**wish, "integrator": "aov", "render": {"spp": 4}})
        layers = render_scene(scene, quick).layers
        depth = layers["depth"]
        assert low - 1e-5 <= float(depth.min()) <= float(depth.max()) <= high + 1e-5
        assert (layers["position"][..., 2] + 4).abs().max() < 1e-5


@pytest.mark.parametrize("name", ["thinlens", "hexagon", "orthographic"])
def test_compiled_rays(name):
    scene = room(name)
    moved = scene.params["camera.to_world"] + 0.5 * torch.eye(4)[:, [3, 0, 1, 2]]
    for params in (None, {"camera.to_world": moved}):
        eager, compiled = (
            render_scene(
                scene,
                settings(
                    scene.description, {"film": {**film_of(32), "filter": "box"}, "render": {"compile": mode, "spp": 4}}
                ),
                params=params,
            ).image
            for mode in ("off", "on")
        )
        assert torch.isclose(eager, compiled, rtol=1e-3, atol=1e-4).all(-1).float().mean() > 0.99
        assert float(compiled.mean()) == pytest.approx(float(eager.mean()), rel=1e-4)
