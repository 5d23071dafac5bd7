"""The sky and the sun: radiance beside Mitsuba's, the sun's place, sampling, irradiance, derivatives, refusals."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from significance import SIGNIFICANCE, chi_square_p, z_limit
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.vectors import Frame, dot, luminance
from torchpt.physics.ibl.equirect import solid_angles
from torchpt.physics.lights import environment_image, sample
from torchpt.physics.lights.kinds.sky import Dome, Sky
from torchpt.physics.lights.sun_position import sun_angles

RADIUS = math.radians(0.5358 / 2)


def described(**keys: Any) -> dict[str, Any]:
    """A white floor below the sky, seen from above."""
    return {
        "camera": {"type": "orthographic", "origin": [0, 2, 0], "target": [0, 0, 0], "up": [0, 0, -1], "width": 0.5},
        "film": {"width": 8, "height": 8, "filter": {"type": "box"}},
        "materials": {"white": {"type": "diffuse", "reflectance": 1.0}},
        "shapes": {
            "floor": {
                "type": "rectangle",
                "material": "white",
                "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}],
            }
        },
        "lights": {"s": {"type": "sky", **keys}},
    }


def lights_of(dtype: torch.dtype = torch.float64, **keys: Any) -> Any:
    return torchpt.load(described(**keys), device="cpu").world(dtype)[0].lights


def dome_of(dtype: torch.dtype = torch.float64, **keys: Any) -> Dome:
    return lights_of(dtype, **keys).environment


def toward(elevation: float, azimuth: float = 40.0) -> list[float]:
    """A direction by angles in degrees, where up is y, north -z and east x."""
    e, a = math.radians(elevation), math.radians(azimuth)
    return [math.cos(e) * math.sin(a), math.sin(e), -math.cos(e) * math.cos(a)]


def upper(count: int, seed: int = 0) -> Tensor:
    """Unit directions ``(3, N)`` of the upper half, more of them at the horizon."""
    u = torch.rand(2, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    y, phi = u[0] ** 3, 2 * math.pi * u[1]
    r = (1 - y * y).sqrt()
    return torch.stack((r * torch.sin(phi), y, -r * torch.cos(phi)))


def disc(dome: Dome, side: int, radius: float = RADIUS) -> tuple[Tensor, Tensor]:
    """Directions ``(3, N)`` of equal solid angles that fill the sun, and the radiance from each."""
    middles = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    u = torch.cartesian_prod(middles, middles).T
    z = 1 - u[0] * (1 - math.cos(radius))
    r = ((1 - z) * (1 + z)).sqrt()
    local = torch.stack((r * torch.cos(2 * math.pi * u[1]), r * torch.sin(2 * math.pi * u[1]), z))
    d = Frame.about(dome.sun.frame.axis.double()[:, None]).to_world(local)
    return d, Sky.radiance_pdf(dome, d.to(dome.sun.cap.dtype), True)[0].double()


# ---- Beside Mitsuba


@cache
def mitsuba() -> Any:
    from mitsuba_scene import load_mitsuba

    return load_mitsuba("scalar_rgb")


def of_mitsuba(d: Tensor, to_sun: list[float], **keys: Any) -> Tensor:
    """Radiance ``(3, N)`` of Mitsuba's emitter, whose up is z; its negative numbers are 0."""
    m = mitsuba()
    x, y, z = to_sun
    emitter = m.load_dict({"type": "sunsky", "sun_direction": [z, -x, y], **keys})
    interaction = m.SurfaceInteraction3f()
    found = []
    for x, y, z in d.T.tolist():
        interaction.wi = m.Vector3f(-z, x, -y)
        found.append(list(emitter.eval(interaction)))
    return torch.tensor(found, dtype=torch.float64).T.clamp_min(0.0)


