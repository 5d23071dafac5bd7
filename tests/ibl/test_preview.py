"""The split-sum preview: closed forms, the path tracer where nothing is shadowed, other lights, derivatives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt.ibl import IblMaps, Sky, brdf_table
from torchpt.math.sampling import Distribution1D
from torchpt.paths.integrators.split_sum import shade_under
from torchpt.physics import bsdfs
from torchpt.physics.lights import without_environment

IBL = {"type": "ibl"}
WHITE = {"sky": {"type": "constant", "radiance": 1.0}}


def ball(material: dict[str, Any], lights: dict[str, Any], **more: Any) -> torchpt.Scene:
    """A ball that fills most of the film, under ``lights``."""
    return torchpt.load(
        {
            "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 30},
            "film": {"width": 16, "height": 16, "filter": {"type": "box"}},
            "materials": {"m": material},
            "shapes": {"ball": {"type": "sphere", "material": "m"}, **more},
            "lights": lights,
        }
    )


def preview(scene: torchpt.Scene, spp: int = 4, **settings: Any) -> Tensor:
    return torchpt.render(scene, integrator=IBL, spp=spp, **settings)


@pytest.fixture
def sky(tmp_path: Path) -> dict[str, Any]:
    """An uneven sky with a lamp in it."""
    map = torch.rand(16, 32, 3, generator=torch.Generator().manual_seed(2)) * 0.5 + 0.25
    map[4:6, 20:23] = torch.tensor([30.0, 25.0, 18.0])
    torchpt.write_image(tmp_path / "sky.exr", map)
    turn = {"rotate": {"axis": [1, 2, 0], "angle": 70}}
    return {"sky": {"type": "envmap", "path": str(tmp_path / "sky.exr"), "scale": 0.7, "transform": [turn]}}


def test_a_white_sky_gives_the_albedo() -> None:
    matt = preview(ball({"type": "diffuse", "reflectance": [0.2, 0.5, 0.8]}, WHITE))
    assert torch.allclose(matt[8, 8], torch.tensor([0.2, 0.5, 0.8]), atol=1e-5)
    mirror = preview(ball({"type": "conductor", "reflectance": 1.0}, WHITE))
    assert torch.allclose(mirror, torch.ones_like(mirror), atol=1e-4)


@pytest.mark.parametrize(
    "material",
    few(
        [
            {"type": "roughconductor", "material": "Au", "roughness": 0.4},
            {"type": "plastic", "diffuse_reflectance": 0.6},
            {"type": "roughplastic", "alpha": 0.1, "nonlinear": True},
            {"type": "nonmetal"},
            {"type": "microfacet"},
            {"type": "phong"},
            {"type": "blinn_phong"},
            {"type": "principled", "base_color": 0.6, "roughness": 0.3},
            {"type": "principled", "base_color": [0.8, 0.5, 0.2], "roughness": 0.5, "metallic": 0.8, "spec_tint": 1.0},
            {"type": "principled", "base_color": 1.0, "spec_trans": 1.0, "roughness": 0.1},
            {"type": "dielectric"},
            {"type": "thindielectric"},
            {"type": "roughdielectric"},
            {"type": "blend", "a": {"type": "diffuse"}, "b": {"type": "roughconductor"}, "weight": 0.3},
        ],
        4,
    ),
    ids=lambda material: material["type"],
)
def test_models_under_a_white_sky(material: dict[str, Any]) -> None:
    """As bright as the path tracer has them, seen head on."""
    scene = ball(material, WHITE)
    found = preview(scene)[6:10, 6:10].mean((0, 1))
    wanted = torchpt.render(scene, integrator={"type": "path", "max_depth": 8}, spp=32)[6:10, 6:10]
    assert torch.allclose(found, wanted.mean((0, 1)), rtol=0.05)


def test_every_model_has_a_rule() -> None:
    own = (bsdfs.Bsdf.split_sum, bsdfs.Bsdf.preview)
    lacking = [name for name, kind in bsdfs.KINDS.items() if (kind.split_sum, kind.preview) == own]
    assert lacking == ["diffuse", "roughdiffuse"]  # which are what their albedo says


def test_a_model_without_a_rule_is_diffuse() -> None:
    class Own(bsdfs.Bsdf):
        def albedo(self, parameters: bsdfs.Parameters) -> Tensor:
            return parameters["color"]

        eval = pdf = lambda *_: torch.zeros(0)  # type: ignore[assignment]

    even = torch.full((2, 1, 3), 2.0)
    lanes = torch.tensor([[0.0], [0.0], [1.0]])
    found = shade_under(
        Sky.of(IblMaps(even, (even, even), brdf_table(8, 64).float())), Own(), {"color": lanes * 0 + 0.3}, lanes, lanes
    )
    assert torch.allclose(found, torch.full((3, 1), 0.6))


@pytest.mark.parametrize(
    "material",
    few(
        [
            {"type": "diffuse", "reflectance": 0.7},
            {"type": "roughconductor", "reflectance": [0.9, 0.6, 0.3], "roughness": 0.4},
        ],
        1,
    ),
    ids=["diffuse", "metal"],
)
def test_a_lone_convex_body_is_as_the_path_tracer_has_it(material: dict[str, Any], sky: dict[str, Any]) -> None:
    """Nothing to shadow it: of the preview's errors only n = v = r is left, and a diffuse body has none."""
    scene = ball(material, sky)
    found = preview(scene, spp=16)
    wanted = torchpt.render(scene, integrator={"type": "direct"}, spp=128)
    off = float((found - wanted)[3:13, 3:13].abs().mean() / wanted[3:13, 3:13].mean())
    assert off < (0.015 if material["type"] == "diffuse" else 0.08)
    if material["type"] == "diffuse":
        assert float(found[3:13, 3:13].mean()) == pytest.approx(float(wanted[3:13, 3:13].mean()), rel=5e-3)


