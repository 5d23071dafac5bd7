"""Cameras by OpenCV's matrices: against projections of known points, kornia's camera and a picture; and out again."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from optics import CAMERAS, POSE, made, numbers
from trials import shoot

import torchpt
from torchpt.core.errors import SceneError
from torchpt.physics.cameras.opencv import PinholeMatrices
from torchpt.scene.formats.description import settings

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
WIDTH, HEIGHT = 64, 48
K = [[70.0, 0, 29.5], [0, 55.0, 27.25], [0, 0, 1]]
TURN = torch.linalg.qr(numbers(3, 3, 3) - 0.5)[0]
TURN = TURN * torch.linalg.det(TURN)
MOVE = torch.tensor([0.2, -0.3, 4.0], dtype=torch.float64)
GIVEN = {"type": "perspective", "K": K, "R": TURN.tolist(), "t": MOVE.tolist()}
FILM = {"width": WIDTH, "height": HEIGHT, "filter": "box"}
POINTS = TURN.T @ (
    numbers(3, 20, 4) * torch.tensor([[2.0], [2], [3]]) + torch.tensor([[-1.0], [-1], [2]]) - MOVE[:, None]
)


def kornia(matrices: PinholeMatrices, width: int = WIDTH, height: int = HEIGHT) -> PinholeCamera:
    """Kornia's camera of the same matrices."""
    inner, outer = torch.eye(4, dtype=matrices.K.dtype)[None], torch.eye(4, dtype=matrices.K.dtype)[None]
    inner[0, :3, :3], outer[0, :3, :3], outer[0, :3, 3] = matrices
    return PinholeCamera(inner, outer, torch.tensor([height]), torch.tensor([width]))


def loaded(camera: dict[str, Any] = GIVEN, **more: Any) -> torchpt.Scene:
    return torchpt.load({"camera": camera, "film": FILM, **more}, "cpu")


def given() -> PinholeMatrices:
    return PinholeMatrices(torch.tensor(K, dtype=torch.float64), TURN, MOVE)


def test_rays_go_through_the_points_that_kornia_projects():
    scene = loaded()
    x, y = kornia(given()).project(POINTS.T[None])[0].T
    film = settings(scene.description).film
    camera = scene.camera(film, {k: torch.as_tensor(v) for k, v in scene.built.parameters.items()}, torch.float64)
    o, d = camera.rays(x, y, None)
    way = POINTS - o
    assert torch.allclose(o[:, 0], -(TURN.T @ MOVE), atol=1e-12)
    assert torch.allclose(d, way / way.norm(dim=0), atol=1e-12)


