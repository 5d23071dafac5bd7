"""Tent and Mitchell: moments, signs and weights of what is drawn; edges, constants and gradients of what is rendered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from trials import film_of, shoot, z_limit

import torchpt
from torchpt.physics.film import Filter, filter_of
from torchpt.rendering.api import first_hit
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

CPU = torch.device("cpu")
U = (torch.arange(1 << 20, dtype=torch.float64) + 0.5) / (1 << 20)
MIDDLE = torch.full_like(U, 0.5)


def tent(x: np.ndarray, radius: float) -> np.ndarray:
    return np.maximum(1 - np.abs(x) / radius, 0) / radius


def mitchell(x: np.ndarray, b: float, c: float) -> np.ndarray:
    """Through the four cubics of Mitchell and Netravali's figure, as products: not the polynomial that is tested."""
    x = np.abs(x)
    far = 2 - x
    outer = far**2 * (b * far + 6 * c * (1 - x)) / 6
    inner = 1 - b / 3 + x**2 * ((2 - 1.5 * b - c) * x - (3 - 2 * b - c))
    return np.where(x < 1, inner, np.where(x < 2, outer, 0.0))


#: Kind, keys, radius, the profile, which integrates to one.
FILTERS: dict[str, tuple[dict[str, Any], float, Any]] = {
    "tent": ({"type": "tent"}, 1.0, lambda x: tent(x, 1.0)),
    "wide tent": ({"type": "tent", "radius": 1.7}, 1.7, lambda x: tent(x, 1.7)),
    "mitchell": ({"type": "mitchell"}, 2.0, lambda x: mitchell(x, 1 / 3, 1 / 3)),
    "catmull-rom": ({"type": "mitchell", "B": 0, "C": 0.5}, 2.0, lambda x: mitchell(x, 0, 0.5)),
    "b-spline": ({"type": "mitchell", "B": 1, "C": 0}, 2.0, lambda x: mitchell(x, 1, 0)),
    "both": ({"type": "mitchell", "B": 1, "C": 1}, 2.0, lambda x: mitchell(x, 1, 1)),
}


def made(keys: dict[str, Any]) -> Filter:
    return filter_of(keys["type"], CPU, **{key: value for key, value in keys.items() if key != "type"})


def weights(filter: Filter) -> tuple[torch.Tensor, float]:
    """Signed weight along one axis at ``U``, and that of the other axis at its centre."""
    if not filter.signed:
        return torch.ones_like(U), 1.0
    centre = float(filter.weight(torch.full((2, 1), 0.5, dtype=torch.float64)).sqrt())
    return filter.weight(torch.stack((U, MIDDLE))) / centre, centre


@pytest.mark.parametrize("name", few(FILTERS, 3))
def test_what_is_drawn_has_the_moments_and_shares_of_the_filter(name):
    keys, radius, profile = FILTERS[name]
    filter = made(keys)
    x, order = filter.offset(U).double().sort()
    weight = weights(filter)[0][order]
    assert float(x.abs().max()) <= radius
    grid = np.linspace(-radius, radius, 100_001)
    exact = profile(grid) * (grid[1] - grid[0])
    assert float(weight.mean()) == pytest.approx(1, abs=2e-6)  # the integral of each profile
    assert abs(float((weight * x).mean())) < 1e-5
    assert float((weight * x**2).mean()) == pytest.approx((exact * grid**2).sum(), abs=3e-4 * radius**2)
    assert float((weight * x**4).mean()) == pytest.approx((exact * grid**4).sum(), abs=1e-3 * radius**2)
    # The signed measure up to places all over the support.
    places = np.linspace(-0.99 * radius, 0.99 * radius, 41)
    found = np.concatenate(([0], np.cumsum(weight.numpy())))[np.searchsorted(x.numpy(), places)] / len(U)
    np.testing.assert_allclose(found, np.interp(places, grid, np.cumsum(exact)), atol=3e-4)


@pytest.mark.parametrize("name", FILTERS)
def test_weights_have_the_sign_of_the_filter_and_a_mean_of_one(name):
    keys, radius, profile = FILTERS[name]
    filter = made(keys)
    negative = float((profile(np.linspace(-radius, radius, 100_001)) < 0).mean()) > 0
    assert filter.signed == negative
    if not negative:
        return
    grid = np.linspace(-radius, radius, 100_001)
    whole = np.abs(profile(grid)).sum() * (grid[1] - grid[0])
    _, centre = weights(filter)
    assert centre == pytest.approx(whole, rel=1e-6)  # the integral of the magnitude
    side = (torch.arange(500) + 0.5) / 500
    u = torch.stack((side.repeat(500), side.repeat_interleave(500)))
    weight, place = filter.weight(u), filter.offset(u).double().numpy()
    value = profile(place[0]) * profile(place[1])
    clear = np.abs(value) > 1e-4
    assert (np.sign(value[clear]) == np.sign(weight.numpy()[clear])).all()
    assert float(weight.double().mean()) == pytest.approx(1, abs=2e-2)
    # Over all numbers that a sampler can give, exactly: the lobe is a whole number of steps.
    negative = float(filter.tensors()["negative"])
    assert (1 - 2 * negative) * centre == pytest.approx(1, abs=1e-7)
    assert negative * 2**24 == round(negative * 2**24)


