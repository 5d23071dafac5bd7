"""Points, spots and directional lights: closed forms, shadows, choice, derivatives, errors."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few
from trials import film_of, shoot, z_limit

import torchpt
from torchpt.core.errors import EdgeWarning, SceneError
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import normalize
from torchpt.physics import lights
from torchpt.physics.shapes.interaction import OFFSET

ALBEDO = 0.6
LIGHTS: dict[str, dict[str, Any]] = {
    "point": {"type": "point", "position": [1, 2, 0.5], "intensity": [4, 2, 1]},
    "spot": {"type": "spot", "position": [0.5, 2, -0.5], "target": [0.2, 0, 0], "intensity": [9, 5, 3]},
    "sun": {"type": "directional", "direction": [1, -2, 0.5], "irradiance": [3, 2, 1]},
}


def floor(sources: dict[str, Any], **shapes: Any) -> dict[str, Any]:
    """One pixel that sees the point (0, 0, 0) of a Lambert floor, and next to nothing around it."""
    tilt = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    ground = {"type": "rectangle", "transform": [tilt], "material": {"type": "diffuse", "reflectance": ALBEDO}}
    return {
        "camera": {"origin": [0, 3, -2], "target": [0, 0, 0], "fov": 0.01},
        "integrator": {"type": "direct"},
        "film": film_of(1),
        "lights": sources,
        "shapes": {"floor": ground, **shapes},
    }


def seen(scene: dict[str, Any], spp: int = 16) -> torch.Tensor:
    return shoot(scene, spp, integrator={"max_depth": 2}).image[0, 0].double()


def exact(name: str) -> torch.Tensor:
    light = LIGHTS[name]
    if name == "sun":
        d = torch.tensor(light["direction"], dtype=torch.float64)
        return ALBEDO / math.pi * torch.tensor(light["irradiance"], dtype=torch.float64) * float(-d[1] / d.norm())
    p = torch.tensor(light["position"], dtype=torch.float64)
    falloff = 1.0
    if name == "spot":
        axis = torch.tensor(light["target"], dtype=torch.float64) - p
        angle = math.degrees(math.acos(float(-(p @ axis) / p.norm() / axis.norm())))
        falloff = min(max((20 - angle) / 5, 0), 1)
    return (
        ALBEDO / math.pi * torch.tensor(light["intensity"], dtype=torch.float64) * float(p[1] / p.norm() ** 3 * falloff)
    )


@pytest.mark.parametrize("name", LIGHTS)
def test_a_lambert_floor_under_one_light(name):
    torch.testing.assert_close(seen(floor({name: LIGHTS[name]})), exact(name), rtol=2e-4, atol=0)


@pytest.mark.parametrize("strategy", few(["mis", "light"], 1))
def test_lights_add_up(strategy):
    lamp = {"type": "sphere", "center": [0, 3, 1], "radius": 0.1, "emission": 40}
    whole = floor({**LIGHTS, "sky": {"type": "constant", "radiance": 0.3}}, lamp=lamp)
    whole["film"] = film_of(4)  # pixels of one and the same place
    found = shoot(whole, 512, 40, integrator={"max_depth": 2, "strategy": strategy}).image.double().flatten(0, 1)
    expected = sum(exact(name) for name in LIGHTS) + ALBEDO * 0.3
    # A sphere of radius r at distance d sends the irradiance pi L (r / d)^2 cos.
    sphere = ALBEDO / math.pi * math.pi * 40 * (0.1**2 / 10) * (3 / math.sqrt(10))
    z = (found.mean(0) - expected - sphere) / (found.std(0) / math.sqrt(len(found)))
    assert (z.abs() < z_limit(3)).all(), z


@pytest.mark.parametrize("name", LIGHTS)
def test_shadows(name):
    blocker = {"type": "sphere", "center": [0, 0, 0], "radius": 1e-2, "material": {"type": "diffuse", "reflectance": 0}}
    light = LIGHTS[name]
    way = torch.tensor(light.get("position") or [-x for x in light["direction"]], dtype=torch.float64)
    blocker["center"] = (0.3 * way).tolist()
    assert (seen(floor({name: light}, blocker=blocker)) == 0).all()


def test_a_blocker_behind_the_point_casts_no_shadow():
    way = torch.tensor(LIGHTS["point"]["position"], dtype=torch.float64)
    behind = {"type": "sphere", "center": (1.2 * way).tolist(), "radius": 0.05}
    torch.testing.assert_close(seen(floor({"p": LIGHTS["point"]}, behind=behind)), exact("point"), rtol=2e-4, atol=0)


def test_no_ray_meets_them():
    scene = floor(LIGHTS)
    scene["camera"] = {"origin": [1, 2, -3], "target": [1, 2, 0.5], "fov": 20}
    assert (seen(scene) == 0).all()


def test_the_table_tells_deltas_apart():
    lamp = {"type": "rectangle", "emission": 1, "transform": [{"translate": [0, 0, -4]}]}
    world, _ = torchpt.load(floor({**LIGHTS, "sky": {"type": "constant"}}, lamp=lamp), "cpu").world(
        torch.float32, choice="power"
    )
    table = world.lights
    assert table is not None and isinstance(table.choice, Distribution1D)
    assert table.kinds == ("rectangle", "point", "spot", "directional", "constant")
    n = 4096
    x = torch.rand(3, n, generator=torch.Generator().manual_seed(1))
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(2))
    light = lights.sample(table, x, u[0], u[1:], OFFSET)
    row = table.choice.draw(u[0])[0]
    delta = (row >= 1) & (row <= 3)
    assert len(row.unique()) == 5
    assert torch.equal(torch.isinf(light.pdf), delta)
    assert light.distant is not None and torch.equal(light.distant, row >= 3)
    assert light.bare is not None and torch.equal(light.bare, row >= 1)
    rest = light.weight[~delta] > 0
    torch.testing.assert_close((light.pdf * light.weight)[~delta][rest], torch.ones(int(rest.sum())), rtol=1e-5, atol=0)
    square = (torch.tensor(LIGHTS["point"]["position"])[:, None] - x).square().sum(0)
    at = row == 1
    torch.testing.assert_close(light.weight[at], 1 / (square[at] * table.choice.pmf[1]), rtol=1e-5, atol=0)


def test_a_spot_falls_linearly_in_the_angle():
    light = {**LIGHTS["spot"], "position": [0, 2, 0], "target": [0, 0, 0], "cutoff_angle": 30, "beam_width": 10}
    world, _ = torchpt.load(floor({"s": light}), "cpu").world(torch.float64)
    angle = torch.arange(0.0, 60.0, 1.0, dtype=torch.float64)
    turn = angle * (math.pi / 180)
    x = torch.stack((torch.sin(turn), 2 - torch.cos(turn), torch.zeros_like(turn)))
    assert world.lights is not None
    drawn = lights.sample(world.lights, x, None, torch.zeros(2, len(angle), dtype=torch.float64), OFFSET)
    expected = ((30 - angle) / 20).clamp(0, 1)
    torch.testing.assert_close(drawn.radiance[0], 9 * expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(drawn.wi, normalize(torch.tensor([[0.0], [2.0], [0.0]], dtype=torch.float64) - x))


def test_textures_of_other_lights_leave_them_alone():
    """Where lights' textures are looked up, these have none: the row of the first primitive is not theirs."""
    squares = {"type": "checkerboard", "color0": 0, "color1": 0}
    dark = {"type": "mesh", "vertices": [[5, 0, 0], [6, 0, 0], [5, 0, 1]], "faces": [[0, 1, 2]],
            "uvs": [[0, 0], [1, 0], [0, 1]], "material": {"type": "diffuse", "emission": squares}}  # fmt: skip
    found = seen(floor({"p": LIGHTS["point"]}, dark=dark), 1024)
    torch.testing.assert_close(found, exact("point"), rtol=0.05, atol=0)


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
@pytest.mark.parametrize("name", few(LIGHTS, 2))
def test_gradients(name):
    """Of one light: among several the choice follows their power, and the samples would change."""
    scene = torchpt.load({**floor({name: LIGHTS[name]}), "film": {**film_of(2), "filter": "box"}}, "cpu")
    names = tuple(name for name in scene.params if name.startswith("lights."))
    assert len(names) == {"point": 2, "spot": 5, "sun": 2}[name]
    leaves = tuple(scene.params[name].double().requires_grad_() for name in names)

    def picture(*values):
        given = dict(zip(names, values, strict=True))
        return torchpt.render(scene, params=given, spp=4, seed=1, seed_grad=1, dtype=torch.float64)

    assert torch.autograd.gradcheck(picture, leaves, eps=1e-5, atol=1e-6, rtol=1e-4, fast_mode=True)


