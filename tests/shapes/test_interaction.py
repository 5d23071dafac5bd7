"""Surface points: on the surface, on the right side of it, with the normals of the shape."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torchpt
from torchpt.math.sampling import uniform_sphere
from torchpt.math.vectors import dot
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit

G = torch.Generator().manual_seed(3)
N = 20_000
SPIN = {"rotate": {"axis": [1, -1, 2], "angle": 77}}


def load(shape: dict[str, Any], offset: float = 0.0) -> torchpt.Scene:
    shape = {**shape, "transform": [*shape.get("transform", []), {"translate": [offset, 0, 0]}]}
    far = {"type": "sphere", "radius": 1e-3, "center": [-offset, 0, 0]}  # keeps the scene where it is
    shapes = {"shape": shape} if offset == 0 else {"shape": shape, "far": far}
    return torchpt.load({"camera": {"origin": [0, 0, 9], "target": [0, 0, 0]}, "shapes": shapes}, device="cpu")


SHAPES: dict[str, dict[str, Any]] = {
    "mesh": {
        "type": "mesh",
        "vertices": [[-1, -1, 0.2], [1, -1, 0], [0, 1, 0.1], [0.1, 0.2, 1]],
        "faces": [[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]],
    },
    "rectangle": {"type": "rectangle", "transform": [SPIN]},
    "disk": {"type": "disk", "transform": [{"scale": [1, 0.6, 1]}, SPIN]},
    "sphere": {"type": "sphere", "radius": 0.8, "center": [0.1, 0.1, 0]},
    "cube": {"type": "cube", "transform": [{"scale": 0.5}, SPIN]},
}


def hits(scene: torchpt.Scene, centre: float, dtype: torch.dtype = torch.float32):
    """Rays toward the shape from all around, those that hit, and their surface points."""
    o = 3 * uniform_sphere(torch.rand(2, N, generator=G)) + torch.tensor([[centre], [0.0], [0.0]])
    d = torch.tensor([[centre], [0.0], [0.0]]) + 0.7 * torch.randn(3, N, generator=G) - o
    d = d / d.norm(dim=0)
    t, prim, u, v = scene.accel("auto", None).intersect(o, d, torch.full((N,), torch.inf))
    world, _ = scene.world(dtype)
    keep = prim >= 0
    assert keep.sum() > 500
    o, d = o[:, keep].to(dtype), d[:, keep].to(dtype)
    found = Hit(t[keep].to(dtype), prim[keep].long(), u[keep].to(dtype), v[keep].to(dtype))
    return world, o, d, found


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", list(SHAPES))
def test_points_lie_on_the_ray_and_normals_are_unit(name, dtype):
    world, o, d, found = hits(load(SHAPES[name]), 0.0, dtype)
    at = interact(world, o, d, found)
    away = (at.p - (o + d * found.t)).norm(dim=0) * dot(d, at.ng).abs()  # glancing rays slide along the surface
    assert away.quantile(0.999) < 2e-6
    assert away.max() < 1e-3  # on silhouettes, where the watertight search takes an edge to its triangle
    for n in (at.ng, at.ns):
        assert (n.norm(dim=0) - 1).abs().max() < 1e-6
    assert (dot(at.ng, at.ns) > 0).all()
    slid = interact(world, o, d, found, follow_ray=True)
    assert ((slid.p - at.p).norm(dim=0) * dot(d, at.ng).abs()).quantile(0.999) < 2e-6


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("name", ["cube", "sphere", "mesh"])
def test_normals_point_out_of_solids_or_in_where_flipped(name, flip):
    world, o, d, found = hits(load({**SHAPES[name], "flip_normals": flip}), 0.0)
    at = interact(world, o, d, found)
    outside = dot(d, at.ng) < 0  # rays start outside
    assert (outside ^ flip).float().mean() > 0.999  # all but silhouettes
    if name == "sphere":
        centre = torch.tensor([[0.1], [0.1], [0.0]])
        outward = (at.p - centre) / 0.8
        torch.testing.assert_close(at.ng, -outward if flip else outward, rtol=0, atol=2e-6)


@pytest.mark.parametrize("offset", [0.0, 1000.0])
@pytest.mark.parametrize("name", list(SHAPES))
def test_rays_that_leave_do_not_meet_their_own_surface(name, offset):
    """From either side, at any angle, near the origin and 1,000 sizes away from it."""
    scene = load(SHAPES[name], offset)
    world, o, d, found = hits(scene, offset)
    at = interact(world, o, d, found)
    convex = name != "mesh"
    for sign in (1.0, -1.0):
        w = uniform_sphere(torch.rand(2, at.p.shape[1], generator=G))
        w[:, ::3] = w[:, ::3] - 0.9999 * dot(w, at.ng)[::3] * at.ng[:, ::3]  # a third of them glance
        w = w / w.norm(dim=0)
        w = w * torch.sign(dot(w, at.ng)) * sign
        start = offset_origin(world, at, w)
        assert (dot(start - at.p, at.ng) * sign > 0).all()
        t, prim, _, _ = scene.accel("auto", None).intersect(start, w, torch.full((start.shape[1],), torch.inf))
        if name == "sphere" and sign < 0:
            # From inside it meets the far side, never the near one: the chord is 2 r cos.
            chord = 1.6 * dot(w, at.ng).abs()
            assert (t > 0.5 * chord - 0.02 * (1 + offset)).all()
        elif convex or sign > 0:
            assert ((prim != at.prim) | (t > 20)).all()  # exactly within the plane, t has no meaning


def test_the_offset_knows_no_world_unit():
    scales = []
    for scale in (1e-4, 1.0, 1e6):
        shape = {**SHAPES["rectangle"], "transform": [SPIN, {"translate": [0, 0, 1]}, {"scale": scale}]}
        world, _ = load(shape).world(torch.float32)
        scales.append(float(world.geometry.bound[0]) / scale)
    assert max(scales) == pytest.approx(min(scales), rel=1e-4)
