"""Bidirectional path tracing: the means of ``path`` in rooms of every kind, and what it finds that ``path`` does not."""

from __future__ import annotations

import itertools
import math
import re
from dataclasses import dataclass, replace
from typing import Any

import pytest
import torch
from few import few
from light_rooms import ROOMS, room
from same_means import SEEDS, assert_same_means, pictures

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.vectors import dot, rows
from torchpt.paths.integrators.kinds.bdpt import STRATEGIES, Bdpt
from torchpt.paths.integrators.weights import (
    Arrival,
    leaving_dvc,
    leaving_dvcm,
    reduced,
    reverse_pdf,
    root_of_squares,
)
from torchpt.paths.surface import surface_at
from torchpt.paths.wave import Wave
from torchpt.physics.lights.emission import LightRay, density_of_hit, emit, light_weight
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.world import World
from torchpt.scene.formats.description import settings
from torchpt.scene.prepare import make_wave

#: Connections with a light path for each sample.
CONNECTED = {"connections": "one", "light_paths": 1.0}


def test_samples_of_rough_glass_that_fail_end_light_paths():
    """Some directions that end on the wrong side have a value, but no density."""
    ball = {"type": "sphere", "material": {"type": "roughdielectric", "alpha": 0.8}}
    described = {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
        "film": {"width": 8, "height": 8},
        "shapes": {"ball": ball},
        "lights": {"point": {"type": "point", "position": [0.2, 0.1, 0.3]}},
    }
    keys = {"type": "bdpt", "light_paths": 1.0}
    found = torchpt.render(torchpt.load(described, "cpu"), integrator=keys, spp=64, compile="off", full=True)
    assert not found.nonfinite_samples


