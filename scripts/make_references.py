"""Render the reference pictures of the tests with Mitsuba 3: means over independent seeds, and the variance of each mean.

    python scripts/make_references.py [NAME ...]

Needs the extra ``bench``; ``cornell_bunny`` needs ``$TORCHPT_ASSETS/bunny.ply``. Writes ``tests/references/NAME.exr``
with the picture and the layer ``variance``: box filter, rr_depth 5. Shapes whose material Mitsuba lacks are left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mitsuba_scene import comparable, convert, load_mitsuba

import torchpt
from torchpt.scene.formats.description import settings

#: Width, height and max_depth by scene. Deep where light passes null, which Mitsuba counts as a bounce.
SCENES = {
    "cornell_box": (64, 64, 8),
    "cornell_bunny": (64, 64, 8),
    "veach_mis": (72, 48, 2),
    "material_row": (96, 32, 64),
    "studio": (72, 48, 64),
    "shapes_and_maps": (72, 45, 64),
}
FOLDER = Path(__file__).resolve().parent.parent / "tests" / "references"


def main() -> None:
    """Render and write the references named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help=f"of {', '.join(SCENES)}")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba's variant")
    parser.add_argument("--seeds", type=int, default=64, help="independent pictures")
    parser.add_argument("--spp", type=int, default=512, help="samples a pixel of each")
    arguments = parser.parse_args()
    mitsuba = load_mitsuba(arguments.variant)
    for name in arguments.scenes:
        start = time.perf_counter()
        mean, variance = reference(mitsuba, name, arguments.seeds, arguments.spp)
        torchpt.write_image(FOLDER / f"{name}.exr", mean, {"variance": variance})
        share = float((variance.sqrt() / mean.clamp_min(1e-6)).median())
        print(f"{name}: mean {mean.mean((0, 1)).tolist()}, median relative error {share:.2e}", end=", ")
        print(f"{time.perf_counter() - start:.0f} s")


def reference(mitsuba: Any, name: str, seeds: int, spp: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Render ``seeds`` pictures; return their mean ``(H, W, 3)`` and the variance of that mean."""
    scene = torchpt.load(name, device="cpu") if name.startswith("cornell") else comparable(name)
    width, height, depth = SCENES[name]
    film = {"width": width, "height": height, "filter": "box"}
    integrator = {"type": "path", "max_depth": depth, "rr_depth": 5}
    wishes = settings(scene.description, {"film": film, "integrator": integrator, "render": {"spp": spp}})
    with tempfile.TemporaryDirectory() as folder:
        theirs = mitsuba.load_dict(convert(mitsuba, scene, wishes, Path(folder)))
        pictures = [np.asarray(mitsuba.render(theirs, spp=spp, seed=seed), np.float64) for seed in range(seeds)]
    stack = torch.from_numpy(np.stack(pictures))
    return stack.mean(0), stack.var(0) / seeds


if __name__ == "__main__":
    main()
