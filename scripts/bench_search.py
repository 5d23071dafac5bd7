"""Measure rays a second of the CPU's tree on one thread, beside Embree if ``embreex`` is installed.

Run: ``python scripts/bench_search.py [--sets bunny room lamp sphere82k sphere1M clutter growth] [--rounds 7] [--json file]``.
The first three need ``$TORCHPT_ASSETS/bunny.ply``. Times are CPU times of the thread, medians of rounds in which
the contenders take turns. Camera rays are four a pixel in scan order; shadow rays go from their hits to a point light or a
square light; ``second`` and ``fourth`` are the bounces of diffuse paths. Each line shows Mrays/s and the ratio to Embree.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_accel import bumpy_sphere, mesh_geometry

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.tree import WideBvh

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
RAYS = 1 << 18


def bunny() -> Geometry:
    """Load the bunny: 69,451 triangles."""
    import trimesh

    mesh = trimesh.load_mesh(Path(os.environ["TORCHPT_ASSETS"]) / "bunny.ply", process=False)
    return mesh_geometry(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def joined(first: Geometry, second: Geometry) -> Geometry:
    """Join two sets of triangles."""
    parts = [torch.cat([getattr(first, p), getattr(second, p)], 1) for p in ("p0", "p1", "p2")]
    a, b = first.counts, second.counts
    return Geometry(parts[0], parts[1], parts[2], (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4]))


def extent(g: Geometry) -> tuple[np.ndarray, np.ndarray, float]:
    """Return low corner, centre and longest side of the triangles' box."""
    low, high = (x.numpy().astype(np.float64) for x in (g.p0.amin(1), g.p0.amax(1)))
    return low, (low + high) / 2, float((high - low).max())


def room(g: Geometry) -> Geometry:
    """Put a mesh on the floor of a box of twelve triangles."""
    low, centre, size = extent(g)
    a, b = centre - 1.2 * size, centre + 1.2 * size
    a[1] = low[1]
    k = np.array([[x, y, z] for x in (a[0], b[0]) for y in (a[1], b[1]) for z in (a[2], b[2])])
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return joined(g, mesh_geometry(k, np.array([t for p, q, r, s in quads for t in ((p, q, r), (p, r, s))])))


def lamp(g: Geometry) -> Geometry:
    """Put a rectangle above a mesh."""
    _, centre, size = extent(g)
    corners = [centre + size * np.array(x) for x in ((-0.2, 0.8, -0.2), (0.2, 0.8, -0.2), (-0.2, 0.8, 0.2))]
    p = [torch.tensor(x, dtype=torch.float32)[:, None] for x in corners]
    return joined(g, Geometry(p[0], p[1], p[2], (0, 1, 0, 0, 0)))


def clutter() -> Geometry:
    """Return the 900,000 triangles of the shipped scene."""
    import torchpt

    with torch.no_grad():
        _, own = torchpt.load("clutter", device="cpu").world(torch.float32)
    n = own.counts[0]
    p = [x[:, :n].contiguous() for x in (own.p0, own.p1, own.p2)]
    return Geometry(p[0], p[1], p[2], (n, 0, 0, 0, 0))


