"""No ray escapes a closed mesh, however large the mesh, however far from the origin, however well aimed at its edges."""

import os
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from accel_reference import sphere_mesh, triangles
from few import few

from torchpt.scene.meshes import load_mesh
from torchpt.search import build
from torchpt.search.tree import WideBvh

HERE = (0.0, 0.0, 0.0)
FAR = (148376.0, 1234.0, -223423.0)
BLOCK = 250_000


def cube(cells):
    """A closed cube of side 2 with ``12 cells^2`` triangles, vertices shared: vertices, faces."""
    k = np.linspace(-1, 1, cells + 1)
    a, b = (x.reshape(-1) for x in np.meshgrid(k, k, indexing="ij"))
    sides, faces = [], []
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    corner = (i * (cells + 1) + j).reshape(-1)
    quad = np.stack([corner, corner + 1, corner + cells + 2, corner + cells + 1], 1)
    for axis in range(3):
        for side in (-1.0, 1.0):
            faces.append(quad + len(sides) * len(a))
            sides.append(np.roll(np.stack([np.full_like(a, side), a, b], 1), axis, axis=1))
    f = np.concatenate(faces)
    return np.concatenate(sides).astype(np.float32), np.concatenate([f[:, [0, 1, 2]], f[:, [0, 2, 3]]])


def bunny():
    """The scanned bunny at size 12, the origin well inside, its holes closed by fans: vertices, faces."""
    folder = os.environ.get("TORCHPT_ASSETS")
    if not folder:
        pytest.skip("the bunny lies in $TORCHPT_ASSETS")
    (mesh,) = load_mesh(Path(folder) / "bunny.ply")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    pairs, counts = np.unique(edges, axis=0, return_counts=True)
    rim = pairs[counts == 1]
    hole = np.arange(len(vertices))  # of each vertex on a rim: the least vertex of its hole
    while (hole[rim[:, 0]] != hole[rim[:, 1]]).any():
        np.minimum.at(hole, rim[:, 0], hole[rim[:, 1]])
        np.minimum.at(hole, rim[:, 1], hole[rim[:, 0]])
    for k in np.unique(hole[rim[:, 0]]):
        own = rim[hole[rim[:, 0]] == k]
        faces = np.concatenate([faces, np.column_stack([own, np.full(len(own), len(vertices))])])
        vertices = np.concatenate([vertices, vertices[np.unique(own)].mean(0, keepdims=True)])
    size = np.ptp(vertices, axis=0).max()
    return ((vertices - vertices.mean(0)) * (12 / size)).astype(np.float32), faces


MESHES = {"sphere": lambda: sphere_mesh(144), "cube": lambda: cube(40), "bunny": bunny}


