"""The choice among lights in whole renders: no way to choose changes the picture, and weights of both strategies sum to one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from trials import coarse, film_of, shoot, spread, z_limit

import torchpt
from torchpt.core.errors import EdgeWarning, SceneError
from torchpt.math.sampling import Distribution1D
from torchpt.physics import lights
from torchpt.physics.lights.choice import MANY, TreeSampler, bounds_of, draw, probability
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.shapes.interaction import OFFSET
from torchpt.scene.formats.description import settings
from torchpt.search.bounds import primitive_bounds

G = torch.Generator().manual_seed(8)
LIFT = {"translate": [0, 1.2, 0]}


def bulbs(count: int, seed: int = 3) -> dict[str, Any]:
    """Small spheres of any colour over the floor."""
    g = torch.Generator().manual_seed(seed)
    place = torch.rand(count, 3, generator=g) * torch.tensor([5.0, 1.2, 5.0]) + torch.tensor([-2.5, 0.15, -2.5])
    glow = 8 * torch.exp(torch.randn(count, 3, generator=g))
    return {
        f"bulb{k}": {"type": "sphere", "center": place[k].tolist(), "radius": 0.03, "emission": glow[k].tolist()}
        for k in range(count)
    }


def every_kind(sources: bool = True) -> dict[str, Any]:
    """Lights of every kind, more than few, over diffuse, glossy and clear things."""
    shapes: dict[str, Any] = {
        "floor": {
            "type": "rectangle",
            "material": "glossy",
            "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "ball": {"type": "sphere", "center": [-0.8, 0.4, 0.6], "radius": 0.4, "material": "glass"},
        "block": {"type": "cube", "transform": [{"scale": [0.3, 0.3, 0.3]}, {"translate": [0.9, 0.3, 0.2]}]},
        "panel": {"type": "rectangle", "emission": [2, 1, 1], "transform": [{"scale": 0.2}, LIFT]},
        "plate": {
            "type": "disk",
            "emission": [1, 3, 1],
            "transform": [{"scale": [0.2, 0.1, 1]}, {"translate": [1, 1, -1]}],
        },
        "tube": {"type": "cylinder", "center": [-1.5, 0.5, -1], "radius": 0.05, "height": 1, "emission": [4, 4, 1]},
        "hat": {
            "type": "cone",
            "apex": [1.6, 1, 0],
            "height": -0.5,
            "slope": 0.3,
            "capped": False,
            "emission": [1, 2, 4],
        },
        "egg": {
            "type": "sphere",
            "emission": [3, 1, 4],
            "transform": [{"scale": [0.1, 0.2, 0.1]}, {"translate": [0, 1, -1]}],
        },
        "kite": {
            "type": "mesh",
            "vertices": [[-0.5, 0.9, 0], [0.2, 1.1, 0.3], [0, 1.4, 0], [0.4, 1.5, -0.5]],
            "faces": [[0, 1, 2], [1, 3, 2]],
            "emission": [2, 2, 2],
        },
        **bulbs(12),
    }
    found = {
        "camera": {"origin": [0, 2.5, 5], "target": [0, 0.5, 0], "fov": 45},
        "materials": {
            "glossy": {"type": "roughplastic", "diffuse_reflectance": [0.5, 0.45, 0.4], "alpha": 0.15},
            "glass": {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.1},
        },
        "shapes": shapes,
    }
    if sources:
        found["lights"] = {
            "spark": {"type": "point", "position": [-1, 1.5, 1], "intensity": [0.6, 0.4, 0.4]},
            "beam": {
                "type": "spot", "position": [1, 2, 2], "target": [0, 0, 0.5], "intensity": [3, 3, 4], "cutoff_angle": 25,
            },
            "sun": {"type": "directional", "direction": [1, -2, -1], "irradiance": [0.1, 0.1, 0.08]},
            "sky": {"type": "constant", "radiance": [0.02, 0.02, 0.03]},
        }  # fmt: skip
    return found


def test_few_lights_are_chosen_by_power_and_many_by_the_tree():
    for count, kind in ((MANY - 1, Distribution1D), (MANY, TreeSampler)):
        scene = torchpt.load(
            {"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": bulbs(count)}, device="cpu"
        )
        table = scene.world(torch.float32)[0].lights
        assert table is not None and isinstance(table.choice, kind)
        assert lights.depends_on_point(table) == (kind is TreeSampler)
        for way, chosen in (("uniform", Distribution1D), ("power", Distribution1D), ("tree", TreeSampler)):
            table = scene.world(torch.float32, choice=way)[0].lights
            assert table is not None and isinstance(table.choice, chosen)


def test_uniform_choice_draws_all_lights_alike():
    scene = torchpt.load({"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": bulbs(30)}, device="cpu")
    table = scene.world(torch.float32, choice="uniform")[0].lights
    assert table is not None and isinstance(table.choice, Distribution1D)
    torch.testing.assert_close(table.choice.pmf, torch.full((30,), 1 / 30))


@pytest.mark.parametrize("key", ["path", "direct"])
def test_an_unknown_way_is_an_error(key):
    with pytest.raises(SceneError, match=r"integrator.light_choice.*auto.*uniform.*power.*tree"):
        settings(torchpt.load("cornell_box").description, {"integrator": {"type": key, "light_choice": "nearest"}})


def test_bounds_hold_what_the_lights_draw():
    """Points drawn on every row lie in its box, and shine to where its cones say: in all directions, or off a flat face."""
    world, geometry = torchpt.load(every_kind(), device="cpu").world(torch.float64)
    table = world.lights
    assert table is not None and table.kind is not None and table.row_of_prim is not None
    power = torch.ones(len(table.area), dtype=torch.float64)
    emitting = table.row_of_prim >= 0
    low, high = (box[:, emitting] for box in primitive_bounds(geometry))
    bounds = bounds_of(table, power, (low, high))
    near = len(bounds.intensity)
    assert near == len(power) - 2  # but the sun and the sky
    count = 400
    for row in range(near):
        only = Distribution1D.of(torch.eye(len(power))[row], torch.float64)
        alone = replace(table, choice=only)
        x = torch.randn(3, count, generator=G, dtype=torch.float64) * 3
        u = torch.rand(2, count, generator=G, dtype=torch.float64)
        drawn = lights.sample(alone, x, torch.zeros(count), u, 0.0)
        low, high = bounds.low[:, row, None] - 1e-9, bounds.high[:, row, None] + 1e-9
        assert ((drawn.target >= low) & (drawn.target <= high)).all()
        angle = torch.acos((-drawn.wi * bounds.axis[:, row, None]).sum(0).clamp(-1, 1))
        widest = math.acos(float(bounds.cos_o[row])) + math.acos(float(bounds.cos_e[row]))
        shining = (drawn.weight > 0) & (drawn.radiance[0] > 0)
        assert (angle[shining] <= widest + 1e-6).all()
        assert shining.any()


@pytest.mark.parametrize("sky", [True, False])
def test_weights_of_both_strategies_sum_to_one(sky):
    """The density told to a ray that meets a light by chance is that of drawing it there, the choice included."""
    scene = torchpt.load(every_kind(sky), device="cpu")
    world, _ = scene.world(torch.float32)
    table, count = world.lights, 4000
    assert table is not None and isinstance(table.choice, TreeSampler)
    x = torch.rand(3, count, generator=G) * torch.tensor([[4.0], [1.5], [4.0]]) - torch.tensor([[2.0], [0.0], [2.0]])
    n = torch.nn.functional.normalize(torch.randn(3, count, generator=G), dim=0) * (
        torch.rand(count, generator=G) < 0.7
    )
    which = torch.rand(count, generator=G, dtype=torch.float64)
    row, p, _ = draw(table.choice, which, x, n)
    assert torch.equal(probability(table.choice, row, x, n), p)
    drawn = lights.sample(table, x, which, torch.rand(2, count, generator=G), OFFSET, n)
    t, prim, u, v = scene.accel("auto", None).intersect(x, drawn.wi, torch.full((count,), torch.inf))
    assert table.row_of_prim is not None
    met = torch.where(prim >= 0, table.row_of_prim[prim.long().clamp_min(0)], -1)
    same = (met == row) & (drawn.weight > 0) & (drawn.pdf < 1e30)
    assert same.sum() > count / 8
    at = interact(world, x[:, same], drawn.wi[:, same], Hit(t[same], prim[same].long(), u[same], v[same]))
    _, pdf = lights.emitted(table, x[:, same], at, drawn.wi[:, same], n[:, same])
    chance = 0.7  # any density of the other strategy
    weights = drawn.pdf[same] / (drawn.pdf[same] + chance) + chance / (pdf + chance)
    # As exact as the hit point is; where a light is seen edge-on its cosine is rounding.
    assert float((weights - 1).abs().median()) < 1e-6
    assert float(((weights - 1).abs() < 1e-3).double().mean()) > 0.98


@pytest.mark.parametrize("strategy", ["mis", "light"])
@pytest.mark.slow
def test_the_picture_does_not_depend_on_the_choice(strategy):
    scene = torchpt.load(every_kind(), device="cpu")
    pictures = {}
    for way in ("tree", "power"):
        wish = {"max_depth": 4, "strategy": strategy, "light_choice": way}
        pictures[way] = [shoot(scene, 16, seed, "sobol", wish, film_of(18)).image for seed in range(8)]
    (a, va), (b, vb) = (spread([coarse(image, 6) for image in pictures[way]]) for way in pictures)
    z = (a - b) / (va + vb).clamp_min(1e-20).sqrt()
    assert float(z.abs().max()) < 1.5 * z_limit(z.numel())  # variances from eight pictures each
    means = [torch.stack([image.double().mean() for image in images]) for images in pictures.values()]
    noise = sum(float(mean.var()) / len(mean) for mean in means) ** 0.5
    assert abs(float(means[0].mean() - means[1].mean())) < 4 * noise < 0.2 * float(means[0].mean())


#: Thirty points over a floor, and where one pixel sees it.
PLACES = torch.randn(30, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64).abs() * 2 + 0.3
POWERS = torch.exp(torch.randn(30, generator=torch.Generator().manual_seed(4), dtype=torch.float64))


def floor_under_points() -> dict[str, Any]:
    points = {
        f"p{k}": {"type": "point", "position": PLACES[k].tolist(), "intensity": [float(POWERS[k])] * 3}
        for k in range(30)
    }
    tilt = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    return {
        "camera": {"origin": [0, 3, -2], "target": [0, 0, 0], "fov": 0.01},
        "film": film_of(1),
        "integrator": {"type": "direct"},
        "lights": points,
        "shapes": {
            "floor": {"type": "rectangle", "transform": [tilt], "material": {"type": "diffuse", "reflectance": 0.6}}
        },
    }


def test_a_floor_under_many_points_and_its_derivatives():
    """Against the closed form: sum of I cos / r^2, and its derivative by the height and the intensity of one light."""
    scene = torchpt.load(floor_under_points(), device="cpu")
    table = scene.world(torch.float32)[0].lights
    assert table is not None and isinstance(table.choice, TreeSampler)
    places, powers = PLACES.clone().requires_grad_(), POWERS.clone().requires_grad_()
    expected = (0.6 / math.pi * powers * places[:, 1] / (places * places).sum(1) ** 1.5).sum()
    expected.backward()
    assert places.grad is not None and powers.grad is not None
    strongest = int((POWERS * PLACES[:, 1] / (PLACES * PLACES).sum(1) ** 1.5).argmax())
    names = (f"lights.p{strongest}.position", f"lights.p{strongest}.intensity")
    params = {name: scene.params[name].clone().requires_grad_() for name in names}
    with pytest.warns(EdgeWarning):
        picture = torchpt.render(scene, params=params, spp=1024, compile=False, film={"filter": "box"}, edges=False)
    picture[0, 0, 0].backward()
    assert float(picture.detach()[0, 0, 0]) == pytest.approx(float(expected.detach()), rel=5e-3)
    position, intensity = (params[name].grad for name in names)
    assert position is not None and intensity is not None
    torch.testing.assert_close(
        position.double(), places.grad[strongest], rtol=0.05, atol=0.02 * float(expected.detach())
    )
    assert float(intensity[0]) == pytest.approx(float(powers.grad[strongest]), rel=0.05)


@pytest.mark.slow
def test_compiled_stages_choose_by_the_tree_too():
    description = every_kind()
    for shape in description["shapes"].values():
        shape.pop("material", None)  # one model is enough
    scene = torchpt.load(description, device="cpu")
    eager, compiled = (
        shoot(scene, 32, 5, "sobol", {"max_depth": 3}, film_of(32), compile=mode).image for mode in ("off", "on")
    )
    close = torch.isclose(eager, compiled, rtol=1e-3, atol=1e-4).all(-1)
    assert close.float().mean() > 0.9
    assert float(compiled.mean()) == pytest.approx(float(eager.mean()), rel=5e-3)
