"""The entries for loops outside of torch: arrays with room, every kind of primitive, several Python threads."""

import threading

import numpy as np
import pytest
import torch
from accel_reference import quadric_table, rays, soup, sphere_mesh, triangles

from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.kinds.cylinder import Cylinder
from torchpt.physics.shapes.kinds.sphere import Ellipsoid
from torchpt.search import build

COUNTS = (0, 1, 15, 16, 63, 64, 65, 1000)


def with_copies():
    v, f = sphere_mesh(8)
    g = soup(0, (30, 4, 3, 2))
    mesh = triangles(v * 0.3, f)
    n = g.counts[0] + mesh.size
    p = [torch.cat([getattr(mesh, k), getattr(g, k)], 1) for k in ("p0", "p1", "p2")]
    columns, at = [], n + sum(g.counts[1:])
    for k in range(6):
        columns.append([1, 0, 0, k - 3.0, 0, 0.5, 0.2, 0, 0, 0, 1, 0.1 * k, 0, mesh.size, at])
        at += mesh.size
    table = torch.tensor(columns, dtype=torch.float64).T.contiguous()
    return Geometry(p[0], p[1], p[2], (n, *g.counts[1:]), None, table)


def with_quadrics():
    g = soup(2, (12, 3, 2, 2))
    q = torch.tensor([[0.2, 0, 0, 0.5, 0, 0, 0, 0.4, 0, 0, 0, 0.3], [-0.5, 0, 0, 0.3, 0, 0, 0, 0.3, 0, 0, 0, 1.0]])
    q = q.double().T.contiguous()
    p = [torch.cat([a, b.float()], 1) for a, b in ((g.p0, q[0:3]), (g.p1, q[3:6]), (g.p2, q[6:9]))]
    return Geometry(p[0], p[1], p[2], (*g.counts[:4], 2), quadric_table((Ellipsoid, Cylinder), q))


SCENES = {
    "mixed": (lambda: soup(3), "numba"),
    "quadrics": (with_quadrics, "numba"),
    "copies": (with_copies, "numba"),
    "brute": (lambda: soup(3), "brute"),
    "brute quadrics": (with_quadrics, "brute"),
}


@pytest.mark.parametrize("name", SCENES)
def test_arrays_give_what_tensors_give_and_touch_no_other_lane(name):
    make, kind = SCENES[name]
    accel = build(make(), kind, 1)
    o, d, t_max = rays(5, max(COUNTS) + 40)
    t_max[::5], t_max[3::50], d[1, 4::60] = 1.0, 0.0, float("nan")
    prim = np.empty(0, np.int32)
    for count in COUNTS:
        hits = accel.intersect(o[:, :count], d[:, :count], t_max[:count])
        t, u, v = np.full((3, len(t_max)), 7, np.float32)
        prim, out = np.full((2, len(t_max)), 7, np.int32)
        accel.nearest(o.numpy(), d.numpy(), t_max.numpy(), count, t, prim, u, v)
        accel.blocked(o.numpy(), d.numpy(), t_max.numpy(), count, out)
        for got, expected in zip((t, prim, u, v), hits, strict=True):
            assert np.array_equal(got[:count], expected.numpy()) and (got[count:] == 7).all()
        assert np.array_equal(out[:count], hits[1].numpy() >= 0) and (out[count:] == 7).all()
    assert len(np.unique(prim[: COUNTS[-1]])) > 10


@pytest.mark.parametrize("name", SCENES)
def test_python_threads_search_at_once(name):
    make, kind = SCENES[name]
    accel = build(make(), kind, 1)
    o, d, t_max = (x.numpy() for x in rays(6, 20_000))
    expected = accel.intersect(*(torch.from_numpy(x) for x in (o, d, t_max)))[1].numpy()
    results = []

    def work():
        t, u, v = np.empty((3, len(t_max)), np.float32)
        prim = np.empty(len(t_max), np.int32)
        for _ in range(3):
            accel.nearest(o, d, t_max, len(t_max), t, prim, u, v)
        results.append(prim)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 3 and all(np.array_equal(expected, prim) for prim in results)


def test_the_tensor_search_takes_arrays_too():
    """By way of tensors: any structure serves the compiled loop."""
    accel = build(soup(40), "torch")
    rays = np.random.default_rng(5).normal(size=(7, 50)).astype(np.float32)
    o, d, t_max = rays[:3], rays[3:6], np.abs(rays[6]) + 1
    t, u, v = (np.full(50, 7, np.float32) for _ in range(3))
    prim, out = np.full(50, 7, np.int32), np.full(50, 7, np.int32)
    accel.nearest(o, d, t_max, 45, t, prim, u, v)
    accel.blocked(o, d, t_max, 45, out)
    hits = accel.intersect(*(torch.from_numpy(x[..., :45].copy()) for x in (o, d, t_max)))
    for found, expected in zip((t, prim, u, v), hits, strict=True):
        assert (found[:45] == expected.numpy()).all() and (found[45:] == 7).all()
    assert (out[:45] == (prim[:45] >= 0)).all() and (out[45:] == 7).all()
    assert 0 < out[:45].sum() < 45


def test_a_triangle_is_met_alike_beside_other_kinds():
    """Leaves that hold a rectangle too test their triangles in the same way."""
    v, f = sphere_mesh(6)
    alone = triangles(v, f)
    lamp = torch.tensor([[[2.0], [2.0], [2.0]], [[2.1], [2.0], [2.0]], [[2.0], [2.1], [2.0]]])
    p = [torch.cat([getattr(alone, k), lamp[j]], 1) for j, k in enumerate(("p0", "p1", "p2"))]
    both = Geometry(p[0], p[1], p[2], (alone.size, 1, 0, 0, 0))
    o, d, t_max = rays(8, 20_000)
    a, b = (build(g, "numba").intersect(o, d, t_max) for g in (alone, both))
    same = b[1] != alone.size
    assert (~same).sum() > 2 and all(torch.equal(x[same], y[same]) for x, y in zip(a, b, strict=True))
