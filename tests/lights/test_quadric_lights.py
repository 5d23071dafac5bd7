"""Cylinders, cones and ellipsoids as lights: the density of sampling is a density, and every way of sampling agrees."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from trials import film_of, shoot, spread, z_limit

import torchpt
from torchpt.core.errors import warn_once
from torchpt.math.sampling import Distribution1D, uniform_sphere
from torchpt.physics import lights
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.shapes.interaction import OFFSET

N = 1 << 16
SHEAR = {"matrix": [[1, 0.5, -0.2, 0.2], [0.1, 0.7, 0.4, 2.2], [-0.6, 0.2, 1.1, -0.4], [0, 0, 0, 1]]}
SHAPES: dict[str, dict[str, Any]] = {
    "ellipsoid": {"type": "sphere", "radius": 0.6, "transform": [{"scale": [1, 0.4, 2]}, {"translate": [0, 2, 0]}]},
    "sheared sphere": {"type": "sphere", "radius": 0.7, "transform": [SHEAR]},
    "cylinder": {"type": "cylinder", "radius": 0.3, "height": 1.5, "capped": False, "transform": [SHEAR]},
    "mirrored cone": {
        "type": "cone",
        "slope": 0.4,
        "height": -1.5,
        "capped": False,
        "transform": [
            {"scale": [-1, 1, 1.5]},
            {"rotate": {"axis": [1, 0, 0], "angle": 30}},
            {"translate": [1.6, 0, 1]},
        ],
    },
    "tube seen from within": {"type": "cylinder", "radius": 1.5, "height": 4, "capped": False, "flip_normals": True},
}


def drawn(name: str) -> tuple[torchpt.Scene, Any, torch.Tensor, Any]:
    shapes = {"light": {**SHAPES[name], "emission": [1, 1, 1]}}
    scene = torchpt.load({"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")
    world, _ = scene.world(torch.float32)
    assert world.lights is not None
    x = torch.tensor([[0.1], [-0.3], [0.2]]).expand(3, N)
    u = torch.rand(2, N, generator=torch.Generator().manual_seed(4))
    return scene, world, x, lights.sample(world.lights, x, None, u, OFFSET)


def seen(scene: torchpt.Scene, x: torch.Tensor, wi: torch.Tensor) -> tuple[Any, torch.Tensor]:
    t, prim, u, v = scene.accel("auto", None).intersect(x, wi, torch.full((x.shape[1],), torch.inf))
    hit = prim >= 0
    world, _ = scene.world(torch.float32)
    return interact(world, x[:, hit], wi[:, hit], Hit(t[hit], prim[hit].long(), u[hit], v[hit])), hit


@pytest.mark.parametrize("name", few(SHAPES, 3))
def test_inverse_density_integrates_to_the_solid_angle(name):
    """Against directions uniform over the sphere: those that hit the front, nothing of the shape lying before it."""
    scene, world, x, light = drawn(name)
    wi = uniform_sphere(torch.rand(2, N, generator=torch.Generator().manual_seed(5)))
    at, hit = seen(scene, x, wi)
    radiance, pdf = lights.emitted(world.lights, x[:, hit], at, wi[:, hit])
    share = torch.zeros(N, dtype=torch.float64)
    share[hit] = (radiance[0] > 0).double() * 4 * torch.pi
    # Of what is drawn, only what lies nearest counts: a front may hide behind another.
    met, reached = seen(scene, x, light.wi)
    nearest = torch.zeros(N, dtype=torch.bool)
    nearest[reached] = (met.p - light.target[:, reached]).norm(dim=0) < 1e-3
    weight = (light.weight * nearest).double()
    error = (share.var() / N + weight.var() / N).sqrt()
    assert abs(float(weight.mean() - share.mean())) < z_limit(len(SHAPES)) * float(error)
    # Where nothing hides, uniform directions integrate the density to one.
    if name != "tube seen from within":
        total = torch.zeros(N, dtype=torch.float64)
        total[hit] = pdf.double() * 4 * torch.pi
        front = float((light.weight > 0).double().mean())
        assert abs(float(total.mean()) - front) < z_limit(len(SHAPES)) * float(total.std()) / N**0.5 + 5e-3


@pytest.mark.parametrize("name", few(SHAPES, 3))
def test_a_chance_hit_is_told_the_density_of_sampling(name):
    scene, world, x, light = drawn(name)
    lit = light.weight > 0
    at, hit = seen(scene, x[:, lit], light.wi[:, lit])
    assert hit.float().mean() > 0.999
    same = (at.p - light.target[:, lit][:, hit]).norm(dim=0) < 1e-3
    assert same.float().mean() > 0.6
    _, pdf = lights.emitted(world.lights, x[:, lit][:, hit], at, light.wi[:, lit][:, hit])
    ratio = (pdf / light.pdf[lit][hit])[same]
    assert float((ratio - 1).abs().median()) < 1e-5
    assert float(((ratio - 1).abs() < 1e-3).double().mean()) > 0.98  # but where seen edge-on


def test_power_is_by_true_area():
    """An ellipsoid of revolution and a cone against their closed forms."""

    def area(shape: dict[str, Any]) -> float:
        one = {"type": "rectangle", "emission": [1, 1, 1]}  # of area 4
        shapes = {"light": {**shape, "emission": [1, 1, 1]}, "one": one}
        scene = torchpt.load({"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")
        world, _ = scene.world(torch.float64, choice="power")
        assert world.lights is not None and isinstance(world.lights.choice, Distribution1D)
        pmf = (world.lights.choice.pmf - 0.005) / 0.99
        return float(4 * pmf[1] / pmf[0])

    squeezed = {"type": "sphere", "transform": [{"scale": [1, 1, 0.5]}]}
    e = 0.75**0.5
    oblate = 2 * torch.pi * (1 + (1 - e * e) / e * float(torch.atanh(torch.tensor(e))))
    assert area(squeezed) == pytest.approx(oblate, rel=2e-3)
    cone = {"type": "cone", "height": 3, "slope": 4 / 3, "capped": False}
    assert area(cone) == pytest.approx(torch.pi * 4 * 5, rel=1e-6)


@pytest.mark.slow
def test_every_strategy_agrees_under_all_of_them():
    white, size = {"type": "diffuse", "reflectance": 0.7}, 20
    at = [{"translate": [-1.5, 1, 0]}], [{"translate": [0, 1.2, -0.6]}], [{"translate": [1.5, 1, 0.2]}]
    shapes = {
        "floor": {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 4}],
            "material": white},
        "can": {"type": "cylinder", "radius": 0.3, "height": 0.8, "emission": [3, 1, 1], "transform": at[0]},
        "cone": {"type": "cone", "slope": 0.5, "height": -0.8, "emission": [1, 3, 1],
            "transform": [{"scale": [1, 1, 0.6]}, *at[1]]},
        "egg": {"type": "sphere", "radius": 0.3, "emission": [1, 1, 3], "transform": [{"scale": [1, 1.6, 0.7]}, *at[2]]},
        "plate": {
            "type": "disk",
            "emission": [2, 2, 1],
            "transform": [{"scale": [0.4, 0.2, 1]}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 2, 1]}],
        },
    }  # fmt: skip
    scene = torchpt.load(
        {"camera": {"origin": [0, 3, 5], "target": [0, 0.5, 0], "fov": 45}, "shapes": shapes}, device="cpu"
    )

    def pictures(strategy: str, spp: int) -> tuple[torch.Tensor, torch.Tensor]:
        wish = {"max_depth": 3, "strategy": strategy}
        return spread([shoot(scene, spp, 50 + k, integrator=wish, film=film_of(size)).image for k in range(8)])

    def blocks(image: torch.Tensor, side: int) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], side)[0]

    mean, variance = pictures("mis", 64)
    for strategy, spp in (("light", 64), ("bsdf", 512)):
        other, noise = pictures(strategy, spp)
        for side in (5, size):
            spread_ = blocks(variance + noise, side) / side**2
            z = (blocks(other, side) - blocks(mean, side)) / spread_.sqrt().clamp_min(1e-12)
            assert z.abs().max() <= 1.25 * z_limit(z.numel()), (strategy, side, z.abs().max())


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_the_pose_of_a_lone_ellipsoid_has_its_derivative_by_kernels(capfd: pytest.CaptureFixture[str]) -> None:
    warn_once.cache_clear()
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 1, 5], "target": [0, 0, 0], "fov": 40},
            "film": {"width": 8, "height": 8},
            "integrator": {"type": "path", "max_depth": 2},
            "shapes": {
                "lamp": {
                    "type": "sphere",
                    "emission": 4,
                    "transform": [{"scale": [0.5, 0.2, 0.3]}, {"translate": [0.5, 0, 0.5]}],
                },
                "floor": {
                    "type": "rectangle",
                    "transform": [
                        {"rotate": {"axis": [1, 0, 0], "angle": -90}},
                        {"scale": 4},
                        {"translate": [0, -1, 0]},
                    ],
                },
            },
        },
        "cpu",
    )
    found = []
    for compiled in ("on", "off"):
        pose = scene.params["shapes.lamp.to_world"].clone().requires_grad_()
        wish = {"spp": 1, "spp_grad": 16, "edges": False, "compile": compiled}
        torchpt.render(scene, params={"shapes.lamp.to_world": pose}, **wish).mean().backward()
        assert pose.grad is not None
        found.append(pose.grad)
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=1e-5)
    assert "tensor operations" not in capfd.readouterr().err