@pytest.mark.mitsuba
@pytest.mark.parametrize("turbidity", [1.0, 2.3, 3.0, 6.6, 10.0])
def test_the_dome_is_mitsubas(turbidity: float) -> None:
    albedo = [0.1, 0.5, 0.9]
    d = upper(400)
    for elevation in (0.3, 4.0, 25.0, 60.0, 90.0):
        keys: dict[str, Any] = {"turbidity": turbidity, "albedo": albedo}
        ours, _ = Sky.radiance_pdf(dome_of(sun_direction=toward(elevation), sun_scale=0, **keys), d, True)
        keys["albedo"] = {"type": "rgb", "value": albedo}
        theirs = of_mitsuba(d, toward(elevation), sun_scale=0.0, **keys)
        assert float(((ours - theirs).abs() / (theirs + 0.01 * theirs.mean())).max()) < 2e-3, elevation
        assert float(theirs.mean()) > 1e-3


@pytest.mark.mitsuba
@pytest.mark.parametrize("turbidity", [1.0, 3.5, 8.0])
def test_the_suns_disc_is_mitsubas(turbidity: float) -> None:
    """Irradiance within half a percent, and radiance from the middle to the limb; Mitsuba's angles are single precision."""
    for elevation in (1.0, 3.0, 10.0, 35.0, 70.0, 90.0):
        keys: dict[str, Any] = {"turbidity": turbidity, "sky_scale": 0.0}
        d, ours = disc(dome_of(sun_direction=toward(elevation), **keys), 24)
        theirs = of_mitsuba(d, toward(elevation), complex_sun=True, **keys)
        assert float((ours.mean(1) - theirs.mean(1)).abs().max() / theirs.mean()) < 5e-3, elevation
        inside = torch.arange(d.shape[1]) < 0.8 * d.shape[1]  # the limb falls steeply
        least = 0.12 if elevation < 2.0 else 0.03  # a cubic stands for the fall to the horizon
        assert float((ours - theirs)[:, inside].abs().max() / theirs.mean()) < least, elevation
        if elevation == 35.0 and turbidity == 3.5:
            even = of_mitsuba(d, toward(elevation), **keys)  # a disc of one radiance, tabulated every three degrees
            assert float((ours.mean(1) / even.mean(1) - 1).abs().max()) < 0.02
            assert float(ours[0, 0] / ours[0, -1]) > 2.0


@pytest.mark.mitsuba
def test_the_sun_stands_where_it_does_in_mitsuba() -> None:
    """Its julian days are single precision, which is a third of a degree."""
    m = mitsuba()
    places: tuple[dict[str, Any], ...] = (
        {},
        {"hour": 9.5, "month": 12, "day": 3},
        {"latitude": -33.9, "longitude": 18.4, "timezone": 2, "month": 3, "hour": 13},
        {
            "latitude": 64.1,
            "longitude": -21.9,
            "timezone": 0,
            "year": 2014,
            "month": 6,
            "day": 20,
            "hour": 22,
            "minute": 30,
        },
    )
    for place in places:
        emitter = m.load_dict({"type": "sunsky", **place})
        x, y, z = np.array(m.traverse(emitter)["sun_direction"], np.float64).ravel()
        ours = dome_of(**place).sun.frame.axis
        assert float(ours @ torch.tensor([-y, z, x])) > math.cos(math.radians(0.5)), place


# ---- The sun's place


def test_the_sun_stands_where_almanacs_say() -> None:
    # Reda and Andreas, Solar Position Algorithm for Solar Radiation Applications, NREL 2008, table A5.1, with refraction of
    # 0.02 degrees.
    zenith, azimuth = sun_angles(39.742476, -105.1786, -7.0, 2003, 10, 17, 12.5 + 30 / 3600)
    assert math.degrees(zenith) == pytest.approx(50.11162, abs=0.03)
    assert math.degrees(azimuth) == pytest.approx(194.34024, abs=0.03)
    # At noon of a solstice on the tropic the sun stands in the zenith, of an equinox on the pole on the horizon.
    assert math.degrees(sun_angles(23.44, 0.0, 0.0, 2012, 6, 20, 12.03)[0]) < 0.5
    assert math.degrees(sun_angles(90.0, 0.0, 0.0, 2012, 3, 20, 5.25)[0]) == pytest.approx(90.0, abs=0.02)
    assert sun_angles(10.0, 20.0, 1.0, 2012, 2, 30, 12.0) == sun_angles(10.0, 20.0, 1.0, 2012, 3, 1, 12.0)


