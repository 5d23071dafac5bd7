"""Rays that leave the lights bring what light samples do: the irradiance of a floor, by either."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from light_rooms import ROOMS
from significance import t_limit
from torch import Tensor

import torchpt
from torchpt.math.vectors import rows
from torchpt.paths.vertex import light_radiance
from torchpt.physics import lights
from torchpt.physics.lights.emission import density_of_sample, emit, light_weight
from torchpt.scene.formats.description import settings
from torchpt.scene.prepare import make_wave

N, SEEDS, HALF = 1 << 15, 8, 1.5
_SHAPED, _DELTA = ROOMS["lamps of all shapes"]["shapes"], ROOMS["lights without extent"]["lights"]
_RECTANGLE = {key: value for key, value in ROOMS["thin lens"]["shapes"]["lamp"].items() if key != "material"}
_LAMPS = ("ball_lamp", "disk_lamp", "tube", "cone", "flag")
_MANY = {name: lamp for name, lamp in ROOMS["many lamps"]["shapes"].items() if name.startswith("lamp")}
#: Shapes and lights over a floor.
LIGHTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    **{name: ({name: _SHAPED[name]}, {}) for name in _LAMPS},
    "rectangle": ({"lamp": _RECTANGLE}, {}),
    "textured": ({"lamp": ROOMS["textured lamp and opacity"]["shapes"]["lamp"]}, {}),
    **{name: ({}, {name: light}) for name, light in _DELTA.items()},
    "constant": ({}, ROOMS["sky of one colour"]["lights"]),
    "sky": ({}, ROOMS["sky and sun"]["lights"]),
    "envmap": ({}, ROOMS["environment map"]["lights"]),
    "many": ({**_MANY, **{name: _SHAPED[name] for name in _LAMPS}}, ROOMS["many lamps"]["lights"]),
}


class Floor:
    """A square floor of half width 1.5, and its lights."""

    def __init__(self, name: str) -> None:
        shapes, sources = LIGHTS[name]
        turn = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
        floor = {"type": "rectangle", "transform": [{"scale": HALF}, turn]}
        camera = {"type": "perspective", "origin": [0, 1, 4], "target": [0, 0, 0]}
        scene = {"camera": camera, "shapes": {"floor": floor, **shapes}, "lights": sources}
        scene = torchpt.load(scene, device="cpu")
        wave = make_wave(
            scene,
            settings(scene.description, {"integrator": {"type": "bdpt", "strategy": "light_paths"}}),
            None,
            torch.float64,
        )
        self.space, self.world = scene.space, wave.context.world
        assert self.world.emission is not None and self.world.lights is not None
        self.emission, self.lights = self.world.emission, self.world.lights

    def met(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return where rays meet it, as if nothing stood in their way, and which do."""
        p = o + d * ((-self.space.centre[1] / self.space.unit - o[1]) / d[1])
        x = p * self.space.unit + self.space.centre[:, None]
        return p, (d[1] < 0) & (x[0].abs() < HALF) & (x[2].abs() < HALF)

    def points(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return points and the normal there."""
        x = torch.stack((2.0 * u[0] - 1.0, torch.zeros_like(u[0]), 2.0 * u[1] - 1.0)) * HALF
        up = torch.zeros_like(x)
        up[1] = 1.0
        return (x - self.space.centre[:, None]) / self.space.unit, up

    def emitted(self, seed: int) -> Tensor:
        """Return the irradiance by rays that leave the lights."""
        u = numbers(seed)
        ray = emit(self.emission, u[4], u[:2], u[2:4], 0.0, mis=False)
        _, meets = self.met(ray.o, ray.d)
        brought = torch.where(meets, light_radiance(self.world, ray).mean(0) / ray.density.clamp_min(1e-30), 0.0)
        return brought.mean() / (2.0 * HALF / self.space.unit) ** 2

    def sampled(self, seed: int) -> Tensor:
        """Return the irradiance by light samples."""
        u = numbers(seed + 100)
        x, up = self.points(u[2:4])
        sample = lights.sample(self.lights, x, u[4], u[:2], 0.0, n=up, mis=False)
        return (light_radiance(self.world, sample).mean(0) * sample.weight * sample.wi[1].clamp_min(0.0)).mean()


def numbers(seed: int) -> Tensor:
    return torch.quasirandom.SobolEngine(5, scramble=True, seed=seed).draw(N, dtype=torch.float64).T


@pytest.mark.parametrize("name", LIGHTS)
def test_the_irradiance_of_a_floor(name):
    floor = Floor(name)
    a = torch.stack([floor.emitted(seed) for seed in range(SEEDS)])
    b = torch.stack([floor.sampled(seed) for seed in range(SEEDS)])
    error = ((a.var() + b.var()) / SEEDS).sqrt()
    assert float(error / b.mean()) < 0.02
    difference = float((a.mean() - b.mean()).abs())
    assert difference < t_limit(len(LIGHTS), SEEDS - 1) * float(error) + 1e-6 * float(b.mean())


@pytest.mark.parametrize("name", ["rectangle", "disk_lamp", "point", "spot", "sun", "constant"])
def test_a_ray_has_one_density_from_both_ends(name):
    """Of these lights it is the same for all rays."""
    floor, u = Floor(name), numbers(3)
    ray = emit(floor.emission, u[4], u[:2], u[2:4], 0.0)
    p, meets = floor.met(ray.o, ray.d)
    lanes = meets.nonzero()[:, 0]
    x, up = p[:, lanes], floor.points(u)[1][:, lanes]
    sample = lights.sample(floor.lights, x, u[4][lanes], u[:2][:, lanes], 0.0, n=up)
    torch.testing.assert_close(density_of_sample(floor.emission, sample), ray.density[lanes])
    weight = light_weight(floor.emission, rows(ray, lanes), x, up)
    assert bool((weight > 0).all())
    if name in ("point", "sun", "constant"):
        torch.testing.assert_close(weight, sample.weight)