@pytest.mark.parametrize("keys", [{}, CONNECTED], ids=["t = 1", "connected"])
def test_the_mean_of_path_among_diffuse_walls(keys):
    shapes = {name: ROOMS["thin lens"]["shapes"][name] for name in ("floor", "back", "left", "lamp")}
    lights = {"sky": {"type": "constant", "radiance": 0.2}, "point": {"type": "point", "position": [0.5, 1, 1]}}
    scene = torchpt.load({**ROOMS["thin lens"], "shapes": shapes, "lights": lights}, device="cpu")
    assert_same_means(pictures(scene, "path", 128), pictures(scene, "bdpt", 128, **keys))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_the_mean_of_path(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    # Of lights without extent, some light comes to `path` through glass in rare bright samples: few seeds do not show its
    # variance.
    seeds, spp = (48, 4096) if name == "lights without extent" else (SEEDS, 1024)
    assert_same_means(pictures(scene, "path", spp, seeds=seeds), pictures(scene, "bdpt", 1024, seeds=seeds))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_connections_leave_the_mean(name):
    """Beside ``bdpt`` without them: rare bright samples of ``path`` hide what is missing."""
    scene = torchpt.load(ROOMS[name], device="cpu")
    assert_same_means(pictures(scene, "bdpt", 1024), pictures(scene, "bdpt", 1024, first_seed=1001, **CONNECTED))


@pytest.mark.parametrize("name", few(ROOMS, 1))
def test_strategies_add_up_to_the_picture(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    wish: dict[str, Any] = {"spp": 4, "compile": "off", "full": True}
    keys = {"type": "bdpt", "connections": "one"}
    whole = torchpt.render(scene, integrator=keys, **wish)
    parts = [
        torchpt.render(scene, integrator={**keys, "strategy": strategy, "weighted": True}, **wish).image
        for strategy in STRATEGIES
    ]
    assert torch.allclose(whole.image, sum(parts[1:], parts[0]), rtol=1e-5, atol=1e-6) and not whole.nonfinite_samples
    assert parts[1].any() and parts[2].any() and parts[3].any()


def test_connections_by_kernels_and_by_tensors():
    """The same numbers but for rounding, for any threads; with a surface that is not opaque, and rays side by side."""
    room = ROOMS["parallel rays"]
    shapes = {name: room["shapes"][name] for name in ("floor", "lamp")}
    shapes["veil"] = {
        "type": "rectangle",
        "material": {"type": "diffuse", "opacity": 0.4},
        "transform": [{"scale": 0.4}, {"translate": [0, 0.3, 0.2]}],
    }
    scene = torchpt.load({**room, "shapes": shapes}, device="cpu")
    # A strategy alone has the weight that connections leave it, and makes none.
    for keys in ({}, {"strategy": "light", "weighted": True}):
        wish: dict[str, Any] = {"spp": 4, "integrator": {"type": "bdpt", **CONNECTED, **keys}}
        of_tensors = torchpt.render(scene, compile="off", **wish)
        of_kernels = torchpt.render(scene, compile="on", threads=1, **wish)
        torch.testing.assert_close(of_kernels, of_tensors, rtol=1e-3, atol=1e-4)
        assert of_kernels.any() and torch.equal(torchpt.render(scene, compile="on", threads=2, **wish), of_kernels)


def test_paths_of_two_edges_are_not_connected():
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    wish: dict[str, Any] = {"spp": 4, "compile": "off"}
    plain = torchpt.render(scene, integrator={"type": "bdpt", "max_depth": 2}, **wish)
    keys = {"type": "bdpt", "max_depth": 2, "connections": "one"}
    assert torch.equal(torchpt.render(scene, integrator=keys, **wish), plain)


@pytest.mark.parametrize("keys", [{"strategy": "connections"}, {"strategy": "connections", "connections": "one"}])
def test_connections_alone_are_weighted(keys):
    with pytest.raises(torchpt.SceneError, match="integrator.(connections|weighted): expected"):
        torchpt.render(torchpt.load(ROOMS["thin lens"], device="cpu"), integrator={"type": "bdpt", **keys}, spp=1)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["light", "light_paths"])
def test_a_strategy_alone(strategy):
    """Of direct light on surfaces that scatter, seen by rays that meet no lamp, either finds all."""
    shapes = {name: ROOMS["thin lens"]["shapes"][name] for name in ("floor", "back", "left", "lamp")}
    scene = torchpt.load({**ROOMS["thin lens"], "shapes": shapes}, device="cpu")
    a = pictures(scene, "path", 256)
    b = pictures(scene, "bdpt", 256, strategy=strategy)
    rows = slice(8, 16)  # the lamp is above
    assert_same_means(a[:, rows].repeat(1, 2, 1, 1), b[:, rows].repeat(1, 2, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["many lamps", "lamps of all shapes"])
def test_fewer_light_paths(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    assert_same_means(pictures(scene, "bdpt", 64), pictures(scene, "bdpt", 64, light_paths=0.25))


@pytest.mark.slow
def test_part_of_a_film():
    whole = torchpt.load(ROOMS["thin lens"], device="cpu")
    part = {"width": 32, "height": 32, "filter": "gaussian", "crop": [8, 4, 16, 16]}
    a, b = (
        torch.stack(
            [torchpt.render(whole, integrator=name, spp=64, seed=seed + 1, film=part) for seed in range(SEEDS)]
        ).double()
        for name in ("path", "bdpt")
    )
    assert a.shape == (SEEDS, 16, 16, 3)
    assert_same_means(a, b)


GLASS = {
    "camera": {"origin": [0, 2, 6], "target": [0, 0.7, 0], "fov": 40},
    "film": {"width": 24, "height": 18, "filter": "box"},
    "shapes": {
        "floor": {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]},
        "bulb": {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "material": {"type": "dielectric"}},
    },
    "lights": {"p": {"type": "point", "position": [0, 1, 0], "intensity": 10}},
}


def test_a_point_in_the_middle_of_a_glass_ball():
    """All rays meet the glass at right angles: it lets (1 - R)^2 out, and what is reflected within it comes back."""
    bare = {**GLASS, "shapes": {"floor": GLASS["shapes"]["floor"]}}
    glass, free = torchpt.load(GLASS, device="cpu"), torchpt.load(bare, device="cpu")
    direct = {"type": "bdpt", "max_depth": 2, "light_paths": 1.0}
    assert not torchpt.render(glass, integrator="path", spp=4).any()
    # Straight through the ball, of radius 0.5: three edges more than without it would reach the floor in one.
    once = torchpt.render(glass, integrator={**direct, "max_depth": 3}, spp=256, compile="off")
    plain = torchpt.render(free, integrator=direct, spp=256, compile="off")
    passed = 1.0 - 0.2**2  # of eta 1.5, at right angles
    floor = slice(13, 18)  # rows in which the ball does not stand
    assert float(once[floor].mean() / plain[floor].mean()) == pytest.approx(passed, rel=1.5e-2)
    # Light that is reflected n times within leaves along the same rays: passed * sum of R^n = 1.
    many = torchpt.render(glass, integrator={"type": "bdpt", "max_depth": 12}, spp=256, compile="off")
    assert float(
        many[floor].mean() / torchpt.render(free, integrator="bdpt", spp=256, compile="off")[floor].mean()
    ) == pytest.approx(1.0, rel=2e-2)


@pytest.mark.slow
def test_a_small_lamp_is_found_with_less_noise():
    """Where its light falls through glass: on the floor, and not where the lamp is seen through the ball."""
    lamp = {
        "type": "rectangle",
        "emission": [300, 275, 225],
        "transform": [{"scale": 0.06}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1.9, 0]}],
    }
    scene = torchpt.load(room(materials={"glass": {"type": "dielectric"}}, shapes={"lamp": lamp}), device="cpu")
    layers = torchpt.render(scene, spp=1, film={"aovs": ["object_id"]}, full=True).layers
    floor = layers["object_id"].squeeze() == 1
    # The mean, not the median: light comes to `path` in samples that are rare in every pixel.
    a, b = (pictures(scene, name, 64).var(0)[floor].mean() for name in ("path", "bdpt"))
    assert float(b) < 0.05 * float(a)


