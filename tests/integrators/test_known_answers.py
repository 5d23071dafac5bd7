"""Pictures whose values are known in closed form."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few
from trials import estimate, film_of, shoot

# Radiance 1 over a Lambert floor of albedo 0.5 at the origin, normal +y: outgoing radiance.
TRIANGLES = [
    (((-0.443432, 0.596366, 0.495985), (-0.320397, 0.0677699, -0.229359), (0.0341197, 0.11415, -0.343049)), 0.0898394),
    (((0.461963, 0.397843, 0.412747), (-0.0381582, 0.851323, -0.156872), (0.195443, 0.891957, -0.260672)), 0.02292),
    (((0.100871, 0.289075, -0.422609), (-0.308386, 0.629587, 0.423966), (-0.373132, 0.237287, 0.351592)), 0.0534198),
    (((-0.17575, 0.639397, 0.151268), (0.318604, 0.732996, 0.459771), (0.139095, 0.294498, 0.478556)), 0.0205314),
    (((-0.17487, 0.447916, 0.367201), (-0.405259, 0.249607, -0.354079), (0.356029, 0.0918984, -0.132271)), 0.26174),
]
FACE_DOWN = {"rotate": {"axis": [1, 0, 0], "angle": 90}}
FACE_UP = {"rotate": {"axis": [1, 0, 0], "angle": -90}}


def floor(albedo: float = 0.5, size: float = 10.0) -> dict[str, Any]:
    return {
        "type": "rectangle",
        "material": {"type": "diffuse", "reflectance": [albedo] * 3},
        "transform": [{"scale": size}, FACE_UP],
    }


def origin_camera(height: float = 0.02) -> dict[str, Any]:
    """Below every light, at the origin's point: the whole film spans 1e-4 of the height."""
    return {"origin": [0.01 * height, height, 0.0], "target": [0, 0, 0], "up": [1, 0, 0], "fov": 0.005}


def at_origin(shapes: dict[str, Any], strategy: str, spp: int, size: int = 64, height: float = 0.02, **keys: Any):
    """Radiance of the floor's origin and its standard error; every pixel is an estimate of its own."""
    scene = {"camera": origin_camera(height), "shapes": {"floor": floor(), **shapes}, **keys}
    integrator = {"strategy": strategy, "max_depth": 2}
    image = shoot(scene, spp, seed=1, sampler="sobol", integrator=integrator, film=film_of(size)).image
    mean, error = estimate(image)
    return float(mean[1]), float(error[1])


def polygon_irradiance(corners: torch.Tensor) -> float:
    """Lambert's formula at the origin with normal +y: half the sum of arcs times their normals' cosines."""
    unit = corners / corners.norm(dim=1, keepdim=True)
    after = unit.roll(-1, 0)
    arc = torch.atan2(torch.linalg.cross(unit, after).norm(dim=1), (unit * after).sum(1))
    gamma = torch.nn.functional.normalize(torch.linalg.cross(unit, after), dim=1)
    return abs(float((arc * gamma[:, 1]).sum())) / 2


@pytest.mark.parametrize(("corners", "expected"), TRIANGLES)
def test_the_triangle_values_are_lamberts(corners, expected):
    assert 0.5 / math.pi * polygon_irradiance(torch.tensor(corners, dtype=torch.float64)) == pytest.approx(
        expected, rel=1e-5
    )


@pytest.mark.parametrize("strategy", few(["mis", "light", "bsdf"], 2))
@pytest.mark.parametrize(("corners", "expected"), few(TRIANGLES, 2))
def test_triangle_light(corners, expected, strategy):
    # 15 comparisons at three standard errors; the error stays below 0.3 % (1.5 % where the light is found by chance).
    c = torch.tensor(corners)
    towards = torch.linalg.cross(c[1] - c[0], c[2] - c[0]) @ -c[0]
    light = {
        "type": "mesh",
        "vertices": [list(p) for p in corners],
        "faces": [[0, 1, 2]],
        "emission": [1, 1, 1],
        "flip_normals": bool(towards < 0),
        "face_normals": True,
    }
    value, error = at_origin({"light": light}, strategy, spp=32)
    assert error / expected <= (0.015 if strategy == "bsdf" else 0.003)
    assert abs(value - expected) <= 3 * error


