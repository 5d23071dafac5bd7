"""Compare noise at equal samples with Mitsuba 3.

    python scripts/bench_noise.py [scenes] [--spp 64] [--seeds 5] [--size 128]

For each scene the table shows the relMSE of single pictures, mean and standard error over seeds, for torchpt's samplers and for
Mitsuba's ``independent`` and ``multijitter``; box filter on both sides. The reference is torchpt's own mean over many more
seeds, whose variance is subtracted: an unbiased estimate if torchpt is unbiased (``tests/integrators/test_mitsuba.py``). The
ratio is that of ``sobol``, the default, to the better of Mitsuba's two. Needs the extra ``bench``.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from mitsuba_scene import comparable, convert, find_llvm, load_mitsuba
from torch import Tensor

import torchpt
from torchpt.images.metrics import relative
from torchpt.rendering.api import render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

FLOOR = {"type": "rectangle", "transform": [{"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 4}]}
BUNNY = ["$TORCHPT_ASSETS/bunny.ply", str(Path(__file__).parent.parent / "scenes" / "standin.ply")]
#: Scenes that are not shipped: a bunny under an environment map, and a lamp close to a surface.
OWN: dict[str, dict[str, Any]] = {
    "env_bunny": {
        "camera": {"origin": [0, 0.2, 0.35], "target": [-0.02, 0.1, 0], "fov": 35},
        "shapes": {
            "bunny": {"type": "mesh", "path": BUNNY, "material": {"type": "plastic", "diffuse_reflectance": [0.5, 0.3, 0.2]}},
            "floor": {**FLOOR, "transform": [*FLOOR["transform"], {"translate": [0, 0.033, 0]}]},
        },
        "lights": {"sky": {"type": "envmap", "path": "$TORCHPT_ASSETS/museum.exr"}},
    },
    "near_light": {
        "camera": {"origin": [0, 1.2, 2.4], "target": [0, 0.1, 0], "fov": 40},
        "shapes": {
            "floor": FLOOR,
            "lamp": {
                "type": "rectangle",
                "emission": [6, 5, 4],
                "transform": [
                    {"scale": [0.5, 0.25, 1]},
                    {"rotate": {"axis": [1, 0, 0], "angle": 90}},
                    {"translate": [0, 0.12, 0]},
                ],
            },
            "block": {"type": "cube", "transform": [{"scale": [0.1, 0.04, 0.1]}, {"translate": [0.2, 0.04, 0.1]}]},
        },
    },
}  # fmt: skip
SCENES = ("env_bunny", "veach_mis", "many_lights", "near_light", "cornell_box")
OURS = ("sobol", "independent")
THEIRS = ("independent", "multijitter")
KEYS = {"type": "path", "max_depth": 6, "rr_depth": 5, "dark_rims": True}

Shoot = Callable[[int], Tensor]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "scenes", nargs="*", default=SCENES, help=f"of {', '.join(SCENES)}, or names of scenes that ship"
    )
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--reference", type=int, default=64, help="how many more samples the reference has")
    arguments = parser.parse_args()
    mitsuba = load_mitsuba("llvm_ad_rgb" if find_llvm() else "scalar_rgb")
    names = [f"torchpt {sampler}" for sampler in OURS] + [f"mitsuba {sampler}" for sampler in THEIRS]
    print(f"relMSE x 1e3 at {arguments.spp} spp, {arguments.seeds} seeds, {arguments.size} x {arguments.size}")
    print(f"{'':14s}" + "".join(f"{name:>22s}" for name in names) + "     ratio")
    ratios = []
    for name in arguments.scenes:
        found = compare(mitsuba, name, arguments)
        ours, best = found["torchpt sobol"][0], min(found[f"mitsuba {sampler}"][0] for sampler in THEIRS)
        ratios.append(ours / best)
        row = "".join(f"{1e3 * mean:14.3f} ± {1e3 * error:5.3f}" for mean, error in found.values())
        print(f"{name:14s}{row}{ratios[-1]:10.2f}", flush=True)
    print(f"geometric mean of the ratios: {math.exp(sum(map(math.log, ratios)) / len(ratios)):.3f}")


def compare(mitsuba: Any, name: str, arguments: argparse.Namespace) -> dict[str, tuple[float, float]]:
    """Return the mean relMSE of every contender and its standard error."""
    scene = torchpt.load(OWN[name], device="cpu") if name in OWN else comparable(name)
    film = {"width": arguments.size, "height": arguments.size, "filter": {"type": "box"}}
    wishes = settings(scene.description, {"film": film, "integrator": KEYS, "render": {"spp": arguments.spp}})
    contenders: dict[str, Shoot] = {f"torchpt {sampler}": own(scene, film, arguments.spp, sampler) for sampler in OURS}
    with tempfile.TemporaryDirectory() as folder:
        given = convert(mitsuba, scene, wishes, Path(folder))
        for sampler in THEIRS:
            given["sensor"]["sampler"]["type"] = sampler
            contenders[f"mitsuba {sampler}"] = other(mitsuba, mitsuba.load_dict(given), arguments.spp)
        found = {
            who: torch.stack([shoot(1 + seed) for seed in range(arguments.seeds)]) for who, shoot in contenders.items()
        }
    more = torch.stack([contenders["torchpt sobol"](10_000 + seed) for seed in range(arguments.reference)])
    reference, variance = more.mean(0), more.var(0) / len(more)
    errors = {
        who: relative((pictures - reference).square() - variance, reference).mean((1, 2, 3))
        for who, pictures in found.items()
    }
    return {who: (float(e.mean()), float(e.std() / math.sqrt(len(e)))) for who, e in errors.items()}


def own(scene: Scene, film: dict[str, Any], spp: int, sampler: str) -> Shoot:
    """Render pictures with torchpt, by seed."""

    def shoot(seed: int) -> Tensor:
        drawn = {"spp": spp, "seed": seed, "compile": "off"}
        blocks = {"film": film, "integrator": KEYS, "sampler": {"type": sampler}, "render": drawn}
        return render_scene(scene, settings(scene.description, blocks)).image.double()

    return shoot


def other(mitsuba: Any, scene: Any, spp: int) -> Shoot:
    """Render pictures with Mitsuba, by seed."""
    return lambda seed: torch.tensor(mitsuba.render(scene, spp=spp, seed=seed).numpy(), dtype=torch.float64)


if __name__ == "__main__":
    main()