def test_what_goes_in_comes_out():
    found = loaded().pinhole(dtype=torch.float64)
    for ours, theirs in zip(found, given(), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5)  # parameters are float32
    half = loaded().pinhole(film={"width": WIDTH // 2, "height": HEIGHT // 2})
    assert torch.allclose(half.K[:2], 0.5 * found.K[:2].float()) and half.K.dtype == torch.float32
    scaled = kornia(given()).scale(torch.tensor([0.5], dtype=torch.float64))
    assert torch.allclose(half.K.double(), scaled.camera_matrix[0], atol=1e-4)


@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger", "diagonal"])
@pytest.mark.parametrize("name", [name for name, keys in CAMERAS.items() if keys["type"] != "orthographic"])
def test_any_camera_with_an_angle_projects_by_its_matrices(name, axis):
    keys = {**CAMERAS[name], "fov_axis": axis}
    camera = made(keys, 9, 14)
    place = numbers(2, 30, 1) * camera.film[:, None]
    o, d = camera.rays(place[0], place[1], torch.full((2, 30), 0.5, dtype=torch.float64) if camera.lens else None)
    scene = torchpt.load({"camera": {**POSE, **keys}}, "cpu")
    matrices = scene.pinhole(film={"width": 9, "height": 14}, dtype=torch.float64)
    again = kornia(matrices, 9, 14).project((o + 3.0 * d).T[None])[0].T
    assert torch.allclose(again, place, atol=2e-5)


def test_plain_matrices_make_a_plain_camera():
    for film in (FILM, {}):
        plain = {
            "K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]],
            "R": np.eye(3),
            "t": torch.zeros(3),
            "size": [WIDTH, HEIGHT],
        }
        scene = torchpt.load({"camera": plain, "film": film}, "cpu")
        assert set(scene.params) == {"camera.to_world", "camera.fov"}
        angle = 2 * np.degrees(np.arctan(32 / 60))
        aimed = torchpt.load(
            {"camera": {"origin": [0, 0, 0], "target": [0, 0, 1], "up": [0, -1, 0], "fov": float(angle)}}, "cpu"
        )
        for name, value in aimed.params.items():
            assert torch.allclose(scene.params[name], value), name


@pytest.mark.parametrize("key", ["K", "R", "t"])
def test_gradients(key):
    scene = loaded()
    names = [name for name in scene.params if name.startswith("camera.")]
    leaves = [scene.params[name].double().requires_grad_() for name in names]

    def matrices(*values: torch.Tensor) -> torch.Tensor:
        return getattr(scene.pinhole(dict(zip(names, values, strict=True)), dtype=torch.float64), key)

    assert torch.autograd.gradcheck(matrices, leaves, eps=1e-6, atol=1e-5)
    reached = torch.autograd.grad(matrices(*leaves).square().sum(), leaves, allow_unused=True)
    moved = {name for name, gradient in zip(names, reached, strict=True) if gradient is not None and gradient.any()}
    numbers_of = {
        "camera.fov",
        "camera.principal_point_offset_x",
        "camera.principal_point_offset_y",
        "camera.pixel_aspect",
    }
    assert moved == (numbers_of if key == "K" else {"camera.to_world"} if key == "t" else moved)


def test_a_picture_shows_points_where_they_are_projected():
    world = torch.stack(
        [TURN.T @ (torch.tensor(p, dtype=torch.float64) - MOVE) for p in ((-1.0, -0.8, 4), (1.2, 1, 5))]
    )
    places = kornia(given()).project(world[None])[0]
    for point, place in zip(world, places, strict=True):
        shapes = {"dot": {"type": "sphere", "center": point.tolist(), "radius": 0.15, "emission": 1}}
        image = shoot(loaded(shapes=shapes), 64, 1, "sobol", {"max_depth": 1}, FILM).image[..., 0].double()
        y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
        centre = torch.stack(((image * x).sum(), (image * y).sum())) / image.sum()
        assert torch.allclose(centre, place, atol=0.05)


def test_of_parallel_rays_there_is_no_such_matrix():
    with pytest.raises(SceneError, match=r"camera\.type: expected a camera with an angle of view, got 'orthographic'"):
        loaded({**POSE, "type": "orthographic"}).pinhole()


def changed(key: str, value: Any) -> dict[str, Any]:
    return {name: x for name, x in {**GIVEN, "size": [WIDTH, HEIGHT], key: value}.items() if x is not None}


@pytest.mark.parametrize(
    ("camera", "key", "words"),
    [
        (changed("K", [[70, 2, 32], [0, 70, 24], [0, 0, 1]]), "K.0.1", "no skew"),
        (changed("K", [[70, 0, 32], [0, -70, 24], [0, 0, 1]]), "K.1.1", "y points down"),
        (changed("K", [[70, 0, 32], [0, 70, 24], [0, 0, -1]]), "K", "pixels"),
        (changed("K", [[70, 0], [0, 70]]), "K", "pixels"),
        (changed("K", [[1e-38, 0, 32], [0, 1e30, 24], [0, 0, 1]]), "K", "size of a picture"),
        (changed("K", 5), "K", "pixels"),
        (changed("R", (2 * TURN).tolist()), "R", "orthogonal"),
        (changed("R", (-TURN).tolist()), "R", "determinant 1"),
        (changed("R", None), "R", "go together"),
        (changed("t", None), "t", "go together"),
        (changed("t", [1, 2]), "t", "three finite numbers"),
        (changed("fov", 40), "fov", "either K or fov, not both"),
        (changed("pixel_aspect", 2), "pixel_aspect", "either K or pixel_aspect"),
        (changed("size", [0, 4]), "size", "whole numbers"),
        (changed("K", None), "size", "only beside K"),
        (changed("origin", [0, 0, 1]), "R", "either origin, target and up or R and t, not both"),
        (changed("to_world", np.eye(4).tolist()), "R", "either to_world or R and t, not both"),
        ({**GIVEN, "type": "orthographic"}, "K", "belongs to perspective, thinlens"),
    ],
)  # fmt: skip
def test_matrices_that_no_camera_has(camera, key, words):
    with pytest.raises(SceneError) as caught:
        loaded(camera)
    assert caught.value.key == f"camera.{key}" and words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_pixels_of_which_picture():
    with pytest.raises(SceneError, match=r"camera\.size.*width, height"):
        torchpt.load({"camera": GIVEN}, "cpu")
