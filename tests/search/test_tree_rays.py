"""The search of trees inside kernels: one ray at a time it gives the bits of the CPU's search by packets."""

import numpy as np
import pytest
import torch
from accel_reference import soup, sphere_mesh, triangles
from few import few
from ray_kernels import searched_trees, searches
from ray_sets import KINDS, make_rays
from search_scenes import copied, maps, with_instances, with_quadrics
from test_bits import equal_bits, found

import torchpt
from torchpt.compiler.form import SCALAR
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import build
from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_rays import TreeSearch

SCENES = {
    "mesh": lambda: triangles(*sphere_mesh(40)),
    "rectangles": lambda: soup(4, (0, 90, 0, 0)),
    "disks and spheres": lambda: soup(5, (0, 0, 60, 60)),
    "triangles and rectangles": lambda: soup(6, (300, 5, 0, 0)),
    "quadrics and all others": with_quadrics,
    "one": lambda: soup(4, (1, 0, 0, 0)),
    "none": lambda: soup(4, (0, 0, 0, 0)),
}


def search_of(accel, functions=None):
    """Return ``t, prim, u, v`` and ``blocked`` of rays, arrays of numpy, by a kernel of single lanes."""
    trees = searched_trees(accel)
    run = searches(functions or trees.functions, trees.words.ctypes.data, SCALAR)
    # `trees`: their tables live as long as the function
    return lambda *rays, trees=trees: [x.numpy() for x in run(*map(torch.from_numpy, rays))]


def check(accel, search, rays):
    """Compare; return the share of rays that hit."""
    wanted, (*hits, blocked) = found(accel, *rays), search(*rays)
    assert equal_bits(wanted, hits)
    assert np.array_equal(blocked, wanted[1] >= 0)
    return blocked.mean()


@pytest.mark.parametrize("name", SCENES)
def test_bits_are_those_of_packets(name):
    """Random rays; rays at vertices and edges; rays along axes, without length, not finite, or that end early."""
    g = SCENES[name]()
    accel = WideBvh(g, 1)
    search = search_of(accel)
    for kind in KINDS if g.size else KINDS[:1]:
        rays = make_rays(kind, g if g.size else SCENES["one"](), 10_000, 1)
        hit = check(accel, search, rays)
        assert 0.1 < hit < 1.0 or not g.size or kind == "aimed"


def test_rays_of_paths():
    """Four bounces between a bumpy sphere and one inside of it: rays from surfaces, and shadow rays that end on them."""
    vertices, faces = sphere_mesh(40)
    g = triangles(
        np.concatenate([vertices, 0.3 * vertices[:, [1, 2, 0]]]), np.concatenate([faces, faces + len(vertices)])
    )
    accel = WideBvh(g, 1)
    search, rng = search_of(accel), np.random.default_rng(7)
    n = 4000
    o, d, t_max = (
        np.full((3, n), 0.5, np.float32),
        rng.normal(size=(3, n)).astype(np.float32),
        np.full(n, np.inf, np.float32),
    )
    for _ in range(4):
        assert check(accel, search, (o, d, t_max)) > 0.3
        t = found(accel, o, d, t_max)[0]
        check(accel, search, (o, d, t))  # a ray that ends where it would hit
        check(accel, search, (o, d, np.nextafter(t, np.float32(np.inf))))
        o = (o + np.where(np.isfinite(t), t, 0) * d).astype(np.float32)
        d = rng.normal(size=(3, n)).astype(np.float32)


def test_kinds_that_the_scene_lacks_change_nothing():
    g = soup(6, (300, 5, 0, 0))
    accel = WideBvh(g, 1)
    rays = make_rays("aimed", g, 5000, 2)
    every = TreeSearch(("triangle", "rectangle", "disk", "sphere", "quadric"), accel.depth)
    assert equal_bits(search_of(accel)(*rays)[:4], search_of(accel, every)(*rays)[:4])


def test_refit():
    """A tree that was refitted is searched as it is."""
    g = soup(8, (500, 0, 0, 0), size=0.1)
    before = WideBvh(g, 1)
    moved = Geometry(g.p0 + 0.01, g.p1, g.p2, g.counts)
    accel = before.refit(moved)
    assert accel is not None
    check(accel, search_of(accel), make_rays("aimed", moved, 5000, 3))


def with_two_at_a_place():
    """A mesh, an instance of it at the same place, and two at another one."""
    same, moved = np.eye(3, 4), np.eye(3, 4)
    moved[0, 3] = 1.5
    g = triangles(*sphere_mesh(10))
    return copied(g, [(0, g.size)], [same, moved, moved])


def with_flat_meshes():
    """Instances of a mesh, of triangles without area, and of no triangle."""
    g = soup(9, (40, 0, 3, 0))
    p = [torch.cat([a[:, :20], b[:, :20], a[:, 20:]], 1) for a, b in zip((g.p0, g.p1, g.p2), [g.p0] * 3, strict=True)]
    flat = Geometry(p[0], p[1], p[2], (60, *g.counts[1:]))
    return copied(flat, [(0, 20), (20, 20), (40, 0)], maps(2, 9))


#: Geometries with instances, and what rays are aimed at.
INSTANCES = {
    "two at a place": lambda: (with_two_at_a_place(),) * 2,
    "two meshes": lambda: with_instances(23),
    "quadrics and all others": lambda: (copied(with_quadrics(), [(0, 40), (40, 20)], maps(4, 30)),) * 2,
    "a hundred": lambda: with_instances(100, 5),
    "flat": lambda: (with_flat_meshes(),) * 2,
    "only flat": lambda: (copied(soup(4, (9, 2, 0, 0)), [(0, 0)], maps(1, 2)),) * 2,
}


@pytest.mark.parametrize("name", few(INSTANCES, 3))
def test_bits_of_instances(name):
    """Random rays; rays at vertices and edges of instances; rays along axes, not finite, or that end early."""
    g, aim = INSTANCES[name]()
    accel = InstancedWideBvh(g, 1)
    search = search_of(accel)
    for kind in KINDS:
        rays = make_rays(kind, aim, 4000, 1)
        assert check(accel, search, rays) > 0.01
        t, prim, *_ = found(accel, *rays)
        assert (prim >= g.size).any() == (name != "only flat")
        for end in (t, np.nextafter(t, np.float32(np.inf))):  # rays that end where they would hit
            check(accel, search, (*rays[:2], end))


def test_instances_that_moved():
    g, _ = with_instances(23)
    before = build(g, "numba", 1)
    assert g.copies is not None
    copies = g.copies.clone()
    copies[3] += 0.2
    moved = Geometry(g.p0, g.p1, g.p2, g.counts, None, copies)
    accel = before.refit(moved)
    assert isinstance(accel, InstancedWideBvh)
    check(accel, search_of(accel), make_rays("aimed", moved, 5000, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_bunny", "env_teapot", "shapes_and_maps", "instances", "clutter"])
def test_shipped_scenes(name):
    _, g = torchpt.load(name, "cpu").world(torch.float32)
    assert (g.copies is not None) == (name == "instances")
    accel = build(g, "numba", 1)
    search = search_of(accel)
    for kind in KINDS:
        for seed in range(5):
            assert check(accel, search, make_rays(kind, g, 100_000, seed)) > 0.01
