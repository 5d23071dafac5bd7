"""Scenes and an obvious float64 search for the tests of torchpt.search."""

import numpy as np
import torch

from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.quadrics import quadrics_of, table_of

#: Numbers of primitives in the packets of the tests: triangles, rectangles, disks, spheres.
SCENES = {
    "triangles": (20, 0, 0, 0),
    "rectangles": (0, 12, 0, 0),
    "disks": (0, 0, 12, 0),
    "spheres": (0, 0, 0, 12),
    "one": (1, 0, 0, 0),
    "triangles and spheres": (9, 0, 0, 7),
    "rectangles and disks": (0, 5, 6, 0),
    "all": (10, 6, 6, 6),
}


def geometry(p0, p1, p2, counts):
    """Build a `Geometry` from ``(P, 3)`` arrays."""
    a, b, c = (torch.tensor(np.asarray(p, np.float32).reshape(-1, 3).T.copy()) for p in (p0, p1, p2))
    n = [*counts, 0][:5]
    return Geometry(a, b, c, (n[0], n[1], n[2], n[3], n[4]))


def quadric_table(kinds, frames):
    """Return quadrics of these types with transforms ``(12, Q)`` float64, in the form that the search takes."""
    return table_of(quadrics_of(kinds, [False] * len(kinds), frames, torch.float64), frames)


def triangles(vertices, faces):
    """Build the `Geometry` of a mesh."""
    v, f = np.asarray(vertices, np.float32), np.asarray(faces)
    return geometry(v[f[:, 0]], v[f[:, 1]], v[f[:, 2]], (len(f), 0, 0, 0))


def soup(seed, counts=(20, 8, 6, 6), spread=1.0, size=0.5):
    """Return random primitives of all types."""
    rng = np.random.default_rng(seed)
    n = sum(counts)
    p0 = rng.uniform(-spread, spread, (n, 3))
    p1, p2 = (p0 + rng.normal(0, size, (n, 3)) for _ in range(2))
    s = n - counts[3]
    p1[s:] = 0
    p2[s:] = 0
    p1[s:, 0] = rng.uniform(0.1, 1, counts[3]) * size
    return geometry(p0, p1, p2, counts)


def rays(seed, n, spread=2.0):
    """Return random rays o, d, t_max; directions are not unit vectors."""
    g = torch.Generator().manual_seed(seed)
    o = (torch.rand(3, n, generator=g) * 2 - 1) * spread
    d = torch.randn(3, n, generator=g)
    return o, d, torch.full((n,), float("inf"))


def sphere_mesh(n, bumps=0.1, seed=0):
    """Return vertices and faces of a displaced, closed sphere with about 2 n^2 triangles."""
    rng = np.random.default_rng(seed)
    theta = np.linspace(0, np.pi, n + 1)[1:-1]
    phi = np.linspace(0, 2 * np.pi, 2 * n, endpoint=False)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    x = np.stack([np.sin(t) * np.cos(p), np.cos(t), np.sin(t) * np.sin(p)], -1).reshape(-1, 3)
    x = np.concatenate([x, [[0, 1, 0], [0, -1, 0]]])
    x *= 1 + bumps * rng.uniform(-0.5, 0.5, (len(x), 1)) * min(1.0, 30 / n)
    m, rows = 2 * n, n - 1
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(m), indexing="ij")
    a, b = i * m + j, i * m + (j + 1) % m
    body = np.concatenate([np.stack([a, b, b + m], -1).reshape(-1, 3), np.stack([a, b + m, a + m], -1).reshape(-1, 3)])
    k = np.arange(m)
    top = np.stack([np.full(m, rows * m), (k + 1) % m, k], -1)
    low = (rows - 1) * m
    bottom = np.stack([np.full(m, rows * m + 1), low + k, low + (k + 1) % m], -1)
    return x.astype(np.float32), np.concatenate([body, top, bottom])


def search(g, o, d, t_max):
    """Test every ray against every primitive in float64; return t, prim and margin (how far the decision was from an edge)."""
    p0, p1, p2 = (p.double().numpy() for p in (g.p0, g.p1, g.p2))
    o, d, t_max = o.double().numpy(), d.double().numpy(), t_max.double().numpy()
    n_tri, n_rect, n_disk, *_ = g.counts
    best, prim, margin = t_max.copy(), np.full(o.shape[1], -1), np.full(o.shape[1], np.inf)
    with np.errstate(all="ignore"):
        for k in range(g.size):
            a, e1, e2 = p0[:, k], p1[:, k] - p0[:, k], p2[:, k] - p0[:, k]
            if k < n_tri + n_rect + n_disk:
                n = np.cross(e1, e2)
                t = n @ (a[:, None] - o) / (n @ d)
                q = o + t * d - a[:, None]
                u, v = (np.cross(e2, n) @ q) / (n @ n), (np.cross(n, e1) @ q) / (n @ n)
                if k < n_tri:
                    inside = np.minimum(np.minimum(u, v), 1 - u - v)
                elif k < n_tri + n_rect:
                    inside = np.minimum(np.minimum(u, v), 1 - np.maximum(u, v))
                else:
                    inside = 1 - u * u - v * v
                hit = (inside >= 0) & (t > 0)
                grazing = np.abs(n @ d) / np.linalg.norm(n) / np.linalg.norm(d, axis=0)
                margin = np.where(t > 0, np.minimum(margin, np.abs(inside) * grazing), margin)
            else:
                f, r = o - a[:, None], p1[0, k]
                aa, bb = (d * d).sum(0), (f * d).sum(0)
                disc = bb * bb - aa * ((f * f).sum(0) - r * r)
                t1, t2 = (-bb - np.sqrt(disc)) / aa, (-bb + np.sqrt(disc)) / aa
                t = np.where(t1 > 0, t1, t2)
                hit = (disc >= 0) & (t > 0)
                margin = np.minimum(margin, np.abs(disc) / (aa * r * r))
            closer = hit & (t < best)
            margin = np.where(hit, np.minimum(margin, np.abs(t - best) / t), margin)
            best, prim = np.where(closer, t, best), np.where(closer, k, prim)
    return np.where(prim < 0, np.inf, best), prim, margin
