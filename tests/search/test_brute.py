"""The search of few primitives: against every ray and primitive in float64, at edges, with ends, and among quadrics."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from accel_reference import SCENES, geometry, quadric_table, rays, search, soup, sphere_mesh, triangles
from few import few
from test_arrays import with_quadrics

import torchpt
from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.kinds.sphere import Ellipsoid
from torchpt.search import brute, build, tables
from torchpt.search.brute import Brute, merge_quadric_hits

N = 20_000


def places(g, hits):
    """Points that the parameters of planar hits name: p0 + u e1 + v e2."""
    prim = hits[1].long()
    p0, p1, p2 = (p[:, prim].double() for p in (g.p0, g.p1, g.p2))
    return p0 + hits[2].double() * (p1 - p0) + hits[3].double() * (p2 - p0)


@pytest.mark.parametrize("name", few(SCENES, 4))
def test_hits_are_those_of_float64(name):
    """Rays within rounding of an edge or of two surfaces apart, of which there are few."""
    g = soup(4, SCENES[name], size=0.4)
    o, d, t_max = rays(2, N)
    t_max = torch.where(torch.arange(N) % 2 == 0, torch.rand(N, generator=torch.Generator().manual_seed(1)) * 2, t_max)
    accel = Brute(g, 1)
    hits = accel.intersect(o, d, t_max)
    t, prim, margin = search(g, o, d, t_max)
    sure = torch.from_numpy(margin > 1e-5)
    assert sure.float().mean() > 0.99
    assert torch.equal(hits[1].long()[sure], torch.from_numpy(prim)[sure])
    assert (hits[1].long() != torch.from_numpy(prim)).sum() <= 2
    # By rows in float32: the rounding of a plane's distance is that of coordinates of size 2, over the slope.
    same = hits[1].long() == torch.from_numpy(prim)
    hit = same & (hits[1] >= 0)
    error = (hits[0][hit].double() - torch.from_numpy(t)[hit]).abs() / torch.from_numpy(t)[hit].clamp_min(1.0)
    assert error.max() < 2e-5 and error.median() < 1e-7
    assert (hits[0][hits[1] >= 0] < t_max[hits[1] >= 0]).all() and (hits[0] > 0).all()
    planar = hit & (hits[1] < sum(SCENES[name][:3]))
    at = (o.double() + hits[0].double() * d.double())[:, planar]
    away = (places(g, [x[planar] for x in hits]) - at).norm(dim=0)
    assert away.numel() == 0 or away.max() < 1e-4
    assert torch.equal(accel.occluded(o, d, t_max), hits[1] >= 0)


def test_shared_edges_let_nothing_through():
    """Rays from within a closed mesh at its vertices and at places on its edges, and what they are told of the place."""
    vertices, faces = sphere_mesh(7)
    g = triangles(vertices, faces)
    accel = Brute(g, 1)
    rng = np.random.default_rng(0)
    ends = vertices[faces[rng.integers(len(faces), size=100_000)]]
    w = np.where(np.arange(100_000) % 3 == 0, 0.0, rng.random(100_000))[:, None]
    aim = torch.from_numpy((ends[:, 0] * (1 - w) + ends[:, 1] * w).T.astype(np.float32))
    o = torch.from_numpy((rng.normal(size=(3, 100_000)) * 0.15).astype(np.float32))
    far = torch.full((100_000,), torch.inf)
    t, prim, u, v = accel.intersect(o, aim - o, far)
    assert (prim >= 0).all() and accel.occluded(o, aim - o, far).all()
    assert (u >= 0).all() and (v >= 0).all() and (u + v <= 1 + 1e-6).all()
    away = (places(g, (t, prim, u, v)) - aim).norm(dim=0)
    assert away.max() < 1e-4 and (away > 1e-6).double().mean() < 0.01  # more only where a ray grazes its triangle
    open_ = Brute(triangles(vertices, faces[(faces != 10).all(1)]), 1)  # that nothing escapes is not so by construction
    assert not open_.occluded(o, aim - o, far).all()


def test_what_touches_at_an_edge_goes_to_the_lower_number():
    """Two rectangles side by side, a fold, and a ray at each place of the edge: one of both, and none goes between."""
    g = geometry([[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [-1, 0, 0.5]], [[0, 1, 0], [0, 1, 0]], (0, 2, 0, 0))
    y = torch.linspace(0.001, 0.999, 999)
    o = torch.stack([torch.zeros(999), y, torch.ones(999)])
    d = torch.tensor([[0.0], [0.0], [-1.0]]).expand(3, 999)
    t, prim, u, v = Brute(g, 1).intersect(o, d, torch.full((999,), torch.inf))
    assert (prim == 0).all() and (t == 1).all() and (u == 0).all() and torch.allclose(v, y, atol=1e-7)


def test_edges_are_where_they_are():
    """A lamp seen from far away at a grazing angle, by rays at its edges: as large as it is, and hit where float64 hits it."""
    low, high = np.array([-0.24, -0.22]), np.array([0.23, 0.16])
    lamp, tri = [low[0], 1.98, low[1]], [3.0, 1.0, 0.0]
    scene = geometry(
        [tri, lamp], [[4, 1, 0], [high[0], 1.98, low[1]]], [[3, 2, 1], [low[0], 1.98, high[1]]], (1, 1, 0, 0)
    )
    rng = np.random.default_rng(0)
    side, along = rng.integers(4, size=N * 5), rng.random((2, N * 5))
    at = low + along.T * (high - low)
    edge = np.where(side < 2, low[side % 2], high[side % 2]) + rng.normal(size=N * 5) * 2e-4
    at[np.arange(N * 5), side % 2] = edge
    aim = torch.from_numpy(np.stack([at[:, 0], np.full(N * 5, 1.98), at[:, 1]]).astype(np.float32))
    eye = torch.tensor([[0.0], [1.0], [6.8]]).expand(3, N * 5)
    d, far = aim - eye, torch.full((N * 5,), torch.inf)
    accel = Brute(scene, 1)
    seen = accel.intersect(eye, d, far)[1] == 1
    place = eye.double() + d.double() * (np.float64(np.float32(1.98)) - 1.0) / d[1].double()
    deep = torch.minimum(*((place[k] - scene.p0[k, 1]) for k in (0, 2)))
    deep = torch.minimum(deep, torch.minimum(scene.p1[0, 1] - place[0], scene.p2[2, 1] - place[2]))
    assert 0.3 < seen.double().mean() < 0.7
    assert torch.equal(seen, accel.occluded(eye, d, far))
    wrong = seen != (deep >= 0)
    assert wrong.double().mean() < 4e-3 and deep[wrong].abs().max() < 2e-6  # its corners' rounding to float32


def test_ends_are_open():
    g = geometry([[-1, -1, 0]], [[1, -1, 0]], [[-1, 1, 0]], (0, 1, 0, 0))
    o = torch.tensor([[0.0], [0.0], [2.0]]).expand(3, 4)
    d = torch.tensor([[0.0], [0.0], [-1.0]]).expand(3, 4)
    t_max = torch.tensor([2.0, np.nextafter(np.float32(2), np.float32(3)), 1.0, torch.inf])
    accel = Brute(g, 1)
    assert accel.occluded(o, d, t_max).tolist() == [False, True, False, True]
    assert accel.intersect(o, d, t_max)[1].tolist() == [-1, 0, -1, 0]
    behind = accel.intersect(o, -d, t_max)
    assert (behind[1] == -1).all() and (behind[0] == torch.inf).all()


# -- quadrics, which packets do not know


def test_quadrics_among_others_are_those_of_the_tree():
    g = with_quadrics()
    o, d, t_max = rays(3, N)
    t_max[::3] = 1.0
    few_, tree = Brute(g, 1), build(g, "numba", 1)
    hits, other = few_.intersect(o, d, t_max), tree.intersect(o, d, t_max)
    bent = hits[1] >= sum(g.counts[:4])
    assert bent.sum() > 500 and len(hits[1][bent].unique()) == 2
    assert (hits[1] != other[1]).sum() <= 2  # edges of planar primitives are placed elsewhere
    same = bent & (hits[1] == other[1])
    for a, b in zip(hits, other, strict=True):  # the same numbers in float64
        torch.testing.assert_close(a[same], b[same], rtol=2e-7, atol=2e-7)
    assert torch.equal(few_.occluded(o, d, t_max), hits[1] >= 0)
    assert (hits[0][hits[1] >= 0] < t_max[hits[1] >= 0]).all()


def test_dead_rays_meet_no_quadric():
    frame = torch.tensor([[0.0, 0, 0, 0.5, 0, 0, 0, 0.5, 0, 0, 0, 0.5]]).double().T.contiguous()
    p = [frame[k : k + 3].float() for k in (0, 3, 6)]
    accel = Brute(Geometry(p[0], p[1], p[2], (0, 0, 0, 0, 1), quadric_table((Ellipsoid,), frame)), 1)
    nan, inf = float("nan"), float("inf")
    t_max = torch.tensor([inf, 1.5, 1.5001, 0, -1, nan, -inf, inf, inf, inf, inf])
    o = torch.tensor([[0.0, 0.0, 2.0]] * 11).T.contiguous()
    d = torch.tensor([[0.0, 0.0, -1.0]] * 11).T.contiguous()
    o[0, 7], o[1, 8], d[2, 9], d[0, 10] = nan, inf, -inf, nan
    t, prim, _, _ = accel.intersect(o, d, t_max)
    assert prim.tolist() == [0, -1, 0] + [-1] * 8
    assert t.tolist() == [1.5, inf, 1.5] + [inf] * 8
    assert torch.equal(accel.occluded(o, d, t_max), prim >= 0)


def test_quadrics_by_a_kernel_and_by_tensor_operations():
    g = with_quadrics()
    ray = rays(6, 4000)
    accel = Brute(g, 1)
    assert len(accel.quadrics) == 2
    hits = accel.intersect(*ray)
    p0, p1, p2 = (p[:, : g.size - 2] for p in (g.p0, g.p1, g.p2))
    plain = Brute(Geometry(p0, p1, p2, (*g.counts[:4], 0)), 1).intersect(*ray)
    for row, number in accel.quadrics:
        plain = merge_quadric_hits.function(*ray, *plain, row, number)
    for a, b in zip(hits, plain, strict=True):
        assert torch.equal(a, b)
    kernel: Any = merge_quadric_hits.implementations[0]
    assert kernel(*ray, *plain, *accel.quadrics[0]) is not NotImplemented and not kernel.refused


def test_auto_leaves_quadrics_to_the_tree():
    g = with_quadrics()
    p0, p1, p2 = (p[:, : g.size - 2] for p in (g.p0, g.p1, g.p2))
    flat = Geometry(p0, p1, p2, (*g.counts[:4], 0))
    assert [build(x, kind).name for x, kind in ((flat, "auto"), (g, "auto"), (g, "brute"))] == [
        "brute",
        "numba",
        "brute",
    ]


def test_pictures_with_quadrics_are_the_trees():
    """By name and by any way to render: the same picture but for rounding."""
    cone = {"type": "cone", "apex": [0, 1, 0], "height": -1.5, "slope": 0.4}
    lamp = {"type": "sphere", "center": [2, 3, 2], "radius": 0.5, "emission": [9, 8, 7]}
    floor = {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 2, 5], "target": [0, 0.3, 0]},
            "shapes": {"cone": cone, "lamp": lamp, "floor": floor},
        },
        device="cpu",
    )
    pictures = [
        torchpt.render(scene, accel=accel, compile=how, spp=16, seed=1, film={"width": 32, "height": 24})
        for accel, how in (("numba", False), ("brute", False), ("brute", True), ("numba", True), ("auto", True))
    ]
    mean = pictures[0].mean()
    assert mean > 0.01
    for picture in pictures[1:]:
        assert (picture - pictures[0]).abs().mean() < 1e-3 * mean
    assert torch.equal(pictures[3], pictures[4])


def test_a_render_of_few_primitives_needs_no_numba():
    """All its kernels are those of the lane compiler, of quadrics too."""
    code = (
        "import sys, torchpt\n"
        "cone = {'type': 'cone', 'apex': [0, 1, 0], 'height': -1.5, 'slope': 0.4, 'emission': [1, 1, 1]}\n"
        "scene = torchpt.load({'camera': {'origin': [0, 2, 5], 'target': [0, 0, 0]}, 'shapes': {'c': cone}}, device='cpu')\n"
        "image = torchpt.render(scene, compile=False, accel='brute', spp=1, film={'width': 8, 'height': 8})\n"
        "print(scene.accel('brute', None).name, float(image.mean()) > 0, 'numba' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == ["brute", "True", "False"]


@pytest.mark.parametrize("kind", ["auto", "brute"])
def test_primitives_are_inspected_once_a_build(kind, monkeypatch):
    seen = []
    monkeypatch.setattr(brute, "affine_rows", lambda geometry: seen.append(geometry) or tables.affine_rows(geometry))
    g = soup(4, SCENES["all"])
    assert build(g, kind, 1).name == "brute" and seen == [g]
