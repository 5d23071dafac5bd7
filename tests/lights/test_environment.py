"""Scenes lit by an environment map: keys and errors, closed forms, strategies, derivatives, and Mitsuba."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from mitsuba_scene import convert, load_mitsuba
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p, coarse, estimate, film_of, shoot, spread, z_limit

import torchpt
from torchpt.core.errors import AssetError, SceneError
from torchpt.math.sampling import Distribution1D
from torchpt.physics.lights.kinds.envmap import EnvironmentMap
from torchpt.scene.formats.description import settings

ALBEDO = 0.6


@pytest.fixture(scope="module")
def quadrants(tmp_path_factory) -> Path:
    """A map in four colours: red before the world's -z to the right of it, and so on round; dark below."""
    texels = torch.zeros(33, 64, 3)
    for k, colour in enumerate(([1.0, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 1.0], [1.0, 1.0, 0.1])):
        texels[:, 16 * k : 16 * (k + 1)] = torch.tensor(colour)
    texels[20:] *= 0.05
    path = tmp_path_factory.mktemp("maps") / "quadrants.exr"
    torchpt.write_image(path, texels)
    return path


def under(sky: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A Lambert ball and a glossy one on a floor."""
    tilt = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    return {
        "camera": {"origin": [0.5, 1.6, 5], "target": [0, 0.6, 0], "fov": 40},
        "film": film_of(32),
        "integrator": {"type": "path", "max_depth": 4},
        "materials": {
            "grey": {"type": "diffuse", "reflectance": ALBEDO},
            "glossy": {"type": "roughplastic", "alpha": 0.1},
        },
        "lights": {"sky": sky},
        "shapes": {
            "floor": {"type": "rectangle", "material": "grey", "transform": [{"scale": 4}, tilt]},
            "a": {"type": "sphere", "center": [-0.8, 0.7, 0], "radius": 0.7, "material": "grey"},
            "b": {"type": "sphere", "center": [0.8, 0.7, 0], "radius": 0.7, "material": "glossy"},
        },
        **more,
    }


def plane(sky: dict[str, Any]) -> dict[str, Any]:
    """Pixels that all see one Lambert floor facing +y, which sees the upper half of the map alone."""
    tilt = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    floor = {"type": "rectangle", "transform": [tilt], "material": {"type": "diffuse", "reflectance": ALBEDO}}
    return {
        "camera": {"origin": [0, 3, -2], "target": [0, 0, 0], "fov": 0.01},
        "film": film_of(32),
        "lights": {"sky": sky},
        "shapes": {"floor": floor},
    }


def irradiance(texels: Tensor, scale: float) -> Tensor:
    """``E / pi`` on a surface facing +y, by quadrature of the bilinear look-up; of any rotation about y the same."""
    height = len(texels)
    theta = (torch.arange(4000, dtype=torch.float64) + 0.5) * (0.5 * math.pi / 4000)
    y = theta / math.pi * (height - 1)
    row = y.floor().long()
    rings = texels.double().mean(1)  # of a ring the mean over texels is that of the look-up
    ring = rings[row] * (1 - (y - row))[:, None] + rings[row + 1] * (y - row)[:, None]
    return scale * (ring * (torch.sin(2 * theta) * (0.5 * math.pi / 4000))[:, None]).sum(0)


def test_directions_on_the_map(quadrants):
    """What a camera sees: red is u in 0..1/4, from -z toward +x; turned by 90 degrees about y it lies from -x to -z."""
    colours = {"red": [1.0, 0.1, 0.1], "green": [0.1, 1.0, 0.1], "blue": [0.1, 0.1, 1.0], "yellow": [1.0, 1.0, 0.1]}
    views = {"red": [1, 0.2, -1], "green": [1, 0.2, 1], "blue": [-1, 0.2, 1], "yellow": [-1, 0.2, -1]}
    turns = {"red": "green", "green": "blue", "blue": "yellow", "yellow": "red"}
    for angle in (0, 90):
        turn = [{"scale": 3}, {"rotate": {"axis": [0, 1, 0], "angle": angle}}, {"translate": [5, 6, 7]}]
        sky = {"type": "envmap", "path": str(quadrants), "scale": 2.0, "transform": turn}
        for name, target in views.items():
            camera = {"origin": [0, 0, 0], "target": target, "fov": 5}
            image = torchpt.render(
                torchpt.load({"camera": camera, "film": film_of(2), "lights": {"sky": sky}}, "cpu"), spp=1
            )
            expected = torch.tensor(colours[turns[name] if angle else name]) * 2
            torch.testing.assert_close(image, expected.expand(2, 2, 3), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("strategy", ["mis", "light", "bsdf", "uniform"])
def test_a_lambert_floor_under_a_map(quadrants, strategy):
    sky = {"type": "envmap", "path": str(quadrants), "scale": 1.5}
    scene = torchpt.load(plane(sky), "cpu")
    for alone in (False, True):  # the density by luminance is made only where it is read
        world, _ = scene.world(torch.float32, alone=alone)
        assert world.lights is not None and isinstance(world.lights.environment, EnvironmentMap)
        assert world.lights.environment.compensated is not None
        assert (world.lights.environment.plain is not None) == alone
    mean, error = estimate(shoot(scene, 64, 7, integrator={"max_depth": 2, "strategy": strategy}).image)
    expected = ALBEDO * irradiance(scene.params["lights.sky.texels"], 1.5)
    assert ((mean - expected).abs() < z_limit(12) * error).all(), (mean, expected, error)


def test_a_constant_map_is_a_constant_light(tmp_path):
    """Every material sees it: a white room of a map, and pictures that agree with those of a `constant` light."""
    torchpt.write_image(tmp_path / "even.exr", torch.full((8, 16, 3), 0.5))
    sky = {"type": "envmap", "path": str(tmp_path / "even.exr"), "scale": 2.0}
    furnace = under(sky)
    furnace["materials"] = {"grey": {"type": "diffuse", "reflectance": 1.0}, "glossy": {"type": "dielectric"}}
    furnace["integrator"] = {"type": "path", "max_depth": 64, "rr_depth": 100}
    furnace["shapes"].pop("floor")
    furnace["integrator"]["strategy"] = "bsdf"
    image = shoot(furnace, 4, 3).image
    torch.testing.assert_close(image, torch.ones_like(image), rtol=0, atol=2e-3)
    pictures = [
        spread([shoot(under(light), 16, 50 + k, "sobol", {"max_depth": 4}, film_of(16)).image for k in range(4)])
        for light in (sky, {"type": "constant", "radiance": 1.0})
    ]
    (a, va), (b, vb) = pictures
    z = (coarse(a, 8) - coarse(b, 8)) / (coarse(va + vb, 8) / 64).sqrt()
    assert float(z.abs().max()) < z_limit(z.numel())


def test_with_other_lights(quadrants):
    """Beside a lamp and a sun: what each brings alone adds up, and MIS weights of both strategies sum to one."""
    sky = {"type": "envmap", "path": str(quadrants)}
    sun = {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 2.0}
    lamp = {"type": "sphere", "center": [0, 3, 1], "radius": 0.2, "emission": 8}

    def picture(lights: dict[str, Any], shapes: dict[str, Any]) -> tuple[Tensor, Tensor]:
        scene = plane(sky)
        scene["lights"] = lights
        scene["shapes"].update(shapes)
        return estimate(shoot(scene, 32, 5, integrator={"max_depth": 2}).image)

    dark = {**lamp, "emission": 0}
    parts = [picture({"sky": sky}, {"lamp": dark}), picture({"sun": sun}, {"lamp": dark}), picture({}, {"lamp": lamp})]
    whole, error = picture({"sky": sky, "sun": sun}, {"lamp": lamp})
    expected = sum(mean for mean, _ in parts)
    error = (error**2 + sum(e**2 for _, e in parts)).sqrt()
    assert ((whole - expected).abs() < z_limit(3) * error).all()


def test_a_black_map(tmp_path):
    torchpt.write_image(tmp_path / "black.exr", torch.zeros(8, 16, 3))
    sky = {"type": "envmap", "path": str(tmp_path / "black.exr")}
    assert float(shoot(under(sky), 4).image.abs().max()) == 0
    lit = under(sky)
    lit["lights"]["lamp"] = {"type": "point", "position": [0, 3, 2], "intensity": 5.0}
    alone = {**lit, "lights": {"lamp": lit["lights"]["lamp"]}}
    world, _ = torchpt.load(lit, "cpu").world(torch.float32, choice="power")
    assert world.lights is not None and isinstance(world.lights.choice, Distribution1D)
    assert float(world.lights.choice.pmf[-1]) == 0
    torch.testing.assert_close(shoot(lit, 4).image, shoot(alone, 4).image, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_pictures_are_linear_in_the_map(quadrants):
    """So the derivative with respect to texels and scale is exact: the picture is their sum weighted by it."""
    scene = torchpt.load(under({"type": "envmap", "path": str(quadrants), "scale": 1.5}), "cpu")
    texels = scene.params["lights.sky.texels"].clone().requires_grad_()
    scale = torch.tensor(1.5, requires_grad=True)
    params = {"lights.sky.texels": texels, "lights.sky.scale": scale}
    torchpt.render(scene, params=params, spp=4, seed=3, seed_grad=3).sum().backward()
    total = float(torchpt.render(scene, spp=4, seed=3).sum())
    assert texels.grad is not None and scale.grad is not None
    assert float((texels.grad * texels.detach()).sum()) == pytest.approx(total, rel=1e-4)
    assert float(scale.grad) == pytest.approx(total / 1.5, rel=1e-4)
    assert (texels.grad >= 0).all() and (texels.grad > 0).float().mean() > 0.5


def test_a_turned_map_has_a_derivative(quadrants):
    """Against central differences of the same samples: BSDF sampling holds the directions still."""
    scene = torchpt.load(plane({"type": "envmap", "path": str(quadrants)}), "cpu")

    def pose(angle: Tensor) -> Tensor:
        c, s, one = torch.cos(angle), torch.sin(angle), torch.ones_like(angle)
        zero = torch.zeros_like(angle)
        rows = ((c, -s, zero, zero), (s, c, zero, zero), (zero, zero, one, zero), (zero, zero, zero, one))
        return torch.stack([torch.stack(row) for row in rows])

    def lit(angle: Tensor, strategy: str) -> Tensor:
        keys = {"type": "path", "max_depth": 2, "strategy": strategy}
        given = {"lights.sky.to_world": pose(angle)}
        return torchpt.render(
            scene,
            params=given,
            spp=16,
            seed=3,
            seed_grad=3,
            integrator=keys,
            film={"filter": "box"},
            dtype=torch.float64,
        ).mean()

    angle = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    lit(angle, "bsdf").backward()
    step = 1e-6  # small beside a texel: the look-up bends at each
    with torch.no_grad():
        difference = (lit(angle + step, "bsdf") - lit(angle - step, "bsdf")) / (2 * step)
    assert angle.grad is not None
    assert float(angle.grad) == pytest.approx(float(difference), rel=1e-3)
    other = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
    lit(other, "mis").backward()
    assert other.grad is not None
    assert float(other.grad) == pytest.approx(float(difference), rel=0.1)


@pytest.mark.parametrize(
    ("grey", "colorspace", "decoded"),
    [
        (np.uint8(128), {}, True),
        (np.uint8(128), {"colorspace": "linear"}, False),
        (np.uint16(32896), {}, False),
        (np.uint16(32896), {"colorspace": "srgb"}, True),
    ],
)
def test_pictures_of_eight_bits_are_srgb_unless_the_scene_says_otherwise(tmp_path, grey, colorspace, decoded):
    import imageio.v3 as iio

    from torchpt.images.colour import srgb_to_linear

    iio.imwrite(tmp_path / "grey.png", np.full((4, 8), grey))
    light = {"type": "envmap", "path": str(tmp_path / "grey.png"), **colorspace}
    scene = torchpt.load({"camera": {"origin": [0, 0, 1], "target": [0, 0, 0]}, "lights": {"sky": light}}, "cpu")
    value = torch.tensor(128 / 255.0)
    expected = srgb_to_linear(value) if decoded else value
    torch.testing.assert_close(scene.params["lights.sky.texels"], expected.expand(4, 8, 3))


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no path": ({}, "lights.sky.path"),
    "scale": ({"scale": -1}, "lights.sky.scale"),
    "colour space": ({"colorspace": "xyz"}, "lights.sky.colorspace"),
    "squeezed": ({"transform": [{"scale": [1, 2, 1]}]}, "lights.sky.transform"),
    "unknown key": ({"radiance": 1}, "lights.sky.radiance"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_keys(quadrants, name):
    keys, key = BAD[name]
    sky = {"type": "envmap", **({} if name == "no path" else {"path": str(quadrants)}), **keys}
    with pytest.raises(SceneError) as caught:
        torchpt.load(under(sky), "cpu")
    assert caught.value.key == key and "\n" not in str(caught.value)


def test_bad_maps_and_parameters(quadrants, tmp_path):
    with pytest.raises(AssetError, match="no such file"):
        torchpt.load(under({"type": "envmap", "path": "nowhere.exr"}), "cpu")
    (tmp_path / "bad.png").write_text("no picture")
    with pytest.raises(AssetError, match=r"bad\.png: cannot be read .*, named by lights\.sky\.path$"):
        torchpt.load(under({"type": "envmap", "path": str(tmp_path / "bad.png")}), "cpu")
    torchpt.write_image(tmp_path / "below.exr", torch.full((4, 8, 3), -1.0))
    with pytest.raises(SceneError, match="numbers >= 0"):
        torchpt.load(under({"type": "envmap", "path": str(tmp_path / "below.exr")}), "cpu")
    two = under({"type": "envmap", "path": str(quadrants)})
    two["lights"]["other"] = {"type": "constant"}
    with pytest.raises(SceneError, match="one environment only"):
        torchpt.load(two, "cpu")
    scene = torchpt.load(under({"type": "envmap", "path": str(quadrants)}), "cpu")
    squeezed = torch.diag(torch.tensor([1.0, 2.0, 1.0, 1.0]))
    for name, value in (("scale", torch.tensor(-1.0)), ("texels", -torch.ones(33, 64, 3)), ("to_world", squeezed)):
        with pytest.raises(SceneError, match=f"lights.sky.{name}"):
            torchpt.render(scene, params={f"lights.sky.{name}": value}, spp=1)


@pytest.mark.mitsuba
def test_against_mitsuba(quadrants, tmp_path):
    """Block means and their chi-square, under a rotation about a skew axis, all materials lit by the map."""
    mitsuba = load_mitsuba("scalar_rgb")
    turn = [{"rotate": {"axis": [1, 2, 3], "angle": 70}}, {"scale": [-1, 1, 1]}]
    scene = torchpt.load(under({"type": "envmap", "path": str(quadrants), "scale": 1.5, "transform": turn}), "cpu")
    wishes = {"film": {"filter": "box"}, "integrator": {"type": "path", "max_depth": 4, "rr_depth": 5}}
    given = settings(scene.description, wishes)
    theirs = mitsuba.load_dict(convert(mitsuba, scene, given, tmp_path))
    pictures = [torch.from_numpy(np.array(mitsuba.render(theirs, spp=64, seed=k))).double() for k in range(12)]
    b, vb = spread([picture[..., :3] for picture in pictures])
    a, va = spread([shoot(scene, 32, 90 + k, "sobol", {"max_depth": 4, "rr_depth": 5}).image for k in range(12)])
    # A block that shows but one colour of the map varies by rounding alone.
    z = (coarse(a, 4) - coarse(b, 4)) / (coarse(va + vb, 4) / 16 + 1e-10).sqrt()
    assert float(z.abs().max()) < z_limit(z.numel(), SIGNIFICANCE / 2) * 1.2  # the variances are estimated
    assert chi_square_p(float((z[..., 1] ** 2).sum()) * 9 / 11, z[..., 1].numel()) > SIGNIFICANCE / 2
