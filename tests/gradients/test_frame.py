"""The frame of gradients of geometry: near points slide along their rays, far ones are held."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.gradients import parameters
from torchpt.gradients.parameters import near_of
from torchpt.math.vectors import cross, dot, normalize
from torchpt.physics.shapes import interact, reattach
from torchpt.physics.shapes.geometry import Hit

SCENE = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
    "shapes": {
        "wall": {
            "type": "mesh",
            "vertices": [[-3, -2, -0.4], [3, -2, 0.3], [2, 3, 0.1], [-2, 3, -0.2]],
            "faces": [[0, 1, 2], [0, 2, 3]],
        },
        "far": {"type": "rectangle", "transform": [{"translate": [9, 0, -9]}]},
    },
}
KEY = "shapes.wall.vertices"


def turned(near: float, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return how directions ``w`` from moving origins move with the vertices, and the relative change of their measure."""
    scene = torchpt.load(SCENE, "cpu")
    base = scene.params[KEY].double()
    shift = torch.randn(base.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    origin = torch.tensor([[0.2], [0.3], [0.9]], dtype=torch.float64).expand(3, w.shape[1])
    moves = torch.tensor([[0.4], [-0.3], [0.6]], dtype=torch.float64)
    world, _ = scene.world(torch.float64)
    away = world.geometry.p0[:, :1] - origin
    t = dot(away, world.geometry.normal[:, :1]) / dot(w, world.geometry.normal[:, :1])
    found = Hit(t, torch.zeros(w.shape[1], dtype=torch.int64), torch.zeros_like(t), torch.zeros_like(t))
    at = interact(world, origin, w, found, follow_ray=True)
    hit = Hit(t, found.prim, at.u, at.v)

    def at_step(step: Tensor) -> tuple[Tensor, Tensor]:
        moved = scene.world(torch.float64, {KEY: base + step * shift})[0]
        return reattach(moved, origin + moves * step, hit, w, torch.tensor([near], dtype=torch.float64))

    step = torch.zeros((), dtype=torch.float64)
    _, (direction, ratio) = torch.autograd.functional.jvp(at_step, step, torch.ones_like(step))
    return direction, ratio


@pytest.mark.parametrize("near", [0.4, 1.0, 3.0])
def test_the_measure_changes_by_the_divergence_of_directions(near: float):
    """Light is integrated over directions: where these move by ``D``, their measure changes by ``div D``."""
    g = torch.Generator().manual_seed(5)
    w = normalize(torch.randn(3, 40, generator=g, dtype=torch.float64) * 0.5 - torch.tensor([[0.0], [0.0], [1.0]]))
    w = w[:, w[2] < -0.3]
    motion, ratio = turned(near, w)
    assert (dot(motion, w).abs() < 1e-12).all() and motion.norm() > 0.1
    axis = torch.tensor([[1.0], [0.0], [0.0]], dtype=torch.float64).expand_as(w)
    one = normalize(cross(w, axis))
    h, divergence = 1e-5, torch.zeros_like(ratio)
    for along in (one, cross(w, one)):
        ahead, behind = (turned(near, normalize(w + side * h * along))[0] for side in (1, -1))
        divergence += dot(along, ahead - behind) / (2 * h)
    torch.testing.assert_close(ratio, divergence, rtol=1e-5, atol=1e-6)


def test_near_is_half_the_box_of_what_moves():
    scene = torchpt.load(SCENE, "cpu")
    geometry = scene.world(torch.float64)[0].geometry
    box = torch.tensor([6.0, 5.0, 0.7], dtype=torch.float64) / scene.space.unit
    assert float(near_of(scene, geometry, [KEY])) == pytest.approx(float(box.norm()) / 2)
    alone = float(near_of(scene, geometry, ["camera.to_world"]))
    assert 0 < alone < float(near_of(scene, geometry, [KEY, "shapes.far.to_world"]))


def test_kernels_take_the_length_of_each_pass(monkeypatch: pytest.MonkeyPatch):
    """Scenes of one structure share kernels, and differ in the length over which points slide."""
    quads = {
        "floor": {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 2}]},
        "block": {"type": "cube", "transform": [{"scale": 0.4}, {"translate": [0.1, 0.5, 0]}]},
        "lamp": {"type": "rectangle", "emission": [9, 8, 7], "transform": [{"translate": [0, 1, -3]}]},
    }
    described = {
        "camera": {"origin": [0, 1.5, 4], "target": [0, 0.4, 0], "fov": 40},
        "film": {"width": 12, "height": 12, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 4},
        "shapes": quads,
    }
    scene, key = torchpt.load(described, "cpu"), "shapes.block.to_world"
    found: dict[tuple[float, str], Tensor] = {}
    for near in (0.3, 1.5):
        monkeypatch.setattr(parameters, "near_of", lambda *_, near=near: torch.tensor([near], dtype=torch.float64))
        for compile in ("on", "off"):
            leaf = scene.params[key].clone().requires_grad_()
            wish = {"spp": 8, "seed": 2, "seed_grad": 2, "threads": 1, "edges": False, "compile": compile}
            with pytest.warns(torchpt.EdgeWarning):
                picture = torchpt.render(scene, params={key: leaf}, **wish)
            found[near, compile] = torch.autograd.grad(picture.sum(), leaf)[0]
        torch.testing.assert_close(found[near, "on"], found[near, "off"], rtol=1e-3, atol=2e-3)
    apart = (found[0.3, "on"] - found[1.5, "on"]).abs().max()
    assert float(apart) > 0.1
