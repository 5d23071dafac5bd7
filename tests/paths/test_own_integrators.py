"""Integrators of a user's own: fields that paths carry, stages, and what holds rays up between surfaces, by both engines.

Nothing of the package is edited for them: each is a class in this file.
"""

from __future__ import annotations

import math
import platform
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.compiler import cpu
from torchpt.compiler.cache import clear_programs
from torchpt.compiler.target import Target
from torchpt.math.sampling import cosine_hemisphere, uniform_sphere
from torchpt.math.vectors import dot
from torchpt.paths.integrators.base import Limits
from torchpt.paths.integrators.kinds.aov import Aov
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.state import Emission, Field, StageContext, Transmission, VertexInput, VertexOutput
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import interact

ENGINES = ("off", "on")


def length(v: Tensor) -> Tensor:
    return dot(v, v).sqrt()


# ---- a field: how far light has come, in a fog that absorbs


class Absorbing(Path):
    """Path tracing where light is absorbed on its way: ``exp(-density * length)``."""

    name = "absorbing"
    fields = (Field("length"),)
    density: ClassVar[float] = 0.25

    def emit(self, context: StageContext, vertex: VertexInput) -> Emission:
        light, state = super().emit(context, vertex), vertex.state
        # The distance of a hit has no derivative; that of the point has.
        at = interact(context.world, state.o, state.d, vertex.hit, context.follow_ray)
        whole = state.extra["length"] + length(at.p - state.o)
        return replace(light, brought=light.brought * torch.exp(-self.density * whole))

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        output = super().bounce(context, model, vertex)
        whole = vertex.state.extra["length"] + length(output.at.p - vertex.state.o)
        shadow = output.shadow
        if shadow is not None:
            left = torch.exp(-self.density * (whole + length(shadow.d)))
            shadow = replace(shadow, radiance=shadow.radiance * left)
        return replace(output, leaving=replace(output.leaving, extra={"length": whole}), shadow=shadow)


def lamp(distance: float = 2.0) -> dict[str, Any]:
    """A lamp that fills the view."""
    return {
        "camera": {"type": "perspective", "origin": [0, 0, 0], "target": [0, 0, 1], "fov": 1.0},
        "shapes": {
            "lamp": {
                "type": "rectangle",
                "transform": [
                    {"scale": 4},
                    {"rotate": {"axis": [0, 1, 0], "angle": 180}},
                    {"translate": [0, 0, distance]},
                ],
                "emission": [3.0, 2.0, 1.0],
            }
        },
    }


def mirrored() -> dict[str, Any]:
    """A lamp behind the camera, seen by a diffuse wall, in a room that is closed."""
    return {
        "camera": {"type": "perspective", "origin": [0, 0, -0.5], "target": [0, 0, 1], "fov": 60.0},
        "materials": {"wall": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]}},
        "shapes": {
            "room": {"type": "sphere", "radius": 1.5, "material": "wall", "flip_normals": True},
            "lamp": {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.3, "emission": [5, 4, 3]},
        },
    }


@pytest.mark.parametrize("compile", ENGINES)
def test_a_field_is_carried_from_the_camera_on(compile):
    scene = torchpt.load(lamp(), "cpu")
    image = torchpt.render(scene, spp=4, film={"width": 8, "height": 8}, integrator=Absorbing(), compile=compile)
    seen = torch.tensor([3.0, 2.0, 1.0]) * math.exp(-0.25 * 2.0)
    torch.testing.assert_close(image, seen.expand(8, 8, 3), rtol=2e-4, atol=0)


