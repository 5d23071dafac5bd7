"""Surfaces that textures light and cut out: met by chance or sampled, they bring the same light."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from trials import coarse, film_of, shoot, spread, z_limit

import torchpt

UP = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
SQUARES = {"type": "checkerboard", "color0": [3, 1, 0.5], "color1": [0, 0.5, 2]}
HOLES = {"type": "checkerboard", "color0": 1, "color1": 0.2, "scale": 3}


def lit_by(shape: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A grey floor under a lamp; the camera looks down from the side and sees both."""
    lamp = {"material": {"type": "diffuse", "reflectance": 0, "emission": SQUARES, "emission_strength": 2, **more}}
    return {
        "camera": {"origin": [0, 2.2, 5], "target": [0, 0.7, 0], "fov": 45},
        "shapes": {
            "floor": {"type": "rectangle", "transform": [{"scale": 3}, UP]},
            "post": {"type": "cylinder", "center": [1.6, 0.4, 0.3], "radius": 0.2, "height": 0.8},
            "lamp": {**shape, **lamp},
        },
        "lights": {"sky": {"type": "constant", "radiance": 0.05}},
    }


TIPPED = [{"rotate": {"axis": [1, 0, 0], "angle": 60}}, {"translate": [0, 1.4, 0]}]
LAMPS: dict[str, dict[str, Any]] = {
    "rectangle": {"type": "rectangle", "transform": TIPPED},
    "disk": {"type": "disk", "transform": TIPPED},
    "sphere": {"type": "sphere", "center": [0, 1.2, 0], "radius": 0.6},
    "cylinder": {"type": "cylinder", "center": [0, 1.2, 0], "radius": 0.5, "height": 1},
    "cone": {"type": "cone", "apex": [0, 2, 0], "height": -1.2, "slope": 0.5},
    "cube": {"type": "cube", "transform": [{"scale": 0.5}, *TIPPED]},
}


#: The others take the same paths with another shape's coordinates, which tests of shapes and of look-ups cover too.
FAST = (("rectangle", "holes"),)
CASES = [
    pytest.param(kind, more, marks=() if (kind, more) in FAST else pytest.mark.slow)
    for kind in LAMPS
    for more in ("whole", "holes")
]


@pytest.mark.parametrize("other", few(["bsdf", "light"], 1))
@pytest.mark.parametrize(("kind", "more"), CASES)
def test_strategies_agree(kind: str, more: str, other: str):
    scene = torchpt.load(lit_by(LAMPS[kind], **({"opacity": HOLES} if more == "holes" else {})), device="cpu")
    found = {}
    for strategy in ("mis", other):
        keys = {"strategy": strategy, "max_depth": 3}
        images = [shoot(scene, 4, 10 + seed, "sobol", keys, film_of(48)).image for seed in range(12)]
        found[strategy] = spread([coarse(image, 12) for image in images])
    difference, noise = found[other][0] - found["mis"][0], (found[other][1] + found["mis"][1]).sqrt()
    # Student's t of about 22 degrees has wider tails than the normal: hence the margin.
    assert (difference.abs() <= 1.4 * z_limit(difference.numel() * 24) * noise + 1e-5).all()
    whole, error = difference.mean(), noise.square().sum().sqrt() / noise.numel()
    assert whole.abs() < 3.5 * error, (float(whole), float(error))


def test_emission_seen_directly_is_the_texture():
    lamp = {"type": "rectangle", "material": {"type": "diffuse", "reflectance": 0, "emission": SQUARES}}
    scene = {"camera": {"origin": [0, 0, 9], "target": [0, 0, 0], "fov": 10}, "shapes": {"lamp": lamp}}
    image = shoot(scene, 4, 0, integrator={"max_depth": 1}, film=film_of(8)).image
    top = torch.tensor([[0.0, 0.5, 2.0], [3.0, 1.0, 0.5]])
    assert torch.allclose(image[1, 1], top[0]) or torch.allclose(image[1, 1], top[1])
    assert torch.allclose(image[1, 6] + image[1, 1], top.sum(0)) and torch.equal(image[6, 6], image[1, 1])


@pytest.mark.slow
def test_gradients_reach_the_texture_of_a_lamp():
    scene = torchpt.load(lit_by(LAMPS["rectangle"]), device="cpu")
    name = "shapes.lamp.material.emission.color0"
    color = scene.params[name].clone().requires_grad_()
    film = {"width": 8, "height": 8}
    torchpt.render(scene, spp=256, params={name: color}, film=film, seed_grad=0).mean().backward()
    assert color.grad is not None and (color.grad > 0).all()
    # The picture is linear in it; but a brighter lamp is chosen more often, so that not the same samples are compared.
    with torch.no_grad():
        more = torchpt.render(scene, spp=256, params={name: color + 1}, film=film).mean()
        same = torchpt.render(scene, spp=256, params={name: color}, film=film).mean()
    assert float(color.grad.sum()) == pytest.approx(float(more - same), rel=1e-2)
