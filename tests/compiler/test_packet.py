"""The search inside kernels: in any form, among any neighbours and kinds, what the search of whole tensors gives.

That one is tested against float64 in tests/search.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence

import numpy as np
import pytest
import ray_kernels
import torch
from accel_reference import SCENES, geometry, soup
from few import few
from ray_kernels import Search
from torch import Tensor

from torchpt.compiler.form import SCALAR, VECTORS, Form
from torchpt.compiler.packet import KINDS, PacketSearch
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.brute import Brute


def searches(accel: Brute, kinds: Sequence[str] | None = None, form: Form = VECTORS) -> Search:
    """``t, prim, u, v, blocked`` of rays: a kernel around the nodes ``nearest`` and ``occluded``."""
    if kinds is None:
        kinds = [kind for kind, count in zip(KINDS, accel.counts, strict=False) if count]
    return ray_kernels.searches(PacketSearch(tuple(kinds)), ctypes.addressof(accel.words), form)


def rays(seed: int, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """From within and around the scene, not of unit length, half of them short."""
    rng = torch.Generator().manual_seed(seed)
    o = (torch.rand(3, n, generator=rng) * 2 - 1) * 2
    d = torch.randn(3, n, generator=rng)
    t_max = torch.where(torch.rand(n, generator=rng) < 0.5, torch.rand(n, generator=rng) * 2, math.inf)
    return o, d, t_max


COUNT = 20_000


@pytest.mark.parametrize("name", SCENES)
def test_whole_tensors_meet_the_same(name):
    """A ray meets in a render by tensor operations what it meets inside of a stage, to the bit."""
    accel = Brute(soup(4, SCENES[name]), threads=1)
    o, d, t_max = rays(2, COUNT)
    for n in (COUNT, 1, 15, 17):
        ray = o[:, :n], d[:, :n], t_max[:n]
        *hits, blocked = searches(accel)(*ray)
        for a, b in zip(hits, accel.intersect(*ray), strict=True):
            assert torch.equal(a, b)
        assert torch.equal(blocked, accel.occluded(*ray)) and torch.equal(blocked, hits[1] >= 0)
        if n == COUNT:
            assert hits[1].unique().tolist() == list(range(-1, sum(SCENES[name])))  # all are seen, and the void


def test_rays_that_are_none():
    """Dead rays meet nothing, and do not disturb the others of their vector."""
    accel = Brute(soup(4, SCENES["all"]), threads=1)
    search = searches(accel)
    o, d, t_max = rays(3, 4000)
    whole = search(o, d, t_max)
    dead = torch.arange(4000) % 3 == 0
    kinds = [
        (o, d, torch.where(dead, 0.0, t_max)),
        (o, d, torch.where(dead, -1.0, t_max)),
        (o, d, torch.where(dead, math.nan, t_max)),
        (o, d, torch.where(dead, -math.inf, t_max)),
        *((torch.where(dead, bad, o), d, t_max) for bad in (math.nan, math.inf)),
        *((o, torch.where(dead, bad, d), t_max) for bad in (math.nan, -math.inf)),
        (o, torch.cat([torch.where(dead, math.nan, d[:1]), d[1:]]), t_max),
    ]
    for ray in kinds:
        found = search(*ray)
        assert (found[1][dead] == -1).all() and (found[0][dead] == math.inf).all() and not found[4][dead].any()
        assert (found[2][dead] == 0).all() and (found[3][dead] == 0).all()
        for a, b in zip(found, whole, strict=True):
            assert torch.equal(a[~dead], b[~dead])
        assert (accel.intersect(*ray)[1][dead] == -1).all()
    still = search(o, torch.zeros_like(d), t_max)  # a direction of length 0 leads nowhere
    assert (still[1] == -1).all() and not still[4].any()


def test_a_ray_does_not_depend_on_its_neighbours():
    accel = Brute(soup(4, SCENES["all"]), threads=1)
    search = searches(accel)
    ray = rays(5, 1000)
    order = torch.randperm(1000, generator=torch.Generator().manual_seed(1))
    for a, b in zip(search(*ray), search(*(x[..., order] for x in ray)), strict=True):
        assert torch.equal(a[order], b)


@pytest.mark.parametrize("name", SCENES)
def test_one_ray_at_a_time(name):
    """The same bits of the same rays by packets of sixteen and of one; of rays that are none, too."""
    accel = Brute(soup(4, SCENES[name]), threads=1)
    o, d, t_max = rays(7, 3000)
    bad = torch.tensor([math.nan, math.inf, -1.0, 0.0])
    t_max = torch.where(torch.arange(3000) % 7 == 0, bad[torch.arange(3000) % 4], t_max)
    o[:, ::11], d[1, ::13] = math.inf, math.nan
    packets, single = (searches(accel, form=form)(o, d, t_max) for form in (VECTORS, SCALAR))
    assert (packets[1] >= 0).any() and (packets[1] < 0).any()
    for a, b in zip(packets, single, strict=True):
        assert torch.equal(a.view(torch.uint8), b.view(torch.uint8))


def test_kinds_that_the_scene_lacks_change_nothing():
    accel = Brute(soup(4, SCENES["triangles and spheres"]), threads=1)
    ray = rays(6, 2000)
    for a, b in zip(searches(accel)(*ray), searches(accel, KINDS)(*ray), strict=True):
        assert torch.equal(a, b)


def test_empty_scene():
    accel = Brute(soup(4, (0, 0, 0, 0)), threads=1)
    t, prim, _, _, blocked = searches(accel)(*rays(1, 100))
    assert (prim == -1).all() and (t == math.inf).all() and not blocked.any()


def cube(kind: str, size: float) -> Geometry:
    """A closed cube around the origin, turned so that nothing is aligned with the axes."""
    rng = np.random.default_rng(8)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) @ turn * size
    corners = corners.astype(np.float32)
    faces = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 4, 5), (2, 3, 6, 7), (0, 2, 4, 6), (1, 3, 5, 7)]
    if kind == "rectangles":
        at = np.array([face[:3] for face in faces])
        counts = (0, 6, 0, 0)
    else:  # two triangles a face, which share the diagonal
        at = np.array([tri for a, b, c, d in faces for tri in ((a, b, c), (d, c, b))])
        counts = (12, 0, 0, 0)
    return geometry(corners[at[:, 0]], corners[at[:, 1]], corners[at[:, 2]], counts)


@pytest.mark.parametrize("size", few([0.01, 1.0, 100.0], 2))
@pytest.mark.parametrize("kind", ["rectangles", "triangles"])
def test_watertight(kind, size):
    """No ray from inside a closed cube escapes, not along edges, diagonals and corners: 300,000 for each kind."""
    scene = cube(kind, size)
    accel = Brute(scene, threads=1)
    rng = torch.Generator().manual_seed(3)
    n = 100_000
    p0, p1, p2 = scene.p0, scene.p1, scene.p2
    corners = torch.cat([p0, p1, p2, p1 + p2 - p0] if kind == "rectangles" else [p0, p1, p2], 1)
    prim = torch.randint(p0.shape[1], (n,), generator=rng)
    ends = torch.stack([p0, p1, p2])[:, :, prim]
    side = torch.randint(3, (n,), generator=rng)  # the third edge of a rectangle is its diagonal, inside it
    lanes = torch.arange(n)
    a, b = ends[side, :, lanes].T, ends[(side + 1) % 3, :, lanes].T
    target = a + (b - a) * torch.rand(n, generator=rng)
    corner = torch.rand(n, generator=rng) < 0.2
    target = torch.where(corner, corners[:, torch.randint(corners.shape[1], (n,), generator=rng)], target)
    # Origins within the inscribed ball, a tenth of them next to a face, and directions of any length.
    o = torch.randn(3, n, generator=rng)
    o = o / o.norm(dim=0) * torch.rand(n, generator=rng) * 0.95 * size
    close = torch.rand(n, generator=rng) < 0.1
    o = torch.where(close, o + (target - o) * 0.9, o)
    d = (target - o) * torch.exp(torch.randn(n, generator=rng))
    t, prim, _, _, blocked = searches(accel)(o, d, torch.full((n,), math.inf))
    assert (prim < 0).sum() == 0 and blocked.all()
    # The hit is on the cube's surface near where the ray was aimed.
    away = ((o + t * d) - target).norm(dim=0)
    assert away.max() < 2e-3 * size and (away > 1e-4 * size).float().mean() < 1e-3


def test_spheres_are_closed():
    """Each ray from inside a sphere meets it, at the far side."""
    rng = torch.Generator().manual_seed(3)
    scene = geometry(np.array([[0.3, -0.2, 5.0]]), np.array([[0.5, 0.0, 0.0]]), np.zeros((1, 3)), (0, 0, 0, 1))
    accel = Brute(scene, threads=1)
    o = torch.randn(3, 50_000, generator=rng)
    o = o / o.norm(dim=0) * torch.rand(50_000, generator=rng) * 0.499 + scene.p0
    d = torch.randn(3, 50_000, generator=rng)
    t, prim, _, _, blocked = searches(accel)(o, d, torch.full((50_000,), math.inf))
    assert (prim == 0).all() and blocked.all()
    radius = (o.double() + t.double() * d.double() - scene.p0.double()).norm(dim=0)
    assert (radius - 0.5).abs().max() < 3e-6  # coordinates of size 5 are float32
