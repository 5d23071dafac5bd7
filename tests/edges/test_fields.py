"""Gradients of vertices of height fields, whose faces light each other: sizes and means."""

from __future__ import annotations

import math
import statistics
from typing import Any

import pytest
import torch
from known_gradients import ABOVE, OPEN_SKY, grid
from torch import Tensor

import torchpt

SUN_AND_SKY = {
    "sky": {"type": "constant", "radiance": [0.3, 0.3, 0.3]},
    "sun": {"type": "directional", "direction": [0.5, -1, 0.3], "irradiance": [2, 2, 2]},
}


def valley(x: Tensor, _: Tensor) -> Tensor:
    return 0.35 * (3 * x).sin().abs()


def bumps(x: Tensor, z: Tensor) -> Tensor:
    return 0.2 * (4 * x).cos() * (4 * z).cos()


def terraces(_: Tensor, z: Tensor) -> Tensor:
    return 0.2 * torch.floor(1.25 * (z + 1.001))


def worn_terraces(x: Tensor, z: Tensor) -> Tensor:
    return terraces(x, z) + 0.03 * torch.randn(x.shape, generator=torch.Generator().manual_seed(5))


#: A sun's light sets behind faces that are shaded smooth along lines that are not differentiated, so those under it are flat.
FIELDS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "valleys": (grid(6, valley), OPEN_SKY),
    "bumps": (grid(7, bumps), OPEN_SKY),
    # Faces in one plane that are shaded smooth, with other normals than the plane's, have derivatives of two kinds: one bend
    # lets them see each other, the other does not. Even terraces are flat-shaded therefore.
    "terraces": (grid(6, terraces, face_normals=True), OPEN_SKY),
    "worn terraces": (grid(6, worn_terraces), OPEN_SKY),
    "bumps under sun and sky": (grid(6, bumps, face_normals=True), SUN_AND_SKY),
    "valleys under sun and sky": (grid(6, valley, face_normals=True), SUN_AND_SKY),
}


@pytest.mark.slow
@pytest.mark.parametrize("depth", [3, 6])
@pytest.mark.parametrize("name", FIELDS)
def test_seeds_agree_with_each_other_and_with_differences(name: str, depth: int):
    mesh, lights = FIELDS[name]
    described = {
        **ABOVE,
        "film": {"width": 32, "height": 32, "filter": "box"},
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": 100},
        "shapes": {"field": mesh},
        "lights": lights,
    }
    scene, key = torchpt.load(described, "cpu"), "shapes.field.vertices"
    base = torch.tensor(mesh["vertices"], dtype=torch.float64)
    along = torch.randn(base.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    along = along / along.norm()
    norms, found = list[float](), list[float]()
    for seed in range(40):
        leaf = base.float().requires_grad_()
        picture = torchpt.render(scene, params={key: leaf}, spp=1, spp_grad=16, seed=seed, threads=1)
        (grad,) = torch.autograd.grad(picture.mean(), leaf)
        norms.append(float(grad.norm()))
        found.append(float((grad.double() * along).sum()))
    assert max(norms) <= 3.0 * statistics.median(norms)

    def slope(step: float, seed: int) -> float:
        ends = [
            float(torchpt.render(scene, params={key: (base + h * along).float()}, spp=1024, seed=seed).double().mean())
            for h in (step, -step)
        ]
        return (ends[0] - ends[1]) / (2 * step)

    known = [(4 * slope(0.02, seed) - slope(0.04, seed)) / 3 for seed in range(4)]
    error = math.hypot(statistics.stdev(found) / len(found) ** 0.5, statistics.stdev(known) / len(known) ** 0.5)
    apart = abs(statistics.fmean(found) - statistics.fmean(known))
    assert apart < 4.0 * error + 0.02 * abs(statistics.fmean(known))
