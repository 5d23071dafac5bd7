"""The search of a tree inside kernels: one ray at a time it gives the bits of the CPU's search by packets."""

import numpy as np
import pytest
import torch
from accel_reference import quadric_table, soup, sphere_mesh, triangles
from ray_kernels import searches
from ray_sets import KINDS, make_rays
from test_bits import equal_bits, found

import torchpt
from torchpt.compiler.form import SCALAR
from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.kinds.cone import Cone
from torchpt.physics.shapes.kinds.cylinder import Cylinder
from torchpt.physics.shapes.kinds.sphere import Ellipsoid
from torchpt.physics.shapes.quadrics import Form
from torchpt.search.tree import WideBvh
from torchpt.search.tree_rays import TreeSearch, tree_search


class Bowl(Cylinder):
    """A paraboloid, ``x^2 + y^2 = z``."""

    name, form = "bowl", Form(bend=0.0, level=0.0, half=-0.5)


QUADRICS = (Ellipsoid, Cylinder, Cone, Bowl)


def with_quadrics():
    """Twenty quadrics of each shape at random places, and primitives of all other kinds."""
    rng = np.random.default_rng(3)
    g = soup(2, (60, 12, 12, 12))
    kinds = QUADRICS * 20
    frame = torch.from_numpy(rng.normal(size=(12, len(kinds))) * 0.3)
    p = [torch.cat([a, frame[k : k + 3].float()], 1) for a, k in ((g.p0, 0), (g.p1, 3), (g.p2, 6))]
    return Geometry(p[0], p[1], p[2], (*g.counts[:4], len(kinds)), quadric_table(kinds, frame))


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
    run = searches(functions or tree_search(accel), accel.words.ctypes.data, SCALAR)
    return lambda *rays: [x.numpy() for x in run(*map(torch.from_numpy, rays))]


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cornell_bunny", "env_teapot", "shapes_and_maps"])
def test_shipped_scenes(name):
    _, g = torchpt.load(name, "cpu").world(torch.float32)
    assert g.copies is None
    accel = WideBvh(g, 1)
    search = search_of(accel)
    for kind in KINDS:
        for seed in range(5):
            assert check(accel, search, make_rays(kind, g, 100_000, seed)) > 0.01