def furnace(albedo: float, emission: float = 1.0, kind: str = "cube") -> dict[str, Any]:
    return {
        "camera": {"origin": [0.1, -0.2, 0.3], "target": [0.7, 0.4, -0.3], "fov": 60},
        "shapes": {
            "room": {
                "type": kind,
                "flip_normals": True,
                "emission": [emission] * 3,
                "material": {"type": "diffuse", "reflectance": [albedo] * 3},
            }
        },
    }


@pytest.mark.parametrize("albedo", few([0.5, 0.8], 1))
@pytest.mark.parametrize("max_depth", [-1, 60])
@pytest.mark.parametrize("strategy", ["mis", "bsdf"])
def test_closed_furnace(albedo, max_depth, strategy):
    integrator = {"max_depth": max_depth, "strategy": strategy}
    mean, error = estimate(shoot(furnace(albedo), 8, integrator=integrator, film=film_of(48)).image)
    expected = 1 / (1 - albedo)
    assert float(error.max()) < 0.01 * expected
    assert (mean - expected).abs().max() <= 3.9 * error.max()  # 8 comparisons of one channel each: 1e-3 in all


@pytest.mark.parametrize("bounces", [0, 1, 2, 3, 5])
def test_furnace_after_n_bounces(bounces):
    a = 0.8
    expected = (1 - a ** (bounces + 1)) / (1 - a)
    integrator = {"max_depth": bounces + 1, "rr_depth": 100}
    # Found by BSDF sampling alone each path carries the series itself: no noise but rounding.
    exact = shoot(furnace(a), 4, integrator={**integrator, "strategy": "bsdf"}, film=film_of(8)).image
    torch.testing.assert_close(exact, torch.full_like(exact, expected), rtol=1e-5, atol=0)
    mean, error = estimate(shoot(furnace(a), 16, integrator={**integrator, "strategy": "mis"}, film=film_of(32)).image)
    assert (mean - expected).abs().max() <= 3.9 * error.max() + 1e-6


def test_unit_sphere_from_inside():
    image = shoot(furnace(0.5, 0.5, "sphere"), 16, integrator={"max_depth": 40}, film=film_of(48)).image
    mean, error = estimate(image)
    assert error.max() < 5e-3
    assert (mean - 1).abs().max() <= 3.3 * error.max()
    exact = shoot(
        furnace(0.5, 0.5, "sphere"),
        4,
        integrator={"max_depth": 40, "strategy": "bsdf", "rr_depth": 100},
        film=film_of(8),
    )
    assert (exact.image - 1).abs().max() < 1e-5


@pytest.mark.parametrize("strategy", ["mis", "light"])
@pytest.mark.parametrize(("radius", "distance"), [(1.0, 1.0), (1.0, 0.05), (0.01, 1.0), (1.0, 1000.0)])
def test_disc_light(radius, distance, strategy):
    lamp = {"type": "disk", "emission": [1, 1, 1], "transform": [{"scale": radius}, FACE_DOWN]}
    lamp["transform"].append({"translate": [0, distance, 0]})
    expected = 0.5 * radius**2 / (radius**2 + distance**2)
    # A light so near that its solid angle is all but the hemisphere is found by chance: not for light sampling alone.
    if strategy == "light" and distance < 0.1:
        expected_error = 0.2
    else:
        expected_error = 0.003
    value, error = at_origin({"lamp": lamp}, strategy, spp=16, height=min(0.02, distance / 10))
    assert error / expected <= expected_error
    assert abs(value - expected) <= 3.5 * error + 1e-6 * expected