def test_normal_maps_let_no_light_through():
    """A steep normal of the map lies on the side of camera and lamp alike, though the wall stands between them."""
    slopes = torch.randn(8, 8, 2, generator=torch.Generator().manual_seed(3))
    normals = torch.nn.functional.normalize(torch.cat((slopes, torch.ones(8, 8, 1)), -1), dim=-1)
    relief = {"type": "image", "data": (0.5 * normals + 0.5).tolist()}
    wall = {"type": "diffuse", "normal_map": relief}
    scene = {
        "camera": {"origin": [0, 0, 2], "target": [0, 0, 0], "fov": 40},
        "film": {"width": 8, "height": 8},
        "shapes": {"wall": {"type": "rectangle", "material": wall}},
        "lights": {"behind": {"type": "point", "position": [0.3, 0.1, -0.3], "intensity": 2}},
    }
    assert not torchpt.render(torchpt.load(scene, device="cpu"), integrator="bdpt", spp=64, compile="off").any()


def test_distant_light_falls_on_all_instances():
    """One that stands far from the meshes, and one that is larger than they are."""
    cube = {"type": "cube", "transform": [{"scale": 0.1}]}
    far = {"type": "instance", "of": "cube", "transform": [{"scale": 0.5}, {"translate": [3, 0, 0]}]}
    scene = torchpt.load(
        {
            "camera": {"origin": [3, 1, 3], "target": [3, 0, 0], "fov": 30},
            "film": {"width": 16, "height": 16, "filter": "box"},
            "shapes": {"cube": cube, "far": far},
            "lights": {"sun": {"type": "directional", "direction": [-1, -2, -1.5]}},
        },
        device="cpu",
    )
    a, b = (
        torchpt.render(scene, integrator={"type": "bdpt", "strategy": strategy, "max_depth": 2}, spp=256, compile="off")
        for strategy in ("light", "light_paths")
    )
    assert float(a.mean()) > 0.01
    assert float(b.mean()) == pytest.approx(float(a.mean()), rel=0.02)


def test_a_checkpoint_goes_on_to_the_bit(tmp_path):
    scene, file = torchpt.load(GLASS, device="cpu"), str(tmp_path / "half.ckpt")
    whole = torchpt.render(scene, integrator="bdpt", spp=8)
    torchpt.render(scene, integrator="bdpt", spp=5, checkpoint=file)
    assert torch.equal(whole, torchpt.render(scene, integrator="bdpt", spp=8, checkpoint=file, resume=True))


