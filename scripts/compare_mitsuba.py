"""Compare pictures with Mitsuba 3: ``python scripts/compare_mitsuba.py [scenes] [--size 128] [--pictures FOLDER]``.

Scenes of ``configs/scene`` under :func:`mitsuba_scene.nearest`, rendered by both with the same number of seeds; box filter,
rr_depth 5. A line shows the means, and z-scores ``z = (ours - theirs) / sqrt(variances)`` of the means and of blocks of 8 x 8
pixels. In scenes where light passes surfaces, which only Mitsuba counts as a bounce, the depth is 64 without ``--depth``.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from bench_figures import SCENES
from bench_workers import DEPTH
from mitsuba_scene import convert, find_llvm, lets_pass, load_mitsuba, nearest
from torch import Tensor

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

BLOCK = 8
#: Depth for scenes in which light passes surfaces, which Mitsuba counts as bounces.
DEEP = 64


@dataclass(frozen=True)
class Comparison:
    """Two pictures ``(H, W, 3)`` and their difference in standard errors.

    Attributes:
        ours: torchpt's mean over seeds.
        theirs: Mitsuba's mean over seeds.
        whole: ``(3,)`` z-scores of the means.
        blocks: ``(H / 8, W / 8, 3)`` z-scores of blocks, 0 where both have no noise.
    """

    ours: Tensor
    theirs: Tensor
    whole: Tensor
    blocks: Tensor


def main() -> None:
    """Print a line for each scene; with ``--pictures`` write both pictures side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES)
    parser.add_argument("--size", type=int, default=128, help="a multiple of 8")
    parser.add_argument("--spp", type=int, default=32, help="of each picture")
    parser.add_argument("--seeds", type=int, default=16, help="pictures of each")
    parser.add_argument("--depth", type=int, help=f"{DEPTH}, or {DEEP} where light passes surfaces")
    parser.add_argument("--pictures", type=Path, metavar="FOLDER", help="where NAME.png goes: ours, Mitsuba's")
    arguments = parser.parse_args()
    mitsuba = load_mitsuba("llvm_ad_rgb" if find_llvm() else "scalar_rgb")
    print(
        f"{'':22s}{'ours':>9s}{'Mitsuba':>9s}{'ratio':>8s}{'z':>7s} {'blocks: rms z':>14s}{'largest':>9s}{'|z| > 3':>9s}"
    )
    for name in arguments.scenes:
        scene = nearest(name)
        depth = arguments.depth or (DEEP if lets_pass(scene) else DEPTH)
        found = compare(mitsuba, scene, arguments.size, arguments.spp, arguments.seeds, depth)
        a, b = float(found.ours.mean()), float(found.theirs.mean())
        z = found.blocks
        print(f"{name:22s}{a:9.5f}{b:9.5f}{a / b:8.4f}{worst(found.whole):7.2f}", end=" ")
        print(f"{float(z.square().mean().sqrt()):14.2f}{worst(z):9.2f}", end="")
        print(f"{float((z.abs() > 3).double().mean()):9.2%}   depth {depth}", flush=True)
        if arguments.pictures:
            arguments.pictures.mkdir(parents=True, exist_ok=True)
            both = torch.cat((found.ours, found.theirs), 1)
            torchpt.write_image(arguments.pictures / f"{name}.png", both.float())


def worst(deviates: Tensor) -> float:
    """Return the value furthest from 0."""
    flat = deviates.flatten()
    return float(flat[flat.abs().argmax()])


def compare(mitsuba: Any, scene: Scene, size: int, spp: int, seeds: int, depth: int = DEPTH) -> Comparison:
    """Render a scene with both renderers, ``seeds`` pictures each, and compare them.

    Args:
        mitsuba: the module, with its variant set.
        scene: a scene that Mitsuba can express.
        size: width and height in pixels, a multiple of 8.
        spp: samples a pixel of each picture.
        seeds: number of pictures.
        depth: largest path depth.
    """

    def wishes(seed: int) -> Any:
        blocks = {
            "film": {"width": size, "height": size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": depth, "rr_depth": 5, "dark_rims": True},
            "render": {"spp": spp, "seed": seed, "compile": "off"},
        }
        return settings(scene.description, blocks)

    a = [render_scene(scene, wishes(1 + seed)).image for seed in range(seeds)]
    with tempfile.TemporaryDirectory() as folder:
        other = mitsuba.load_dict(convert(mitsuba, scene, wishes(0), Path(folder)))
    b = [torch.from_numpy(np.array(mitsuba.render(other, spp=spp, seed=seed))) for seed in range(seeds)]
    return deviates(torch.stack(a).double(), torch.stack(b).double())


def deviates(ours: Tensor, theirs: Tensor) -> Comparison:
    """Compare stacks of independent pictures ``(S, H, W, 3)``."""

    def over(side: tuple[int, int]) -> Tensor:
        (a, var_a), (b, var_b) = (spread(pooled(stack, side)) for stack in (ours, theirs))
        error = (var_a + var_b).sqrt()
        # Two pictures without noise, of a lamp for one, differ by no more than rounding.
        return torch.where(error > 1e-5 * b, (a - b) / error.clamp_min(1e-30), 0.0)

    return Comparison(ours.mean(0), theirs.mean(0), over((ours.shape[1], ours.shape[2]))[0, 0], over((BLOCK, BLOCK)))


def spread(stack: Tensor) -> tuple[Tensor, Tensor]:
    """Mean over the first dimension, and the variance of that mean."""
    return stack.mean(0), stack.var(0) / len(stack)


def pooled(stack: Tensor, side: tuple[int, int]) -> Tensor:
    """Means over blocks of pixels of pictures ``(S, H, W, 3)``."""
    return torch.nn.functional.avg_pool2d(stack.permute(0, 3, 1, 2), side).permute(0, 2, 3, 1)


if __name__ == "__main__":
    main()
