"""Near outlines of smooth-shaded meshes, where the shading normal turns away from the viewer."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from coarse_ball import CORNERS, ball_under

import torchpt

SKY = {"sky": {"type": "constant", "radiance": [1, 1, 1]}}
SUN = {"sun": {"type": "directional", "direction": [-1, 1, -1], "irradiance": [3, 3, 3]}}
FILM = {"width": 96, "height": 96, "aovs": ["alpha"]}
MATERIALS: dict[str, dict[str, Any]] = {
    "diffuse": {"type": "diffuse", "reflectance": 1},
    "one side": {"type": "diffuse", "reflectance": 1, "two_sided": False},
    "conductor": {"type": "roughconductor", "roughness": 0.9, "reflectance": 1},
    "principled": {"type": "principled", "base_color": [1, 1, 1], "roughness": 0.9},
}


@pytest.mark.parametrize("kind", ["path", "bdpt"])
@pytest.mark.parametrize("name", MATERIALS)
def test_outlines_are_lit(name: str, kind: str) -> None:
    """Under a constant sky a ball of twenty faces is bright all over; with dark rims a part of it is black."""
    scene = torchpt.load(ball_under(SKY, MATERIALS[name]), "cpu")

    def darkest(*, dark_rims: bool) -> float:
        wish = {"type": kind, "dark_rims": dark_rims, "max_depth": 2}
        picture: Any = torchpt.render(scene, integrator=wish, spp=64, film=FILM, seed=1, full=True)
        return float(picture.image.amin(-1)[picture.layers["alpha"][..., 0] == 1].min())

    assert darkest(dark_rims=False) > 0.3
    assert darkest(dark_rims=True) < 0.1


@pytest.mark.parametrize("kind", ["direct", "ibl"])
def test_outlines_are_lit_by_the_sun(kind: str) -> None:
    scene = torchpt.load(ball_under(SUN, MATERIALS["diffuse"]), "cpu")
    lit, dark = (
        torchpt.render(scene, integrator={"type": kind, "dark_rims": dark}, spp=16, film=FILM | {"aovs": []}, seed=1)
        for dark in (False, True)
    )
    assert float((lit - dark).max()) > 0.2
    assert float((lit - dark).min()) == 0.0


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("dark_rims", [False, True])
def test_light_paths_agree(dark_rims: bool, mapped: bool) -> None:
    """Light that camera paths find at rims, and light paths that are joined to the camera there: each alone."""
    lamp = {"type": "rectangle", "material": "grey", "emission": [30, 30, 30]}
    lamp |= {
        "transform": [{"scale": 0.4}, {"look_at": {"origin": [-2.5, -2, 2], "target": [0, 0, 0], "up": [0, 0, 1]}}]
    }
    floor = {"type": "rectangle", "material": "grey", "transform": [{"scale": 4}, {"translate": [0, 0, -1.1]}]}
    tilts = {"type": "checkerboard", "color0": [0.7, 0.4, 0.9], "color1": [0.2, 0.6, 0.8], "scale": 6}
    described = ball_under(
        {},
        MATERIALS["diffuse"] | ({"normal_map": tilts} if mapped else {}),
        shapes={"lamp": lamp, "floor": floor},
        materials={"grey": {"type": "diffuse"}},
    )
    described["shapes"]["ball"]["uvs"] = [[0.5 + 0.5 * x, 0.5 + 0.5 * z] for x, _, z in CORNERS]
    scene = torchpt.load(described, "cpu")

    def sums(**wish: Any) -> tuple[torch.Tensor, torch.Tensor]:
        wish |= {"max_depth": 3, "dark_rims": dark_rims}
        found = torch.stack([torchpt.render(scene, integrator=wish, spp=128, seed=seed) for seed in range(8)]).double()
        blocks = found.view(8, 4, 6, 4, 6, 3).sum((2, 4, 5)).flatten(1)
        return blocks.mean(0), blocks.var(0) / 8

    (a, a_variance), (b, b_variance) = sums(type="path"), sums(type="bdpt", strategy="light_paths", light_paths=1.0)
    assert ((a - b).abs() <= 4.5 * (a_variance + b_variance).sqrt()).all()
    assert abs(float((a - b).sum())) < 4.0 * float((a_variance + b_variance).sum().sqrt())