def test_strategies_agree_and_so_do_engines():
    scene = torchpt.load(mirrored(), "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 12, "height": 12, "filter": "box"}, "spp": 64}
    found = {
        (strategy, compile): torchpt.render(
            scene, integrator=Absorbing(strategy=strategy, max_depth=4), compile=compile, **keys
        )
        for strategy, compile in (("mis", "on"), ("mis", "off"), ("bsdf", "on"))
    }
    torch.testing.assert_close(found["mis", "on"], found["mis", "off"], rtol=1e-4, atol=1e-5)
    assert float(found["bsdf", "on"].mean()) == pytest.approx(float(found["mis", "on"].mean()), rel=0.02)
    plain = torchpt.render(scene, integrator={"type": "path", "max_depth": 4}, **keys)
    assert float(found["mis", "on"].mean()) < 0.8 * float(plain.mean())


def assert_gradient_is_the_slope(integrator: Path, compile: str) -> None:
    """By a wall's colour, for the same samples."""
    scene = torchpt.load(mirrored(), "cpu")
    name, value = "materials.wall.reflectance", scene.params["materials.wall.reflectance"]
    keys: Mapping[str, Any] = {"spp": 4, "seed_grad": 0, "film": {"width": 8, "height": 8}, "compile": compile}

    def brought(reflectance: Tensor) -> Tensor:
        return torchpt.render(scene, params={name: reflectance}, integrator=integrator, **keys).sum()

    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(brought(leaf), leaf)
    with torch.no_grad():
        step = 1e-2
        slope = (brought(value + step) - brought(value - step)) / (2 * step)
    assert float(gradient.sum()) == pytest.approx(float(slope), rel=2e-3)


@pytest.mark.parametrize("compile", ENGINES)
def test_gradients_go_through_fields(compile):
    assert_gradient_is_the_slope(Absorbing(max_depth=4, rr_depth=9), compile)


@pytest.mark.filterwarnings("ignore:the gradient leaves out")
@pytest.mark.parametrize("compile", ENGINES)
def test_gradients_of_places_go_through_fields(compile):
    """The wall behind the lamp's light is 2 away: moving it changes how much is absorbed, and nothing else."""
    description = lamp()
    description["materials"] = {"mirror": {"type": "conductor", "reflectance": [1, 1, 1]}}
    description["shapes"]["lamp"]["transform"] = [{"scale": 9}, {"translate": [0, 0, -1]}]
    description["shapes"]["mirror"] = {
        "type": "rectangle",
        "material": "mirror",
        "transform": [{"scale": 4}, {"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 0, 2]}],
    }
    scene = torchpt.load(description, "cpu")
    pose = scene.params["shapes.mirror.to_world"].clone().requires_grad_()
    image = torchpt.render(
        scene,
        params={"shapes.mirror.to_world": pose},
        spp=1,
        seed_grad=0,
        edges=False,
        film={"width": 4, "height": 4},
        integrator=Absorbing(max_depth=3),
        compile=compile,
    )
    expected = torch.tensor([3.0, 2.0, 1.0]) * math.exp(-0.25 * 5.0)
    torch.testing.assert_close(image.detach(), expected.expand(4, 4, 3), rtol=1e-3, atol=0)
    (gradient,) = torch.autograd.grad(image.mean((0, 1)).sum(), pose)
    # Both ways to the mirror grow with its distance.
    assert float(gradient[2, 3]) == pytest.approx(-2 * 0.25 * float(expected.sum()), rel=1e-2)


# ---- what scatters between surfaces: a ball of thin fog


class Foggy(Path):
    """Path tracing in a ball of fog that scatters evenly in all directions: a collision is no vertex and loses no light."""

    name = "foggy"
    density: ClassVar[float] = 0.7
    radius: ClassVar[float] = 1.5

    def chord(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return where rays enter the ball and leave it, in units of ``d``; twice the same where they miss it."""
        a, b, c = dot(d, d), dot(o, d), dot(o, o) - self.radius**2
        root = (b * b - a * c).clamp_min(0.0).sqrt()
        return ((-b - root) / a).clamp_min(0.0), ((-b + root) / a).clamp_min(0.0)

    def transmit(self, context: StageContext, vertex: VertexInput) -> Transmission:
        state, hit, draws = vertex.state, vertex.hit, Draws(context.plan.sampler, vertex.state.key, context.salts)
        enters, leaves = self.chord(state.o, state.d)
        t = enters - torch.log1p(-draws.one(Dimension.DISTANCE)) / self.density
        collides = (t < leaves) & (t < hit.t)
        p = state.o + torch.where(collides, t, 0.0) * state.d
        d = uniform_sphere(draws.two(Dimension.PHASE))
        # The next emitter that is met counts whole: no light is sampled from within the fog.
        turned = replace(state, o=p, d=d, pdf=torch.full_like(state.pdf, math.inf))
        through = super().transmit(context, vertex)
        return Transmission(collides | through.on, through.o, collides, turned)

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        output = super().bounce(context, model, vertex)
        shadow = output.shadow
        if shadow is None:
            return output
        size = length(shadow.d)
        enters, leaves = self.chord(shadow.o, shadow.d)
        reach = torch.where(torch.isinf(shadow.t_max), math.inf, 1.0)
        way = (torch.minimum(leaves, reach) - torch.minimum(enters, reach)) * size
        return replace(output, shadow=replace(shadow, radiance=shadow.radiance * torch.exp(-self.density * way)))


def furnace() -> dict[str, Any]:
    return {
        "camera": {"type": "perspective", "origin": [0, 0, -4], "target": [0, 0, 0], "fov": 50.0},
        "materials": {"ball": {"type": "diffuse", "reflectance": [1, 1, 1]}},
        "shapes": {"ball": {"type": "sphere", "radius": 0.7, "material": "ball"}},
        "lights": {"sky": {"type": "constant", "radiance": 1.0}},
    }


@pytest.mark.parametrize("compile", ENGINES)
def test_nothing_is_lost_in_a_furnace_of_fog(compile):
    scene = torchpt.load(furnace(), "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 12, "height": 12, "filter": "box"}, "compile": compile}
    alone = torchpt.render(scene, spp=4, integrator=Foggy(strategy="bsdf", max_depth=-1, rr_depth=10**6), **keys)
    torch.testing.assert_close(alone, torch.ones(12, 12, 3), rtol=1e-4, atol=0)
    both = torchpt.render(scene, spp=256, integrator=Foggy(max_depth=-1, rr_depth=10**6), full=True, **keys)
    assert float(both.image.mean()) == pytest.approx(1.0, abs=0.01)


@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="these are x86 machines")
def test_fog_is_the_same_without_avx512(monkeypatch):
    """Rows of an arena hold any number behind the last lane where vectors are compressed in memory: nothing is read by them."""
    scene = torchpt.load(furnace(), "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 13, "height": 11}, "spp": 3, "integrator": Foggy(max_depth=9)}
    here = torchpt.render(scene, compile="on", threads=1, **keys)
    older = "haswell" if "+avx2" in cpu.host().features.split(",") else "nehalem"
    clear_programs()
    monkeypatch.setitem(cpu._state, "host", Target(older, ""))
    try:
        assert torch.equal(torchpt.render(torchpt.load(furnace(), "cpu"), compile="on", threads=1, **keys), here)
    finally:
        clear_programs()


def test_fog_is_the_same_by_both_engines_and_over_threads():
    scene = torchpt.load(mirrored(), "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 16, "height": 16}, "spp": 8, "integrator": Foggy(max_depth=4)}
    kernels = torchpt.render(scene, compile="on", threads=1, **keys)
    assert torch.equal(kernels, torchpt.render(scene, compile="on", threads=2, **keys))
    tensors = torchpt.render(scene, compile="off", **keys)
    close = torch.isclose(kernels, tensors, rtol=1e-3, atol=1e-5).all(-1).float().mean()
    assert float(close) > 0.97  # a collision may fall on the other side of a surface by rounding
    assert float(kernels.mean()) == pytest.approx(float(tensors.mean()), rel=5e-3)


@pytest.mark.parametrize("compile", ENGINES)
def test_gradients_go_through_fog(compile):
    assert_gradient_is_the_slope(Foggy(max_depth=4, rr_depth=9), compile)


@pytest.mark.filterwarnings("ignore:the gradient leaves out")
def test_geometry_is_not_differentiated_through_fog():
    scene = torchpt.load(mirrored(), "cpu")
    pose = scene.params["shapes.lamp.to_world"].clone().requires_grad_()
    small = {"width": 4, "height": 4}
    image = torchpt.render(
        scene, params={"shapes.lamp.to_world": pose}, spp=1, edges=False, film=small, integrator=Foggy()
    )
    with pytest.raises(torchpt.TorchptError, match=r"integrator\.type"):
        image.sum().backward()


def test_surfaces_in_fog_let_rays_pass_by_their_opacity():
    description = mirrored()
    description["materials"]["veil"] = {"type": "diffuse", "reflectance": [0.2, 0.2, 0.2], "opacity": 0.5}
    description["shapes"]["veil"] = {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.5, "material": "veil"}
    scene = torchpt.load(description, "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 12, "height": 12, "filter": "box"}, "spp": 256}
    mean = {
        (strategy, compile): float(
            torchpt.render(scene, integrator=Foggy(strategy=strategy, max_depth=3), compile=compile, **keys).mean()
        )
        for strategy, compile in (("mis", "on"), ("mis", "off"), ("bsdf", "on"))
    }
    assert mean["mis", "on"] == pytest.approx(mean["mis", "off"], rel=5e-3)
    assert mean["bsdf", "on"] == pytest.approx(mean["mis", "on"], rel=0.06)


# ---- what stages may do, and what is refused


class OneVertex(Path):
    """Light that is sampled at the first surface, and no further, by the stages of a path."""

    name = "one_vertex"

    @property
    def limits(self) -> Limits:
        return Limits(2, 3, first_surface=True)


def test_paths_may_end_at_first_surfaces_where_the_search_is_inside_of_stages():
    description = mirrored()
    description["shapes"]["room"] = {"type": "sphere", "radius": 0.4, "material": "wall"}
    scene = torchpt.load(description, "cpu")
    keys: Mapping[str, Any] = {"film": {"width": 16, "height": 16}, "spp": 2, "integrator": OneVertex()}
    found = torchpt.render(scene, compile="on", **keys)
    torch.testing.assert_close(found, torchpt.render(scene, compile="off", **keys), rtol=1e-4, atol=1e-6)


class Glowing(Path):
    """Surfaces shine by themselves, as much as they let through."""

    name = "glowing"

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        output = super().bounce(context, model, vertex)
        leaving = output.leaving
        return replace(output, leaving=replace(leaving, radiance=leaving.radiance + 0.3 * leaving.throughput))


@pytest.mark.parametrize("compile", ENGINES)
def test_light_that_a_stage_adds_is_differentiated(compile):
    assert_gradient_is_the_slope(Glowing(max_depth=3, rr_depth=9), compile)


class Flickering(Absorbing):
    """Emitters shine as a random number says, which a stage may draw wherever it is."""

    name = "flickering"

    def emit(self, context: StageContext, vertex: VertexInput) -> Emission:
        light = super().emit(context, vertex)
        u = Draws(context.plan.sampler, vertex.state.key, context.salts).one(Dimension.DISTANCE)
        return replace(light, brought=light.brought * (2.0 * u))


def test_every_stage_may_draw_numbers():
    scene = torchpt.load(mirrored(), "cpu")
    name = "materials.wall.reflectance"
    found = []
    for compile in ENGINES:
        leaf = scene.params[name].clone().requires_grad_()
        image = torchpt.render(
            scene, params={name: leaf}, spp=4, seed_grad=0, film={"width": 8, "height": 8},
            integrator=Flickering(max_depth=3), compile=compile,
        )  # fmt: skip
        found.append((image.detach(), *torch.autograd.grad(image.sum(), leaf)))
    torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(found[0][1], found[1][1], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("compile", ENGINES)
def test_layers_come_through_what_reads_fields(compile):
    class Counting(Foggy):
        name = "counting"
        fields = (Field("collisions"),)

        def transmit(self, context: StageContext, vertex: VertexInput) -> Transmission:
            out = super().transmit(context, vertex)
            assert out.state is not None
            return replace(out, state=replace(out.state, extra={"collisions": vertex.state.extra["collisions"] + 1.0}))

    scene, film = torchpt.load(mirrored(), "cpu"), {"width": 8, "height": 8, "aovs": ["depth"]}
    seen = torchpt.render(scene, spp=1, film=film, integrator=Counting(), compile=compile, full=True)
    assert bool((seen.layers["depth"] > 0).all())


def test_what_a_class_says_is_read_anew():
    class Changing(Absorbing):
        name = "changing"

    scene, integrator = torchpt.load(lamp(), "cpu"), Changing()
    keys: Mapping[str, Any] = {"film": {"width": 4, "height": 4}, "spp": 1, "integrator": integrator}
    before = torchpt.render(scene, compile="on", **keys)
    Changing.density = 1.0
    after = torchpt.render(scene, compile="on", **keys)
    torch.testing.assert_close(after, torchpt.render(scene, compile="off", **keys), rtol=1e-5, atol=1e-6)
    assert float(after.mean()) < 0.5 * float(before.mean())


def test_a_checkpoint_knows_the_code_of_an_integrator(tmp_path):
    class SceneCache(Absorbing):
        name = "kept"

    scene, file = torchpt.load(lamp(), "cpu"), str(tmp_path / "kept.ckpt")
    keys: Mapping[str, Any] = {"film": {"width": 4, "height": 4}, "integrator": SceneCache(), "checkpoint": file}
    torchpt.render(scene, spp=2, **keys)
    SceneCache.density = 3.0
    with pytest.raises(torchpt.TorchptError):
        torchpt.render(scene, spp=4, resume=True, **keys)


class Forgetful(Absorbing):
    """A stage that leaves a field out."""

    name = "forgetful"

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        output = super().bounce(context, model, vertex)
        return replace(output, leaving=replace(output.leaving, extra={}))


@pytest.mark.parametrize("compile", ENGINES)
def test_a_field_that_a_stage_leaves_out_is_named(compile):
    scene = torchpt.load(mirrored(), "cpu")
    with pytest.raises(torchpt.SceneError, match=r"integrator\.fields\.length"):
        torchpt.render(scene, spp=1, film={"width": 4, "height": 4}, integrator=Forgetful(), compile=compile)


class Bessel(torchpt.Bsdf):
    """Diffuse, with an operator that no kernel knows."""

    name = "bessel"

    def eval_pdf(self, parameters: Mapping[str, Tensor], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / math.pi
        return (torch.special.bessel_j0(wi[2]) * pdf).expand(3, -1), pdf

    def sample(self, parameters: Mapping[str, Tensor], wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        value, pdf = self.eval_pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, value / pdf)

    def albedo(self, parameters: Mapping[str, Tensor]) -> Tensor:
        return torch.ones(3, 1)


def test_fields_are_carried_past_models_that_no_kernel_can_be_made_of():
    """A render by kernels takes those vertices by tensor operations."""
    description = {**mirrored(), "materials": {"wall": {"type": "bessel"}}}
    description["shapes"]["lamp"]["material"] = "wall"
    scene = torchpt.load(description, "cpu", bsdfs={"bessel": Bessel()})
    keys: Mapping[str, Any] = {"spp": 2, "film": {"width": 8, "height": 8}}
    found = torchpt.render(scene, integrator=Absorbing(max_depth=4), compile="on", full=True, **keys)
    assert "bessel_j0" in found.eager[0]
    plain = torchpt.render(scene, integrator=Absorbing(max_depth=4), compile="off", **keys)
    assert float(torch.isclose(found.image, plain, rtol=1e-3, atol=1e-5).all(-1).float().mean()) > 0.98
    with pytest.raises(torchpt.SceneError, match=r"integrator\.fields\.length"):
        torchpt.render(scene, integrator=Forgetful(), compile="on", **keys)


def test_an_integrator_that_is_made_is_checked_as_one_by_name():
    scene = torchpt.load(mirrored(), "cpu")
    with pytest.raises(torchpt.SceneError, match="target_error"):
        torchpt.render(scene, integrator=Aov(), target_error=0.1)
    with pytest.raises(torchpt.SceneError, match="integrator"):
        torchpt.render(scene, integrator=Aov)  # pyright: ignore[reportArgumentType]


def test_fields_that_cannot_be_are_refused_where_they_are_declared():
    with pytest.raises(TypeError, match="twice"):
        type("ErrorProbes", (Path,), {"fields": (Field("a"), Field("a", 3))})
    with pytest.raises(ValueError, match="whole"):
        Field("count", start=0.5, whole=True)
    with pytest.raises(ValueError, match="rows"):
        Field("nothing", rows=0)
