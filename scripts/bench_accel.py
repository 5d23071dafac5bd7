"""Measure search speed, build times and tree quality of every search backend.

Run: ``python scripts/bench_accel.py [--rays 262144] [--threads 2] [--million]``. The large mesh is
``$TORCHPT_ASSETS/bunny.ply`` where that is set, else a displaced sphere. Coherent rays come from a pinhole camera in
scan order; incoherent ones start on the surface in random order and directions.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import build
from torchpt.search.base import Accel


def mesh_geometry(vertices: np.ndarray, faces: np.ndarray) -> Geometry:
    """Build a geometry from a mesh, ``(V, 3)`` and ``(F, 3)``."""
    corners = [torch.from_numpy(np.ascontiguousarray(vertices[faces[:, k]].T, np.float32)) for k in range(3)]
    return Geometry(corners[0], corners[1], corners[2], (len(faces), 0, 0, 0, 0))


def box() -> Geometry:
    """Return the triangles of a room with two boxes: 36 triangles."""
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    cubes = (((0, 0, 0), 1.0), ((0.3, -0.7, 0.2), 0.3), ((-0.4, -0.5, -0.2), 0.35))
    vertices = np.concatenate([np.array(centre) + size * corners for centre, size in cubes])
    return mesh_geometry(vertices, np.concatenate([faces + 8 * k for k in range(3)]))


def bumpy_sphere(n: int) -> Geometry:
    """Return a closed, displaced sphere with about ``4 n^2`` triangles."""
    theta, phi = np.meshgrid(np.linspace(1e-3, np.pi - 1e-3, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    r = 1 + 0.05 * np.sin(9 * theta) * np.cos(11 * phi)
    x = np.stack([r * np.sin(theta) * np.cos(phi), r * np.cos(theta), r * np.sin(theta) * np.sin(phi)], -1)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(2 * n - 1), indexing="ij")
    a = (i * 2 * n + j).reshape(-1)
    faces = np.concatenate([np.stack([a, a + 1, a + 2 * n + 1], 1), np.stack([a, a + 2 * n + 1, a + 2 * n], 1)])
    return mesh_geometry(x.reshape(-1, 3), faces)


def large_mesh() -> tuple[str, Geometry]:
    """Return the bunny if its file is there, else a displaced sphere of its size."""
    path = Path(os.environ.get("TORCHPT_ASSETS", "")) / "bunny.ply"
    if not os.environ.get("TORCHPT_ASSETS") or not path.exists():
        return "bumpy sphere", bumpy_sphere(132)
    import trimesh

    mesh = trimesh.load_mesh(path, process=False)
    return "bunny", mesh_geometry(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def coherent(g: Geometry, n: int, inside: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the rays of a square pinhole camera, in front of the scene or within it."""
    low, high = g.p0.amin(1, keepdim=True), g.p0.amax(1, keepdim=True)
    side = round(n**0.5)
    y, x = torch.meshgrid(*[torch.linspace(-0.4, 0.4, side)] * 2, indexing="ij")
    d = torch.stack([x.reshape(-1), -y.reshape(-1), -torch.ones(side * side)])
    eye = (low + high) / 2 + torch.tensor([[0.0], [0.0], [0.45 if inside else 1.5]]) * (high - low).max()
    return eye.expand(3, side * side).contiguous(), d / d.norm(dim=0)


def incoherent(g: Geometry, n: int, inside: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return rays in uniform directions from random points of the surface (or of the room)."""
    gen = torch.Generator().manual_seed(1)
    d = torch.randn(3, n, generator=gen)
    if inside:
        return (torch.rand(3, n, generator=gen) * 2 - 1) * 0.95, d / d.norm(dim=0)
    k = torch.randint(g.size, (n,), generator=gen)
    return ((g.p0 + g.p1 + g.p2) / 3)[:, k].contiguous(), d / d.norm(dim=0)


def rate(call: Callable[[], object], n: int, repeats: int) -> float:
    """Measure millions of rays a second: the best of several runs after a warm-up run."""
    call()
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return n / best / 1e6


def report(title: str, g: Geometry, accel: Accel, n: int, repeats: int, inside: bool) -> None:
    """Print a line for each backend."""
    cells = []
    for name, make in (("coherent", coherent), ("incoherent", incoherent)):
        o, d = make(g, n, inside)
        t_max = torch.full((o.shape[1],), torch.inf)
        seen = rate(lambda o=o, d=d, t=t_max: accel.intersect(o, d, t), o.shape[1], repeats)
        dark = rate(lambda o=o, d=d, t=t_max: accel.occluded(o, d, t), o.shape[1], repeats)
        cells.append(f"{name} {seen:7.2f} occluded {dark:7.2f}")
    print(f"{title:14s} {accel.name:6s} Mrays/s: {'   '.join(cells)}", flush=True)


def quality(title: str, g: Geometry, kind: str) -> None:
    """Print the seconds of a second build (the first may compile) and the quality of the tree."""
    build(g, kind)
    info = build(g, kind).describe()
    megabytes = info["bytes"] / 2**20
    print(
        f"{title:14s} {kind:6s} build {info['build_seconds']:6.3f} s, SAH cost {info['sah_cost']:7.1f}, "
        f"{info['nodes']} nodes, depth {info['depth']}, {megabytes:.0f} MB",
        flush=True,
    )


def main() -> None:
    """Run the benchmark and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rays", type=int, default=1 << 18)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--million", action="store_true", help="build times of a million triangles")
    args = parser.parse_args()
    threads = args.threads or None
    name, mesh = large_mesh()
    for kind in ("brute", "numba", "torch"):
        n, repeats = (args.rays, args.repeats) if kind != "torch" else (min(args.rays, 1 << 16), 2)
        report("36 triangles", box(), build(box(), kind, threads), n, repeats, inside=True)
        if kind != "brute":
            report(f"{name} {mesh.size}", mesh, build(mesh, kind, threads), n, repeats, inside=False)
    for kind in ("numba", "torch"):
        quality(f"{name} {mesh.size}", mesh, kind)
        if args.million:
            large = bumpy_sphere(501)
            quality(f"sphere {large.size}", large, kind)


if __name__ == "__main__":
    main()
