"""Shadow rays past primitives that may let light pass: blocked, to be looked at closer, or clear."""

import numpy as np
import pytest
import torch
from accel_reference import geometry, rays, soup, sphere_mesh
from test_arrays import SCENES, with_quadrics

from torchpt.search import build

N = 6400


def asked(accel, o, d, t_max, non_opaque):
    out = np.full(N, 7, np.int32)
    accel.blocked(o.numpy(), d.numpy(), t_max.numpy(), N, out, non_opaque)
    return out


def opaque(g, non_opaque):
    """The primitives that block, alone."""
    keep = [np.flatnonzero(non_opaque[sum(g.counts[:k]) : sum(g.counts[: k + 1])] == 0) for k in range(4)]
    ids = np.concatenate([k + sum(g.counts[:i]) for i, k in enumerate(keep)])
    p0, p1, p2 = (p.numpy().T[ids] for p in (g.p0, g.p1, g.p2))
    return geometry(p0, p1, p2, [len(k) for k in keep])


def bundles(seed):
    """Rays of which sixteen at a time share an octant, and others."""
    o, d, t_max = rays(seed, N)
    near = d[:, :: N // 200].repeat_interleave(16, 1)
    d[:, : near.shape[1]] = near + 0.02 * torch.randn(near.shape, generator=torch.Generator().manual_seed(1))
    t_max[::7] = 0.8
    t_max[::11] = 0.0
    return o, d, t_max


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seed", [3, 4])
def test_each_ray_is_told_what_stands_in_its_way(seed, share):
    g = soup(seed, (60, 10, 8, 8))
    non_opaque = (np.random.default_rng(seed).random(g.size) < share).astype(np.uint8)
    o, d, t_max = bundles(seed)
    found = asked(build(g, "numba", 1), o, d, t_max, non_opaque)
    anything = build(g, "brute", 1).occluded(o, d, t_max).numpy()
    blocks = build(opaque(g, non_opaque), "brute", 1).occluded(o, d, t_max).numpy() if share < 1 else np.zeros(N, bool)
    wanted = np.where(blocks, 1, np.where(anything, 2, 0))
    assert (found != wanted).mean() < 1e-3  # the packets of few primitives place edges elsewhere
    assert {0, *([1] if share < 1 else []), *([2] if share > 0 else [])} == set(found.tolist())


def test_a_mesh_that_lets_light_pass_blocks_nothing():
    vertices, faces = sphere_mesh(30)
    corners = [vertices[faces[:, k]] for k in range(3)]
    wall = [np.array([[-9.0, -9, 3]]), np.array([[9.0, -9, 3]]), np.array([[-9.0, 9, 3]])]
    p0, p1, p2 = (np.concatenate([c, w]) for c, w in zip(corners, wall, strict=True))
    g = geometry(p0, p1, p2, (len(faces), 1, 0, 0))
    non_opaque = np.append(np.ones(len(faces), np.uint8), np.uint8(0))
    o, d, t_max = bundles(0)
    o = o * 0.1
    found = asked(build(g, "numba", 1), o, d, t_max, non_opaque)
    at = o + d * ((3 - o[2]) / d[2])
    through = (d[2] > 0) & (at[0].abs() < 8.9) & (at[1].abs() < 8.9) & ((3 - o[2]) / d[2] < t_max)
    beside = (d[2] < -1e-3) | (at[0].abs() > 9.1) | (at[1].abs() > 9.1)
    alive = t_max > 0
    assert (found[through.numpy()] == 1).all()
    assert (found[(beside & alive & torch.isinf(t_max)).numpy()] == 2).all()
    assert (found[~alive.numpy()] == 0).all()


@pytest.mark.parametrize("name", ["copies", "brute", "brute quadrics"])
def test_others_have_every_ray_that_meets_anything_looked_at_closer(name):
    make, kind = SCENES[name]
    g = make()
    accel = build(g, kind, 1)
    o, d, t_max = bundles(2)
    found = asked(accel, o, d, t_max, np.ones(g.size, np.uint8))
    assert np.array_equal(found, 2 * accel.occluded(o, d, t_max).numpy())


def test_quadrics_let_light_pass_too():
    g = with_quadrics()
    o, d, t_max = bundles(5)
    accel = build(g, "numba", 1)
    assert np.array_equal(asked(accel, o, d, t_max, np.ones(g.size, np.uint8)), 2 * accel.occluded(o, d, t_max).numpy())