def camera(eye: np.ndarray, target: np.ndarray, fov: float, n: int = RAYS) -> Rays:
    """Return the rays of a pinhole camera, four a pixel, pixel after pixel."""
    side = round((n / 4) ** 0.5)
    w = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(w, (0, 1, 0))
    right /= np.linalg.norm(right)
    y, x = (np.repeat(k.reshape(-1), 4) for k in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    jitter, k = np.random.default_rng(0).random((2, len(x))), 2 * np.tan(np.radians(fov) / 2) / side
    d = w + ((x + jitter[0]) - side / 2)[:, None] * k * right
    d = d - ((y + jitter[1]) - side / 2)[:, None] * k * np.cross(right, w)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return rays(np.broadcast_to(eye[:, None], (3, len(x))), d.T)


def rays(o: np.ndarray, d: np.ndarray, t_max: np.ndarray | float = np.inf) -> Rays:
    """Convert rays to contiguous float32 arrays."""
    end = np.broadcast_to(np.asarray(t_max, np.float32), o.shape[1:])
    return tuple(np.array(x, np.float32, order="C") for x in (o, d, end))  # type: ignore[return-value]


def surface(g: Geometry, ray: Rays, t: np.ndarray, prim: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points ``(3, K)`` that rays hit, moved off the surface to the ray's side, and the normals there."""
    hit = (prim >= 0) & (prim < g.counts[0])
    p0, p1, p2 = (x.numpy()[:, prim[hit]].astype(np.float64) for x in (g.p0, g.p1, g.p2))
    n = np.cross(p1 - p0, p2 - p0, axis=0)
    n /= np.maximum(np.linalg.norm(n, axis=0), 1e-300)
    d = ray[1][:, hit].astype(np.float64)
    n *= np.where((n * d).sum(0) > 0, -1, 1)
    return ray[0][:, hit] + t[hit] * d + n * offset, n


def cosine(n: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sample directions of a diffuse surface about normals ``(3, K)``."""
    d = rng.normal(size=n.shape)
    d = n + d / np.linalg.norm(d, axis=0)
    return d / np.maximum(np.linalg.norm(d, axis=0), 1e-9)


def ray_sets(g: Geometry, accel: WideBvh, first: Rays, light: np.ndarray, size: float) -> dict[str, Rays]:
    """Return camera rays, shadow rays from their hits, and bounces."""
    sets, ray, rng = {"camera": first}, first, np.random.default_rng(1)
    for depth in range(2, 5):
        n = ray[0].shape[1]
        t, u, v = np.empty((3, n), np.float32)
        prim = np.empty(n, np.int32)
        accel.nearest(*ray, n, t, prim, u, v)
        x, normal = surface(g, ray, t, prim, 1e-4 * size)
        if depth == 2:
            for name, spread in (("shadow, point", 0.0), ("shadow, area", 0.6)):
                to = light[:, None] + spread * size * (rng.random(x.shape) - 0.5) * [[1], [0], [1]] - x
                front, far = (to * normal).sum(0) > 0, np.linalg.norm(to, axis=0)
                sets[name] = rays(x[:, front], (to / far)[:, front], far[front] * 0.999)
        ray = rays(x, cosine(normal, rng))
        if x.shape[1] < 20_000:
            break
        if depth in (2, 4):
            sets["second" if depth == 2 else "fourth"] = ray
    return sets


def embree(g: Geometry) -> Any:
    """Build Embree's tree of the triangles; return None if Embree is not installed."""
    try:
        mesh_construction: Any = importlib.import_module("embreex.mesh_construction")
        rtcore_scene: Any = importlib.import_module("embreex.rtcore_scene")
    except ImportError:
        return None
    n = g.counts[0]
    corners = torch.stack([p[:, :n] for p in (g.p0, g.p1, g.p2)], 1).permute(2, 1, 0).reshape(-1, 3)
    scene = rtcore_scene.EmbreeScene()
    vertices = np.ascontiguousarray(corners.numpy())
    mesh = mesh_construction.TriangleMesh(scene, vertices, np.arange(3 * n, dtype=np.int32).reshape(-1, 3))
    return scene, vertices, mesh  # Embree shares the memory of the vertices


def contenders(accel: WideBvh, other: Any, ray: Rays, any_hit: bool) -> dict[str, Callable[[], object]]:
    """Return the searches to measure, by name."""
    n = ray[0].shape[1]
    t, u, v = np.empty((3, n), np.float32)
    prim = np.empty(n, np.int32)
    o, d = (np.ascontiguousarray(x.T) for x in ray[:2])
    found: dict[str, Callable[[], object]] = {}
    if any_hit:
        found["torchpt"] = lambda: accel.blocked(*ray, n, prim)
        if other:
            found["embreex"] = lambda: other[0].run(o, d, dists=ray[2], query="OCCLUDED")
    else:
        found["torchpt"] = lambda: accel.nearest(*ray, n, t, prim, u, v)
        if other:
            found["embreex"] = lambda: other[0].run(o, d)
    return found


def measure(calls: dict[str, Callable[[], object]], n: int, rounds: int) -> dict[str, float]:
    """Measure Mrays/s by name."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            start = time.thread_time()
            call()
            times[name].append(time.thread_time() - start)
    return {name: n / statistics.median(x) / 1e6 for name, x in times.items()}


def built(g: Geometry) -> tuple[WideBvh, float]:
    """Build the tree three times; return it and the least CPU time."""
    accel, best = WideBvh(g, 1), np.inf
    for _ in range(3):
        start = time.process_time()
        accel = WideBvh(g, 1)
        best = min(best, time.process_time() - start)
    return accel, best


def report(rows: list[dict[str, Any]], row: dict[str, Any]) -> None:
    """Print a row and keep it."""
    rows.append(row)
    ratio = f"  {row['torchpt'] / row['embreex']:5.2f}" if "embreex" in row else ""
    speeds = "  ".join(f"{name} {row[name]:6.2f}" for name in ("torchpt", "embreex") if name in row)
    print(f"{row['scene']:12s} {row['triangles']:8d} {row['rays']:14s} {speeds}{ratio}", flush=True)


def one(name: str, rounds: int, rows: list[dict[str, Any]]) -> None:
    """Measure all ray sets of one scene."""
    if name in ("bunny", "room", "lamp"):
        mesh = bunny()
        g = {"bunny": lambda x: x, "room": room, "lamp": lamp}[name](mesh)
    else:
        mesh = g = clutter() if name == "clutter" else bumpy_sphere({"sphere82k": 144, "sphere1M": 501}[name])
    accel, seconds = built(g)
    info = accel.describe()
    print(f"{name}: build {seconds:.3f} s CPU, {info['bytes'] / g.size:.0f} bytes a primitive, depth {info['depth']}")
    _, centre, size = extent(mesh)
    near = np.array([0.1, 0.15, 1.0]) * 0.95 if mesh.size < 80_000 else np.array([0.3, 0.4, 1.0]) * 1.15
    eye, target, fov = centre + near * size, centre, 40.0
    light = centre + np.array([0.5, 1.1, 0.6] if name == "room" else [0.9, 1.6, 1.2]) * size
    if name == "clutter":
        eye, target, fov, light = (np.array(x) for x in ([2.6, 3.0, 5.6], [-0.1, 0.75, -0.2], 42.0, [2.2, 4.2, 2.6]))
    other = embree(g) if name != "lamp" else embree(mesh)
    for kind, ray in ray_sets(g, accel, camera(eye, target, float(fov)), light, size).items():
        speeds = measure(contenders(accel, other, ray, kind.startswith("shadow")), ray[0].shape[1], rounds)
        report(rows, {"scene": name, "triangles": g.counts[0], "rays": kind, **speeds})


def growth(rounds: int, rows: list[dict[str, Any]]) -> None:
    """Measure build time, memory and random rays from inside, from a thousand triangles to a million."""
    rng = np.random.default_rng(0)
    for n in (16, 50, 158, 501):
        g = bumpy_sphere(n)
        accel, seconds = built(g)
        ray = rays(rng.normal(size=(3, RAYS)) * 0.2, rng.normal(size=(3, RAYS)))
        speeds = measure(contenders(accel, embree(g), ray, False), RAYS, rounds)
        size = accel.describe()["bytes"] / g.size
        print(f"growth: {g.size} triangles, build {seconds:.3f} s CPU, {size:.0f} bytes a triangle")
        row = {"scene": "growth", "triangles": g.size, "rays": "random inside", "build": seconds, "bytes": size}
        report(rows, {**row, **speeds})


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--sets", nargs="+", default=["bunny", "room", "lamp", "sphere82k", "sphere1M", "clutter", "growth"]
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for name in args.sets:
        if name == "growth":
            growth(args.rounds, rows)
        else:
            one(name, args.rounds, rows)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
