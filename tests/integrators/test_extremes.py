"""Scenes at the edge: empty, dark, cameras inside solids, radiance and albedo at their limits."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from trials import estimate, film_of, shoot

import torchpt
from torchpt.paths.integrators import base

CAMERA = {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40}
SKY = {"sky": {"type": "constant", "radiance": [0.25, 0.5, 1.0]}}


def room(albedo: float, radiance: float) -> dict[str, Any]:
    walls = {"type": "cube", "flip_normals": True, "material": {"type": "diffuse", "reflectance": [albedo] * 3}}
    lamp = {"type": "sphere", "center": [0, 0.5, 0], "radius": 0.2, "emission": [radiance] * 3}
    return {
        "camera": {"origin": [0, 0, 0.9], "target": [0, 0, -1], "fov": 80},
        "shapes": {"walls": walls, "lamp": lamp},
    }


@pytest.mark.parametrize("strategy", ["mis", "bsdf", "light", "uniform"])
def test_an_empty_scene_is_black(strategy):
    assert not shoot({"camera": CAMERA}, 2, integrator={"strategy": strategy}, film=film_of(5)).image.any()


@pytest.mark.parametrize("strategy", ["mis", "bsdf", "light", "uniform"])
def test_an_empty_scene_shows_its_environment(strategy):
    image = shoot({"camera": CAMERA, "lights": SKY}, 2, integrator={"strategy": strategy}, film=film_of(5)).image
    assert torch.equal(image, torch.tensor([0.25, 0.5, 1.0]).expand(5, 5, 3))


@pytest.mark.parametrize("strategy", ["mis", "bsdf", "light", "uniform"])
def test_without_a_light_all_is_black(strategy):
    scene = {"camera": CAMERA, "shapes": {"ball": {"type": "sphere"}, "block": {"type": "cube"}}}
    assert not shoot(scene, 2, integrator={"strategy": strategy}, film=film_of(9)).image.any()


def test_one_triangle_covers_its_share():
    triangle = {
        "type": "mesh",
        "vertices": [[-1, -1, 0], [1, -1, 0], [0, 1, 0]],
        "faces": [[0, 1, 2]],
        "emission": [3, 2, 1],
    }
    camera = {
        "origin": [0, 0, 4],
        "target": [0, 0, 0],
        "fov": 53.13010235415598,
    }  # 4 wide at the triangle: area 2 of 16
    mean, error = estimate(shoot({"camera": camera, "shapes": {"t": triangle}}, 16, film=film_of(64)).image)
    assert float(error[0]) < 0.02  # of the spread over the picture; within it the shares are much nearer
    torch.testing.assert_close(mean, torch.tensor([3.0, 2.0, 1.0], dtype=torch.float64) / 8, rtol=5e-3, atol=0)
    behind = shoot({"camera": {**camera, "origin": [0, 0, -4]}, "shapes": {"t": triangle}}, 4, film=film_of(16))
    assert not behind.image.any()


def test_a_camera_inside_a_solid_sees_neither_sky_nor_outward_light():
    for solid in ("cube", "sphere"):
        block = {"type": solid, "emission": [5, 5, 5]}
        scene = {"camera": {"origin": [0, 0, 0], "target": [0, 0, 1]}, "shapes": {"block": block}, "lights": SKY}
        assert not shoot(scene, 8, integrator={"max_depth": 6}, film=film_of(16)).image.any()


def test_touching_and_overlapping_walls_do_not_leak():
    # A closed cube standing on a floor of the same plane, and two that share a face, under a bright sky.
    shapes: dict[str, Any] = {
        "room": {"type": "cube"},
        "neighbour": {"type": "cube", "transform": [{"translate": [2, 0, 0]}]},
        "floor": {
            "type": "rectangle",
            "transform": [{"scale": 5}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"translate": [0, -1, 0]}],
        },
    }
    camera = {"origin": [0.3, 0.1, 0.2], "target": [1, -1, -1], "fov": 120}
    scene = {"camera": camera, "shapes": shapes, "lights": {"sky": {"type": "constant", "radiance": [1e6] * 3}}}
    assert not shoot(scene, 8, integrator={"max_depth": 8}, film=film_of(128)).image.any()


@pytest.mark.parametrize("albedo", [0.0, 0.5, 1.0])
def test_radiance_and_albedo_at_their_limits(albedo):
    # Shapes scale with the light: the picture over its radiance is the same to rounding.
    dim, plain, bright = (
        shoot(room(albedo, radiance), 2, integrator={"max_depth": 12}, film=film_of(34)).image.double() / radiance
        for radiance in (1e-30, 1.0, 1e30)
    )
    assert plain.amax() > 0
    for image in (dim, bright):
        assert torch.isfinite(image).all()
        torch.testing.assert_close(image, plain, rtol=1e-4, atol=1e-7)


@pytest.mark.slow
def test_a_closed_room_of_albedo_one_ends():
    image = shoot(room(1.0, 1.0), 2, integrator={"max_depth": -1}, film=film_of(8))
    assert torch.isfinite(image.image).all()
    assert image.truncated_paths == 0


def test_endless_paths_are_ended_and_counted(monkeypatch):
    monkeypatch.setattr(base, "ENDLESS", 100)
    never = {"max_depth": -1, "rr_depth": 2**31 - 1, "strategy": "bsdf"}
    shot = shoot(room(1.0, 1.0), 1, integrator=never, film=film_of(2, 1))
    assert torch.isfinite(shot.image).all()
    assert shot.truncated_paths == 2
    assert shot.summary()["truncated_paths"] == 2


def test_a_light_close_to_its_floor():
    # 1e-4 above it: light sampling alone has 1/d^2 spikes, MIS keeps the error small. Under the disc E is all but pi L.
    lamp = {
        "type": "disk",
        "emission": [1, 1, 1],
        "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1e-4, 0]}],
    }
    floor = {"type": "rectangle", "transform": [{"scale": 5}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
    camera = {"origin": [0.2, 5e-5, 0.0], "target": [0.2001, 0, 0], "fov": 0.1}
    scene = {"camera": camera, "shapes": {"lamp": lamp, "floor": floor}}
    mean, error = estimate(shoot(scene, 16, integrator={"max_depth": 2}, film=film_of(32)).image)
    assert float(error[0]) < 2e-3
    assert abs(float(mean[0]) - 0.5) < 4 * float(error[0]) + 1e-6


def test_one_light_among_many_a_million_times_brighter():
    # Choice by power: 2,000 dim triangles beside a bright one must not drown it.
    shapes: dict[str, Any] = {
        "bright": {
            "type": "rectangle",
            "emission": [1e6] * 3,
            "transform": [{"scale": 0.01}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1, 0]}],
        },
        "floor": {"type": "rectangle", "transform": [{"scale": 50}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]},
    }
    corners, faces = [], []
    for k in range(2000):
        x = 5 + 0.01 * k
        corners += [[x, 0.5, 0], [x, 0.5, 0.01], [x + 0.005, 0.5, 0]]
        faces.append([3 * k, 3 * k + 2, 3 * k + 1])
    shapes["dim"] = {"type": "mesh", "vertices": corners, "faces": faces, "emission": [1, 1, 1], "face_normals": True}
    camera = {"origin": [0, 0.02, 0.001], "target": [0, 0, 0], "fov": 0.01}
    mean, error = estimate(
        shoot({"camera": camera, "shapes": shapes}, 16, integrator={"max_depth": 2}, film=film_of(32)).image
    )
    expected = 0.5 / torch.pi * 1e6 * 4e-4  # far enough to be a point: E = L A / d^2, to within its own size
    assert float(error[0]) < 2e-3 * expected
    assert float(mean[0]) == pytest.approx(expected, rel=1e-2)


def test_the_layer_of_positions_is_of_the_world_though_lanes_count_from_elsewhere() -> None:
    """A scene far from the origin is moved there to be rendered."""
    place = [1e5, -2e5, 3e5]
    wall = {"type": "rectangle", "transform": [{"scale": 4}, {"translate": place}]}
    camera = {"origin": [place[0], place[1], place[2] + 5], "target": place, "fov": 30}
    scene = torchpt.load({"camera": camera, "shapes": {"wall": wall}}, "cpu")
    film = {"width": 8, "height": 8, "filter": "box", "aovs": ["position"]}
    position = torchpt.render(scene, spp=4, film=film, integrator="aov", full=True)["position"]
    assert float((position - torch.tensor(place)).abs().amax()) < 2.0
    assert float((position[..., 2] - place[2]).abs().amax()) < 0.1
