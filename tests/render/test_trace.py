"""Radiance along given rays: the bits of a render along a camera's rays, known answers, gradients by differences, errors."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from mirrored import Mirrored
from torch import Tensor

import torchpt
from torchpt.core.errors import RenderError, SceneError
from torchpt.engines.kernels.engine import Chunk, KernelsEngine
from torchpt.engines.kernels.programs import Kernels
from torchpt.gradients.edges.traced import Along, Passing, Use, traced_of
from torchpt.paths.wave import Rays
from torchpt.physics.bsdfs.kinds.diffuse import Diffuse
from torchpt.rendering import kernels_of, make_wave
from torchpt.scene.formats.description import settings

quiet = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

WHITE = {"type": "diffuse", "reflectance": [0.8, 0.5, 0.3]}
#: Of a render whose samples all go through the middles of pixels.
MIDDLES = {"width": 12, "height": 9, "filter": {"type": "tent", "radius": 1e-30}}

#: With a lens; with textures, displacement and opacity; with all materials; with a light tree.
SHIPPED = ("thin_lens", "shapes_and_maps", "material_row", "many_lights")


def floor(**blocks: Any) -> dict[str, Any]:
    """A floor at z = 0, seen from above."""
    return {
        "camera": {"origin": [0, -3, 4], "target": [0, 0, 0]},
        "shapes": {"floor": {"type": "rectangle", "transform": [{"scale": 4}], "material": WHITE}},
        "lights": {"lamp": {"type": "point", "position": [0.5, 0.3, 2.0], "intensity": [4, 5, 6]}},
        **blocks,
    }


def lit() -> dict[str, Any]:
    """The floor under a lamp with an area, two vertices of each path."""
    lamp = {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 180}}, {"translate": [0, 0, 3]}]}
    described = floor(lights={}, integrator={"type": "direct", "strategy": "light"})
    described["shapes"]["lamp"] = {**lamp, "emission": [5, 6, 7]}
    return described


def camera_rays(scene: torchpt.Scene, film: dict[str, Any], seed: int = 0, **wish: Any) -> tuple[Tensor, Tensor]:
    """Origins and directions ``(H, W, 3)`` of the first samples of a render, to the bit as its engine has them."""
    dtype = wish.pop("dtype", torch.float32)
    wave = make_wave(scene, settings(scene.description, {"film": film, "render": {"seed": seed, **wish}}), None, dtype)
    _, _, width, height = wave.crop
    count = width * height
    if wish.get("compile") == "off" or dtype == torch.float64:
        state = wave.rays(0, count, 0, 1)
        vectors = {"o": state.o, "d": state.d}
    else:
        kernels = Kernels(
            wave, kernels_of(scene, wave).by_kernels, False
        )  # whose paths are all kept, whatever they met
        paths = KernelsEngine(kernels).spawn(Chunk(0, count, 0, 1))
        vectors = kernels.state.take(paths.arena, np.arange(count), ("o", "d"))
    space = scene.space
    o = vectors["o"].double() * space.unit + space.centre[:, None]
    return o.T.reshape(height, width, 3), vectors["d"].T.reshape(height, width, 3)


@pytest.mark.parametrize("sampler", ["sobol", "independent", "stratified", "hammersley"])
@pytest.mark.parametrize("way", [{"accel": "brute"}, {"accel": "numba"}, {"compile": "off"}])
def test_camera_rays_bring_the_bits_of_a_render(way, sampler):
    scene = torchpt.load("cornell_box", device="cpu")
    o, d = camera_rays(scene, MIDDLES, **way)
    found = torchpt.trace(scene, o, d, spp=3, seed=5, sampler=sampler, **way)
    image = torchpt.render(scene, film=MIDDLES, spp=3, seed=5, sampler=sampler, **way)
    assert found.shape == (9, 12, 3)
    assert float(image.mean()) > 0.01
    assert torch.equal(found, image)


@pytest.mark.parametrize("way", [{"compile": "on"}, {"compile": "off"}, {"dtype": torch.float64}])
@pytest.mark.parametrize(
    "name", ["cornell_specular", "far", *(pytest.param(x, marks=pytest.mark.slow) for x in SHIPPED)]
)
def test_a_filter_s_places_too(name, way):
    """The first sample of each pixel, wherever in the pixel it lies; in a scene that is moved, opacity and a sky besides."""
    away = 3e4
    leaf = {"type": "rectangle", "transform": [{"translate": [away, 0, 1]}], "material": {**WHITE, "opacity": 0.5}}
    far = {
        "camera": {"origin": [away, -3, 4], "target": [away, 0, 0]},
        "shapes": {
            "floor": {"type": "rectangle", "transform": [{"translate": [away, 0, 0]}], "material": WHITE},
            "leaf": leaf,
        },
        "lights": {"sky": {"type": "constant", "radiance": [1, 2, 3]}},
        "film": {"filter": "mitchell"},
    }
    scene = torchpt.load(far if name == "far" else name, device="cpu")
    film = {"width": 12, "height": 9, "filter": "box"}
    o, d = camera_rays(scene, film, seed=3, **way)
    found = torchpt.trace(scene, o, d, seed=3, **way)
    assert torch.equal(found, torchpt.render(scene, film=film, spp=1, seed=3, **way))


def test_numbers_are_those_of_the_ray():
    """Whatever else is traced, on any number of threads, in any shape."""
    scene = torchpt.load("cornell_box", device="cpu")
    turn = torch.linspace(-0.3, 0.3, 18_000)
    d = torch.stack((turn, 0.5 * torch.cos(40 * turn) - 0.2, torch.ones_like(turn)), 1)
    o = torch.tensor([278.0, 273.0, -500.0])
    wish: Any = {"spp": 2, "seed": 9, "integrator": {"type": "path", "max_depth": 4}}
    whole = torchpt.trace(scene, o, d, **wish)
    assert torch.equal(whole, torchpt.trace(scene, o, d, threads=1, **wish))
    assert torch.equal(whole[:70], torchpt.trace(scene, o, d[:70], **wish))
    assert torch.equal(whole[:70], torchpt.trace(scene, o, d[:70].view(7, 5, 2, 3), **wish).view(70, 3))
    assert torch.equal(whole[0], torchpt.trace(scene, o, d[0], **wish))
    other: Any = {**wish, "seed": 10}
    assert not torch.equal(whole, torchpt.trace(scene, o, d, **other))
    eager = torchpt.trace(scene, o, d[:70], compile="off", **wish)
    assert float((eager - whole[:70]).abs().median()) < 1e-6
    assert torchpt.trace(scene, o, d[:0], **wish).shape == (0, 3)


def test_known_answers():
    scene = torchpt.load(floor(), device="cpu")
    o, d, expected = _plane(torch.float32)
    for length in (1.0, 1e-30, 1e30):
        found = torchpt.trace(scene, o, length * d)
        assert torch.allclose(found.double(), expected, rtol=1e-5)
    exact = torchpt.trace(scene, o.double(), d.double(), dtype=torch.float64)
    assert exact.dtype == torch.float64
    assert torch.allclose(exact, _plane(torch.float64)[2], rtol=1e-7, atol=0)
    away = torchpt.trace(scene, o, torch.tensor([0.0, 0.0, 1.0]), spp=2)
    assert torch.equal(away, torch.zeros(len(o), 3))


def _plane(dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Rays onto the floor, and what a diffuse one sends back of a point light's light."""
    o = torch.tensor([[0.1, -1.0, 2.0], [-0.4, 0.2, 1.5], [0.9, 0.8, 3.0]], dtype=dtype)
    d = torch.tensor([[0.2, 0.6, -1.0], [0.1, -0.3, -2.0], [-0.05, 0.0, -0.5]], dtype=dtype)
    return o, d, _reflected(o.double(), d.double())