@pytest.mark.slow
def test_other_lights_are_added_with_their_shadows(sky: dict[str, Any]) -> None:
    point = {"bulb": {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": 5.0}}
    lamp = {"type": "rectangle", "emission": 4.0, "transform": [{"scale": 0.2}, {"translate": [0, 0.3, -2.5]}]}
    screen = {"type": "rectangle", "transform": [{"scale": 3}, {"translate": [0, 0, -3]}]}
    material = {"type": "diffuse", "reflectance": 0.5}
    both = preview(ball(material, {**sky, **point}, screen=screen, lamp=lamp), spp=64)
    alone = preview(ball(material, sky, screen=screen, lamp={**lamp, "emission": 0.0}), spp=64)
    others = torchpt.render(
        ball(material, point, screen=screen, lamp=lamp), integrator={"type": "direct", "strategy": "light"}, spp=64
    )
    # The lamp shines away from the camera's side of the ball; the bulb's light on the screen stops at the ball's shadow.
    assert float((both - alone - others).abs().mean()) < 0.02 * float(others.mean())
    assert float(others[8, 8].min()) > 0.1


def test_the_environment_is_cut_from_the_table() -> None:
    scene = ball(
        {"type": "diffuse"},
        {**WHITE, "a": {"type": "point", "position": [0, 3, 0]}, "b": {"type": "directional", "direction": [0, -1, 0]}},
    )
    lights = scene.world(torch.float32)[0].lights
    assert lights is not None
    left = without_environment(lights)
    assert left is not None and left.kinds == ("point", "directional") and left.environment is None
    assert isinstance(left.choice, Distribution1D) and float(left.choice.pmf.sum()) == pytest.approx(1.0)
    assert left.radiance.shape == (3, 2) and without_environment(left) is left
    alone = ball({"type": "diffuse"}, WHITE).world(torch.float32)[0].lights
    assert without_environment(alone) is None and without_environment(None) is None


@pytest.mark.parametrize("kind", few(["constant", "envmap"], 1))
def test_gradients_flow_to_sky_and_material(kind: str, sky: dict[str, Any]) -> None:
    scene = ball({"type": "roughconductor", "reflectance": 0.6, "roughness": 0.5}, WHITE if kind == "constant" else sky)
    name = "lights.sky.radiance" if kind == "constant" else "lights.sky.texels"
    own = scene.params[name].detach()
    params = {name: own.clone().requires_grad_(), "materials.m.reflectance": torch.full((3,), 0.6, requires_grad=True)}
    settings: dict[str, Any] = {"integrator": IBL, "spp": 1, "seed_grad": 0, "film": {"width": 8, "height": 8}}
    image = torchpt.render(scene, params=params, **settings)
    grads = torch.autograd.grad(image.sum(), list(params.values()))
    assert all(bool(torch.isfinite(g).all()) for g in grads)
    # The picture is linear in the sky, and nearly so in a metal's colour.
    assert float((grads[0] * own).sum()) == pytest.approx(float(image.detach().sum()), rel=1e-3)
    assert math.isfinite(float(grads[1].sum())) and float(grads[1].min()) > 0


def test_what_is_refused() -> None:
    with pytest.raises(torchpt.SceneError, match="integrator.max_depth"):
        torchpt.render(ball({"type": "diffuse"}, WHITE), integrator={"type": "ibl", "max_depth": 3}, spp=1)


@pytest.mark.parametrize("directional", few([False, True], 1))
def test_a_light_tree_is_cut_likewise(directional: bool) -> None:
    lights: dict[str, Any] = {**WHITE, "a": {"type": "point", "position": [0, 2, 3], "intensity": 4.0}}
    lights["b"] = {"type": "point", "position": [3, 0, 2], "intensity": 6.0}
    if directional:
        lights["c"] = {"type": "directional", "direction": [1, 0, -1], "irradiance": 0.5}
    scene = ball({"type": "diffuse"}, lights)
    tree, power = (
        torchpt.render(scene, integrator={**IBL, "light_choice": way}, spp=64).mean() for way in ("tree", "power")
    )
    assert float(tree) == pytest.approx(float(power), rel=0.01)