def test_splats_that_are_too_large_are_named():
    """Sums of splats hold less than 2^55, the radiance of camera paths more."""
    bright = {**GLASS, "lights": {"p": {**GLASS["lights"]["p"], "intensity": 1e30}}}
    found = torchpt.render(torchpt.load(bright, device="cpu"), integrator="bdpt", spp=4, compile="off", full=True)
    assert re.search(r"infinite splat at depth \d+ \(shape floor", found.nonfinite_first)
    assert found.nonfinite_causes.keys() == {"infinite splat", "nan, not traced"}


def test_connections_that_are_not_finite_are_named():
    room = {**ROOMS["thin lens"], "lights": {"p": {"type": "point", "position": [0.5, 1.6, 0.6], "intensity": 1e37}}}
    scene = torchpt.load(room, device="cpu")
    keys = {"type": "bdpt", **CONNECTED, "strategy": "connections", "weighted": True}
    found = torchpt.render(scene, integrator=keys, spp=4, compile="off", full=True)
    assert re.search(r"infinite connection at depth \d+$", found.nonfinite_first)
    assert found.nonfinite_causes.keys() <= {"infinite connection", "nan connection"}


def test_a_scene_without_light_is_black():
    dark = {**GLASS, "lights": {}}
    assert not torchpt.render(torchpt.load(dark, device="cpu"), integrator="bdpt", spp=2, compile="off").any()


def test_gradients_are_refused():
    scene = torchpt.load(GLASS, device="cpu")
    leaf = scene.params["lights.p.intensity"].clone().requires_grad_()
    with pytest.raises(SceneError, match="expected one of path, direct, .* where gradients are wanted, got 'bdpt'"):
        torchpt.render(scene, params={"lights.p.intensity": leaf}, integrator="bdpt", spp=1, compile="off")


# ---- Weights


@dataclass(frozen=True)
class ThreeEdges:
    """Paths of three edges, N lanes: from a point on a lamp by surface points ``a`` and ``b`` to the camera.

    ``ray`` goes to ``a`` along ``d0``, ``d1`` leads from ``a`` to ``b``, and ``view`` from ``b`` to the camera. ``density`` is
    that of the camera, by area of the surface at ``b``, in square pixels; ``first`` and ``second`` are the models at ``a`` and
    ``b``.
    """

    wave: Wave
    ray: LightRay
    a: Interaction
    b: Interaction
    d0: torch.Tensor
    d1: torch.Tensor
    view: torch.Tensor
    density: torch.Tensor
    first: int = 0
    second: int = 0

    def of(self, first: int, second: int) -> ThreeEdges:
        """Return those whose surface points are of two models."""
        key = self.wave.context.world.materials
        models = [key.key[at.slot + 1].long() % len(key.models) for at in (self.a, self.b)]
        index = ((models[0] == first) & (models[1] == second)).nonzero()[:, 0]
        return replace(self.rows(index), first=first, second=second)

    def rows(self, index: torch.Tensor) -> ThreeEdges:
        names = ("ray", "a", "b", "d0", "d1", "view", "density")
        return replace(self, **{name: rows(getattr(self, name), index) for name in names})


def random_paths(wave: Wave, n: int) -> ThreeEdges:
    """Return random paths that leave the lamp, whose second point reflects light to the camera."""
    world, numbers = wave.context.world, torch.Generator().manual_seed(7)
    assert world.emission is not None

    def met(o: torch.Tensor, d: torch.Tensor) -> tuple[Interaction, torch.Tensor]:
        t, prim, u, v = wave.accel.intersect(o, d, torch.full_like(o[0], math.inf))
        return interact(world, o, d, Hit(t.double(), prim.clamp_min(0).long(), u.double(), v.double())), prim >= 0

    u, v = (torch.rand(2, n, generator=numbers, dtype=torch.float64) for _ in range(2))
    ray = emit(world.emission, None, u, v, 1e-5)
    a, lit = met(ray.o, ray.d)
    d1 = torch.nn.functional.normalize(torch.randn(3, n, generator=numbers, dtype=torch.float64), dim=0)
    d1 = d1 * -torch.sign(dot(d1, a.ng) * dot(ray.d, a.ng))  # on the side that the lamp shines on
    b, found = met(offset_origin(world, a, d1), d1)
    to = wave.camera.origin() - b.p
    view = torch.nn.functional.normalize(to, dim=0)
    density = wave.camera.film_density(-view) * dot(view, b.ng).abs() / dot(to, to)
    good = lit & found & (a.slot != b.slot) & (dot(view, b.ng) * dot(d1, b.ng) < 0)
    return ThreeEdges(wave, ray, a, b, ray.d, d1, view, density).rows(good.nonzero()[:, 0])


