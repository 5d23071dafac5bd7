"""What every light promises, kind by kind: one row of CASES each.

A density integrates to one and draws follow it, a light that is drawn and one that is met are told the same, powers are those
of brute force, no light leaves the bounds, derivatives are those of differences, float32 is float64 but for rounding, a lane
does not ask how many there are, and numbers out of range are refused in a file and in ``params`` alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from trials import SIGNIFICANCE, chi_square_p

import torchpt
from torchpt import spec
from torchpt.core.errors import SceneError
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import Frame, dot, luminance, normalize
from torchpt.physics import lights
from torchpt.physics.lights.choice import bounds_of
from torchpt.physics.lights.records import LightSample
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.shapes.interaction import OFFSET
from torchpt.search.bounds import primitive_bounds

N = 1 << 14
COLOR = [3.0, 2.0, 1.0]
AT = [0.3, 1.2, -0.2]
TURN = [{"rotate": {"axis": [1, 0.3, 0], "angle": 70}}, {"translate": AT}]
SKY = str(Path(__file__).parents[2] / "scenes" / "sky.exr")


@dataclass(frozen=True)
class Case:
    """A light of a kind.

    Attributes:
        keys: of its block in a scene file.
        arriving: of a kind that no ray meets, what comes to points ``(3, N)``: unit directions toward it and irradiance
            ``(3, N)`` on what faces them.
        within: how many degrees off that a direction may be drawn.
        together: values that do not go together with the others, by the key that is refused.
        brightest: radiant intensity at most, over what its bounds say.
        density_moves: parameters change the density of draws, over edges of the radiance: differences are those of an integral
            over directions.
    """

    keys: dict[str, Any]
    arriving: Callable[[Tensor], tuple[Tensor, Tensor]] | None = None
    within: float = 0.0
    together: dict[str, Any] = field(default_factory=dict)
    brightest: float = 1.0
    density_moves: bool = False


def _column(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


def _of_point(x: Tensor) -> tuple[Tensor, Tensor]:
    to = _column(AT) - x
    return to / to.norm(dim=0), _column(COLOR) / to.square().sum(0)


def _of_spot(x: Tensor) -> tuple[Tensor, Tensor]:
    wi, whole = _of_point(x)
    angle = torch.rad2deg(torch.acos((-wi * normalize(_column([0.5, 0, 0.1]) - _column(AT))).sum(0)))
    return wi, whole * ((50 - angle) / 45).clamp(0, 1)


def _of_sun(x: Tensor) -> tuple[Tensor, Tensor]:
    return -normalize(_column([1, -2, 0.5])).expand_as(x), _column(COLOR).expand_as(x)


CASES: dict[str, Case] = {
    "point": Case({"position": AT, "intensity": COLOR}, _of_point),
    "spot": Case(
        {"position": AT, "target": [0.5, 0, 0.1], "intensity": COLOR, "cutoff_angle": 50, "beam_width": 5},
        _of_spot,
        together={"target": AT, "beam_width": 51.0},
    ),
    "directional": Case({"direction": [1, -2, 0.5], "irradiance": COLOR}, _of_sun),
    "constant": Case({"radiance": COLOR}),
    "envmap": Case({"path": SKY, "scale": 0.7, "transform": TURN}),
    "sky": Case({"sun_direction": [0.5, 0.8, 0.6], "turbidity": 4.3, "sun_aperture": 30, "transform": [
        {"rotate": {"axis": [1, 0.3, 0.2], "angle": 20}}]}, density_moves=True),
    "triangle": Case({
        "type": "mesh", "vertices": [[-0.2, 0, 0], [0.3, 0.1, 0], [0, 0.4, 0.1]], "faces": [[0, 1, 2]],
        "face_normals": True, "transform": TURN,
    }),
    "rectangle": Case({"type": "rectangle", "transform": [{"scale": [0.4, 0.2, 1]}, *TURN]}),
    "disk": Case({"type": "disk", "transform": [{"scale": [0.4, 0.2, 1]}, *TURN]}),
    "sphere": Case({"type": "sphere", "center": AT, "radius": 0.3}),
    # Where its broad side shows it is brighter than on average.
    "quadric": Case({"type": "sphere", "radius": 0.3, "transform": [{"scale": [1, 0.6, 1.4]}, *TURN]}, brightest=1.5),
}  # fmt: skip
ALL = [*lights.KINDS, *lights.SURFACES]
MET = [name for name in ALL if name in lights.SURFACES or lights.KINDS[name].environment]
NEAR = [name for name in ALL if not lights.emitter(name).distant]
DISTANT = [name for name in ALL if lights.emitter(name).distant]


def block(name: str, **changed: Any) -> dict[str, Any]:
    """A scene with the light of a case, called ``it``."""
    keys = {**CASES[name].keys, **changed}
    made: dict[str, Any] = {"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "lights": {}, "shapes": {}}
    if name in lights.KINDS:
        made["lights"]["it"] = {"type": name, **keys}
    else:
        made["shapes"]["it"] = {"emission": COLOR, **keys}
    return made


def loaded(name: str, **changed: Any) -> torchpt.Scene:
    return torchpt.load(block(name, **changed), device="cpu")


def table_of(scene: torchpt.Scene, dtype: torch.dtype = torch.float32) -> Any:
    return scene.world(dtype, alone=True)[0].lights


def rand(*shape: int, seed: int = 3) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def squares(side: int) -> Tensor:
    """Midpoints ``(2, side^2)`` of a grid over the unit square."""
    middles = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    return torch.cartesian_prod(middles, middles).T


def sphere(u: Tensor) -> Tensor:
    """Unit directions ``(3, N)``: equal areas of the square are equal solid angles."""
    z, phi = 1 - 2 * u[0], 2 * math.pi * u[1]
    r = (1 - z * z).sqrt()
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def place(name: str, scene: torchpt.Scene, radii: float) -> tuple[Tensor, Tensor, float]:
    """A point ``(3, 1)`` that sees the light's front from so many radii, the direction to it, and its angular radius."""
    if name in lights.KINDS:
        return torch.zeros(3, 1).double(), torch.tensor([[0.0], [0], [1]]).double(), math.pi
    world, geometry = scene.world(torch.float64)
    low, high = (
        box.double().amin(1) if k == 0 else box.double().amax(1) for k, box in enumerate(primitive_bounds(geometry))
    )
    centre, radius = 0.5 * (low + high)[:, None], float((high - low).norm() / 2)
    front = _column([0.2, -0.9, 0.4]) if lights.SURFACES[name].convex else world.geometry.normal[:, :1]
    away = normalize(front + 0.3 * _column([0.5, 0.1, -0.7]))
    return centre + away * radius * radii, -away, math.asin(1 / radii)


