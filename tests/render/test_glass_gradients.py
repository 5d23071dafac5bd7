"""Gradients through glass and materials, in the mean: as a user takes them (float32, the backward pass drawing samples of its
own) against central differences of independent renders.

Both are random, so each is drawn from several independent seeds and judged by its standard error; the two sides of one
difference draw the same samples. What is lit falls off smoothly and no silhouette moves in view, so that the derivative
has no part that docs/explanations/gradients.md leaves out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor
from trials import film_of

import torchpt

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

SEEDS = 10
AGREES = 3.0  # standard errors of a difference
KNOWN = 0.03  # standard error of a gradient as a fraction of it, at most; and of a difference
WRONG = 1.3  # a gradient that is wrong by this factor is to be noticed

PIXELS = 4
#: Of the loss: every pixel and colour counts differently.
WEIGHT = torch.rand(PIXELS, PIXELS, 3, generator=torch.Generator().manual_seed(1)) + 0.5

AROUND = {"rotate": {"axis": [0, 1, 0], "angle": 180}}
CLEAR = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
FROSTED = {**CLEAR, "type": "roughdielectric", "alpha": 0.1}

BALL = {"type": "sphere"}
SHEET = {"type": "rectangle", "transform": [{"scale": 20}, {"rotate": {"axis": [1, 2, 0], "angle": 20}}]}
#: Two sheets at an angle: they bend what is seen through them, wherever they stand.
WEDGE = {
    "type": "mesh",
    "face_normals": True,
    "vertices": [
        [-9, -9, 1],
        [9, -9, 0.6],
        [9, 9, 0.2],
        [-9, 9, 0.6],
        [-9, -9, -1],
        [9, -9, -1],
        [9, 9, -1],
        [-9, 9, -1],
    ],
    "faces": [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]],
}


def described(camera: Mapping[str, Any], depth: int, material: Mapping[str, Any], **parts: Any) -> dict[str, Any]:
    return {
        "camera": camera,
        "film": {**film_of(PIXELS), "filter": "box"},
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": 100},
        "render": {"threads": 1, "compile": "off"},
        "materials": {"it": material},
        **parts,
    }


def before_a_wall(shape: Mapping[str, Any], material: Mapping[str, Any] = CLEAR, depth: int = 4) -> dict[str, Any]:
    """Glass over the whole view, off its middle; behind it a wall under a lamp to the side that shines on it alone."""
    wall = {"type": "diffuse", "reflectance": [0.9, 0.7, 0.5]}
    shapes = {
        "it": {**shape, "material": "it"},
        "wall": {"type": "rectangle", "material": wall, "transform": [{"scale": 50}, {"translate": [0, 0, -3]}]},
        "lamp": {
            "type": "rectangle",
            "transform": [{"scale": 0.3}, AROUND, {"translate": [2, 1.4, -2]}],
            "emission": [40, 50, 60],
        },
    }
    camera = {"origin": [0.6, 0.4, 5], "target": [0.45, 0.3, 0], "fov": 6}
    return described(camera, depth, material, shapes=shapes)


def under_a_lamp(material: Mapping[str, Any]) -> dict[str, Any]:
    """A plate over the whole view, a lamp where a mirror would show it."""
    shapes = {
        "it": {"type": "rectangle", "material": "it", "transform": [{"scale": 20}]},
        "lamp": {
            "type": "rectangle",
            "transform": [{"scale": 0.5}, AROUND, {"translate": [0.2, -1.2, 4]}],
            "emission": [12, 10, 8],
        },
    }
    return described({"origin": [0, 1.5, 5], "target": [0, 0, 0], "fov": 6}, 2, material, shapes=shapes)


def under_the_sky(material: Mapping[str, Any]) -> dict[str, Any]:
    """A sheet with nothing but even light on both its sides."""
    camera = {"origin": [0.3, 4, 3], "target": [0, 0, 0], "fov": 30}
    shapes = {"it": {**SHEET, "material": "it"}}
    return described(camera, 3, material, shapes=shapes, lights={"sky": {"type": "constant"}})


#: A parameter, an entry of it (None: the number, or the colour's first component), and the step of its differences.
Wanted = tuple[str, tuple[int, ...] | None, float]


def entry_of(wanted: Wanted, tensor: Tensor) -> tuple[int, ...]:
    return (0,) * tensor.dim() if wanted[1] is None else wanted[1]


def loss(scene: torchpt.Scene, params: Mapping[str, Tensor], **wish: Any) -> Tensor:
    return (torchpt.render(scene, params=params, **wish) * WEIGHT).mean()


def gradients(scene: torchpt.Scene, wanted: list[Wanted], spp: int) -> list[Tensor]:
    """Of each parameter, one derivative of the loss by seed. The loss is linear, so the forward pass does not matter."""
    found = [[] for _ in wanted]
    for seed in range(SEEDS):
        leaves = {name: scene.params[name].clone().requires_grad_() for name, _, _ in wanted}
        loss(scene, leaves, spp=1, seed=seed, spp_grad=spp).backward()
        for values, one in zip(found, wanted, strict=True):
            grad = leaves[one[0]].grad
            assert grad is not None
            values.append(grad[entry_of(one, grad)].double())
    return [torch.stack(values) for values in found]


def differences(scene: torchpt.Scene, wanted: Wanted, spp: int) -> Tensor:
    """Central differences of the loss, one by seed."""
    name, _, step = wanted
    shift = torch.zeros_like(scene.params[name])
    shift[entry_of(wanted, shift)] = step
    sides = [
        [loss(scene, {name: scene.params[name] + side * shift}, spp=spp, seed=1000 + seed) for seed in range(SEEDS)]
        for side in (1, -1)
    ]
    return (torch.tensor(sides[0]).double() - torch.tensor(sides[1]).double()) / (2 * step)


def standard_error(values: Tensor) -> float:
    return float(values.std()) / len(values) ** 0.5


def apart(gradient: Tensor, difference: Tensor) -> float:
    """How far the means are from each other, in standard errors of their difference."""
    error = (standard_error(gradient) ** 2 + standard_error(difference) ** 2) ** 0.5
    return abs(float(gradient.mean() - difference.mean())) / error


def judge(scene: dict[str, Any], wanted: list[Wanted], spp: int, spp_difference: int) -> None:
    loaded = torchpt.load(scene, "cpu")
    for one, gradient in zip(wanted, gradients(loaded, wanted, spp), strict=True):
        difference = differences(loaded, one, spp_difference)
        for values in (gradient, difference):
            assert standard_error(values) <= KNOWN * abs(float(values.mean())), one
        assert apart(gradient, difference) <= AGREES, one
        assert apart(WRONG * gradient, difference) > AGREES, one


def of_it(**steps: float) -> list[Wanted]:
    """Parameters of the material, each with the step of its differences."""
    return [(f"materials.it.{name}", None, step) for name, step in steps.items()]


POSE = "shapes.it.to_world"
GOLD = {"type": "roughconductor", "eta": [0.2, 0.4, 1.4], "k": [3.2, 2.4, 1.7], "alpha": 0.3}
PAINT = {"type": "principled", "base_color": [0.6, 0.4, 0.2], "roughness": 0.5, "metallic": 0.3, "clearcoat": 0.5}
WORN = {"type": "blend", "weight": 0.4, "a": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.2]}, "b": GOLD}


@pytest.mark.parametrize(
    ("scene", "wanted", "spp", "spp_difference"),
    [
        pytest.param(before_a_wall(BALL), [*of_it(int_ior=0.02), (POSE, (2, 3), 0.02)], 8, 32, id="ball of glass"),
        pytest.param(before_a_wall(SHEET), [(POSE, (2, 3), 0.1)], 4, 4, id="surface of glass"),
        pytest.param(under_a_lamp(GOLD), of_it(alpha=0.005), 4, 8, id="roughconductor"),
        pytest.param(under_a_lamp(PAINT), of_it(base_color=0.05, roughness=0.005), 4, 8, id="principled"),
        pytest.param(under_a_lamp(WORN), of_it(weight=0.05), 4, 8, id="blend"),
    ],
)
@pytest.mark.slow
def test_gradients_agree_with_differences_in_the_mean(scene, wanted, spp, spp_difference):
    judge(scene, wanted, spp, spp_difference)


ALL_PAINT = {
    **PAINT,
    **{"clearcoat_gloss": 0.3, "spec_tint": 0.5, "flatness": 0.4, "anisotropic": 0.5},
}
ICE = {"type": "principled", "base_color": [0.6, 0.4, 0.2], "roughness": 0.4, "spec_trans": 0.6, "eta": 1.4}
STAINED = {"type": "blend", "weight": 0.4, "a": CLEAR, "b": {"type": "diffuse"}}
BLACK_BELOW = {"int_ior": 1.5, "ext_ior": 1.0, "specular_transmittance": [0.0, 0.0, 0.0]}
GLOSSY = {"diffuse": [0.6, 0.4, 0.2], "specular": [0.1, 0.08, 0.05]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "wanted", "spp", "spp_difference"),
    [
        pytest.param(before_a_wall(BALL), [(POSE, (0, 3), 0.02), (POSE, (1, 3), 0.02)], 32, 64, id="ball aside"),
        pytest.param(before_a_wall(SHEET), of_it(int_ior=0.02), 32, 64, id="surface of glass"),
        pytest.param(
            before_a_wall(WEDGE), [*of_it(int_ior=0.02), ("shapes.it.vertices", (0, 2), 0.1)], 32, 512, id="wedge"
        ),
        pytest.param(before_a_wall(SHEET, FROSTED), of_it(int_ior=0.02), 128, 256, id="frosted surface"),
        pytest.param(before_a_wall(SHEET, STAINED), of_it(weight=0.05), 128, 512, id="blend with glass"),
        pytest.param(under_the_sky({"type": "dielectric", **BLACK_BELOW}), of_it(int_ior=0.05), 256, 2048, id="clear"),
        pytest.param(
            under_the_sky({"type": "thindielectric", **BLACK_BELOW}), of_it(int_ior=0.05), 64, 1024, id="pane"
        ),
        pytest.param(
            under_a_lamp({**GOLD, "energy_compensation": True}),
            of_it(alpha=0.005, eta=0.01, k=0.01),
            32,
            64,
            id="roughconductor, energy compensation",
        ),
        pytest.param(
            under_a_lamp({"type": "roughconductor", "reflectance": 0.8, "alpha_u": 0.3, "alpha_v": 0.4}),
            of_it(alpha_u=0.005, alpha_v=0.005, reflectance=0.01),
            32,
            64,
            id="roughconductor, anisotropic",
        ),
        pytest.param(
            under_a_lamp({**FROSTED, "alpha": 0.3}),
            of_it(alpha=0.005, int_ior=0.01, ext_ior=0.01),
            32,
            64,
            id="roughdielectric",
        ),
        pytest.param(
            under_a_lamp({"type": "nonmetal", "base_color": [0.6, 0.4, 0.2], "specular": 0.1}),
            of_it(base_color=0.05, specular=0.01, roughness=0.005),
            32,
            64,
            id="nonmetal",
        ),
        pytest.param(
            under_a_lamp({"type": "microfacet", "diffuse": [0.6, 0.4, 0.2]}),
            of_it(diffuse=0.05, roughness=0.005, ior=0.01),
            32,
            64,
            id="microfacet",
        ),
        pytest.param(under_a_lamp({"type": "phong", **GLOSSY}), of_it(diffuse=0.05, exponent=0.5), 64, 256, id="phong"),
        pytest.param(
            under_a_lamp({"type": "blinn_phong", **GLOSSY}),
            of_it(diffuse=0.05, exponent=0.5),
            64,
            256,
            id="blinn_phong",
        ),
        pytest.param(
            under_a_lamp(ALL_PAINT),
            of_it(metallic=0.05, specular=0.02, clearcoat=0.02, clearcoat_gloss=0.02, flatness=0.02, anisotropic=0.02),
            32,
            64,
            id="principled, all",
        ),
        pytest.param(
            under_a_lamp(ICE),
            of_it(base_color=0.05, roughness=0.005, eta=0.01, spec_trans=0.02),
            32,
            64,
            id="principled, transmissive",
        ),
        pytest.param(
            under_a_lamp({"type": "diffuse", "opacity": 0.6}),
            of_it(opacity=0.05, reflectance=0.05),
            64,
            512,
            id="opacity",
        ),
    ],
)
def test_gradients_of_every_kind_agree_in_the_mean(scene, wanted, spp, spp_difference):
    judge(scene, wanted, spp, spp_difference)