def test_place_and_time_are_a_direction() -> None:
    zenith, azimuth = sun_angles(48.0, 11.0, 2.0, 2015, 5, 6, 10.25 + 7 / 3600)
    time: dict[str, Any] = {
        "latitude": 48,
        "longitude": 11,
        "timezone": 2,
        "year": 2015,
        "month": 5,
        "day": 6,
        "hour": 10,
        "minute": 15,
    }
    found = dome_of(**time, second=7).sun.frame.axis
    expected = torch.tensor(toward(90 - math.degrees(zenith), math.degrees(azimuth)), dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)
    assert (
        90 < math.degrees(azimuth) < 180 and float(found[0]) > 0 and float(found[2]) > 0
    )  # in the morning east, not north


def test_a_transform_turns_sky_and_sun_of_a_time_but_not_a_given_direction() -> None:
    turn = [{"rotate": {"axis": [0, 1, 0], "angle": -90}}]  # north, -z, becomes east, x
    plain, turned = dome_of(), dome_of(transform=turn)
    x, y, z = plain.sun.frame.axis.tolist()
    torch.testing.assert_close(turned.sun.frame.axis, torch.tensor([-z, y, x], dtype=torch.float64), rtol=0, atol=1e-7)
    d = upper(200)
    quarter = torch.stack((-d[2], d[1], d[0]))
    torch.testing.assert_close(
        Sky.radiance_pdf(plain, d, True)[0], Sky.radiance_pdf(turned, quarter, True)[0], rtol=1e-5, atol=1e-6
    )
    mirrored = dome_of(transform=[{"scale": [-1, 1, 1]}])
    torch.testing.assert_close(
        mirrored.sun.frame.axis, torch.tensor([-x, y, z], dtype=torch.float64), rtol=0, atol=1e-7
    )
    across = d * torch.tensor([[-1.0], [1.0], [1.0]])
    torch.testing.assert_close(Sky.radiance_pdf(plain, d, True)[0], Sky.radiance_pdf(mirrored, across, True)[0])
    given = toward(30)
    tilted = dome_of(sun_direction=given, transform=[{"rotate": {"axis": [1, 0, 0], "angle": 20}}])
    torch.testing.assert_close(tilted.sun.frame.axis, torch.tensor(given, dtype=torch.float64), rtol=0, atol=1e-7)


# ---- Shape of the radiance


def test_below_the_horizon_it_is_black_and_stretch_lowers_it() -> None:
    d = upper(300)
    down = d * torch.tensor([[1.0], [-1.0], [1.0]])
    plain, stretched = (dome_of(sun_direction=toward(40), sun_scale=0, stretch=s) for s in (1.0, 1.5))
    assert not Sky.radiance_pdf(plain, down, True)[0].any()
    zenith = torch.acos(d[1])
    wide, level = 1.5 * zenith, d[[0, 2]] / zenith.sin()
    lower = torch.stack((level[0] * wide.sin(), wide.cos(), level[1] * wide.sin()))
    torch.testing.assert_close(
        Sky.radiance_pdf(stretched, lower, True)[0], Sky.radiance_pdf(plain, d, True)[0], rtol=2e-4, atol=1e-6
    )
    assert not Sky.radiance_pdf(stretched, torch.tensor([[0.0], [-1], [0]]).double(), True)[0].any()
    lowered = dome_of(sun_direction=toward(40), stretch=1.5).sun.frame.axis
    torch.testing.assert_close(lowered, torch.tensor(toward(90 - 75)).double(), rtol=0, atol=1e-6)
    assert (Sky.radiance_pdf(dome_of(sun_direction=toward(40), stretch=2.0), down, True)[0] > 0).all()


