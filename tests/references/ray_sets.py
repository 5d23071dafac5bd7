"""Sets of rays for tests of searches: random ones, and those that are hard for a tree."""

import numpy as np

__all__ = ["KINDS", "make_rays"]

KINDS = ("random", "aimed", "axes")


def make_rays(kind, g, n, seed=0, sort=False):
    """Make rays ``o, d, t_max``: random, aimed at vertices and edges, or parallel to axes with ±0, NaN, infinity and ends."""
    rng = np.random.default_rng(seed)
    corners = np.concatenate([p.numpy() for p in (g.p0, g.p1, g.p2)], 1)
    low, high = corners.min(1), corners.max(1)
    size, t_max = (high - low).max(), np.full(n, np.inf, np.float32)
    d = rng.normal(size=(3, n)).astype(np.float32)
    o = (low[:, None] + rng.random((3, n)) * (high - low)[:, None]).astype(np.float32)
    if kind == "aimed":
        k, w = rng.integers(g.size, size=n), np.where(np.arange(n) % 2, rng.random(n), 0.0)
        target = g.p0.numpy()[:, k] * (1 - w) + g.p1.numpy()[:, k] * w
        o = (target + rng.normal(size=(3, n)) * 0.3 * size).astype(np.float32)
        d = (target - o).astype(np.float32)
    if kind == "axes":
        lanes, axis, what = np.arange(n), rng.integers(3, size=n), np.arange(n) % 4
        d[axis, lanes] = np.select([what == 0, what == 1], [0.0, -0.0], d[axis, lanes])
        d[(axis + 1) % 3, lanes] *= np.select([what == 2, what == 3], [0.0, 1e-30], 1.0).astype(np.float32)
        starts = corners[:, rng.integers(corners.shape[1], size=n)]  # rays in planes through vertices
        o = np.where(what < 2, o, starts + rng.choice([-0.2, 0.2], (3, n)) * size * (what == 2)).astype(np.float32)
        d[0, ::1000], d[1, 1::1000], o[2, 2::1000] = np.nan, np.inf, -np.inf
        t_max[::7] = rng.random(len(t_max[::7])).astype(np.float32) * size
        t_max[::97], t_max[1::97], t_max[2::97] = 0, -1, np.nan
    if sort:  # sixteen rays that go together: one octant, one longest axis
        order = np.lexsort((*(np.signbit(d[c]) for c in range(3)), np.abs(np.nan_to_num(d)).argmax(0)))
        o, d, t_max = o[:, order], d[:, order], t_max[order]
    return np.ascontiguousarray(o), np.ascontiguousarray(d), np.ascontiguousarray(t_max)