def test_moving_lights_warns_of_shadow_edges():
    scene = torchpt.load(floor({"p": LIGHTS["point"]}), "cpu")
    place = scene.params["lights.p.position"].clone().requires_grad_()
    with pytest.warns(EdgeWarning):
        torchpt.render(scene, params={"lights.p.position": place}, spp=1, edges=False)


def test_far_scenes_keep_their_lights_in_place():
    far = torch.tensor([4e5, -3e5, 2e5], dtype=torch.float64)

    def moved(v: Any) -> list[float]:
        return (torch.tensor(v, dtype=torch.float64) + far).tolist()

    scene = floor({"p": {**LIGHTS["point"], "position": moved(LIGHTS["point"]["position"])}})
    scene["camera"] |= {"origin": moved([0, 3, -2]), "target": moved([0, 0, 0])}
    scene["shapes"]["floor"]["transform"].append({"translate": far.tolist()})
    torch.testing.assert_close(seen(scene), exact("point"), rtol=2e-3, atol=0)


BAD = {
    "position": ({"type": "point"}, "lights.l.position"),
    "negative": ({"type": "point", "position": [0, 0, 0], "intensity": -1}, "lights.l.intensity"),
    "target": ({"type": "spot", "position": [0, 1, 0], "target": [0, 1, 0]}, "lights.l.target"),
    "beam": ({"type": "spot", "position": [0, 1, 0], "target": [0, 0, 0], "beam_width": 30}, "lights.l.beam_width"),
    "cutoff": (
        {"type": "spot", "position": [0, 1, 0], "target": [0, 0, 0], "cutoff_angle": 0},
        "lights.l.cutoff_angle",
    ),
    "direction": ({"type": "directional", "direction": [0, 0, 0]}, "lights.l.direction"),
    "unknown": ({"type": "directional", "direction": [0, 1, 0], "radiance": 1}, "lights.l.radiance"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_lights_are_one_line(name):
    light, key = BAD[name]
    with pytest.raises(SceneError) as caught:
        torchpt.load(floor({"l": light}), "cpu")
    assert key in str(caught.value) and "\n" not in str(caught.value)