def shining(name: str, scene: torchpt.Scene, x: Tensor, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
    """Radiance ``(3, N)`` and density ``(N,)`` that rays from ``x`` along ``d`` find by chance."""
    world, _ = scene.world(torch.float32, alone=True)
    assert world.lights is not None
    if name in lights.KINDS:
        kind = lights.KINDS[name]
        assert issubclass(kind, lights.Environment)
        return kind.radiance_pdf(world.lights.environment, d.float(), mis)
    o, d = x.float().expand_as(d).contiguous(), d.float().contiguous()
    t, prim, u, v = scene.accel("auto", None).intersect(o, d, torch.full((d.shape[1],), torch.inf))
    hit = prim >= 0
    at = interact(world, o[:, hit], d[:, hit], Hit(t[hit], prim[hit].long(), u[hit], v[hit]))
    radiance, pdf = torch.zeros_like(d), torch.zeros_like(d[0])
    radiance[:, hit], pdf[hit] = lights.emitted(world.lights, o[:, hit], at, d[:, hit])
    return radiance, pdf


def drawn(table: Any, x: Tensor, u: Tensor, mis: bool = False, offset: float = OFFSET) -> LightSample:
    """Draws for points ``x (3, N)`` or ``(3, 1)``."""
    dtype = table.radiance.dtype
    return lights.sample(table, x.to(dtype).expand(3, u.shape[1]), None, u.to(dtype), offset, mis=mis)


def test_every_kind_has_a_case():
    assert set(CASES) == set(ALL)
    assert not set(lights.KINDS) & set(lights.SURFACES)


def test_rows_are_in_order():
    """Near lights, those infinitely far, the environment last."""
    ordered = sorted(lights.KINDS, key=lights.sort_key)
    assert ordered[:2] == ["point", "spot"] and lights.KINDS[ordered[-1]].environment
    ordered = [name for name in ordered if not lights.KINDS[name].environment or name == "envmap"]
    many = {name: {"type": name, **CASES[name].keys} for name in reversed(ordered)}
    scene = torchpt.load({**block("disk"), "lights": many}, device="cpu")
    assert table_of(scene).kinds == ("disk", *ordered)


@pytest.mark.parametrize("mis", [False, True], ids=["alone", "mis"])
@pytest.mark.parametrize("radii", [1.4, 4.0], ids=["near", "far"])
@pytest.mark.parametrize("name", MET)
def test_draws_follow_a_density_that_integrates_to_one(name, radii, mis):
    if (name in lights.SURFACES and mis) or (name in lights.KINDS and radii > 2):
        pytest.skip("all the same to it")
    scene = loaded(name)
    x, axis, angle = place(name, scene, radii)
    light = drawn(table_of(scene), x, rand(2, N), mis)
    front = light.weight > 0
    assert lights.emitter(name) in (lights.SURFACES.get("quadric"),) or front.all()
    # A cone about the light in cells of equal solid angle, each of many small ones.
    bands, fine, width = 12, 32, 1 - math.cos(min(1.02 * angle, math.pi))
    g = squares(bands * fine)
    z, phi = 1 - width * g[0], 2 * math.pi * g[1]
    r = (1 - z * z).clamp_min(0).sqrt()
    frame = Frame.about(axis)
    d = frame.to_world(torch.stack((r * torch.cos(phi), r * torch.sin(phi), z)))
    _, pdf = shining(name, scene, x, d, mis)
    shares = pdf.double() * (2 * math.pi * width / g.shape[1])
    cells = ((g * bands).long()[0] * bands + (g * bands).long()[1]).clamp_max(bands * bands - 1)
    expected = N * torch.zeros(bands * bands, dtype=torch.float64).index_add(0, cells, shares)
    # Points on the back of a light that is drawn by its area bring nothing, and no ray tells their density.
    assert float(expected.sum()) / N == pytest.approx(float(front.double().mean()), abs=0.012)
    local = frame.to_local(light.wi[:, front].double())
    turn = torch.atan2(local[1], local[0]) / (2 * math.pi) % 1.0
    band = ((1 - local[2]) / width * bands).long()
    assert (band < bands).all()
    counts = torch.bincount(band * bands + (turn * bands).long().clamp_max(bands - 1), minlength=bands * bands).double()
    expected = expected * (counts.sum() / expected.sum())
    few = expected < 30
    counts = torch.cat((counts[~few], counts[few].sum()[None]))
    expected = torch.cat((expected[~few], expected[few].sum()[None]))
    square = (counts - expected) ** 2 / expected.clamp_min(1.0)
    # What is expected is known to a percent or so at the light's own edge.
    off = (counts - expected).abs() / expected.clamp_min(30.0)
    assert chi_square_p(float(square.sum()), len(square) - 1) > SIGNIFICANCE or float(off.max()) < 0.1


@pytest.mark.parametrize("radii", [1.4, 4.0], ids=["near", "far"])
@pytest.mark.parametrize("name", MET)
def test_what_is_drawn_and_what_is_met_agree(name, radii):
    scene = loaded(name)
    x, _, _ = place(name, scene, radii)
    light = drawn(table_of(scene), x, rand(2, N), mis=True)
    radiance, pdf = shining(name, scene, x, light.wi.double(), True)
    met = (pdf > 0) & (light.weight > 0)
    assert met.double().mean() > 0.99 * float((light.weight > 0).double().mean())
    torch.testing.assert_close(radiance[:, met], light.radiance[:, met], rtol=2e-3, atol=2e-3)
    ratio = (pdf / light.pdf)[met]
    assert float((ratio - 1).abs().median()) < 1e-5
    assert float(((ratio - 1).abs() < 2e-3).double().mean()) > 0.98  # edge-on the cosine itself is rounding
    torch.testing.assert_close((light.pdf * light.weight)[met], torch.ones_like(ratio), rtol=1e-5, atol=0)


@pytest.mark.parametrize("name", [name for name in ALL if name not in MET])
def test_what_no_ray_meets_arrives_as_it_should(name):
    case = CASES[name]
    assert case.arriving is not None, "a kind that no ray meets is told in closed form"
    x = (rand(3, 512) - 0.5) * 3
    table = table_of(loaded(name), torch.float64)
    light = drawn(table, x, rand(2, 512))
    wi, irradiance = case.arriving(x)
    assert bool(torch.isinf(light.pdf).all())  # so light sampling counts whole
    # A scene's own parameters are float32.
    assert ((light.wi - wi).norm(dim=0) <= 2 * math.sin(math.radians(case.within / 2)) + 1e-5).all()
    torch.testing.assert_close(light.radiance * light.weight, irradiance, rtol=1e-5, atol=1e-6)
    assert light.bare is not None and bool(light.bare.all())
    assert (light.distant is not None) == lights.KINDS[name].distant


@pytest.mark.parametrize("name", ALL)
def test_power_is_that_of_brute_force(name):
    """As the share with which a light is chosen beside one of known power."""
    described = block(name)
    floor: dict[str, Any] = {"type": "rectangle", "transform": [{"scale": 3}]}
    described["shapes"]["floor"] = floor
    alone = torchpt.load(described, device="cpu")
    table = table_of(alone, torch.float64)
    x, u = sphere(rand(2, 1 << 16)), rand(2, 1 << 16, seed=4)
    if name in DISTANT:
        low, high = primitive_bounds(alone.world(torch.float64)[1])
        reach = float((high.amax(1) - low.amin(1)).norm()) / 2
        light = drawn(table, x, u)
        flux = luminance(light.radiance) * light.weight * (math.pi * reach**2)
    else:
        centre = _column(AT)
        light = drawn(table, centre + 3 * x, u)
        flux = luminance(light.radiance) * light.weight * (-dot(light.wi, x)).clamp_min(0) * (4 * math.pi * 9)
    known = "point" if name == "rectangle" else "rectangle"
    if known == "point":
        described["lights"]["known"] = {"type": "point", "position": [0, 0, 1], "intensity": 9.0}
    else:
        floor["emission"] = 1.0
    scene = torchpt.load(described, device="cpu")
    world, _ = scene.world(torch.float64, choice="power")
    assert world.lights is not None and isinstance(world.lights.choice, Distribution1D)
    choice = world.lights.choice
    rows = [*lights.SURFACES, *lights.KINDS]
    own = int(rows.index(name) > rows.index(known))
    assert len(choice.pmf) == 2
    share = (float(choice.pmf[own]) - 0.005) / 0.99  # a hundredth is even, see Distribution1D
    power = 36 * math.pi * share / (1 - share)
    error = float(flux.std()) / math.sqrt(len(flux))
    assert abs(float(flux.mean()) - power) < 4 * error + 2e-3 * power


@pytest.mark.parametrize("name", NEAR)
def test_no_light_leaves_the_bounds(name):
    world, geometry = loaded(name).world(torch.float64)
    table = world.lights
    assert table is not None
    # Far off, what arrives times the squared distance is the intensity: of each of many directions the mean of 64 draws.
    away, u = sphere(rand(2, 1024)), squares(8).repeat(1, 1024)
    light = drawn(table, _column(AT) + 1e3 * away.repeat_interleave(64, 1), u)
    intensity = (luminance(light.radiance) * light.weight).view(1024, 64).mean(1) * 1e6
    bounds = bounds_of(table, (intensity.mean() * (4 * math.pi)).reshape(1), primitive_bounds(geometry))
    assert float(intensity.max()) <= CASES[name].brightest * float(bounds.intensity[0]) * 1.05
    x = _column(AT) + sphere(rand(2, N)) * (0.2 + 4 * rand(N, seed=5))
    light = drawn(table, x, rand(2, N, seed=6), offset=0.0)
    lit = luminance(light.radiance) * light.weight > 0
    assert lit.any()
    low, high = bounds.low[:, :1] - 1e-6, bounds.high[:, :1] + 1e-6
    assert ((light.target >= low) & (light.target <= high))[:, lit].all()
    angle = torch.acos((-light.wi * bounds.axis[:, :1]).sum(0).clamp(-1, 1))
    widest = math.acos(float(bounds.cos_o[0])) + math.acos(float(bounds.cos_e[0]))
    assert (angle[lit] <= widest + 1e-6).all()
    assert float(bounds.axis[:, 0].norm()) > 0.99 or widest >= math.pi
    assert float(bounds.low.amin()) > -2 and float(bounds.high.amax()) < 2  # nor do they hold all of space


def _towards(name: str, key: str, value: Tensor, described: spec.Spec) -> Tensor:
    """A small change of a parameter that keeps it what it is."""
    if isinstance(described, spec.Pose) or key.endswith("to_world"):
        change = torch.zeros(4, 4, dtype=torch.float64)
        if name in lights.KINDS:
            turn = torch.tensor([[0, 0.3, -0.5], [-0.3, 0, 0.7], [0.5, -0.7, 0]], dtype=torch.float64)
            change[:3, :3] = turn @ value[:3, :3].double()
        else:
            change[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
        return change
    change = (rand(value.numel(), seed=7) - 0.4).view(value.shape)
    return change * value.double().abs().clamp_min(0.1)


@pytest.mark.parametrize("name", ALL)
def test_derivatives_are_those_of_differences(name):
    """Of the irradiance at a point, light by light drawn over a fine grid, with respect to every parameter."""
    scene = loaded(name)
    x, axis, _ = place(name, scene, 2.5)
    u, weights = squares(96), _column([1, 0.7, 0.4])
    if name in lights.KINDS:
        axis = normalize(_column([0.3, 1.2, -0.1]))
    params = {key: value.double() for key, value in scene.params.items() if ".it." in key and ".material" not in key}
    assert params
    for key, value in params.items():
        if key.endswith("texels"):  # a lamp of one texel has slopes that take far more draws
            i, j = (torch.linspace(0, math.pi, n, dtype=torch.float64) for n in value.shape[:2])
            params[key] = (1 + 0.5 * torch.sin(2 * j) * torch.sin(i)[:, None])[:, :, None].expand(value.shape).clone()

    def irradiance(given: dict[str, Tensor]) -> Tensor:
        table = scene.world(torch.float64, given, alone=True)[0].lights
        assert table is not None
        light = drawn(table, x, u)
        return (light.radiance * light.weight * dot(light.wi, axis).clamp_min(0) * weights).sum(0).mean()

    def integral(given: dict[str, Tensor]) -> Tensor:
        if not CASES[name].density_moves:
            return irradiance(given)
        table, d = scene.world(torch.float64, given, alone=True)[0].lights, sphere(squares(400))
        kind = lights.KINDS[name]
        assert table is not None and issubclass(kind, lights.Environment)
        radiance, _ = kind.radiance_pdf(table.environment, d, mis=True)
        return (radiance * dot(d, axis).clamp_min(0) * weights).sum(0).mean() * (4 * math.pi)

    for key, value in params.items():
        change = _towards(name, key, value, scene.spec(key))
        tensor = value.clone().requires_grad_()
        (slope,) = torch.autograd.grad(irradiance({**params, key: tensor}), tensor)
        step = 1e-3 if key.endswith("to_world") and name in lights.KINDS else 1e-5
        ends = [float(integral({**params, key: value + sign * step * change})) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * step)
        assert abs(expected) > 1e-3, key
        assert float((slope * change).sum()) == pytest.approx(expected, rel=2e-2), key


@pytest.mark.parametrize("name", ALL)
def test_single_precision_is_double_but_for_rounding(name):
    scene = loaded(name)
    x, _, _ = place(name, scene, 2.5)
    u = (rand(2, 4096) * 2**24).floor() / 2**24
    one, two = (drawn(table_of(scene, dtype), x, u) for dtype in (torch.float32, torch.float64))
    for key in ("wi", "radiance", "weight"):
        a, b = getattr(one, key).double(), getattr(two, key)
        assert getattr(one, key).dtype == torch.float32
        off = (a - b).abs() / b.abs().clamp_min(1e-2 * float(b.abs().mean()))
        # A number on the edge of a texel may fall to either side.
        assert float(torch.quantile(off.reshape(-1), 0.99)) < 1e-4, key


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ALL)
def test_a_lane_does_not_ask_how_many_there_are(name, dtype):
    scene = loaded(name)
    table = table_of(scene, dtype)
    x = (place(name, scene, 2.5)[0] + 0.1 * (rand(3, 37) - 0.5)).to(dtype)
    u = rand(2, 37).to(dtype)
    whole = drawn(table, x, u)
    for count in (1, 2):
        few = drawn(table, x[:, :count].contiguous(), u[:, :count].contiguous())
        for key in ("wi", "target", "radiance", "pdf", "weight"):
            assert torch.equal(getattr(few, key), getattr(whole, key)[..., :count]), key


def bad_values(described: spec.Spec) -> list[Any]:
    """Return what a parameter refuses, as it would be written."""
    if isinstance(described, spec.Color | spec.Scalar | spec.Texels):
        low, high = described.low, described.high
        bad = [described.above] if described.above is not None else [] if low is None else [low - 1.0]
        return [*bad, *([] if high is None else [high + 1.0]), math.nan]
    if isinstance(described, spec.Direction):
        return [[0.0, 0.0, 0.0], [0.0, math.inf, 0.0]]
    if isinstance(described, spec.Point):
        return [[0.0, math.nan, 0.0]]
    if isinstance(described, spec.Pose):
        return [[{"scale": [1, 2, 1]}]]
    return [7.5]


def refusals() -> list[Any]:
    found = []
    for name in lights.KINDS:
        for key, described in spec.parameters_of(lights.KINDS[name]).items():
            found += [(name, key, described, value) for value in bad_values(described)]
    return [pytest.param(*one, id=f"{one[0]}.{one[1]}={one[3]}") for one in found]


@pytest.mark.parametrize(("name", "key", "described", "value"), refusals())
def test_what_is_out_of_range_is_refused(name, key, described, value):
    with pytest.raises(SceneError, match=rf"lights\.it\.{key}"):
        loaded(name, **{key: value})
    if not described.differentiable:
        return
    scene = loaded(name)
    own = "to_world" if key == "transform" else key
    shape = scene.params[f"lights.it.{own}"].shape
    tensor = (
        torch.diag(torch.tensor([1.0, 2, 1, 1])) if own == "to_world" else torch.tensor(value).expand(shape).clone()
    )
    with pytest.raises(SceneError, match=rf"lights\.it\.{own}"):
        torchpt.render(scene, params={f"lights.it.{own}": tensor}, spp=1, film={"width": 2, "height": 2})


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, case in CASES.items() for key in case.together])
def test_what_does_not_go_together_is_refused(name, key):
    value = CASES[name].together[key]
    with pytest.raises(SceneError, match=rf"lights\.it\.{key}"):
        loaded(name, **{key: value})
    with pytest.raises(SceneError, match=rf"params\.lights\.it\.{key}"):
        torchpt.render(
            loaded(name), params={f"lights.it.{key}": torch.tensor(value)}, spp=1, film={"width": 2, "height": 2}
        )


@pytest.mark.parametrize("name", lights.SURFACES)
def test_a_surface_refuses_what_cannot_shine(name):
    with pytest.raises(SceneError, match=r"shapes\.it\.emission"):
        loaded(name, emission=-1.0)
    with pytest.raises(SceneError, match=r"shapes\.it\.emission"):
        bad = torch.tensor([1.0, -1.0, 1.0])
        torchpt.render(loaded(name), params={"shapes.it.emission": bad}, spp=1, film={"width": 2, "height": 2})