@pytest.mark.parametrize("strategy", few(["mis", "light"], 2))
@pytest.mark.parametrize(
    ("radius", "distance"),
    few([(0.5, 1.0), (1.0, 1.01), (1.0, 1.00001), (1e-3, 1.0), (1e-4, 10.0), (0.5, 1000.0), (1e-3, 3000.0)], 4),
)
def test_sphere_light(radius, distance, strategy):
    lamp = {"type": "sphere", "radius": radius, "center": [0, distance, 0], "emission": [1, 1, 1]}
    expected = 0.5 * (radius / distance) ** 2
    height = min(0.02, 0.1 * (distance - radius))
    value, error = at_origin({"lamp": lamp}, strategy, spp=16, height=height)
    assert error / expected <= 0.003
    # 1.00001: the light's own rounding in float32 shows in the distance to it, not in its solid angle.
    assert abs(value - expected) <= 3.5 * error + (1e-4 if distance < 1.001 else 1e-5) * expected


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf"])
def test_floor_inside_a_sphere_light(strategy):
    shell = {"type": "sphere", "radius": 3.0, "center": [0.2, 1, 0.1], "emission": [1, 1, 1], "flip_normals": True}
    shapes = {"shell": shell, "floor": floor(size=0.5)}
    value, error = at_origin(shapes, strategy, spp=16)
    assert error < 0.005
    assert abs(value - 0.5) <= 3.5 * error + 1e-6


def test_a_sphere_light_is_dark_from_inside():
    shell = {"type": "sphere", "radius": 3.0, "emission": [1, 1, 1]}
    for strategy in ("mis", "light", "bsdf"):
        value, _ = at_origin({"shell": shell, "floor": floor(size=0.5)}, strategy, spp=4, size=8)
        assert value == 0


def test_constant_environment_fills_the_picture():
    scene = {"camera": origin_camera(), "lights": {"sky": {"type": "constant", "radiance": [1, 1, 1]}}}
    assert torch.equal(shoot(scene, 4, film=film_of(16)).image, torch.ones(16, 16, 3))


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf", "uniform"])
@pytest.mark.parametrize("albedo", [0.18, 1.0])
def test_lambert_plane_under_a_constant_environment(albedo, strategy):
    sky = {"sky": {"type": "constant", "radiance": [1, 1, 1]}}
    shapes = {"floor": floor(albedo)}
    value, error = at_origin(shapes, strategy, spp=16, size=48, lights=sky)
    assert error < 0.01 * albedo
    assert abs(value - albedo) <= 3.9 * error + 1e-6
    if strategy == "bsdf":
        assert error < 1e-6


def test_a_sphere_of_constant_emission():
    ball = {"type": "sphere", "emission": [1, 1, 1], "material": {"type": "diffuse", "reflectance": [0, 0, 0]}}
    scene = {"camera": {"origin": [0, 0, 5], "target": [0, 0, 0], "fov": 10}, "shapes": {"ball": ball}}
    assert torch.equal(shoot(scene, 4, film=film_of(16)).image, torch.ones(16, 16, 3))


def test_white_furnace_of_a_lossless_sphere():
    scene = {
        "camera": {"origin": [0, 0, 5], "target": [0, 0, 0], "fov": 40},
        "lights": {"sky": {"type": "constant", "radiance": [1, 1, 1]}},
        "shapes": {"ball": {"type": "sphere", "material": {"type": "diffuse", "reflectance": [1, 1, 1]}}},
    }
    exact = shoot(scene, 4, integrator={"strategy": "bsdf"}, film=film_of(32)).image
    torch.testing.assert_close(exact, torch.ones_like(exact), rtol=2e-6, atol=0)
    mean, error = estimate(shoot(scene, 16, film=film_of(32)).image)
    assert error.max() < 5e-3
    assert (mean - 1).abs().max() <= 3.3 * error.max()