@pytest.mark.mitsuba
@pytest.mark.parametrize("name", FILTERS)
def test_the_profiles_are_mitsubas(name):
    import importlib

    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    keys, radius, profile = FILTERS[name]
    theirs = mitsuba.load_dict({key: float(value) if key != "type" else value for key, value in keys.items()})
    assert float(theirs.radius()) == pytest.approx(radius)
    x = np.linspace(-radius, radius, 4001)
    values = np.array([theirs.eval(float(v)) for v in x])
    values /= values.sum() * (x[1] - x[0])
    np.testing.assert_allclose(values, profile(x) / (profile(x).sum() * (x[1] - x[0])), atol=2e-3)


# --- Pictures

EDGE = 8.3  # pixels from the left, where light begins
HALF = {
    "camera": {"origin": [0, 0, 0], "target": [0, 0, -1], "fov": 90},
    "film": {"width": 16, "height": 32},
    "integrator": {"type": "path", "max_depth": 1},
    "shapes": {
        "half": {"type": "rectangle", "emission": 1.0, "transform": [
            {"scale": [4, 20, 1]}, {"translate": [4 + (EDGE - 8) / 8, 0, -1]}]},
    },
}  # fmt: skip


def expected(name: str) -> np.ndarray:
    """The share of the filter of each column's pixels that lies beyond the edge."""
    _, radius, profile = FILTERS[name]
    grid = np.linspace(-radius, radius, 100_001)
    total = np.cumsum(profile(grid)) * (grid[1] - grid[0])
    return 1 - np.interp(EDGE - (np.arange(16) + 0.5), grid, total, left=0, right=1)


@pytest.fixture(scope="module")
def half() -> Scene:
    return torchpt.load(HALF, device="cpu")


@pytest.mark.parametrize("name", FILTERS)
def test_an_edge_is_its_convolution_with_the_filter(half, name):
    film = {"filter": FILTERS[name][0], "aovs": ["variance", "albedo", "object_id"]}
    shot = shoot(half, 64, 1, "independent", {"max_depth": 1}, film)
    image = shot.image[..., 0].double()
    exact = torch.from_numpy(expected(name))
    error = image.std(0) / len(image) ** 0.5
    certain = error == 0
    assert torch.allclose(image.mean(0)[certain], exact[certain], atol=1e-3)  # or too rare to be met
    z = (image.mean(0) - exact)[~certain] / error[~certain]
    assert float(z.abs().max()) < 1.2 * z_limit(16)  # t of 31 degrees
    if name == "catmull-rom":  # it rings: darker than black before the edge, brighter than light behind it
        assert float(exact.min()) < -0.01 and float(exact.max()) > 1.01
    # The picture's own estimate of its variance knows of the weights.
    own = shot.layers["variance"][..., 0].double().mean(0)
    assert float((own / image.var(0))[~certain].mean()) == pytest.approx(1, abs=0.45)
    # Layers are filtered alike; names are not.
    torch.testing.assert_close(shot.layers["albedo"][..., 0].double(), 0.5 * image, rtol=1e-5, atol=1e-6)
    assert set(shot.layers["object_id"].unique().tolist()) <= {0.0, 1.0}


def test_constants_are_kept():
    scene = torchpt.load({**HALF, "shapes": {}, "lights": {"sky": {"type": "constant", "radiance": 0.7}}}, "cpu")
    error = {}
    for sampler in ("independent", "sobol"):
        shot = shoot(scene, 64, 2, sampler, {"max_depth": 1}, {**film_of(48), "filter": "mitchell"})
        image = shot.image[..., 0].double() / 0.7
        error[sampler] = float(image.std())
        assert abs(float(image.mean()) - 1) < 4 * error[sampler] / 48
    # Chance puts as many samples into the lobes as it likes: sqrt(1.145^2 - 1) a sample; strata share them out.
    assert error["independent"] == pytest.approx(math.sqrt(1.14484**2 - 1) / 8, rel=0.1)
    assert error["sobol"] < 0.45 * error["independent"]
    for other in ("box", "tent", "gaussian"):
        image = shoot(scene, 4, 2, "sobol", {"max_depth": 1}, {**film_of(8), "filter": other}).image
        assert torch.equal(image, torch.full_like(image, 0.7))


@pytest.mark.parametrize("name", ["tent", "mitchell"])
def test_gradients_carry_the_weights(half, name):
    emission = half.params["shapes.half.emission"].clone().requires_grad_()
    film = {"filter": FILTERS[name][0]}
    image = torchpt.render(half, params={"shapes.half.emission": emission}, spp=64, film=film, sampler="independent")
    columns = image.mean(0)[..., 0]
    exact = torch.from_numpy(expected(name)).float()
    for column in (6, 8, 9, 13):
        (gradient,) = torch.autograd.grad(columns[column], emission, retain_graph=True)
        assert float(gradient.sum()) == pytest.approx(float(exact[column]), abs=0.03)


def test_a_clamp_bounds_both_signs(half):
    shot = shoot(half, 64, 1, "independent", {"max_depth": 1, "clamp": 0.5}, {"filter": "mitchell"})
    plain = shoot(half, 64, 1, "independent", {"max_depth": 1}, {"filter": "mitchell"})
    norm = 1.14484
    torch.testing.assert_close(shot.image, plain.image * (0.5 / norm), rtol=1e-4, atol=1e-6)


def test_a_preview_of_one_sample_has_no_weights(half):
    layers = first_hit(half, settings(half.description, {"film": {"filter": "mitchell"}}), ("depth",))
    assert float(layers["depth"].min()) == 0