def by_area(density: torch.Tensor, d: torch.Tensor, o: Interaction, at: Interaction) -> torch.Tensor:
    """Return densities by solid angle of directions ``d`` at ``o`` as densities by area at ``at``."""
    way = at.p - o.p
    return density * Arrival.cosine_of(d, at) / dot(way, way)


def arrivals(paths: ThreeEdges) -> tuple[Arrival, Arrival]:
    """Return the numbers of MIS of a light path at ``a``, and of a camera path at ``b``."""
    wave, a, b = paths.wave, paths.a, paths.b
    emission, start = wave.context.world.emission, paths.ray.density
    assert emission is not None
    surface, cosine = surface_at(wave.context.world, paths.first, paths.d0, a), Arrival.cosine_of(paths.d0, a)
    share = light_weight(emission, paths.ray, a.p, surface.frame.n)
    of_light = Arrival(1.0 / (start * share * cosine), paths.ray.met / start / cosine, cosine)
    nothing = torch.zeros_like(paths.density)
    return of_light, Arrival(PIXELS / paths.density, nothing, Arrival.cosine_of(paths.view, b))


def weight_of_connection(paths: ThreeEdges, number: float) -> torch.Tensor:
    """Return the weight as a connection of ``b``, on a camera path, with ``a``, on a light path."""
    context, a, b, (of_light, of_camera) = paths.wave.context, paths.a, paths.b, arrivals(paths)
    at_a = surface_at(context.world, paths.first, paths.d0, a)
    at_b = surface_at(context.world, paths.second, -paths.view, b)
    kinds = context.world.materials.models
    to_b = kinds[paths.first].pdf(at_a.parameters, at_a.wo, at_a.frame.to_local(paths.d1))
    to_a = kinds[paths.second].pdf(at_b.parameters, at_b.wo, at_b.frame.to_local(-paths.d1))
    to_lamp = reverse_pdf(context, paths.first, a, at_a, -paths.d0, paths.d1)
    to_camera = reverse_pdf(context, paths.second, b, at_b, paths.view, -paths.d1)
    ratio = root_of_squares(
        by_area(to_a, paths.d1, b, a) * of_light.others(to_lamp),
        by_area(to_b, paths.d1, a, b) * of_camera.others(to_camera),
    )
    return reduced(None, ratio / number)


