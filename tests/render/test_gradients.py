"""Gradients through the plain tape: exact against finite differences where the estimator is the same function, and equal
in the mean where it is not (directions are sampled detached)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few
from few_lanes import few_lanes

import torchpt
from torchpt.core.errors import SceneError

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
ROOM = {
    "camera": {"type": "perspective", "origin": [0, 2, 0.5], "target": [0, 0, 0.5], "up": [0, 0, 1], "fov": 30},
    "film": {"width": 4, "height": 4, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100},
    "render": {"threads": 1},
    "materials": {"grey": {"type": "diffuse", "reflectance": [0.8, 0.7, 0.6]}},
    "shapes": {
        "floor": {
            "type": "mesh",
            "vertices": [[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]],
            "faces": [[0, 2, 1], [0, 3, 2]],
            "material": "grey",
            "face_normals": True,
        },
        "wall": {
            "type": "mesh",
            "vertices": [[-2, 0, -2], [2, 0, -2], [2, 3, -2], [-2, 3, -2]],
            "faces": [[0, 1, 2], [0, 2, 3]],
            "material": "grey",
            "face_normals": True,
        },
        "panel": {
            "type": "rectangle",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 3, 0.5]}],
            "emission": [5, 4, 3],
        },
        "ball": {"type": "sphere", "center": [0, 4, -1], "radius": 0.5, "emission": [6, 6, 6]},
        "lamp": {
            "type": "mesh",
            "vertices": [[-0.5, 3, 0], [0.5, 3, 0], [0.5, 3, 1], [-0.5, 3, 1]],
            "faces": [[0, 1, 2], [0, 2, 3]],
            "emission": [5, 4, 3],
            "face_normals": True,
        },
    },
}


#: Far enough away for its size to be sampled by area.
FAR = {**ROOM["shapes"]["panel"], "transform": [{"scale": 0.4}, *ROOM["shapes"]["panel"]["transform"]]}


def only(*names: str) -> dict:
    return {**ROOM, "shapes": {name: shape for name, shape in ROOM["shapes"].items() if name in names}}


def checked(scene, names: tuple[str, ...], **wish) -> bool:
    """gradcheck in float64, the backward pass drawing the samples of the forward pass."""
    leaves = tuple(scene.params[name].double().requires_grad_() for name in names)

    def picture(*tensors: torch.Tensor) -> torch.Tensor:
        given = dict(zip(names, tensors, strict=True))
        return torchpt.render(scene, params=given, spp=2, seed=3, seed_grad=3, dtype=torch.float64, **wish)

    return torch.autograd.gradcheck(picture, leaves, eps=1e-5, atol=1e-6, fast_mode=True)


def test_gradcheck_reflectance_and_emission():
    scene = torchpt.load(only("floor", "wall", "lamp"), "cpu")
    assert checked(scene, ("materials.grey.reflectance", "shapes.lamp.emission"))


@pytest.mark.parametrize("name", ["shapes.floor.vertices", "shapes.panel.to_world", "camera.to_world"])
def test_gradcheck_geometry(name):
    # Light sampling alone: points on lights are fixed on their surface, so the estimator itself is differentiated. (Of
    # several emitters the choice would follow their areas, which is not: hence the one panel. Nor is the choice of points by
    # solid angle, which is held as directions are: hence it is far away.)
    scene = torchpt.load({**ROOM, "shapes": {**only("floor")["shapes"], "panel": FAR}}, "cpu")
    assert checked(scene, (name,), integrator={"type": "direct", "strategy": "light"})


@pytest.mark.parametrize("kind", few(["sphere", "cylinder", "cone"], 1))
def test_gradcheck_quadrics(kind):
    # As a light over the floor, and as what the camera sees of it; wide open, so that nothing is hidden or seen edge-on.
    shape = {"type": kind, "emission": [5, 4, 3], "flip_normals": True}
    shape |= {"capped": False} if kind != "sphere" else {}
    place = [
        {"scale": [4, 5, 6]},
        {"rotate": {"axis": [1, 0, 0], "angle": 10}},
        {"translate": [0.2, 3 if kind == "cone" else 0, 0.1]},
    ]
    scene = torchpt.load({**ROOM, "shapes": {**only("floor")["shapes"], "bowl": {**shape, "transform": place}}}, "cpu")
    assert checked(scene, ("shapes.bowl.to_world",), integrator={"type": "direct", "strategy": "light"})


def test_gradcheck_smooth_normals():
    bent = {
        **ROOM["shapes"]["floor"],
        "face_normals": False,
        "vertices": [[-2, 0, -2], [2, 0.2, -2], [2, 0, 2], [-2, 0.1, 2]],
    }
    scene = torchpt.load({**ROOM, "shapes": {"floor": bent, "panel": FAR}}, "cpu")
    # Without edges: horizons of such faces are no derivative of these samples.
    wish: dict = {"integrator": {"type": "direct", "strategy": "light"}}
    with pytest.warns(torchpt.EdgeWarning):
        assert checked(scene, ("shapes.floor.vertices",), edges=False, **wish)
    leaf = scene.params["shapes.floor.vertices"].clone().requires_grad_()
    torchpt.render(scene, params={"shapes.floor.vertices": leaf}, spp=2, edge_spp=64, **wish).mean().backward()
    assert leaf.grad is not None and leaf.grad.isfinite().all() and leaf.grad.any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "name", "entry", "step"),
    [
        ("lamp", "shapes.floor.vertices", (0, 1), 0.02),
        ("panel", "shapes.floor.vertices", (0, 1), 0.02),
        ("lamp", "shapes.wall.vertices", (2, 2), 0.05),
        ("lamp", "shapes.lamp.vertices", (1, 1), 0.01),
        ("lamp", "shapes.lamp.vertices", (1, 0), 0.05),
        ("ball", "shapes.ball.to_world", (1, 3), 0.05),
        ("panel", "shapes.panel.to_world", (1, 3), 0.05),
        ("ball", "camera.to_world", (1, 3), 0.05),
    ],
)
def test_geometry_agrees_with_finite_differences_in_the_mean(light, name, entry, step):
    # One light, as a second one would hide part of the first: no silhouette moves, in view or before a light, so the interior
    # term is the whole derivative: of light and BSDF sampling together.
    scene = torchpt.load(only("floor", "wall", light), "cpu")
    weight = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(1))

    def loss(value: torch.Tensor, spp: int, seed: int) -> torch.Tensor:
        return (torchpt.render(scene, params={name: value}, spp=spp, seed=seed, dtype=torch.float64) * weight).mean()

    base, shift = scene.params[name].double(), torch.zeros_like(scene.params[name]).double()
    shift[entry] = step
    exact, difference = [], []
    for seed in range(4):
        leaf = base.clone().requires_grad_()
        loss(leaf, 1024, seed).backward()
        assert leaf.grad is not None
        exact.append(leaf.grad[entry])
        difference.append((loss(base + shift, 4096, seed) - loss(base - shift, 4096, seed)) / (2 * step))
    a, b = torch.stack(exact), torch.stack(difference)
    error = float((a.var() / 4 + b.var() / 4).sqrt())
    assert abs(float(a.mean() - b.mean())) < 4.5 * error + 5e-3 * abs(
        float(b.mean())
    )  # eight draws, 4.5 SE of few seeds


def test_geometry_gradients_warn_of_edges():
    scene = torchpt.load(only("floor", "panel"), "cpu")
    leaf = scene.params["shapes.floor.vertices"].clone().requires_grad_()
    with pytest.warns(torchpt.EdgeWarning, match="silhouettes"):
        torchpt.render(scene, params={"shapes.floor.vertices": leaf}, spp=1, edges=False)


def test_backward_draws_its_own_samples():
    scene = torchpt.load(only("floor", "lamp"), "cpu")
    rgb = scene.params["materials.grey.reflectance"].clone().requires_grad_()
    grads = []
    wishes: list[dict[str, Any]] = [{}, {}, {"seed_grad": 77}, {"seed_grad": 0}, {"spp_grad": 64}]
    for wish in wishes:
        image = torchpt.render(scene, params={"materials.grey.reflectance": rgb}, spp=4, seed=0, **wish)
        grads.append(torch.autograd.grad(image.sum(), rgb)[0])
    assert torch.equal(grads[0], grads[1])
    for other in grads[2:]:
        assert not torch.equal(grads[0], other)
        assert torch.allclose(grads[0], other, rtol=0.3)


def test_gradient_does_not_depend_on_chunks():
    scene = torchpt.load(only("floor", "wall", "lamp"), "cpu")
    rgb = scene.params["materials.grey.reflectance"].clone().requires_grad_()
    grads = []
    for lanes in (None, 62):
        with few_lanes(lanes):
            image = torchpt.render(scene, params={"materials.grey.reflectance": rgb}, spp=8)
            grads.append(torch.autograd.grad(image.sum(), rgb)[0])
    assert torch.allclose(*grads, rtol=1e-4)


@pytest.mark.slow
def test_recovers_an_albedo_by_gradient_descent():
    scene = torchpt.load(only("floor", "wall", "lamp"), "cpu")
    target = torchpt.render(scene, spp=64, seed=9)
    rgb = torch.tensor([0.3, 0.3, 0.3], requires_grad=True)
    optimizer = torch.optim.Adam([rgb], lr=0.05)
    for step in range(60):
        optimizer.zero_grad()
        image = torchpt.render(scene, params={"materials.grey.reflectance": rgb}, spp=4, seed=step)
        ((image - target) ** 2).mean().backward()
        optimizer.step()
    assert torch.allclose(rgb.detach(), torch.tensor([0.8, 0.7, 0.6]), atol=0.06)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ({"materials.gray.reflectance": torch.ones(3)}, "materials.grey.reflectance"),
        ({"materials.grey.reflectance": torch.ones(4)}, r"shape \(3,\)"),
        ({"materials.grey.reflectance": [1, 1]}, r"shape \(3,\)"),
    ],
)
def test_wrong_parameters_are_named(params, words):
    with pytest.raises(SceneError, match=words) as caught:
        torchpt.render(torchpt.load(only("floor"), "cpu"), params=params, spp=1)
    assert "\n" not in str(caught.value)


def test_the_backward_pass_keeps_to_its_threads(monkeypatch):
    scene, seen = torchpt.load("cornell_box", "cpu"), []
    before, plain = torch.get_num_threads(), torch.autograd.grad
    monkeypatch.setattr(
        torch.autograd, "grad", lambda *a, **k: (seen.append(torch.get_num_threads()), plain(*a, **k))[1]
    )
    red = scene.params["materials.red.reflectance"].clone().requires_grad_()
    torch.set_num_threads(2)
    try:
        picture = torchpt.render(
            scene, params={"materials.red.reflectance": red}, spp=1, threads=1, film={"width": 8, "height": 8}
        )
        picture.sum().backward()
        assert seen and set(seen) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
