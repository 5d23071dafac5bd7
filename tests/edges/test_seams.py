"""Lines along which textures jump, as the surface or the camera moves: closed forms, and what is left out."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.gradients.edges.bodies import bodies_of
from torchpt.gradients.edges.curves import seams_of
from torchpt.scene.formats.description import settings

#: The pattern's colours, side of a square, and where a corner of it lies.
BRIGHT, DARK, SIDE, CORNER = 1.0, 0.2, 0.8, (0.43, 0.2)
#: The square of the film that counts, of x from, x to, y from and y to.
COUNTED = (-0.5, 1.5, 0.0, 1.5)


def surface(kind: str, board: dict[str, Any]) -> dict[str, Any]:
    """Return a square of side 8 with ten squares of the pattern on each side: a rectangle, two triangles, or 10 x 10 x 2."""
    pose = [{"scale": 4}, {"translate": [*CORNER, 0]}]
    if kind == "rectangle":
        return {"type": "rectangle", "material": board, "transform": pose}
    n = 1 if kind == "two triangles" else 10
    v, u = (part.flatten().double() / n for part in torch.meshgrid(*[torch.arange(n + 1)] * 2, indexing="ij"))
    number = torch.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (part.flatten() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    return {
        "type": "mesh",
        "vertices": torch.stack([2 * u - 1, 2 * v - 1, 0 * u], 1).tolist(),
        "faces": torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]).tolist(),
        "uvs": torch.stack([u, v], 1).tolist(),
        "material": board,
        "transform": pose,
    }


def described(shape: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return a picture of 4 x 4 units at 8 x 8 pixels, along z, of a shape in the sun."""
    camera = {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0], "width": 4}
    film = {"width": 8, "height": 8, "filter": "box"}
    sun = {"sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": [math.pi / 3] * 3}}
    return {
        "camera": camera,
        "film": film,
        "integrator": {"max_depth": 2},
        "lights": sun,
        "shapes": {"it": shape},
        **more,
    }


def pattern(x: float, y: float) -> float:
    """Return the colour at a place."""
    squares = math.floor((x - CORNER[0] + 4) / SIDE) + math.floor((y - CORNER[1] + 4) / SIDE)
    return DARK if squares % 2 else BRIGHT


def expected() -> float:
    """Return how the sum of the counted pixels changes as the pattern moves along x: what comes in less what goes out."""
    x0, x1, y0, y1 = COUNTED
    steps = 1500
    middle = [y0 + (y1 - y0) * (k + 0.5) / steps for k in range(steps)]
    return (
        4 * (y1 - y0) * sum(pattern(x0, y) - pattern(x1, y) for y in middle) / steps
    )  # four pixels for a unit of area


@pytest.mark.parametrize("kind", ["rectangle", "two triangles", "a grid along the lines"])
@pytest.mark.parametrize(
    ("texture", "moving"),
    few(
        [("checkerboard", "shapes.it.to_world"), ("checkerboard", "camera.to_world"), ("image", "shapes.it.to_world")],
        2,
    ),
)
def test_textures_move_over_the_picture(kind: str, texture: str, moving: str, tmp_path) -> None:
    if texture == "image":
        rows = torch.arange(10)
        squares = torch.where((rows[:, None] + rows) % 2 > 0, DARK, BRIGHT)[..., None].expand(10, 10, 3)
        torchpt.write_image(str(tmp_path / "squares.exr"), squares.contiguous())
        reflectance = {"type": "image", "path": str(tmp_path / "squares.exr"), "filter": "nearest"}
    else:
        reflectance = {"type": "checkerboard", "color0": [BRIGHT] * 3, "color1": [DARK] * 3, "scale": 5}
    scene = torchpt.load(described(surface(kind, {"type": "diffuse", "reflectance": reflectance})), "cpu")
    weight = torch.zeros(8, 8, 1, dtype=torch.float64)
    weight[1:4, 3:7] = 1.0
    found = []
    for seed in range(6):
        leaf = scene.params[moving].double().requires_grad_()
        picture = torchpt.render(scene, params={moving: leaf}, spp=8, edge_spp=64, seed=seed).double()
        (picture * weight).sum().backward()
        assert leaf.grad is not None
        found.append(float(leaf.grad[0, 3]))
    sign = 1.0 if moving.startswith("shapes") else -1.0
    mean, error = torch.tensor(found).mean(), torch.tensor(found).std() / math.sqrt(len(found))
    assert abs(float(mean) - sign * expected()) < 4.5 * float(error)
    assert float(error) < 0.1 * abs(expected())


def test_a_line_of_two_textures_counts_once() -> None:
    def lines(**textures: float) -> int:
        boards = {name: {"type": "checkerboard", "scale": scale} for name, scale in textures.items()}
        scene = torchpt.load(described(surface("two triangles", {"type": "principled", **boards})), "cpu")
        bodies = bodies_of(scene, settings(scene.description, {}).film, {})
        found = seams_of(scene, bodies, scene.merged(None))
        return 0 if found is None else len(found.prim)

    assert lines(base_color=4) == 2 * 2 * 7 and lines(roughness=3) == 2 * 2 * 5
    assert lines(base_color=4, roughness=2) == lines(base_color=4)
    assert lines(base_color=4, roughness=3) == lines(base_color=4) + lines(roughness=3) - 2 * 2  # the middle is shared


def test_a_camera_over_squares_turns_back() -> None:
    """The gradient of the squared difference leads back to where a picture was taken from."""
    board = {"type": "diffuse", "reflectance": {"type": "checkerboard", "scale": 2}}
    scene = torchpt.load(described(surface("rectangle", board)), "cpu")
    pose = scene.params["camera.to_world"]
    wanted = torchpt.render(scene, spp=64, seed=1)
    for away in (0.08, -0.08):
        moved = pose.clone()
        moved[0, 3] += away
        moved.requires_grad_()
        loss = (torchpt.render(scene, params={"camera.to_world": moved}, spp=64, edge_spp=64) - wanted).square().sum()
        loss.backward()
        assert moved.grad is not None
        assert float(moved.grad[0, 3]) * away > 0


def test_what_is_left_out_of_textures_is_named() -> None:
    squares = {"type": "diffuse", "reflectance": {"type": "checkerboard"}}
    dense = {"type": "diffuse", "reflectance": {"type": "checkerboard", "scale": 100_000}}

    def told(shape: dict[str, Any]) -> str:
        scene = torchpt.load(described(shape), "cpu")
        leaf = scene.params["shapes.it.to_world"].requires_grad_()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torchpt.render(scene, params={"shapes.it.to_world": leaf}, spp=1)
        return " ".join(str(one.message) for one in caught)

    assert told(surface("rectangle", squares)) == ""
    assert told(surface("two triangles", squares)) == ""
    assert "not interpolated" in told({"type": "sphere", "material": squares})
    assert "not interpolated" in told(surface("rectangle", dense))