def directions(rng, vertices, faces, o, n):
    """Half of them at random, a quarter at vertices, a quarter at places on edges; sorted, so that packets take part."""
    f = faces[rng.integers(len(faces), size=n // 2)]
    w = np.where(np.arange(n // 2) % 2, rng.random(n // 2), 0.0)[:, None].astype(np.float32)
    aims = (vertices[f[:, 0]] * (1 - w) + vertices[f[:, 1]] * w).T - o[:, : n // 2]
    d = np.concatenate([aims, rng.normal(size=(3, n - n // 2)).astype(np.float32)], 1)
    order = np.lexsort((*(np.signbit(d[c]) for c in range(3)), np.abs(d).argmax(0)))
    return np.ascontiguousarray(o[:, order]), np.ascontiguousarray(d[:, order].astype(np.float32))


def escapes(name, place, count):
    """Return how many of ``count`` rays from inside miss, by either search."""
    vertices, faces = MESHES[name]()
    scale = 1000.0 if any(place) else 1.0  # float32 is 1/64 apart there: no triangle may collapse
    vertices = (vertices * scale + np.array(place)).astype(np.float32)
    accel = WideBvh(triangles(vertices, faces), 1)
    block = min(BLOCK, count)
    t, u, v = np.empty((3, block), np.float32)
    prim, out = np.empty((2, block), np.int32)
    t_max = np.full(block, np.inf, np.float32)
    nearest = anything = 0
    for seed in range(-(-count // block)):
        rng = np.random.default_rng(seed)
        o = (rng.normal(size=(3, block)) * 0.15 * scale + np.array(place)[:, None]).astype(np.float32)
        o, d = directions(rng, vertices, faces, o, block)
        accel.nearest(o, d, t_max, block, t, prim, u, v)
        accel.blocked(o, d, t_max, block, out)
        nearest, anything = nearest + int((prim < 0).sum()), anything + int((out == 0).sum())
        assert np.isfinite(t[prim >= 0]).all() and (u + v <= 1 + 1e-6).all() and min(u.min(), v.min()) >= 0
    return nearest, anything


@pytest.mark.parametrize(("name", "place"), few(product(MESHES, [HERE, FAR]), 2))
def test_no_ray_escapes(name, place):
    assert escapes(name, place, 100_000) == (0, 0)


@pytest.mark.long
@pytest.mark.parametrize("place", [HERE, FAR])
@pytest.mark.parametrize("name", MESHES)
def test_none_of_a_thousand_million_rays_escapes(name, place):
    """In all: six cases, and each ray is searched twice, for what is nearest and for anything."""
    assert escapes(name, place, 84_000_000) == (0, 0)


@pytest.mark.parametrize("count", [4_000, pytest.param(1_000_000, marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", ["torch", "brute"])
@pytest.mark.parametrize(("name", "place"), [("sphere", HERE), ("sphere", FAR), ("cube", HERE), ("cube", FAR)])
def test_no_ray_escapes_the_other_searches(kind, name, place, count):
    if kind == "brute" and any(place):
        pytest.skip("its rows are too coarse far from the origin: scenes are moved, and the trees take what cannot be")
    vertices, faces = sphere_mesh(8) if name == "sphere" else cube(3)
    scale = 1000.0 if any(place) else 1.0
    vertices = (vertices * scale + np.array(place)).astype(np.float32)
    accel = build(triangles(vertices, faces), kind)
    n = min(count, 20_000)
    for seed in range(count // n):
        rng = np.random.default_rng(seed)
        o = (rng.normal(size=(3, n)) * 0.15 * scale + np.array(place)[:, None]).astype(np.float32)
        o, d = (torch.from_numpy(x) for x in directions(rng, vertices, faces, o, n))
        far = torch.full((n,), float("inf"))
        assert (accel.intersect(o, d, far)[1] >= 0).all()
        assert accel.occluded(o, d, far).all()


@pytest.mark.parametrize("kind", ["numba", "torch"])
def test_triangles_that_are_seen_edge_on_make_no_hole(kind):
    """Rays that each left by a triangle whose plane, as float32 has it, lay behind them."""
    vertices, faces = sphere_mesh(144)
    accel = build(triangles((vertices * 1000 + np.array(FAR)).astype(np.float32), faces), kind)
    o = [[148262.578125, 1372.1507568359375, -223656.578125], [148247.734375, 1461.7618408203125, -223442.78125]]
    d = [[103.84375, 865.6185302734375, 124.0625], [90.328125, -1231.2860107421875, 41.6875]]
    found = accel.intersect(
        torch.tensor(o).T.contiguous(), torch.tensor(d).T.contiguous(), torch.full((2,), float("inf"))
    )
    assert (found[1] >= 0).all() and (found[0] > 0.9).all()


def test_a_hole_is_seen():
    """The count above is not zero by construction."""
    vertices, faces = sphere_mesh(20)
    accel = WideBvh(triangles(vertices, faces[:-1]), 1)
    rng = np.random.default_rng(0)
    o, d = directions(rng, vertices, faces, np.zeros((3, 100_000), np.float32), 100_000)
    out = np.empty(100_000, np.int32)
    accel.blocked(o, d, np.full(100_000, np.inf, np.float32), 100_000, out)
    assert 0 < (out == 0).sum() < 1000
