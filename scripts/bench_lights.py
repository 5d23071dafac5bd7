"""Compare cost and error of the light samplers: `python scripts/bench_lights.py [scene ...]`, or `--emitters 10 100 ...`.

The error is the relMSE (with the usual 0.01) of one picture of `--spp` samples a pixel, estimated from the spread of several
seeds; the reference is the mean of the pictures by the light tree.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

WAYS = ("uniform", "power", "tree")


def emitters(count: int) -> dict[str, Any]:
    """Return a scene of emissive spheres of different powers over a floor; the total power is the same for any number."""
    g = torch.Generator().manual_seed(7)
    place = torch.rand(count, 3, generator=g) * torch.tensor([16.0, 1.8, 16.0]) + torch.tensor([-8.0, 0.2, -8.0])
    power = torch.exp(1.5 * torch.randn(count, generator=g))
    glow = power / power.sum() * 2e5 / 4.0
    floor = {"type": "rectangle", "transform": [{"scale": 10}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
    shapes: dict[str, Any] = {"floor": floor}
    for k in range(count):
        shapes[f"s{k}"] = {
            "type": "sphere",
            "center": place[k].tolist(),
            "radius": 0.02,
            "emission": [float(glow[k])] * 3,
        }
    return {"camera": {"origin": [0, 5, 10], "target": [0, 0, 0], "fov": 50}, "shapes": shapes}


def pictures(
    scene: Scene, way: str, spp: int, seeds: int, size: tuple[int, int], depth: int
) -> tuple[list[Tensor], float]:
    """Render pictures of several seeds; return them and the least CPU time of one, in seconds."""
    found, seconds = [], []
    for seed in range(seeds):
        wishes = {
            "film": {"width": size[0], "height": size[1], "filter": "box"},
            "integrator": {"type": "path", "max_depth": depth, "light_choice": way},
            "render": {"spp": spp, "seed": seed, "compile": "off", "threads": 1},
        }
        complete = settings(scene.description, wishes)
        start = time.process_time()
        found.append(render_scene(scene, complete).image.double())
        seconds.append(time.process_time() - start)
    return found, min(seconds)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=["many_lights"])
    parser.add_argument("--emitters", type=int, nargs="*", help="numbers of spheres instead of scenes")
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--size", type=int, nargs=2, default=[160, 100])
    parser.add_argument("--depth", type=int, default=6)
    options = parser.parse_args()
    sources: list[tuple[str, Any]] = [(name, name) for name in options.scenes]
    if options.emitters:
        sources = [(f"{count} spheres", emitters(count)) for count in options.emitters]
    print(f"{'scene':<16} {'choice':<8} {'relMSE':>9} {'of uniform':>10} {'us/sample':>10}")
    for name, source in sources:
        scene = torchpt.load(source, device="cpu")
        made = {way: pictures(scene, way, options.spp, options.seeds, options.size, options.depth) for way in WAYS}
        mean = torch.stack(made["tree"][0]).mean(0)
        base = None
        for way, (images, seconds) in made.items():
            error = float((torch.stack(images).var(0) / (mean * mean + 0.01)).mean())
            base = base or error
            each = 1e6 * seconds / (options.size[0] * options.size[1] * options.spp)
            print(f"{name:<16} {way:<8} {error:9.4f} {error / base:10.4f} {each:10.2f}", flush=True)


if __name__ == "__main__":
    main()
