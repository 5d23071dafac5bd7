"""Geometries for tests of searches: with quadrics, with instances of meshes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from accel_reference import quadric_table, soup, sphere_mesh, triangles

from torchpt.physics.shapes.geometry import Geometry
from torchpt.physics.shapes.kinds.cone import Cone
from torchpt.physics.shapes.kinds.cylinder import Cylinder
from torchpt.physics.shapes.kinds.sphere import Ellipsoid
from torchpt.physics.shapes.quadrics import Form

__all__ = ["copied", "maps", "with_instances", "with_quadrics"]


class Bowl(Cylinder):
    """A paraboloid, ``x^2 + y^2 = z``."""

    name, form = "bowl", Form(bend=0.0, level=0.0, half=-0.5)


QUADRICS = (Ellipsoid, Cylinder, Cone, Bowl)


def with_quadrics() -> Geometry:
    """Twenty quadrics of each shape at random places, and primitives of all other kinds."""
    rng = np.random.default_rng(3)
    g = soup(2, (60, 12, 12, 12))
    kinds = QUADRICS * 20
    frame = torch.from_numpy(rng.normal(size=(12, len(kinds))) * 0.3)
    p = [torch.cat([a, frame[k : k + 3].float()], 1) for a, k in ((g.p0, 0), (g.p1, 3), (g.p2, 6))]
    return Geometry(p[0], p[1], p[2], (*g.counts[:4], len(kinds)), quadric_table(kinds, frame))


def maps(seed: int, count: int) -> np.ndarray:
    """Affine maps ``(I, 3, 4)``: turned, stretched, every third one mirrored."""
    rng = np.random.default_rng(seed)
    linear = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] * rng.uniform(0.2, 0.8, (count, 1, 3))
    linear[::3] *= -1
    return np.concatenate([linear, rng.uniform(-1.5, 1.5, (count, 3, 1))], 2)


def with_instances(count: int, seed: int = 0) -> tuple[Geometry, Geometry]:
    """Two meshes and some planes with copies of either mesh, and the same with explicit triangles."""
    v, f = sphere_mesh(8)
    small, g = triangles(v[:, ::-1] * 0.4, f[:60]), soup(seed, (30, 4, 3, 2))
    first = [triangles(v * 0.3, f), small]
    parts = [torch.cat([*(getattr(mesh, p) for mesh in first), getattr(g, p)], 1) for p in ("p0", "p1", "p2")]
    sizes = [mesh.size for mesh in first]
    counts = (sum(sizes) + g.counts[0], *g.counts[1:])
    maps_ = maps(seed, count)
    columns, explicit, at = [], [[], [], []], sum(counts)
    for k, m in enumerate(maps_):
        which = k % 2
        start = which * sizes[0]
        columns.append([*m.reshape(-1), start, sizes[which], at])
        at += sizes[which]
        for corner, p in zip(explicit, parts, strict=True):
            q = m[:, :3] @ p[:, start : start + sizes[which]].double().numpy() + m[:, 3:]
            corner.append(torch.from_numpy(q).float())
    copied = Geometry(parts[0], parts[1], parts[2], counts, None, torch.tensor(np.array(columns).T))
    n = counts[0]
    whole = [torch.cat([p[:, :n], *more, p[:, n:]], 1) for p, more in zip(parts, explicit, strict=True)]
    extra = at - sum(counts)
    return copied, Geometry(whole[0], whole[1], whole[2], (n + extra, *counts[1:]))


def copied(g: Geometry, spans: Sequence[tuple[int, int]], placed: Iterable[np.ndarray]) -> Geometry:
    """A geometry with instances of some of its triangles (``first, count``) at each of the maps ``(I, 3, 4)``."""
    columns, end = [], g.size
    for k, affine in enumerate(placed):
        first, count = spans[k % len(spans)]
        columns.append([*affine.reshape(-1), first, count, end])
        end += count
    return Geometry(g.p0, g.p1, g.p2, g.counts, g.quadrics, torch.tensor(np.array(columns).T))
