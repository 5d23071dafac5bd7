"""Lights: what sampling says of its density is what a chance hit is told, and 1 / pdf integrates to the solid angle."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p

import torchpt
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import dot
from torchpt.physics import lights
from torchpt.physics.lights.surfaces import sphere
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.shapes.interaction import OFFSET

G = torch.Generator().manual_seed(12)
N = 1 << 15
TILT = {"rotate": {"axis": [1, 2, 0.5], "angle": 100}}
ONE = [1.0, 1.0, 1.0]
CORNERS = [[-0.3, 1.0, 0.2], [0.4, 1.3, -0.1], [0.1, 0.8, -0.5]]

SHAPES: dict[str, dict[str, Any]] = {
    "triangle": {"type": "mesh", "vertices": CORNERS, "faces": [[0, 1, 2]], "face_normals": True},
    "rectangle": {"type": "rectangle", "transform": [{"scale": [0.7, 0.3, 1]}, TILT, {"translate": [0.1, 1, 0.3]}]},
    "ellipse": {"type": "disk", "transform": [{"scale": [0.7, 0.3, 1]}, TILT, {"translate": [0.1, 1, 0.3]}]},
    "sphere": {"type": "sphere", "center": [0.2, 2, 0.4], "radius": 0.9},
    "small sphere": {"type": "sphere", "center": [0.2, 5, 0.4], "radius": 1e-3},
    "shell": {"type": "sphere", "center": [0.2, 0.5, 0.4], "radius": 3.0, "flip_normals": True},
}


def scene_of(names: list[str], radiance: dict[str, float] | None = None, sky: float | None = None) -> torchpt.Scene:
    shapes = {name: {**SHAPES[name], "emission": [(radiance or {}).get(name, 1.0)] * 3} for name in names}
    shapes["far"] = {
        "type": "sphere",
        "center": [0, 0, -60],
        "radius": 20,
    }  # keeps the origin where it is; the last row
    scene = {"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": shapes}
    if sky is not None:
        scene["lights"] = {"sky": {"type": "constant", "radiance": [sky] * 3}}
    return torchpt.load(scene, device="cpu")


def facing(name: str) -> Tensor:
    """A point that sees the light's front: the origin, or its mirror image in the light's plane."""
    world, _ = scene_of([name]).world(torch.float64)
    x = torch.zeros(3, 1, dtype=torch.float64)
    if name not in ("sphere", "small sphere", "shell"):
        n, p = world.geometry.normal[:, :1], world.geometry.p0[:, :1]
        height = dot(n, x - p)
        x = x if float(height) > 0 else x - 2 * height * n
    return x.float()


def solid_angle(name: str, x: Tensor) -> float:
    """By area: a fine grid over the primitive, in float64; for spheres in closed form."""
    if name == "shell":
        return 4 * math.pi
    world, _ = scene_of([name]).world(torch.float64)
    p0, e1, e2 = (a[:, :1] for a in (world.geometry.p0, world.geometry.e1, world.geometry.e2))
    if "sphere" in name:
        sin2 = float(e1[0, 0] ** 2 / dot(p0 - x, p0 - x))
        return 2 * math.pi * sin2 / (1 + math.sqrt(1 - sin2))
    side = 300
    g = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    u, v = torch.cartesian_prod(g, g).T
    share = 1.0
    if name == "triangle":
        u, v, share = 1 - u.sqrt(), v * u.sqrt(), 0.5
    elif name == "ellipse":
        u, v, share = u.sqrt() * torch.cos(2 * math.pi * v), u.sqrt() * torch.sin(2 * math.pi * v), math.pi
    to = p0 + e1 * u + e2 * v - x
    area = torch.linalg.cross(e1, e2, dim=0).norm() * share
    square = dot(to, to)
    return float((area * dot(to, world.geometry.normal[:, :1]).abs() / square**1.5).mean())


def drawn(scene: torchpt.Scene, x: Tensor, count: int = N):
    world, _ = scene.world(torch.float32)
    assert world.lights is not None
    choice = None if world.lights.choice is None else torch.rand(count, generator=G)
    u = torch.rand(2, count, generator=G)
    return world, lights.sample(world.lights, x.expand(3, count), choice, u, OFFSET)


@pytest.mark.parametrize("name", list(SHAPES))
def test_inverse_density_integrates_to_the_solid_angle(name):
    x = facing(name)
    _, light = drawn(scene_of([name]), x)
    weight = light.weight.double()
    error = float(weight.std()) / N**0.5
    # Spheres seen from outside have one density: exact. Six comparisons at four standard errors.
    assert abs(float(weight.mean()) - solid_angle(name, x)) < 4 * error + 2e-5 * solid_angle(name, x)
    assert (light.wi.norm(dim=0) - 1).abs().max() < 1e-6


@pytest.mark.parametrize("name", list(SHAPES))
def test_a_chance_hit_is_told_the_density_of_sampling(name):
    scene, x = scene_of([name]), facing(name)
    world, light = drawn(scene, x)
    assert world.lights is not None
    o = x.expand(3, N)
    t, prim, u, v = scene.accel("auto", None).intersect(o, light.wi, torch.full((N,), torch.inf))
    hit = prim >= 0
    assert hit.float().mean() > (0.99 if name == "small sphere" else 0.999)  # the rim may be missed by rounding
    hits = Hit(t[hit], prim[hit].long(), u[hit], v[hit])
    at = interact(world, o[:, hit], light.wi[:, hit], hits)
    radiance, pdf = lights.emitted(world.lights, o[:, hit], at, light.wi[:, hit])
    assert (radiance == 1).all()
    ratio = pdf / light.pdf[hit]
    assert float((ratio - 1).abs().median()) < 1e-5
    # Where the light is seen edge-on the cosine itself is rounding.
    assert float(((ratio - 1).abs() < 1e-3).double().mean()) > 0.99
    torch.testing.assert_close(light.pdf * light.weight, torch.ones(N), rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", ["triangle", "rectangle", "ellipse", "sphere"])
def test_nothing_comes_from_behind(name):
    x = facing(name)
    if name == "sphere":
        x = torch.tensor([[0.2], [2.0], [0.4]])  # its centre
    else:
        world, _ = scene_of([name]).world(torch.float32)
        n = world.geometry.normal[:, :1]
        x = x - 2 * dot(n, x - world.geometry.p0[:, :1]) * n
    _, light = drawn(scene_of([name]), x, 1000)
    assert not light.weight.any()
    assert torch.isfinite(light.pdf).all()


def test_lights_are_chosen_by_power():
    names = ["triangle", "rectangle", "sphere"]
    radiance = {"triangle": 3.0, "rectangle": 1.0, "sphere": 0.1}
    world, _ = scene_of(names, radiance).world(torch.float64, choice="power")
    table = world.lights
    assert table is not None and isinstance(table.choice, Distribution1D)
    areas = table.area
    power = areas * table.radiance[0]
    expected = 0.99 * power / power.sum() + 0.01 / 3  # a hundredth is even, see Discrete
    torch.testing.assert_close(table.choice.pmf, expected)
    row = table.choice.draw(torch.rand(N, generator=G))[0]
    counts = torch.bincount(row, minlength=3).double()
    expected = N * expected
    assert chi_square_p(float(((counts - expected) ** 2 / expected).sum()), 2) > SIGNIFICANCE


@pytest.mark.parametrize("sky", [None, 0.02])
def test_a_mixture_integrates_to_the_sum(sky):
    names = ["triangle", "sphere", "ellipse", "small sphere"]
    x = torch.zeros(3, 1)
    _, light = drawn(scene_of(names, {"small sphere": 1e5}, sky), x, 1 << 17)
    value = (light.radiance[0] * light.weight).double()
    expected = sum(solid_angle(n, x) * (1e5 if n == "small sphere" else 1.0) for n in names if _front(n, x))
    expected += 0.0 if sky is None else 4 * math.pi * sky
    assert abs(float(value.mean()) - expected) < 4 * float(value.std()) / (1 << 17) ** 0.5
    if sky is not None:
        assert light.distant is not None
        torch.testing.assert_close(light.pdf * light.weight, torch.ones_like(light.pdf), rtol=1e-5, atol=2)


def _front(name: str, x: Tensor) -> bool:
    world, _ = scene_of([name]).world(torch.float32)
    return "sphere" in name or float(dot(world.geometry.normal[:, :1], x - world.geometry.p0[:, :1])) > 0


def test_the_environment_alone():
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 5], "target": [0, 0, 0]},
            "lights": {"sky": {"type": "constant", "radiance": ONE}},
        },
        device="cpu",
    )
    world, light = drawn(scene, torch.zeros(3, 1))
    assert world.lights is not None and world.lights.choice is None
    radiance, pdf = lights.environment(world.lights, light.wi)
    torch.testing.assert_close(pdf, light.pdf)
    assert (radiance == 1).all()
    assert light.distant is not None and bool(light.distant.all())
    assert light.wi.double().mean(1).abs().max() < 4 / (3 * N) ** 0.5


@pytest.mark.parametrize("distance", [1.0000001, 1.00001, 1.01, 3.0, 1e2, 1e4, 1e7])
def test_spheres_near_and_far_keep_their_cone(distance):
    """Every point drawn lies on the sphere, on the side that is seen, and the density is that of the exact cone."""
    x = torch.tensor([[0.0], [0.0], [-distance]]).expand(3, 4096)
    centre, radius, flip = torch.zeros(3, 1), torch.ones(1), torch.ones(1)
    spot, normal = sphere.sample(x, centre, radius, flip, torch.rand(2, 4096, generator=G))
    assert (spot.norm(dim=0) - 1).abs().max() < 1e-6
    to = spot - x
    wi = to / to.norm(dim=0)
    sin2 = 1 / torch.tensor(distance, dtype=torch.float32).double() ** 2
    exact = float(2 * math.pi * sin2 / (1 + (1 - sin2).clamp_min(0).sqrt()))
    inverse = sphere.inverse_pdf(x, centre, radius, normal, wi, dot(to, to))
    seen = dot(wi, normal) < 0
    if distance > 1.000002:  # nearer, the whole sphere is sampled by area, of which next to nothing is seen
        assert seen.double().mean() > 0.999
        torch.testing.assert_close(
            inverse[seen].double(), torch.full_like(inverse[seen], exact).double(), rtol=2e-3, atol=0
        )