def test_scales_and_the_suns_size() -> None:
    keys: dict[str, Any] = {"sun_direction": toward(50), "turbidity": 2.0}
    one, other = dome_of(**keys), dome_of(**keys, sky_scale=3, sun_scale=0.25, sun_aperture=3.0)
    axis = one.sun.frame.axis[:, None]
    alone = dome_of(**keys, sun_scale=0)
    glow = Sky.radiance_pdf(alone, axis, True)[0]
    sums = [disc(dome, 200, radius)[1].mean(1) * (1 - math.cos(radius)) for dome, radius in
            ((one, RADIUS), (other, math.radians(1.5)))]  # fmt: skip
    sums[0] = sums[0] - glow[:, 0] * (1 - math.cos(RADIUS))
    sums[1] = sums[1] - 3 * glow[:, 0] * (1 - math.cos(math.radians(1.5)))
    torch.testing.assert_close(sums[1], 0.25 * sums[0], rtol=3e-3, atol=0)
    d = upper(100)
    d = d[:, dot(axis, d) < math.cos(math.radians(2))]
    torch.testing.assert_close(Sky.radiance_pdf(other, d, True)[0], 3 * Sky.radiance_pdf(alone, d, True)[0])


def test_half_a_sun_is_above_the_horizon_when_it_sets() -> None:
    dome = dome_of(sun_direction=toward(0.0), turbidity=5.0, sky_scale=0)
    d, radiance = disc(dome, 40)
    assert not radiance[:, d[1] < 0].any() and (radiance[0, d[1] > 0] > 0).all()
    assert (
        radiance[0, d[1] > 0.003].mean() > 2 * radiance[0, (d[1] > 0) & (d[1] < 0.001)].mean()
    )  # redder and darker below


# ---- Sampling


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_samples_of_the_sun_fill_its_disc(dtype: torch.dtype) -> None:
    table = lights_of(dtype, sun_direction=toward(33), sky_scale=0)
    dome, n = table.environment, 1 << 15
    u = torch.rand(2, n, generator=torch.Generator().manual_seed(5), dtype=dtype)
    light = sample(table, torch.zeros(3, n, dtype=dtype), None, u, 1.0)
    frame = dome.sun.frame
    local = torch.stack([dot(axis[:, None], light.wi) for axis in (frame.side, frame.rise)]).double() / math.sin(RADIUS)
    square = local.square().sum(0)
    assert float(square.max()) < 1 + 1e-4
    cells = (square * 8).long().clamp_max(7) * 8 + ((torch.atan2(local[1], local[0]) / (2 * math.pi) % 1) * 8).long()
    counts = torch.bincount(cells, minlength=64).double()
    assert chi_square_p(float(((counts - n / 64) ** 2 / (n / 64)).sum()), 63) > SIGNIFICANCE
    area = 2 * math.pi * (1 - math.cos(RADIUS))
    inside = square < 1 - 1e-4
    torch.testing.assert_close(
        light.pdf[inside].double() * area, torch.ones(int(inside.sum())).double(), rtol=1e-3, atol=0
    )


