"""Gradients of a coarse ball that is shaded smooth, whose normals turn away from the viewer near its outline."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from coarse_ball import CORNERS, ball_under

import torchpt
from torchpt.core.errors import EdgeWarning

LIGHTS = {
    "sun": {"type": "directional", "direction": [-0.2, 1, -0.4], "irradiance": [3, 3, 3]},
    "sky": {"type": "constant", "radiance": [0.2, 0.2, 0.2]},
}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse", "reflectance": 0.8},
    "conductor": {"type": "roughconductor", "roughness": 0.7},
    "mapped": {"type": "diffuse", "reflectance": 0.8, "normal_map": {"type": "checkerboard"}},
}
#: Of a normal map: all normals lean by 0.2 along u.
TILT = [0.5 + 0.5 * math.sin(0.2), 0.5, 0.5 + 0.5 * math.cos(0.2)]
MATERIALS["mapped"]["normal_map"] |= {"color0": TILT, "color1": TILT}
FLOOR = {"type": "rectangle", "material": "it", "transform": [{"scale": 4}, {"translate": [0, 0, -1.1]}]}
#: By material and depth: derivatives as the ball grows, and as it grows taller, by central differences.
KNOWN = {
    ("diffuse", 2): ((536.2, 0.3), (210.8, 0.2)),
    ("diffuse", 3): ((431.6, 1.2), (190.5, 0.8)),
    ("mapped", 2): ((522.8, 0.1), (208.2, 0.1)),
    ("conductor", 2): ((270.1, 0.4), (97.4, 0.2)),
    ("conductor", 3): ((291.3, 1.0), (124.5, 1.0)),
}


@pytest.mark.parametrize(("name", "depth"), KNOWN)
def test_outlines_have_gradients(name: str, depth: int) -> None:
    shapes = {"floor": FLOOR} if depth > 2 else {}
    described = ball_under(LIGHTS, MATERIALS[name], shapes=shapes, integrator={"type": "path", "max_depth": depth})
    described["shapes"]["ball"]["uvs"] = [[0.5 + 0.5 * x, 0.5 + 0.5 * z] for x, _, z in CORNERS]
    scene, corners = torchpt.load(described, "cpu"), torch.tensor(CORNERS)
    y, x = torch.meshgrid(torch.linspace(0, 1, 24), torch.linspace(0, 1, 24), indexing="ij")
    weight = (1.0 + torch.sin(5.0 * x + 1.0) * torch.cos(4.0 * y))[..., None]
    found: list[torch.Tensor] = []
    for seed in range(4):
        moved = corners.clone().requires_grad_()
        picture = torchpt.render(scene, params={"shapes.ball.vertices": moved}, spp=64, edge_spp=64, seed=seed)
        (picture * weight).sum().backward()
        assert moved.grad is not None
        found.append(torch.stack(((moved.grad * corners).sum(), (moved.grad[:, 2] * corners[:, 2]).sum())))
    mean, spread = torch.stack(found).mean(0), torch.stack(found).std(0) / len(found) ** 0.5
    for k, (known, error) in enumerate(KNOWN[name, depth]):
        # Four seeds give no good spread: 1.5 % more.
        limit = 3.0 * (float(spread[k]) ** 2 + error**2) ** 0.5 + 0.015 * known
        assert abs(float(mean[k]) - known) < limit, (k, mean, spread)
        assert limit < 0.1 * known


def test_dark_rims_are_warned_of() -> None:
    scene = torchpt.load(ball_under(LIGHTS, MATERIALS["diffuse"]), "cpu")
    corners = torch.tensor(CORNERS, requires_grad=True)
    with pytest.warns(EdgeWarning, match="dark rims"):
        torchpt.render(scene, params={"shapes.ball.vertices": corners}, spp=1, integrator={"dark_rims": True})
