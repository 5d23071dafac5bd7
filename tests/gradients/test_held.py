"""Gradients by the camera, taken with what is seen held in place: see ``torchpt/gradients/camera.py``."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.gradients import camera as held
from torchpt.math.vectors import dot
from torchpt.physics.shapes import reattach
from torchpt.physics.shapes.geometry import Hit

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

#: A corner under a lamp that fills the view: nothing hides anything, creases and box corners are in view.
CORNER: dict[str, Any] = {
    "camera": {"origin": [0.1, 1.5, 3], "target": [0.2, 0.6, -1], "fov": 40},
    "film": {"width": 8, "height": 6, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 3, "rr_depth": 100},
    "render": {"threads": 1},
    "materials": {
        "grey": {"type": "diffuse", "reflectance": [0.8, 0.7, 0.6]},
        "metal": {"type": "roughconductor", "eta": 0.4, "k": 3, "alpha": 0.3},
    },
    "shapes": {
        "floor": {
            "type": "rectangle",
            "material": "metal",
            "transform": [{"scale": 6}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"translate": [0, 0, 5]}],
        },
        "wall": {"type": "rectangle", "material": "grey", "transform": [{"scale": 6}, {"translate": [0, 6, -1]}]},
        "lamp": {
            "type": "rectangle",
            "emission": [20, 18, 15],
            "transform": [{"scale": 0.4}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0.9, 2.3, 0.2]}],
        },
    },
}
WEIGHT = (0.2 + torch.arange(6.0)[:, None, None] ** 2 + torch.arange(8.0)[None, :, None]) * torch.tensor([1, 0.8, 0.6])
SHIFT = {"principal_point_offset_x": 0.1, "principal_point_offset_y": -0.2, "pixel_aspect": 1.3}


def loss(picture: torch.Tensor) -> torch.Tensor:
    return (picture.double() * WEIGHT).mean()


def camera_of(**more: Any):
    scene = torchpt.load({**CORNER, "camera": {**CORNER["camera"], **more}}, "cpu")
    settings = torchpt.scene.formats.description.settings(scene.description, {})
    return scene.camera(settings.film, scene.merged(None), torch.float64)


@pytest.mark.parametrize("more", [{}, {"fov_axis": "diagonal"}, SHIFT])
def test_projects_points_to_where_rays_meet_them(more):
    camera = camera_of(**more)
    x, y = torch.rand(2, 50, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 7
    _, d = camera.rays(x, y, None)
    found = camera.project(d * torch.linspace(0.1, 30, 50, dtype=torch.float64))
    assert torch.allclose(found[0], x) and torch.allclose(found[1], y)


@pytest.mark.parametrize("more", [{}, SHIFT])
def test_scale_of_areas_is_that_of_the_projection(more):
    camera = camera_of(**more)
    generator = torch.Generator().manual_seed(3)
    p = torch.rand(3, 1, generator=generator, dtype=torch.float64) - camera.axes()[2] * -3.0
    along = [torch.rand(3, 1, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2)]

    def place(u: torch.Tensor) -> torch.Tensor:
        x, y, _ = camera.project(p + u[0] * along[0].detach() + u[1] * along[1].detach())
        return torch.stack((x[0], y[0]))

    jacobian = torch.autograd.functional.jacobian(place, torch.zeros(2, dtype=torch.float64))
    assert isinstance(jacobian, torch.Tensor)
    area = torch.linalg.cross(along[0].detach(), along[1].detach(), dim=0)
    _, _, scale = camera.project(p)
    assert torch.allclose(torch.linalg.det(jacobian).abs(), scale * dot(area, p).abs())


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("tent", "mitchell")]


@pytest.mark.parametrize("filter", ["box", "gaussian", *SLOW])
@pytest.mark.slow
def test_agrees_with_differences(filter):
    scene = torchpt.load({**CORNER, "film": {**CORNER["film"], "filter": filter}}, "cpu")
    name, step = "camera.to_world", 0.04
    base, exact, difference = scene.params[name], [], []
    shift = torch.zeros_like(base)
    shift[0, 3] = step
    for seed in range(6):
        leaf = base.clone().requires_grad_()
        loss(torchpt.render(scene, params={name: leaf}, spp=1, spp_grad=128, seed=seed)).backward()
        assert leaf.grad is not None
        exact.append(leaf.grad[0, 3])
        ends = [loss(torchpt.render(scene, params={name: base + s * shift}, spp=512, seed=seed)) for s in (1, -1)]
        difference.append((ends[0] - ends[1]) / (2 * step))
    a, b = torch.stack(exact), torch.stack(difference)
    error = float((a.var() / 6 + b.var() / 6).sqrt())
    assert error < 0.03 * abs(float(b.mean()))
    assert abs(float(a.mean() - b.mean())) < 4.5 * error + 0.01 * abs(float(b.mean()))


def test_small_chunks_give_the_same_up_to_rounding(monkeypatch):
    scene = torchpt.load(CORNER, "cpu")
    pose, grads = scene.params["camera.to_world"].clone().requires_grad_(), []
    for lanes in (None, 62):
        if lanes is not None:
            monkeypatch.setattr(sys.modules["torchpt.gradients.tape"], "LANES", {"cpu": lanes})
        picture = torchpt.render(scene, params={"camera.to_world": pose}, spp=8)
        grads.append(torch.autograd.grad(loss(picture), pose)[0])
    assert torch.allclose(*grads, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("filter", ["box", "gaussian"])
@pytest.mark.slow
def test_bits_do_not_depend_on_threads_nor_memory(filter):
    """Enough paths for several chunks, each of more lanes than torch gives to one thread."""
    scene = torchpt.load({**CORNER, "film": {"width": 96, "height": 64, "filter": filter}}, "cpu")
    pose, grads = scene.params["camera.to_world"].clone().requires_grad_(), []
    wishes: list[dict[str, Any]] = [{"threads": 1}, {"threads": 3}, {"threads": 1, "max_memory": "3GB"}]
    for wish in wishes:
        picture = torchpt.render(scene, params={"camera.to_world": pose}, spp=1, spp_grad=14, edges=False, **wish)
        grads.append(torch.autograd.grad(picture.square().sum(), pose)[0])
    assert torch.equal(grads[0], grads[1]) and torch.equal(grads[0], grads[2])


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_sheared_axes_are_followed(kind):
    """Entries of a pose move its axes from their right angles: places on the film stay those of the rays."""
    scene = torchpt.load({**CORNER, "camera": {**CORNER["camera"], "type": kind, "fov": 40} if kind == "perspective" else
                          {"type": kind, "origin": [0.1, 1.5, 3], "target": [0.2, 0.6, -1]}}, "cpu")  # fmt: skip
    settings = torchpt.scene.formats.description.settings(scene.description, {})
    pose = scene.params["camera.to_world"].double()
    pose[:3, :3] += 0.2 * torch.rand(3, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    camera = scene.camera(settings.film, scene.merged({"camera.to_world": pose}), torch.float64)
    x, y = torch.rand(2, 50, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 7
    o, d = camera.rays(x, y, None)
    seen = camera.film_of(o + d * torch.linspace(0.1, 30, 50, dtype=torch.float64))
    assert seen is not None and torch.allclose(seen[0] / seen[2], x) and torch.allclose(seen[1] / seen[2], y)


def gradients(scene: torchpt.Scene, names: tuple[str, ...], seeds: int = 4, **wish: Any) -> torch.Tensor:
    """``(seeds, ...)`` by the first of some parameters."""
    found = []
    for seed in range(seeds):
        leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
        picture = torchpt.render(scene, params=leaves, spp=1, seed=seed, **wish)
        found.append(torch.autograd.grad(picture.double().mean(), leaves[names[0]])[0])
    return torch.stack(found)


def test_what_lets_rays_pass_is_not_held():
    """A plate that half of the rays pass fills the view: the gradient by the camera is half of that without it."""
    ball = {"type": "sphere", "radius": 0.5, "material": {"type": "diffuse", "reflectance": 0}}
    plate = {"type": "rectangle", "transform": [{"scale": 9}, {"translate": [0, 0, 1.5]}],
             "material": {"type": "diffuse", "reflectance": 0, "opacity": 0.5}}  # fmt: skip
    found = []
    for shapes in ({"ball": ball}, {"ball": ball, "plate": plate}):
        scene = torchpt.load({
            "camera": {"origin": [0.6, 0, 4], "target": [0.6, 0, 0], "fov": 20}, "shapes": shapes,
            "film": {"width": 12, "height": 12, "filter": "box"}, "integrator": {"type": "path", "max_depth": 2},
            "lights": {"sky": {"type": "constant"}}}, "cpu")  # fmt: skip
        found.append(gradients(scene, ("camera.to_world",), spp_grad=24)[:, 0, 3])
    (free, one), (half, other) = ((float(x.mean()), float(x.std()) / 2) for x in found)
    assert abs(free) > 0.02  # the ball's silhouette is within the picture on one side
    assert abs(half - 0.5 * free) < 4 * (0.5 * one + other) + 0.01 * abs(free)


@pytest.mark.parametrize("name", few(["lights.it.position", "lights.it.direction"], 1))
def test_a_light_beside_the_camera_has_its_shadow_edges(name):
    lights = {
        "lights.it.position": {"type": "point", "position": [0.4, 3, 0.3], "intensity": 5},
        "lights.it.direction": {"type": "directional", "direction": [-0.3, -1, -0.2], "irradiance": 2},
    }
    block = {"type": "cube", "transform": [{"scale": 0.3}, {"translate": [0, 0.8, 0]}]}
    floor = {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
    scene = torchpt.load({
        "camera": {"origin": [0, 3, 4], "target": [0, 0.3, 0], "fov": 40}, "shapes": {"block": block, "floor": floor},
        "lights": {"it": lights[name]}, "film": {"width": 12, "height": 12, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 2}}, "cpu")  # fmt: skip
    alone, beside = (gradients(scene, names, spp_grad=24) for names in ((name,), (name, "camera.fov")))
    error = (alone.std(0) + beside.std(0)) / 2
    assert bool(((alone.mean(0) - beside.mean(0)).abs() <= 4 * error + 1e-3 * alone.mean(0).abs().max()).all())
    without = gradients(scene, (name,), spp_grad=24, edges=False).mean(0)
    assert float((without - alone.mean(0)).abs().max()) > 0.05 * float(alone.mean(0).abs().max())


def test_materials_beside_the_camera_have_their_own_gradient():
    scene = torchpt.load(CORNER, "cpu")
    grads = []
    for names in (("materials.grey.reflectance",), ("materials.grey.reflectance", "camera.fov")):
        leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
        picture = torchpt.render(scene, params=leaves, spp=32)
        grads.append(torch.autograd.grad(loss(picture), leaves[names[0]])[0])
    assert torch.allclose(*grads, rtol=1e-4)


def test_is_left_to_shapes_where_these_move_too(monkeypatch):
    scene = torchpt.load(CORNER, "cpu")
    taken = []
    monkeypatch.setattr(held, "interior", lambda *a: taken.append(a))
    names = ("shapes.wall.to_world", "camera.to_world")
    leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
    torchpt.render(scene, params=leaves, spp=1).sum().backward()
    assert not taken and all(leaf.grad is not None for leaf in leaves.values())


def test_points_that_touch_have_no_derivative_by_their_distance():
    scene = torchpt.load(CORNER, "cpu")
    world, _ = scene.world(torch.float64, None)
    prim = torch.tensor([0, 0, 0, -1])
    half = torch.full((4,), 0.5, dtype=torch.float64)
    hit = Hit(t=half * 0, prim=prim, u=half, v=half)
    d = torch.tensor([[0.0, -1.0, 0.0]], dtype=torch.float64).T.expand(3, 4)
    middle = world.geometry.p0[:, :1] + 0.5 * world.geometry.e1[:, :1] + 0.5 * world.geometry.e2[:, :1]
    away = torch.tensor([[0.0, 0.0, 0.0, 0.0], [0.0, 1e-7, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    x = (middle + away).requires_grad_()
    direction, ratio = reattach(world, x, hit, d, torch.tensor([1e-3], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(direction.sum() + ratio.sum(), x)
    assert torch.isfinite(gradient).all()
    assert (gradient[:, :2] == 0).all()
    assert gradient[:, 2].abs().sum() > 0.1
    assert torch.equal(direction.detach(), d) and (ratio.detach() == 1).all()