@pytest.mark.parametrize("mis", [False, True])
def test_samples_give_the_irradiance_of_brute_force(mis: bool) -> None:
    """Of a floor, from sky and sun, each alone and together, by light sampling."""
    expected = {key: irradiance(dome_of(sun_direction=toward(25), **keys)) for key, keys in ALONE.items()}
    n = 1 << 16
    for key, keys in ALONE.items():
        table = lights_of(sun_direction=toward(25), **keys)
        u = torch.rand(2, n, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
        light = sample(table, torch.zeros(3, n).double(), None, u, 1.0, mis=mis)
        terms = light.radiance * light.weight * light.wi[1].clamp_min(0)
        error = terms.std(1) / math.sqrt(n)
        off = (terms.mean(1) - expected[key]) / error
        if mis and key != "sun":  # a compensated map leaves dim directions to the BSDF
            assert (off < z_limit(9)).all()
        else:
            assert (off.abs() < z_limit(9)).all(), key
        assert float((error / expected[key]).max()) < 0.02


#: Scales of the sky alone, the sun alone, and both.
ALONE: dict[str, dict[str, Any]] = {"sky": {"sun_scale": 0}, "sun": {"sky_scale": 0}, "both": {}}


def irradiance(dome: Dome, side: int = 700) -> Tensor:
    """Irradiance ``(3,)`` of a floor: midpoints of the upper half, and of the sun's disc."""
    middles = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    u = torch.cartesian_prod(middles, middles).T
    y, phi = u[0] ** 2, 2 * math.pi * u[1]  # fine at the horizon
    r = (1 - y * y).sqrt()
    d = torch.stack((r * torch.sin(phi), y, -r * torch.cos(phi)))
    met = dot(dome.sun.frame.axis[:, None], d) > math.cos(RADIUS * 1.01)
    sky = torch.where(met, 0.0, Sky.radiance_pdf(dome, d, True)[0])
    lit, radiance = disc(dome, 200)
    sun = (radiance * lit[1]).mean(1) * (2 * math.pi * (1 - math.cos(RADIUS)))
    return (sky * (y * 2 * u[0])).mean(1) * (2 * math.pi) + sun  # dy = 2 u du


@pytest.mark.parametrize("strategy", ["mis", "bsdf", "light"])
def test_a_floor_reflects_the_irradiance_of_brute_force(strategy: str) -> None:
    keys: dict[str, Any] = {"sun_direction": toward(25)}
    if strategy == "bsdf":
        keys = {"sun_direction": toward(40), "sun_aperture": 40.0}
    dome = dome_of(**keys)
    expected = (irradiance_wide(dome) if strategy == "bsdf" else irradiance(dome)) / math.pi
    scene = torchpt.load(described(**keys), device="cpu")
    values = [
        torchpt.render(
            scene,
            spp=64,
            seed=seed,
            compile="off",
            sampler="independent",
            integrator={"max_depth": 2, "strategy": strategy},
        ).mean((0, 1))
        for seed in range(16)
    ]
    means = torch.stack(values).double()
    error = means.std(0) / 4
    assert ((means.mean(0) - expected).abs() < 5.5 * error).all()  # Student's t with 15 degrees, 9 comparisons
    assert float((error / expected).max()) < 0.02


def irradiance_wide(dome: Dome) -> Tensor:
    """As :func:`irradiance`, with a sun that the grid of the sky resolves."""
    side = 700
    middles = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    u = torch.cartesian_prod(middles, middles).T
    phi = 2 * math.pi * u[1]
    r = (1 - u[0] * u[0]).sqrt()
    d = torch.stack((r * torch.sin(phi), u[0], -r * torch.cos(phi)))
    return (Sky.radiance_pdf(dome, d, True)[0] * u[0]).mean(1) * (2 * math.pi)


def test_the_camera_and_mirrors_see_the_sun() -> None:
    scene = described(sun_direction=toward(60), sky_scale=0)
    to = toward(60)
    scene["camera"] = {"origin": [0, 0.5, 0], "target": [to[0], 0.5 + to[1], to[2]], "fov": 1}
    scene["materials"]["white"] = {"type": "conductor", "reflectance": 1.0}
    direct = torchpt.render(torchpt.load(scene), spp=64, compile="off")
    scene["camera"]["target"] = [to[0], 0.5 - to[1], to[2]]
    mirrored = torchpt.render(torchpt.load(scene), spp=64, compile="off")
    share = math.pi * math.tan(RADIUS) ** 2 / (4 * math.tan(math.radians(0.5)) ** 2)  # of the film
    middle = disc(dome_of(sun_direction=to, sky_scale=0), 64)[1].mean(1)
    for image in (direct, mirrored):
        torch.testing.assert_close(image.mean((0, 1)).double(), middle * share, rtol=0.03, atol=0)
    assert float(direct[0].max()) == 0.0 and float(direct[3:5, 3:5, 0].min()) > 1e3


def test_the_image_has_all_of_the_light() -> None:
    table = lights_of(sun_direction=toward(20))
    image = environment_image(table)
    assert image is not None
    size = solid_angles(*image.texels.shape[:2])[:, None, None].double()
    whole = (image.texels * size).sum((0, 1))
    expected = table.radiance[:, 0] * (4 * math.pi)
    torch.testing.assert_close(whole, expected, rtol=5e-3, atol=0)  # the texels of the horizon reach below it


# ---- Derivatives


@pytest.mark.parametrize("compiled", ["off", pytest.param("auto", marks=pytest.mark.slow)])
def test_derivatives_of_a_picture(compiled: str) -> None:
    """The picture is linear in both scales; by turbidity and albedo beside differences of the irradiance."""
    keys: dict[str, Any] = {"sun_direction": toward(35), "turbidity": 3.4, "albedo": 0.4}
    scene = torchpt.load(described(**keys), device="cpu")
    names = ("turbidity", "albedo", "sky_scale", "sun_scale")
    found = torchpt.gradient(
        scene, lambda image: image.mean((0, 1))[1], [f"lights.s.{name}" for name in names], passes=8, spp=128, seed=0,
        compile=compiled, integrator={"max_depth": 2},
    )  # fmt: skip
    for name in names:
        key = f"lights.s.{name}"
        value = keys.get(name, 1.0)
        step = 0.01
        ends = [irradiance(dome_of(**{**keys, name: value + sign * step}), 300)[1] for sign in (1, -1)]
        expected = float(ends[0] - ends[1]) / (2 * step) / math.pi
        mean, error = float(found.gradients[key].sum()), float(found.standard_errors[key].sum())
        assert abs(mean - expected) < 6 * error + 2e-3 * abs(expected), name
        assert error < 0.05 * abs(expected), name


# ---- Refusals


@pytest.mark.parametrize(
    ("keys", "key", "words"),
    [
        ({"turbidity": 0.5}, "turbidity", "1..10"),
        ({"turbidity": [1, 2, 3]}, "turbidity", "1..10"),
        ({"albedo": 1.5}, "albedo", "0..1"),
        ({"sun_direction": [0, -1, 0]}, "sun_direction", "it stands at -90.0 degrees"),
        ({"sun_direction": [0, 0, 0]}, "sun_direction", "direction"),
        ({"sun_direction": [1, 1, 1], "hour": 12}, "hour", "not both"),
        ({"hour": 2}, "hour", "above the horizon"),
        ({"hour": 25}, "hour", "0..24"),
        ({"month": 13}, "month", "1..12"),
        ({"latitude": 91}, "latitude", "-90..90"),
        ({"sun_aperture": 0}, "sun_aperture", "0.01..60"),
        ({"stretch": 3}, "stretch", "1..2"),
        ({"sky_scale": -1}, "sky_scale", ">= 0"),
        ({"transform": [{"scale": [1, 2, 1]}]}, "transform", "keeps angles"),
        ({"sun": 1}, "sun", "sun_direction"),
    ],
)
def test_wrong_parameters_are_one_line(tmp_path: Any, keys: dict[str, Any], key: str, words: str) -> None:
    import yaml

    file = tmp_path / "scene.yaml"
    file.write_text(yaml.safe_dump(described(**keys)))
    with pytest.raises(SceneError) as caught:
        torchpt.load(str(file))
    message = str(caught.value)
    assert str(file) in message and f"lights.s.{key}" in message and words in message and "\n" not in message


def test_two_skies_are_refused_and_luminance_is_not_negative() -> None:
    scene = described()
    scene["lights"]["other"] = {"type": "constant"}
    with pytest.raises(SceneError, match="one environment only"):
        torchpt.load(scene)
    for turbidity in (1.0, 10.0):
        for elevation in (0.0, 0.4, 89.0):
            dome = dome_of(torch.float32, sun_direction=toward(elevation), turbidity=turbidity)
            radiance, pdf = Sky.radiance_pdf(dome, upper(4000).float(), True)
            assert torch.isfinite(radiance).all() and (radiance >= 0).all() and torch.isfinite(pdf).all()
            assert luminance(radiance).mean() > 0
