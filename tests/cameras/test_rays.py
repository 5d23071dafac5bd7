"""Rays of each camera against the optics that they stand for."""

from __future__ import annotations

import math

import pytest
import torch
from optics import CAMERAS, LENS, POSE, made, numbers

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.transforms import look_at

N = 4096
FILM = numbers(2, N) * torch.tensor([[8.0], [6.0]], dtype=torch.float64)
U = numbers(2, N, 1)
FRAME = torch.from_numpy(look_at(**POSE))


def seen(p: torch.Tensor) -> torch.Tensor:
    """Points ``(3, N)`` of the world in the camera's frame: left, up, depth."""
    return FRAME[:3, :3].T @ (p - FRAME[:3, 3:])


def rays(name: str | dict, u: torch.Tensor = U) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and directions ``(3, N)`` in the camera's frame."""
    camera = made(CAMERAS[name] if isinstance(name, str) else name)
    o, d = camera.rays(FILM[0], FILM[1], u if camera.lens else None)
    return seen(o.expand_as(d)), FRAME[:3, :3].T @ d


@pytest.mark.parametrize("name", CAMERAS)
def test_directions_are_unit_and_look_ahead(name):
    _, d = rays(name)
    assert torch.allclose(d.norm(dim=0), torch.ones((), dtype=torch.float64), atol=1e-12)
    assert d[2].min() > 0


def test_image_right_is_the_view_times_up():
    camera = made(CAMERAS["perspective"])
    x, y = torch.tensor([[8.0, 4, 4], [3, 0, 3]], dtype=torch.float64)
    _, d = camera.rays(x, y, None)
    view = torch.tensor(POSE["target"], dtype=torch.float64) - torch.tensor(POSE["origin"], dtype=torch.float64)
    up = torch.tensor(POSE["up"], dtype=torch.float64)
    right = torch.linalg.cross(view, up)
    assert torch.allclose(d[:, 2], view / view.norm(), atol=1e-12)
    assert d[:, 0] @ right > 0 and abs(float(d[:, 0] @ FRAME[:3, 1])) < 1e-12
    assert d[:, 1] @ up > 0 and abs(float(d[:, 1] @ right)) < 1e-9
    assert float(d[:, 0] @ d[:, 2]) == pytest.approx(math.cos(math.radians(17.5)), rel=1e-6)  # fov 35 along x


def test_rays_through_a_lens_meet_in_the_plane_in_focus():
    for name in ("thinlens", "hexagon"):
        o, d = rays(name)
        _, pinhole = rays("perspective")
        sharp = o + d * ((4.2 - o[2]) / d[2])
        assert torch.allclose(sharp, pinhole * (4.2 / pinhole[2]), atol=1e-5)
        assert o[2].abs().max() < 1e-12
        assert 0.25 < o[:2].norm(dim=0).max() <= 0.3 * (1 + 1e-6)


@pytest.mark.parametrize("blades", [0, 3, 7])
def test_a_lens_without_extent_is_a_pinhole_to_the_last_bit(blades):
    for dtype in (torch.float32, torch.float64):
        lens = made({**LENS, "aperture_radius": 0, "blades": blades}, dtype=dtype)
        pinhole = made(CAMERAS["perspective"], dtype=dtype)
        x, y = FILM.to(dtype)
        o, d = lens.rays(x, y, U.to(dtype))
        origin, expected = pinhole.rays(x, y, None)
        assert torch.equal(o, origin.expand_as(o)) and torch.equal(d, expected)


def test_sizes_at_the_ends_of_float32():
    x, y = FILM.float()
    for radius, focus in ((1e-30, 1e30), (1e30, 1e-30), (1e30, 1e30), (1e-30, 1e-30), (0.0, 1e37)):
        lens = made({**LENS, "aperture_radius": radius, "focus_distance": focus}, dtype=torch.float32)
        o, d = lens.rays(x, y, U.float())
        assert torch.isfinite(o).all()
        assert (d.double().norm(dim=0) - 1).abs().max() < 1e-6


def test_parallel_rays_spread_over_the_width():
    o, d = rays("orthographic")
    assert torch.allclose(d, torch.tensor([[0.0], [0], [1]], dtype=torch.float64).expand_as(d), atol=1e-12)
    expected = torch.stack((-(FILM[0] / 8 - 0.5) * 3.5, (0.5 - FILM[1] / 6) * 3.5 * 6 / 8, torch.zeros(N)))
    assert torch.allclose(o, expected, atol=1e-12)


def test_a_matrix_is_as_good_as_a_target():
    for camera in CAMERAS.values():
        posed = torchpt.load({"camera": {**camera, "to_world": FRAME.tolist()}}, "cpu")
        aimed = torchpt.load({"camera": {**camera, **POSE}}, "cpu")
        assert posed.params.keys() == aimed.params.keys()
        assert all(torch.equal(posed.params[name], aimed.params[name]) for name in posed.params)


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("perspective", {"fov"}),
        ("thinlens", {"fov", "aperture_radius", "focus_distance"}),
        ("orthographic", {"width"}),
    ],
)
def test_parameters(name, keys):
    scene = torchpt.load({"camera": {**POSE, **CAMERAS[name]}}, "cpu")
    assert set(scene.params) == {"camera.to_world", *(f"camera.{key}" for key in keys)}
    assert all(float(scene.params[f"camera.{key}"]) == pytest.approx(CAMERAS[name][key]) for key in keys)


@pytest.mark.parametrize(
    ("name", "key", "value", "words"),
    [
        ("perspective", "fov", 180.0, "> 0 and < 180"),
        ("perspective", "fov", 0.0, "> 0 and < 180"),
        ("thinlens", "aperture_radius", -1e-6, ">= 0"),
        ("thinlens", "focus_distance", 0.0, "> 0"),
        ("thinlens", "focus_distance", float("nan"), "finite"),
        ("thinlens", "focus_distance", float("inf"), "finite"),
        ("orthographic", "width", -1.0, "> 0"),
        ("orthographic", "fov", 30.0, "a parameter of this scene"),
    ],
)
def test_parameters_that_no_scene_could_hold(name, key, value, words):
    scene = torchpt.load({"camera": {**POSE, **CAMERAS[name]}}, "cpu")
    with pytest.raises(SceneError, match=words) as caught:
        torchpt.render(scene, params={f"camera.{key}": torch.tensor(value)}, spp=1)
    assert caught.value.key == f"params.camera.{key}"
    assert "\n" not in str(caught.value)