def weight_of_splat(paths: ThreeEdges, number: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the weight as a light path that is joined to the camera, and the density with which it is sampled at ``a``."""
    wave, a, b, (arrival, _) = paths.wave, paths.a, paths.b, arrivals(paths)
    assert wave.light_paths is not None
    context = wave.light_paths.context
    kinds = context.world.materials.models
    surface = surface_at(context.world, paths.first, paths.d0, a)
    pdf = kinds[paths.first].pdf(surface.parameters, surface.wo, surface.frame.to_local(paths.d1))
    back = reverse_pdf(context, paths.first, a, surface, -paths.d0, paths.d1)
    dvc = leaving_dvc(context, paths.first, a, surface, arrival, paths.d1, pdf, None, back)
    cosine, way = Arrival.cosine_of(paths.d1, b), b.p - a.p
    dvcm = leaving_dvcm(pdf, False, number) * dot(way, way) / cosine
    arrival = Arrival(dvcm, dvc / cosine, cosine)
    surface = surface_at(context.world, paths.second, paths.d1, b)
    back = reverse_pdf(context, paths.second, b, surface, -paths.d1, paths.view)
    return reduced(None, paths.density / PIXELS * arrival.others(back)), pdf


def weights_of_camera_path(paths: ThreeEdges, number: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the weights as a camera path, with a light sample at its end and where it meets the lamp.

    The third result is the density with which it is sampled at ``b`` and ``a``.
    """
    wave, a, b = paths.wave, paths.a, paths.b
    context, emission = wave.context, wave.context.world.emission
    assert emission is not None
    kinds = context.world.materials.models
    surface, (_, arrival) = surface_at(context.world, paths.second, -paths.view, b), arrivals(paths)
    pdf = kinds[paths.second].pdf(surface.parameters, surface.wo, surface.frame.to_local(-paths.d1))
    back = reverse_pdf(context, paths.second, b, surface, paths.view, -paths.d1)
    dvc = leaving_dvc(context, paths.second, b, surface, arrival, -paths.d1, pdf, None, back)
    cosine, way = Arrival.cosine_of(paths.d1, a), b.p - a.p
    dvcm = leaving_dvcm(pdf, False, number) * dot(way, way) / cosine
    arrival = Arrival(dvcm, dvc / cosine, cosine)
    surface = surface_at(context.world, paths.first, -paths.d1, a)
    share = light_weight(emission, paths.ray, a.p, surface.frame.n)
    back = reverse_pdf(context, paths.first, a, surface, paths.d1, -paths.d0)
    by_bsdf = kinds[paths.first].pdf(surface.parameters, surface.wo, surface.frame.to_local(-paths.d0))
    # Of a light sample: over one by the BSDF alone, and over the light path.
    ratio = by_bsdf * share
    alone = 1.0 / (1.0 + ratio * ratio)
    other = paths.ray.density * share * dot(paths.d0, a.ng).abs() * arrival.others(back)
    by_sample = alone * reduced(alone, other)
    # Where the BSDF's ray meets the lamp.
    alone = torch.where(by_bsdf > 0, 1.0 / (1.0 + 1.0 / (ratio * ratio)), 0.0)
    dvc = leaving_dvc(context, paths.first, a, surface, arrival, -paths.d0, by_bsdf, None, back)
    other = density_of_hit(emission, on_lamp(context.world, a.p, -paths.d0)) * dvc
    return by_sample, alone * reduced(alone, other), torch.minimum(pdf, by_bsdf)


def on_lamp(world: World, o: torch.Tensor, d: torch.Tensor) -> Interaction:
    """Return the point of the lamp's first corner; its density is that of all its points."""
    assert world.lights is not None and world.lights.row_of_prim is not None
    zero = torch.zeros_like(o[0])
    prim = torch.full_like(zero, int((world.lights.row_of_prim == 0).nonzero()[0, 0]), dtype=torch.int64)
    return interact(world, o, d, Hit(zero + 1.0, prim, zero, zero))


#: Pixels of the rooms: light paths for each sample.
PIXELS = 16.0 * 16.0


def test_no_connection_takes_the_place_of_a_delta_lobe():
    pdf = torch.tensor([2.0, math.inf])
    assert leaving_dvcm(pdf, False, 0.5).tolist() == [0.25, 0.0]
    assert leaving_dvcm(pdf, True, 0.5).tolist() == leaving_dvcm(pdf, False, 0.0).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("number", [0.0, 0.5])
def test_weights_of_all_strategies_sum_to_one(number):
    """For random paths of three edges, with densities by hand."""
    lamp = {"type": "rectangle", "emission": 3, "transform": [{"scale": 0.5}, {"translate": [0.2, 1, -0.9]}]}
    ball = {"type": "sphere", "center": [0.4, 0.4, 0.2], "radius": 0.35, "material": "metal"}
    scene = torchpt.load(room(shapes={"lamp": lamp, "ball": ball}), device="cpu")
    keys = {"integrator": Bdpt(light_paths=1.0)}
    wave = make_wave(scene, settings(scene.description, keys), None, torch.float64)
    paths, checked = random_paths(wave, 4096), 0
    opaque = [k for k, kind in enumerate(wave.context.world.materials.models) if not kind.transmits]
    for first, second in itertools.product(opaque, repeat=2):
        some = paths.of(first, second)
        by_splat, pdf = weight_of_splat(some, number)
        by_sample, by_hit, other_pdf = weights_of_camera_path(some, number)
        connected = weight_of_connection(some, number) if number else torch.zeros_like(by_splat)
        good = (pdf > 0) & (other_pdf > 0)
        weights = torch.stack((by_splat, by_sample, by_hit, connected))[:, good]
        assert bool((weights >= 0.0).all())
        torch.testing.assert_close(weights.sum(0), torch.ones_like(weights[0]), rtol=0.0, atol=1e-5)
        checked += len(weights[0])
    assert checked > 500
