"""Instances in scenes: the same picture as explicit copies, their own materials, their gradients, and what is refused."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few

import torchpt
from torchpt.core.errors import SceneError
from torchpt.gradients import parameters
from torchpt.math.sampling import uniform_sphere
from torchpt.math.vectors import dot
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene.meshes import smooth_normals

BUNNY = Path(os.environ.get("TORCHPT_ASSETS", "")) / "bunny.ply"
CAMERA = {"origin": [0, 2, 5], "target": [0, 0.4, 0], "fov": 45}
STAR = {
    "type": "mesh",
    "vertices": [[-1, -1, 0.2], [1, -1, 0], [0, 1, 0.1], [0.1, 0.2, 1]],
    "faces": [[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]],
}
STRETCH = [1.0, 0.5, 2.0]
POSES = [
    [{"scale": 0.6}, {"rotate": {"axis": [0, 1, 0], "angle": 70}}, {"translate": [-1.4, 0.5, 0]}],
    [{"scale": [-0.5, 0.9, 0.7]}, {"rotate": {"axis": [1, 2, 0], "angle": 30}}, {"translate": [0.2, 0.6, -0.5]}],
    [{"scale": [0.4, 0.4, 0.8]}, {"rotate": {"axis": [1, 0, 1], "angle": 200}}, {"translate": [1.5, 0.5, 0.3]}],
]


def described(explicit: bool, copies: dict[str, Any] | None = None, **mesh: Any) -> dict[str, Any]:
    """A mesh and three more of it, as instances or in full; these may have something of their own."""
    star = {**STAR, **mesh}
    shapes: dict[str, Any] = {
        "star": {**star, "material": "own", "transform": [{"scale": STRETCH}, {"translate": [0, 0.5, -2.5]}]},
        "floor": {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 4}]},
    }
    for k, pose in enumerate(POSES):
        own = {"transform": pose, "material": {"type": "diffuse", "reflectance": [0.8, 0.2 * k, 0.4]}}
        shapes[f"copy{k}"] = (
            {**star, **(copies or {}), **own} if explicit else {"type": "instance", "of": "star", **own}
        )
    return {
        "camera": CAMERA,
        "film": {"width": 32, "height": 24, "filter": "box"},
        "integrator": {"max_depth": 4},
        "render": {"threads": 1, "compile": "off"},
        "materials": {"own": {"type": "diffuse", "reflectance": 0.7}},
        "shapes": shapes,
        "lights": {"sky": {"type": "constant", "radiance": [0.5, 0.7, 1]}},
    }


def as_it_lies() -> list[list[float]]:
    """The smooth normals that are computed of the mesh where it lies, in its own space."""
    stretch = np.diag(STRETCH)
    normals = smooth_normals(np.array(STAR["vertices"]) @ stretch, np.array(STAR["faces"])) @ stretch
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).tolist()


#: What the mesh has, and what the explicit copies have in its place.
SHADED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "flat": ({"face_normals": True}, {}),
    "given": ({"normals": [[-0.6, -0.6, 0.5], [0.7, -0.5, 0.5], [0, 0.9, 0.4], [0.1, 0.1, 1]]}, {}),
    # Under an uneven stretch they are not those that a copy in full would compute.
    "computed": ({}, {"normals": as_it_lies()}),
}


@pytest.mark.parametrize("accel", ["torch", "numba"])
@pytest.mark.parametrize("shaded", few(SHADED, 2))
def test_the_picture_is_that_of_explicit_copies(shaded, accel):
    mesh, copies = SHADED[shaded]
    scenes = [torchpt.load(described(False, **mesh), "cpu"), torchpt.load(described(True, copies, **mesh), "cpu")]
    # The same numbers meet the same surfaces, by the same search.
    ours, theirs = (torchpt.render(scene, spp=16, seed=5, accel=accel) for scene in scenes)
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)
    assert ours.std() > 0.05


def test_ids_and_albedo_are_the_copies_own():
    names = {}
    for explicit in (False, True):
        scene = torchpt.load(described(explicit, face_normals=True), "cpu")
        for aov in ("object_id", "albedo", "normal"):
            wish = {"width": 64, "height": 48, "filter": "box", "aovs": [aov]}
            names[explicit, aov] = torchpt.render(scene, spp=1, seed=1, integrator="aov", film=wish)
    for aov in ("object_id", "albedo", "normal"):
        apart = (names[False, aov] - names[True, aov]).abs().amax(-1)
        assert (apart < 1e-4).float().mean() > 0.998, aov
    assert len(names[False, "object_id"].unique()) == 6


def test_rays_leave_copies():
    scene = torchpt.load(described(False, face_normals=True), "cpu")
    world, _ = scene.world(torch.float32)
    g = torch.Generator().manual_seed(3)
    n = 40_000
    o = 4 * uniform_sphere(torch.rand(2, n, generator=g))
    d = 1.5 * torch.randn(3, n, generator=g) + torch.tensor([[0.0], [0.5], [0.0]]) - o
    d = d / d.norm(dim=0)
    reach = torch.full((n,), torch.inf)
    accel = scene.accel("numba", None)
    t, prim, u, v = accel.intersect(o, d, reach)
    copied = prim >= len(world.geometry.bound)
    assert copied.sum() > 2000
    o, d = o[:, copied], d[:, copied]
    at = interact(world, o, d, Hit(t[copied], prim[copied].long(), u[copied], v[copied]))
    away = (at.p - (o + d * t[copied])).norm(dim=0) * dot(d, at.ng).abs()
    assert away.quantile(0.999) < 3e-6
    for sign in (1.0, -1.0):
        w = uniform_sphere(torch.rand(2, at.p.shape[1], generator=g))
        w[:, ::3] = w[:, ::3] - 0.9999 * dot(w, at.ng)[::3] * at.ng[:, ::3]  # a third of them glance
        w = w / w.norm(dim=0) * torch.sign(dot(w, at.ng)) * sign
        start = offset_origin(world, at, w)
        again, other, _, _ = accel.intersect(start, w, torch.full((start.shape[1],), torch.inf))
        assert ((other != prim[copied]) | (again > 20)).all()
    # All but those that start within the open solid come from its outside.
    assert (dot(d, at.ng) < 0).float().mean() > 0.95


def test_gradients_of_a_pose_and_of_the_shared_vertices(monkeypatch: pytest.MonkeyPatch):
    """With light sampling alone both scenes are the same function of the pose and of what they share."""
    near = torch.ones(1, dtype=torch.float64)  # the boxes around what moves differ, and with them the frame
    monkeypatch.setattr(parameters, "near_of", lambda *_: near)
    found = []
    for explicit in (False, True):
        scene = torchpt.load(described(explicit, face_normals=True), "cpu")
        pose = scene.params["shapes.copy1.to_world"].double().requires_grad_()
        points = scene.params["shapes.star.vertices"].double().requires_grad_()
        names = ["shapes.star.vertices"] + ([f"shapes.copy{k}.vertices" for k in range(3)] if explicit else [])
        given = {"shapes.copy1.to_world": pose} | dict.fromkeys(names, points)
        with pytest.warns(torchpt.EdgeWarning):
            wish: dict[str, Any] = {"seed": 2, "seed_grad": 2, "dtype": torch.float64, "accel": "torch", "edges": False}
            image = torchpt.render(scene, params=given, spp=4, **wish)
            image.square().mean().backward()
        found.append((pose.grad, points.grad))
    for ours, theirs in zip(*found, strict=True):
        assert ours is not None and theirs is not None and theirs.norm() > 1e-4
        assert (ours - theirs).norm() < 1e-3 * theirs.norm()


BAD: dict[str, tuple[dict[str, Any], str, str]] = {
    "of nothing": ({"of": "sun"}, "shapes.i.of", "star"),
    "of a sphere": ({"of": "ball"}, "shapes.i.of", "star"),
    "of itself": ({"of": "i"}, "shapes.i.of", "star"),
    "of a number": ({"of": 3}, "shapes.i.of", "name of a mesh"),
    "of missing": ({}, "shapes.i.of", "of"),
    "shining": ({"of": "star", "emission": [1, 1, 1]}, "shapes.i.emission", "no emission"),
    "of a shining material": (
        {"of": "star", "material": {"type": "diffuse", "emission": [1, 1, 1]}},
        "shapes.i.material",
        "does not emit",
    ),
}


@pytest.mark.parametrize("name", list(BAD))
def test_bad_instances_are_one_line(name):
    own, key, part = BAD[name]
    shapes = {"star": STAR, "ball": {"type": "sphere"}, "i": {"type": "instance", **own}}
    with pytest.raises(SceneError) as caught:
        torchpt.load({"camera": CAMERA, "shapes": shapes}, "cpu")
    assert key in str(caught.value) and part in str(caught.value) and "\n" not in str(caught.value)


def test_more_primitives_than_ids_are_refused(monkeypatch):
    from torchpt.scene.world import primitives

    monkeypatch.setattr(primitives, "MOST_PRIMITIVES", 16)
    with pytest.raises(SceneError, match="primitives"):
        torchpt.load(described(False), "cpu").world(torch.float32)


def test_info_counts_instances():
    scene = torchpt.load(described(False), "cpu")
    from torchpt.scene.formats.description import settings

    told = scene.info(settings(scene.description))
    assert told["scene"]["instances"] == 3 and told["built"]["accel"]["instances"] == 3
    assert told["shapes"]["copy1"] == {"kind": "instance", "of": "star", "material": "shapes.copy1.material"}
    assert "instances" not in told["left_out"]


SCRIPT = """
import torchpt
turn = lambda k: {{"rotate": {{"axis": [0, 1, 0], "angle": k * 37}}}}
shapes = {{"bunny": {{"type": "mesh", "path": {path!r}}}}}
for k in range(999):
    place = {{"translate": [0.2 * (k % 32) - 3.1, 0, -0.2 * (k // 32)]}}
    shapes[f"b{{k}}"] = {{"type": "instance", "of": "bunny", "transform": [turn(k), place]}}
camera = {{"origin": [0, 1.5, 2], "target": [0, 0, -2]}}
sky = {{"sky": {{"type": "constant"}}}}
scene = torchpt.load({{"camera": camera, "shapes": shapes, "lights": sky, "film": {{"width": 256, "height": 160}}}}, "cpu")
image = torchpt.render(scene, spp=1, threads=1, compile="off")
assert scene.accel("auto", 1).describe()["primitives"] == 1000 * 69451
assert 0.1 < float((image < 0.9).double().mean())
# ru_maxrss would be the parent's where that is larger
print(next(int(line.split()[1]) * 1024 for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


@pytest.mark.slow
@pytest.mark.skipif(not BUNNY.is_file(), reason="$TORCHPT_ASSETS/bunny.ply is not there")
@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is counted in other units there")
def test_a_thousand_bunnies_fit():
    ran = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(path=str(BUNNY))], capture_output=True, text=True, timeout=600, check=True
    )
    assert int(ran.stdout.split()[-1]) < 4e9