def _reflected(o: Tensor, d: Tensor) -> Tensor:
    p = o - d * (o[:, 2] / d[:, 2])[:, None]
    away = torch.tensor([0.5, 0.3, 2.0], dtype=torch.float64) - p
    square = (away * away).sum(1, keepdim=True)
    light = torch.tensor([4.0, 5.0, 6.0], dtype=torch.float64) * (away[:, 2:] / square.sqrt()) / square
    return torch.tensor(WHITE["reflectance"], dtype=torch.float64) / math.pi * light


@quiet
@pytest.mark.parametrize("adjoint", ["replay", "autograd"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_by_rays_are_those_of_the_formula(dtype, adjoint):
    scene = torchpt.load(floor(), device="cpu")
    o, d, _ = _plane(dtype)
    ask = torch.tensor([[0.3, -1.0, 2.0], [1.0, 0.2, 0.1], [-0.5, 0.7, 0.4]], dtype=dtype)
    grads = []
    for f in (lambda *rays: torchpt.trace(scene, *rays, dtype=dtype, adjoint=adjoint), _reflected):
        rays = o.clone().requires_grad_(), d.clone().requires_grad_()
        grads.append(torch.autograd.grad((f(*rays) * ask).sum(), rays))
    for found, right in zip(*grads, strict=True):
        assert found.dtype == dtype
        assert found.shape == o.shape
        assert torch.allclose(
            found, right, rtol=0, atol=float(right.abs().max()) * (2e-5 if dtype == torch.float32 else 1e-7)
        )
    with_rays = (grads[0][1] * d).sum(1).abs().max()
    assert float(with_rays) < 1e-4 * float(grads[0][1].norm())  # a length changes nothing


@quiet
def test_gradients_by_differences():
    """Under a lamp with an area: by origins, directions, a colour and the lamp's emission, by kernels and in float64."""
    scene = torchpt.load(lit(), device="cpu")
    colour, emission = (
        next(name for name in scene.params if name.endswith(end)) for end in ("reflectance", "emission")
    )
    plain = {
        "o": torch.tensor([[0.1, -1.0, 2.0], [-0.4, 0.2, 1.5]], dtype=torch.float64),
        "d": torch.tensor([[0.2, 0.6, -1.0], [0.3, -0.3, -2.0]], dtype=torch.float64),
        colour: scene.params[colour].double(),
        emission: scene.params[emission].double(),
    }
    steps = {
        name: torch.randn(x.shape, generator=torch.Generator().manual_seed(1), dtype=x.dtype)
        for name, x in plain.items()
    }

    def value(given: dict[str, Tensor], **wish: Any) -> Tensor:
        params = {name: given[name].float() for name in (colour, emission)}
        return torchpt.trace(scene, given["o"], given["d"], params=params, spp=1024, seed_grad=0, **wish).double().sum()

    for wish in ({"dtype": torch.float64}, {"compile": "on"}):
        leaves = {name: x.clone().requires_grad_() for name, x in plain.items()}
        value(leaves, **wish).backward()
        for name, step in steps.items():
            h = 2e-3
            ends = [value({**plain, name: plain[name] + k * h * step}, dtype=torch.float64) for k in (1, -1)]
            slope = float(ends[0] - ends[1]) / (2 * h)
            grad = leaves[name].grad
            assert grad is not None
            assert float((grad * step).sum()) == pytest.approx(slope, rel=5e-3), (name, wish)


def test_gradients_are_those_of_a_render():
    """By parameters that move nothing, through chunks and threads."""
    scene = torchpt.load("cornell_box", device="cpu")
    names = ["materials.red.reflectance", next(name for name in scene.params if name.endswith("emission"))]
    o, d = camera_rays(scene, MIDDLES)
    found = []
    wish: Any = {"spp": 4, "seed_grad": 7, "integrator": {"type": "path", "max_depth": 5}}
    for by_render in (True, False):
        params = {name: scene.params[name].clone().requires_grad_() for name in names}
        if by_render:
            image = torchpt.render(scene, film=MIDDLES, params=params, **wish)
        else:
            image = torchpt.trace(scene, o, d, params=params, **wish)
        image.square().sum().backward()
        found.append([value.grad for value in params.values()])
    for one, other in zip(*found, strict=True):
        assert float(one.norm()) > 0
        assert torch.equal(one, other)


@quiet
def test_gradients_by_surfaces_follow_their_points():
    """A floor that is moved up is met sooner: interior terms alone, which are all where nothing is hidden."""
    scene = torchpt.load(floor(), device="cpu")
    o, d, _ = _plane(torch.float64)
    pose = scene.params["shapes.floor.to_world"].clone().requires_grad_()
    torchpt.trace(scene, o, d, params={"shapes.floor.to_world": pose}, dtype=torch.float64).sum().backward()
    h = 1e-4
    lamp = torch.tensor([0.0, 0.0, h], dtype=torch.float64)
    ends = []
    for k in (1, -1):
        p = o - lamp * k  # the floor up is rays and light down
        x = p - d * (p[:, 2] / d[:, 2])[:, None]
        away = torch.tensor([0.5, 0.3, 2.0], dtype=torch.float64) - lamp * k - x
        square = (away * away).sum(1, keepdim=True)
        light = torch.tensor([4.0, 5.0, 6.0], dtype=torch.float64) * away[:, 2:] / square**1.5
        ends.append((torch.tensor(WHITE["reflectance"], dtype=torch.float64) / math.pi * light).sum())
    assert pose.grad is not None
    assert float(pose.grad[2, 3]) == pytest.approx(float(ends[0] - ends[1]) / (2 * h), rel=1e-5)


class Weighed(Diffuse):
    """A diffuse model whose colours are scaled by weights of its own."""

    name = "weighed"
    gain = torch.ones(3, 1)

    def weights(self) -> Iterator[Tensor]:
        yield self.gain

    def eval_pdf(self, parameters: Any, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        value, pdf = super().eval_pdf(parameters, wo, wi)
        return value * self.gain, pdf


@quiet
@pytest.mark.parametrize("by_rays", [True, False])
def test_weights_of_models_beside_rays_and_constants(by_rays):
    described = floor()
    described["shapes"]["floor"]["material"] = {**WHITE, "type": "weighed"}
    model = Weighed()
    model.gain = torch.ones(3, 1, requires_grad=True)
    scene = torchpt.load(described, device="cpu", bsdfs={"weighed": model})
    o, d, _ = _plane(torch.float32)
    o.requires_grad_(by_rays)
    intensity = scene.params["lights.lamp.intensity"].clone().requires_grad_()
    params = {"lights.lamp.intensity": intensity, "lights.lamp.position": scene.params["lights.lamp.position"].clone()}
    found = torchpt.trace(scene, o, d, params=params)
    found.sum().backward()
    assert model.gain.grad is not None and intensity.grad is not None
    assert torch.allclose(model.gain.grad, found.detach().sum(0)[:, None], rtol=1e-5)
    assert torch.allclose(intensity.grad * intensity.detach(), found.detach().sum(0), rtol=1e-5)
    assert (o.grad is not None) == by_rays


def test_edges_are_said_to_be_left_out():
    scene = torchpt.load(floor(), device="cpu")
    o, d, _ = _plane(torch.float32)
    with pytest.warns(torchpt.EdgeWarning, match="all visibility edges"):
        torchpt.trace(scene, o.requires_grad_(), d)
    place = scene.params["lights.lamp.position"].clone().requires_grad_()
    with pytest.warns(torchpt.EdgeWarning, match="all visibility edges"):
        torchpt.trace(scene, o.detach(), d, params={"lights.lamp.position": place})
    intensity = scene.params["lights.lamp.intensity"].clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchpt.trace(scene, o.detach(), d, params={"lights.lamp.intensity": intensity}).sum().backward()
    assert intensity.grad is not None


@quiet
def test_torch_s_own_tools():
    scene = torchpt.load(floor(), device="cpu")
    o, d, _ = _plane(torch.float32)
    rows = torch.func.vmap(lambda o, d: torchpt.trace(scene, o, d))(o, d)
    assert torch.equal(rows, torchpt.trace(scene, o, d))
    slopes = torch.func.jacrev(lambda o: torchpt.trace(scene, o, d))(o)
    plain = o.clone().requires_grad_()
    torchpt.trace(scene, plain, d)[1].sum().backward()
    assert plain.grad is not None and torch.allclose(slopes[1].sum(0), plain.grad)
    with torch.no_grad():
        assert not torchpt.trace(scene, plain, d).requires_grad
    with torch.inference_mode():
        assert torch.equal(torchpt.trace(scene, o, d), torchpt.trace(scene, o.clone(), d))


ONES, DOWN = torch.ones(2, 3), torch.tensor([[0.0, 0, -1], [0, 0, 0]])


@pytest.mark.parametrize(
    ("o", "d", "wish", "said"),
    [
        (ONES, DOWN, {}, "d, ray 1: expected a direction that is finite and not zero, got [0.0, 0.0, 0.0]"),
        (ONES, DOWN + torch.nan, {}, "d, ray 0: expected a direction that is finite and not zero"),
        (ONES * torch.inf, ONES, {}, "o, ray 0: expected an origin that is finite in float32"),
        (ONES.double() * 1e300, ONES, {}, "o, ray 0: expected an origin that is finite in float32"),
        (ONES.long(), ONES, {}, "o: expected a tensor (..., 3) of float32 or float64"),
        (ONES, [0, 0, 1], {}, "d: expected a tensor (..., 3) of float32 or float64, got [0, 0, 1]"),
        (ONES, ONES.half(), {}, "d: expected a tensor (..., 3) of float32 or float64, got (torch.float16, (2, 3))"),
        (ONES[:, :2], ONES, {}, "o: expected a tensor (..., 3) of float32 or float64"),
        (torch.ones(3, 3), ONES, {}, "o, d: expected shapes (..., 3) that are one"),
        (ONES, ONES.to("meta"), {}, "d: expected a tensor on the scene's device cpu, got 'meta'"),
        (ONES, ONES, {"sampler": "zsobol"}, "sampler.type: expected one of sobol, independent, stratified, hammersley"),
        (ONES, ONES, {"sampler": {"type": "sobol", "adaptive": True}}, "sampler.adaptive: expected false"),
        (ONES, ONES, {"integrator": "aov"}, "integrator.type: expected one of path, direct, ibl"),
        (ONES, ONES, {"integrator": Mirrored()}, "integrator.type: expected one without splats"),
        (ONES, ONES, {"params": {"camera.fov": torch.tensor(40.0)}}, "params: expected none of the camera's"),
        (ONES, ONES, {"params": {"lights.sun": torch.tensor(40.0)}}, "lights.sun"),
        (ONES, ONES, {"spp": 0}, "render.spp: expected"),
        (ONES, ONES, {"seed": -1}, "render.seed: expected"),
        (ONES, ONES, {"spp_grad": 0}, "spp_grad: expected a whole number >= 1"),
        (ONES, ONES, {"dtype": torch.float16}, "dtype: expected torch.float32 or torch.float64"),
        (ONES, ONES, {"device": "cuda"}, "device: expected the scene's own device cpu"),
        (ONES, ONES, {"adjoint": "forward"}, "adjoint: expected replay or autograd"),
        (ONES, ONES, {"compile": "on", "dtype": torch.float64}, "render.compile: expected auto or off"),
    ],
)
def test_refusals(o, d, wish, said):
    scene = torchpt.load(floor(), device="cpu")
    with pytest.raises(SceneError) as error:
        torchpt.trace(scene, o, d, **wish)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_of_pictures_is_not_of_rays():
    """Arguments of pictures are unknown; what a scene file wishes for its own picture does not count."""
    own = floor(
        film={"aovs": ["depth"], "denoise": False, "crop": [0, 0, 1, 1], "filter": "mitchell"},
        render={"time_limit": 1e-9, "spp": 3},
        sampler={"type": "sobol", "adaptive": True},
    )
    scene, plain = torchpt.load(own, device="cpu"), torchpt.load(floor(), device="cpu")
    o, d, _ = _plane(torch.float32)
    assert torch.equal(torchpt.trace(scene, o, d, spp=None), torchpt.trace(plain, o, d, spp=3))
    for name in ("film", "edges", "ranks", "pilots", "time_limit", "checkpoint", "full"):
        unknown: Any = {name: None}
        with pytest.raises(TypeError, match=name):
            torchpt.trace(scene, o, d, **unknown)


@pytest.mark.parametrize("compile", ["on", "off"])
@pytest.mark.parametrize("accel", ["brute", "numba"])
def test_rays_by_numbers(compile, accel):
    """As edges ask for them: rays of one number draw alike, whichever ray it is and whichever engine traces it."""
    scene = torchpt.load("cornell_box", device="cpu")
    limit = {"type": "path", "max_depth": 5, "clamp": 0.3}
    wish = settings(scene.description, {"integrator": limit, "render": {"accel": accel, "compile": compile, "spp": 2}})
    wave = make_wave(scene, wish, None, torch.float32)
    o = torch.tensor([[278.0], [273.0], [-500.0]]).repeat(1, 6)
    d = torch.tensor([[0.1], [-0.2], [1.0]]).repeat(1, 6) / math.sqrt(1.05)
    number = torch.tensor([4, 70_000, 4, 2, 1 << 30, 70_000])
    found = Along(scene, wish, wave).radiance(wave.with_rays(Rays(o, d, number)), 1)
    assert found.dtype == torch.float64
    assert torch.equal(found[:, 0], found[:, 2])
    assert torch.equal(found[:, 1], found[:, 5])
    assert len(set(found[1].tolist())) == 4
    assert float(found.max()) == pytest.approx(0.3)
    own = Along(scene, wish, wave).radiance(wave.with_rays(Rays(o, d)), 1)
    assert torch.equal(own[:, 2], found[:, 3])
    eager = Along(scene, replace(wish, render=wish.render.but(compile="off")), wave)
    assert torch.allclose(eager.radiance(wave.with_rays(Rays(o, d, number)), 1), found, atol=1e-5)
    along = Along(scene, wish, wave)
    for depth in (5, 1, 3):  # kernels are found once for all lengths of paths
        shorter = replace(wave.with_rays(Rays(o, d, number)), integrator=wave.integrator.to_depth(depth))
        assert torch.equal(along.radiance(shorter, 1), Along(scene, wish, wave).radiance(shorter, 1))


@pytest.mark.parametrize("opacity", [None, 0.5])
def test_blocked_rays_meet_something_before(opacity):
    """As :meth:`Traced.nearest` says, also where surfaces let some of the rays pass."""
    material = {"type": "diffuse"} if opacity is None else {"type": "diffuse", "opacity": opacity}
    shapes = {"ball": {"type": "sphere", "material": material}}
    scene = torchpt.load({"camera": {"origin": [0, 0, 5], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")
    traced = traced_of(scene, settings(scene.description, {}), {}, torch.float32)
    g = torch.Generator().manual_seed(5)
    d = torch.randn(3, 400, generator=g, dtype=torch.float64)
    o = 4.0 * torch.randn(3, 400, generator=g, dtype=torch.float64)
    far = torch.rand(400, generator=g, dtype=torch.float64) * 6.0
    passing = Passing(traced.key(torch.arange(400), Use.BEHIND), depth=1)
    blocked = traced.blocked(o, d - o, far, passing)
    assert torch.equal(blocked, traced.nearest(o, d - o, passing)[0] < far)
    assert 0 < int(blocked.sum()) < 400


@quiet
def test_strict_names_the_ray():
    near = {"near": {"type": "point", "position": [0.0, 0.0, 1e-3], "intensity": 3e38}}
    scene = torchpt.load(floor(lights=near), device="cpu")
    d = torch.tensor([[3.0, 0, 1], [0, 0, -1]])
    o = torch.tensor([0.0, 0.0, 1.0])
    assert torch.equal(torchpt.trace(scene, o, d), torch.zeros(2, 3))
    with pytest.raises(RenderError, match="sample 0 of ray 1 is not finite"):
        torchpt.trace(scene, o, d, integrator={"type": "path", "strict": True})
