"""Every backend against the obvious search, and against each other."""

import numpy as np
import pytest
import torch
from accel_reference import geometry, rays, search, soup
from few import few

from torchpt.core.errors import SceneError
from torchpt.search import KINDS, build

BACKENDS = [k for k in KINDS if k != "auto"]


def _points(g, hits, o, d):
    """Distance between o + t d and the point that prim, u, v name (planar hits)."""
    t, prim, u, v = hits
    k = (prim >= 0) & (prim < g.size - g.counts[3])
    p = prim[k].long()
    a = g.p0[:, p] + u[k] * (g.p1 - g.p0)[:, p] + v[k] * (g.p2 - g.p0)[:, p]
    return (a - (o[:, k] + t[k] * d[:, k])).norm(dim=0) / (1 + t[k] * d[:, k].norm(dim=0))


@pytest.mark.parametrize("kind", BACKENDS)
@pytest.mark.parametrize("seed", few(range(4), 2))
def test_mixed_kinds_match_the_obvious_search(kind, seed):
    g = soup(seed)
    o, d, t_max = rays(seed, 4001)
    t_max[::3] = 1.0
    accel = build(g, kind)
    hits = accel.intersect(o, d, t_max)
    t, prim, margin = search(g, o, d, t_max)
    sure = torch.from_numpy(margin > 1e-4)
    assert sure.float().mean() > 0.95
    torch.testing.assert_close(hits[1][sure].long(), torch.from_numpy(prim)[sure])
    torch.testing.assert_close(hits[0][sure], torch.from_numpy(t).float()[sure], rtol=2e-4, atol=1e-5)
    assert _points(g, hits, o, d).max() < 2e-3
    blocked = accel.occluded(o, d, t_max)
    assert torch.equal(blocked, hits[1] >= 0)
    miss = hits[1] < 0
    assert torch.isinf(hits[0][miss]).all() and (hits[2][miss] == 0).all() and (hits[3][miss] == 0).all()


@pytest.mark.parametrize("kind", BACKENDS)
def test_empty_single_and_no_rays(kind):
    empty = build(geometry([], [], [], (0, 0, 0, 0)), kind)
    o, d, t_max = rays(0, 5)
    assert (empty.intersect(o, d, t_max)[1] == -1).all()
    assert not empty.occluded(o, d, t_max).any()
    one = build(geometry([[0, 0, 0]], [[1, 0, 0]], [[0, 1, 0]], (1, 0, 0, 0)), kind)
    t, prim, u, v = one.intersect(*(torch.tensor(x) for x in ([[0.25], [0.5], [2.0]], [[0.0], [0.0], [-4.0]], [9.0])))
    assert prim.item() == 0 and t.item() == 0.5
    assert u.item() == pytest.approx(0.25) and v.item() == pytest.approx(0.5)
    assert one.intersect(o[:, :0], d[:, :0], t_max[:0])[0].shape == (0,)
    assert one.occluded(o[:, :0], d[:, :0], t_max[:0]).shape == (0,)
    info = one.describe()
    assert info["name"] == kind and info["primitives"] == 1
    assert set(info) == {"name", "primitives", "nodes", "leaves", "sah_cost", "depth", "bytes", "build_seconds"}


@pytest.mark.parametrize("kind", BACKENDS)
def test_dead_rays_and_open_interval(kind):
    accel = build(geometry([[-1, -1, 0]], [[1, -1, 0]], [[-1, 1, 0]], (0, 1, 0, 0)), kind)
    nan, inf = float("nan"), float("inf")
    z, t_max = [1.0, 1, 1, 1, 1, nan, 1, 1, 1, 0], [inf, 1, 1.0001, 0, -1, inf, inf, inf, nan, inf]
    dz = [-1.0, -1, -1, -1, -1, -1, nan, -inf, -1, -1]
    o = torch.tensor([[0.0] * 10, [0.0] * 10, z])
    d = torch.tensor([[0.0] * 10, [0.0] * 10, dz])
    hit = accel.intersect(o, d, torch.tensor(t_max))[1] == 0
    assert hit.tolist() == [True, False, True] + [False] * 7
    assert torch.equal(accel.occluded(o, d, torch.tensor(t_max)), hit)


@pytest.mark.parametrize("kind", BACKENDS)
def test_ties_go_to_the_lowest_primitive(kind):
    g = soup(3, (9, 3, 2, 2))
    order = [*[*range(9)] * 2, *[*range(9, 12)] * 2, *[12, 13] * 2, *[14, 15] * 2]
    a, b, c = (p.numpy().T[order] for p in (g.p0, g.p1, g.p2))
    twice = geometry(a, b, c, (18, 6, 4, 4))
    _, prim, _, _ = build(twice, kind).intersect(*rays(1, 3000))
    first = [*range(9), *range(18, 21), *range(24, 26), *range(28, 30)]
    assert set(prim.tolist()) - {-1} <= set(first)
    assert (prim >= 0).sum() > 100


@pytest.mark.parametrize("kind", BACKENDS)
def test_zero_area_is_never_hit(kind):
    # a needle, a point, a needle, a needle, and a sphere of radius 0
    p0 = np.zeros((5, 3))
    p1 = np.array([[1.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    g = geometry(p0, p1, 2 * p1, (2, 1, 1, 1))
    o, d, t_max = rays(2, 500)
    d = -o  # through the origin
    assert (build(g, kind).intersect(o, d, t_max)[1] == -1).all()


@pytest.mark.parametrize("kind", BACKENDS)
def test_a_ray_that_starts_on_a_surface_leaves_it(kind):
    g = soup(1)
    o, d, t_max = rays(9, 20000)
    accel = build(g, kind)
    t, prim, _, _ = accel.intersect(o, d, t_max)
    hit = (prim >= 0) & (prim < 28)
    p, k = (o + t * d)[:, hit], prim[hit].long()
    n = torch.linalg.cross((g.p1 - g.p0)[:, k].double(), (g.p2 - g.p0)[:, k].double(), dim=0)
    n = (n / n.norm(dim=0)).float()
    out = torch.where((n * d[:, hit]).sum(0) < 0, 1.0, -1.0)
    start = p + n * out * 2.0**-19 * (n * p).abs().sum(0) * 2
    wi = d[:, hit] - 2 * n * (n * d[:, hit]).sum(0)
    again = accel.intersect(start, wi, torch.full_like(t[hit], float("inf")))
    assert not (again[1] == prim[hit]).any()


def test_unknown_kind_is_refused():
    with pytest.raises(SceneError, match="render.accel"):
        build(soup(0), "fast")


def test_brute_refuses_mixed_scales():
    g = geometry([[0, 0, 0]] * 2, [[1000, 0, 0], [1e-4, 0, 0]], [[0, 1000, 0], [0, 1e-4, 0]], (2, 0, 0, 0))
    with pytest.raises(SceneError, match="brute"):
        build(g, "brute")
