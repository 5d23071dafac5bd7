"""Compare the cost of a refit with that of a build, and measure how searches slow down in a refitted tree.

Run: ``python scripts/bench_refit.py [--rounds 5] [--json file]``; needs ``$TORCHPT_ASSETS/bunny.ply``. Times are CPU times of
one thread. For each way to move the bunny's vertices a line shows the growth of the tree's cost since it was built
(which ``torchpt.search.tree.REBUILD_THRESHOLD`` bounds), its cost relative to a rebuilt tree, and how much longer searches
take than in the rebuilt tree.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_accel import bumpy_sphere
from bench_search import built, bunny, camera, contenders, extent, measure, ray_sets

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import tree as wide
from torchpt.search.tree import WideBvh


def noise(x: np.ndarray, amount: float) -> np.ndarray:
    """Move each vertex independently; 1 is the mean length of an edge."""
    _, place = np.unique(x, axis=0, return_inverse=True)
    return x + amount * 0.00856 * np.random.default_rng(0).normal(size=(len(x), 3))[place]


def wave(x: np.ndarray, amount: float) -> np.ndarray:
    """Move vertices by four waves along each axis; 1 is the size of the mesh."""
    return x + amount * np.sin(8 * np.pi * x[:, [1, 2, 0]])


def twist(x: np.ndarray, amount: float) -> np.ndarray:
    """Twist the mesh about the upward axis; 1 is a turn from bottom to top."""
    t = amount * 2 * np.pi * x[:, 1]
    return np.stack([x[:, 0] * np.cos(t) - x[:, 2] * np.sin(t), x[:, 1], x[:, 0] * np.sin(t) + x[:, 2] * np.cos(t)], 1)


def turn(x: np.ndarray, amount: float) -> np.ndarray:
    """Rotate the mesh about two axes; 1 is a turn."""
    t = amount * 2 * np.pi
    c, s = np.cos(t), np.sin(t)
    return x @ (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])).T


MOVES: dict[str, tuple[Callable[[np.ndarray, float], np.ndarray], tuple[float, ...]]] = {
    "noise": (noise, (0.1, 0.25, 0.5, 1.0, 2.0)),
    "wave": (wave, (0.005, 0.01, 0.02, 0.04)),
    "twist": (twist, (0.05, 0.1, 0.2, 0.4)),
    "turn": (turn, (0.02, 0.05, 0.125)),
}


def moved(g: Geometry, how: Callable[[np.ndarray, float], np.ndarray], amount: float) -> Geometry:
    """Move the corners of triangles, about the mesh's centre and in units of its size."""
    _, centre, size = extent(g)
    x = torch.cat((g.p0, g.p1, g.p2), 1).numpy().T.astype(np.float64)
    x = how((x - centre) / size, amount) * size + centre
    a, b, c = torch.from_numpy(np.ascontiguousarray(x.T, np.float32)).split(g.size, 1)
    return Geometry(a, b, c, g.counts)


def refit(accel: WideBvh, g: Geometry) -> WideBvh:
    """Return the refitted tree, whatever it costs."""
    tree = accel.refit(g)
    assert tree is not None
    return tree


def seconds(rounds: int, rows: list[dict[str, Any]]) -> None:
    """Time builds and refits from a thousand triangles to a million."""
    for n in (16, 50, 144, 501):
        g = bumpy_sphere(n)
        accel, build = built(g)
        refit(accel, g)
        times = []
        for _ in range(rounds):
            start = time.thread_time()
            refit(accel, g)
            times.append(time.thread_time() - start)
        rows.append({"triangles": g.size, "build": build, "refit": statistics.median(times)})
        print(f"{g.size:8d} triangles: build {build:.4f} s, refit {rows[-1]['refit']:.4f} s", flush=True)


def slowdown(rounds: int, rows: list[dict[str, Any]]) -> None:
    """Measure how much longer searches take in a refitted tree."""
    first = bunny()
    accel = WideBvh(first, 1)
    for name, (how, amounts) in MOVES.items():
        for amount in amounts:
            g = moved(first, how, amount)
            old, new = refit(accel, g), WideBvh(g, 1)
            work, least = (x.refit_state.sah_ratio * (x.refit_state.built_cost or 1.0) for x in (old, refit(new, g)))
            sah_ratio = old.refit_state.sah_ratio
            row: dict[str, Any] = {"move": name, "amount": amount, "sah_ratio": sah_ratio, "beside": work / least}
            _, centre, size = extent(g)
            near, light = np.array([0.1, 0.15, 1.0]) * 0.95 * size, np.array([0.9, 1.6, 1.2]) * size
            for kind, ray in ray_sets(g, new, camera(centre + near, centre, 40.0), centre + light, size).items():
                n, any_hit = ray[0].shape[1], kind.startswith("shadow")
                calls = {k: contenders(x, None, ray, any_hit)["torchpt"] for k, x in (("old", old), ("new", new))}
                speed = measure(calls, n, rounds)
                row[kind] = speed["new"] / speed["old"]
            rows.append(row)
            times = "  ".join(f"{k} {row[k]:.2f}" for k in ("camera", "shadow, area", "second"))
            print(
                f"{name} {amount:5.3f}: cost x {sah_ratio:.2f}, {row['beside']:.2f} of anew; time {times}", flush=True
            )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    wide.REBUILD_THRESHOLD = float("inf")
    rows: list[dict[str, Any]] = []
    seconds(args.rounds, rows)
    slowdown(args.rounds, rows)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
