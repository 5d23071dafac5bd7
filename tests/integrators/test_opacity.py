"""Surfaces that are met by chance: rays pass, shadows let light through, and nothing of it counts as a bounce."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from trials import estimate, film_of, shoot, z_limit

import torchpt

CAMERA = {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 5}
SKY = {"sky": {"type": "constant", "radiance": 1}}


def black(**keys: Any) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": 0, **keys}


def scene(shapes: dict[str, Any], lights: dict[str, Any] | None = None, **materials: Any) -> dict[str, Any]:
    return {"camera": CAMERA, "lights": lights or {}, "materials": materials, "shapes": shapes}


def seen(description: dict[str, Any], value: float, spp: int = 64, depth: int = 2, **keys: Any) -> None:
    image = shoot(description, spp, 3, "independent", {"max_depth": depth, **keys}, film_of(32)).image
    mean, error = estimate(image)
    assert ((mean - value).abs() <= z_limit(3) * error + 1e-5).all(), (mean, error, value)


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0])
def test_a_black_ball_lets_the_sky_through_twice(opacity):
    # Entering and leaving, by one camera ray: depth 1, which sees emission alone.
    ball = {"ball": {"type": "sphere", "material": black(opacity=opacity)}}
    seen(scene(ball, SKY), (1 - opacity) ** 2, depth=1)


def test_null_is_not_there():
    ball = {"ball": {"type": "sphere", "material": {"type": "null"}}}
    seen(scene(ball, SKY), 1.0, depth=1)
    without = shoot(scene({}, SKY), 4, film=film_of(8)).image
    torch.testing.assert_close(shoot(scene(ball, SKY), 4, film=film_of(8)).image, without)


@pytest.mark.parametrize("cutoff", [0.25, 0.35])
def test_alpha_is_tested_against_a_cutoff(cutoff):
    ball = {"ball": {"type": "sphere", "material": black(opacity=0.3, alpha_cutoff=cutoff)}}
    image = shoot(scene(ball, SKY), 2, film=film_of(8)).image
    assert torch.equal(image, torch.full_like(image, 1.0 if cutoff > 0.3 else 0.0))


# A floor of albedo 1/2 under two leaves, beneath a lamp and a sky.
LEAVES = scene(
    {
        "floor": {"type": "rectangle", "material": "white", "transform": [{"scale": 100}]},
        "low": {"type": "disk", "material": "leaf", "transform": [{"scale": 50}, {"translate": [0, 0, 1]}]},
        "high": {"type": "sphere", "center": [0, 0, 0], "radius": 90, "material": "veil"},
        "lamp": {"type": "sphere", "center": [1, 0.5, 2.5], "radius": 0.3, "emission": 40},
    },
    SKY,
    white={"type": "diffuse", "reflectance": 0.5},
    leaf=black(opacity=0.4),
    veil=black(opacity=0.2),
)


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf", "uniform"])
def test_shadows_let_through_what_the_surfaces_do(strategy):
    plain = {name: shape for name, shape in LEAVES["shapes"].items() if name in ("floor", "lamp")}
    veiled = {"sky": {"type": "constant", "radiance": 0.8}}
    keys = {"max_depth": 2, "strategy": strategy}
    # Seen through the leaf; lit through the leaf, by the sky through the ball as well.
    expected = 0.6 * 0.6 * shoot({**LEAVES, "shapes": plain, "lights": veiled}, 16, 5, "sobol", keys, film_of(64)).image
    image = shoot(LEAVES, 16, 6, "sobol", keys, film_of(64)).image
    (mean, error), (value, noise) = estimate(image), estimate(expected)
    assert ((mean - value).abs() < z_limit(12) * (error**2 + noise**2).sqrt()).all(), (mean, value, error)


def test_emission_is_covered_by_opacity():
    lamp = {"type": "diffuse", "reflectance": 0, "emission": [1, 2, 3], "emission_strength": 2, "opacity": 0.25}
    shapes = {
        "lamp": {"type": "rectangle", "material": "lamp", "transform": [{"translate": [0, 0, 1]}]},
        "floor": {
            "type": "rectangle",
            "material": "white",
            "transform": [{"rotate": {"axis": [0, 1, 0], "angle": 30}}],
        },
    }
    own = scene({"lamp": {**shapes["lamp"], "transform": []}}, lamp=lamp)
    mean, error = estimate(shoot(own, 64, 1, film=film_of(32)).image)
    assert ((mean - 0.25 * torch.tensor([2.0, 4.0, 6.0])).abs() < z_limit(3) * error).all()
    # On a floor beside it, by all strategies alike.
    turned = [{"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 0, 3]}]
    lit = scene(
        {"lamp": {"type": "rectangle", "material": "lamp", "transform": turned}, "floor": {**shapes["floor"]}},
        lamp={**lamp, "two_sided": False},
        white={"type": "diffuse", "reflectance": 0.5},
    )
    found = [
        estimate(shoot(lit, 256, 9, "independent", {"max_depth": 2, "strategy": s}, film_of(16)).image)
        for s in ("mis", "light", "bsdf")
    ]
    for mean, error in found[1:]:
        both = (error**2 + found[0][1] ** 2).sqrt()
        assert ((mean - found[0][0]).abs() < z_limit(6) * both).all(), found
    assert float(found[0][0].min()) > 0.01


def test_blends_with_null_and_of_covered_materials():
    half = {"type": "blend", "a": "none", "b": "dark", "weight": 0.3}
    ball = {"ball": {"type": "sphere", "material": half}}
    described = scene(ball, SKY, none={"type": "null"}, dark=black())
    seen(described, 0.7**2, depth=1)
    info = torchpt.load(described, device="cpu").world(torch.float32)[0]
    assert [model.name for model in info.materials.models] == ["diffuse"]
    # Opacities 0.2 and 0.6 in equal parts are met as 0.4.
    both = {"type": "blend", "a": black(opacity=0.2), "b": black(opacity=0.6), "weight": 0.5}
    seen(scene({"ball": {"type": "sphere", "material": both}}, SKY), 0.6**2, depth=1)


def test_gradients_of_opacity():
    described = scene(LEAVES["shapes"], SKY, **LEAVES["materials"])
    loaded = torchpt.load(described, device="cpu")
    name = "materials.leaf.opacity"
    wish: dict[str, Any] = {
        "film": {**film_of(32), "filter": "box"},
        "spp": 16,
        "integrator": {"type": "path", "max_depth": 2},
    }

    def mean(value: float, seed: int) -> torch.Tensor:
        params = {name: torch.tensor(value)}
        return torchpt.render(loaded, params=params, seed=seed, **wish).double().mean()

    step = 0.1
    slopes = torch.stack([(mean(0.4 + step, s) - mean(0.4 - step, s)) / (2 * step) for s in range(8)])
    grads = []
    for seed in range(8):
        value = torch.tensor(0.4, requires_grad=True)
        torchpt.render(loaded, params={name: value}, seed=seed, **wish).double().mean().backward()
        assert value.grad is not None
        grads.append(value.grad.double())
    found = torch.stack(grads)
    # The picture is a quadratic in the leaf's opacity, for which central differences are exact.
    error = (found.var() / 8 + slopes.var() / 8).sqrt()
    assert abs(float(found.mean() - slopes.mean())) < 4 * float(error), (found.mean(), slopes.mean(), error)
    assert float(found.mean()) < -10 * float(error)


def test_layers_see_through():
    leaf = {"leaf": {"type": "rectangle", "material": black(opacity=0.5)}, "floor": {"type": "rectangle",
            "material": {"type": "diffuse", "reflectance": 0.5}, "transform": [{"translate": [0, 0, -1]}]}}  # fmt: skip
    loaded = torchpt.load(scene(leaf), device="cpu")
    result = shoot(loaded, 64, film={**film_of(32), "aovs": ["albedo", "depth"]})
    mean, error = estimate(result.layers["albedo"])
    assert abs(float(mean[0]) - 0.25) < 4 * float(error[0])
    mean, error = estimate(result.layers["depth"])
    assert abs(float(mean[0]) - 4.5) < 4 * float(error[0]) + 0.01


def covered(description: dict[str, Any], filter: str, compiled: bool, spp: int = 64) -> torch.Tensor:
    """The layer `alpha` of 24 x 24 pixels."""
    from torchpt.rendering.api import render_scene
    from torchpt.scene.formats.description import settings

    loaded = torchpt.load(description, device="cpu")
    film = {"width": 24, "height": 24, "filter": filter, "aovs": ["alpha"]}
    wishes = settings(loaded.description, {"film": film, "render": {"spp": spp, "compile": compiled}})
    return render_scene(loaded, wishes).layers["alpha"]


@pytest.mark.parametrize("compiled", [False, True])
def test_alpha_is_what_surfaces_cover(compiled):
    disk = {"disk": {"type": "disk", "material": "dark", "transform": [{"scale": 0.1}]}}
    alpha = covered(scene(disk, SKY, dark=black()), "box", compiled)
    assert alpha.shape == (24, 24, 1) and float(alpha[12, 12]) == 1.0 and float(alpha[0, 0]) == 0.0
    width = 8 * torch.tan(torch.tensor(5.0 * torch.pi / 360.0))
    assert float(alpha.mean()) == pytest.approx(torch.pi * 0.01 / float(width) ** 2, rel=2e-3)
    assert 10 < int(((alpha > 0) & (alpha < 1)).sum()) < 80  # the rim, in between
    signed = covered(scene(disk, SKY, dark=black()), "mitchell", compiled)
    assert float(signed[12, 12]) == pytest.approx(1.0, abs=0.05) and float(signed.mean()) == pytest.approx(
        float(alpha.mean()), rel=2e-2
    )


@pytest.mark.parametrize("compiled", [False, True])
def test_alpha_is_weighed_by_opacity(compiled):
    ball = {"ball": {"type": "sphere", "material": black(opacity=0.3)}}
    alpha = covered(scene(ball, SKY), "box", compiled)
    assert float(alpha.mean()) == pytest.approx(1 - 0.7**2, abs=0.01)  # its front, or else its back
    glass = {"ball": {"type": "sphere", "material": {"type": "dielectric"}}}
    assert torch.equal(covered(scene(glass, SKY), "box", compiled, 2), torch.ones(24, 24, 1))
