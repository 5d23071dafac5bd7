"""Copies of meshes: the hits of explicit meshes, by ids that tell copy and triangle."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from accel_reference import rays, sphere_mesh, triangles
from search_scenes import with_instances

from torchpt.core.errors import SceneError
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import build
from torchpt.search.base import Accel

BACKENDS = ("torch", "numba")


def as_explicit(prim: torch.Tensor, geometry: Geometry) -> torch.Tensor:
    """The ids of copies as those of the explicit triangles, which lie before the other kinds."""
    assert geometry.copies is not None
    n, total, extra = geometry.counts[0], geometry.size, int(geometry.copies[13].sum())
    shifted = torch.where(prim >= total, prim - total + n, prim + extra)
    return torch.where(prim < n, prim, shifted)


@pytest.mark.parametrize("kind", BACKENDS)
def test_copies_are_hit_as_explicit_meshes_are(kind):
    copied, explicit = with_instances(23)
    o, d, t_max = rays(1, 15_000)
    t_max[::3] = 1.0
    accel, plain = build(copied, kind), build(explicit, kind)
    t, prim, u, v = accel.intersect(o, d, t_max)
    t2, prim2, u2, v2 = plain.intersect(o, d, t_max)
    same = as_explicit(prim, copied) == prim2
    assert same.float().mean() > 0.9995  # but at edges: both are rounded, in places of their own
    hit = same & (prim >= copied.size)
    assert hit.sum() > 400 and len(prim[hit].unique()) > 250
    torch.testing.assert_close(t[hit], t2[hit], rtol=1e-4, atol=1e-5)
    assert ((u - u2)[hit].abs() < 5e-3).float().mean() > 0.999
    assert ((v - v2)[hit].abs() < 5e-3).float().mean() > 0.999
    base = same & (prim >= 0) & (prim < copied.size)
    assert torch.equal(t[base], t2[base])
    assert torch.equal(accel.occluded(o, d, t_max), prim >= 0)
    miss = prim < 0
    assert torch.isinf(t[miss]).all() and not u[miss].any() and not v[miss].any()


def test_backends_agree_to_the_bit():
    copied, _ = with_instances(40, 3)
    o, d, t_max = rays(2, 20_000)
    found = [build(copied, kind).intersect(o, d, t_max) for kind in BACKENDS]
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("kind", BACKENDS)
def test_equal_distances_go_to_the_lowest_id(kind):
    """Two copies at one place, and one where the mesh itself is."""
    v, f = sphere_mesh(6)
    g = triangles(v, f)
    same, moved = np.eye(3, 4).reshape(-1), np.array([[1.0, 0, 0, 3], [0, 1, 0, 0], [0, 0, 1, 0]]).reshape(-1)
    n = g.size
    table = torch.tensor(np.array([[*m, 0, n, n * (k + 1)] for k, m in enumerate((same, moved, moved))]).T)
    copied = Geometry(g.p0, g.p1, g.p2, g.counts, None, table)
    o, d, t_max = rays(4, 8000, 4.0)
    _, prim, _, _ = build(copied, kind).intersect(o, d, t_max)
    assert set((prim // n).tolist()) <= {-1, 0, 2}
    assert ((prim // n) == 0).sum() > 100 and ((prim // n) == 2).sum() > 100


@pytest.mark.parametrize("kind", BACKENDS)
def test_dead_rays_and_the_open_interval(kind):
    copied, _ = with_instances(5)
    accel = build(copied, kind)
    o, d, t_max = rays(6, 4000)
    t, prim, _, _ = accel.intersect(o, d, t_max)
    hit = prim >= copied.size
    again = accel.intersect(o[:, hit], d[:, hit], t[hit])
    assert not (again[1] == prim[hit]).any()
    for value in (float("nan"), float("inf")):
        bad = d.clone()
        bad[1] = value
        assert (accel.intersect(o, bad, t_max)[1] == -1).all() and not accel.occluded(o, bad, t_max).any()
    for end in (0.0, -1.0, float("nan")):
        dead = torch.full_like(t_max, end)
        assert (accel.intersect(o, d, dead)[1] == -1).all() and not accel.occluded(o, d, dead).any()
    assert accel.intersect(o[:, :0], d[:, :0], t_max[:0])[0].shape == (0,)


def test_what_is_built_and_what_is_refused():
    copied, _ = with_instances(9)

    def nodes(accel: Accel) -> int:
        return accel.describe()["nodes"]

    more, _ = with_instances(9, 1)
    few = build(copied, "numba").describe()
    assert few["instances"] == 9 and few["primitives"] > 9 * 60
    assert abs(nodes(build(more, "numba")) - few["nodes"]) < 20
    assert build(copied, "auto").name == "numba"
    with pytest.raises(SceneError, match="instances"):
        build(copied, "brute")
