"""Compare noise at equal time: ``path``, ``bdpt``, ``vcm``, and Mitsuba's ``path`` and ``ptracer``.

    python scripts/bench_bidirectional.py caustics cornell_box [--seconds 16] [--seeds 5] [--width 128] [--ways path bdpt vcm]

A scene is a name or a file. Each way renders pictures for about so many seconds, box filter, and the table shows its squared
error times its seconds, over those of the first way. A pixel's error counts over the square of the reference and 0.01. The
columns: the mean of a picture without its largest 0.1 %; that of the mean of all pictures (which counts more of the pixels that
are rarely bright, the more pictures there are); and the median of its blocks of 8 x 8 pixels.

The reference is a long render of another seed: by ``bdpt`` with all its strategies, or what ``--reference`` says; a light that
only one way finds counts as an error of the others. Mitsuba's ways need the extra `bench`, and LLVM where
``DRJIT_LIBLLVM_PATH`` says. Other work on the machine disturbs it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.images.metrics import relative
from torchpt.scene import Scene
from torchpt.scene.formats.description import settings

BLOCK = 8
#: Integrators by the name of a way.
WAYS: dict[str, dict[str, Any]] = {
    "path": {"type": "path"},
    "bdpt": {"type": "bdpt"},
    "bdpt connected": {"type": "bdpt", "connections": "one"},
    "bdpt 1 connected": {"type": "bdpt", "light_paths": 1.0, "connections": "one"},
    "vcm": {"type": "vcm"},
}
THEIRS = {"mitsuba path": "path", "mitsuba ptracer": "ptracer"}

#: Renders a picture of a number of samples and a seed.
Shoot = Callable[[int, int], Tensor]


def main() -> None:
    """Print the table of each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--seconds", type=float, default=16.0, help="of each picture")
    parser.add_argument("--seeds", type=int, default=5, help="pictures of each way")
    parser.add_argument("--width", type=int, default=128, help="of a picture, in pixels")
    parser.add_argument("--depth", type=int, default=16)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=[*WAYS, *THEIRS])
    parser.add_argument("--reference", default="bdpt 1 connected", choices=list(WAYS), help="its way")
    parser.add_argument("--reference-seconds", type=float, default=120.0)
    arguments = parser.parse_args()
    for name in arguments.scenes:
        compare(name, arguments)


def compare(name: str, arguments: argparse.Namespace) -> None:
    """Print the table of a scene."""
    scene = torchpt.load(name, device="cpu")
    if any(way in THEIRS for way in arguments.ways):
        from mitsuba_scene import nearest

        scene = nearest(scene)
    film = {"width": arguments.width, "filter": "box"}
    ways = {way: own(scene, film, keys, arguments) for way, keys in WAYS.items()}
    with tempfile.TemporaryDirectory() as folder:
        if any(way in THEIRS for way in arguments.ways):
            ways |= others(scene, film, arguments, Path(folder))
        reference, spp, _ = timed(ways[arguments.reference], 90_001, arguments.reference_seconds)
        print(f"\n{name}, {reference.shape[1]} x {reference.shape[0]}; reference: {arguments.reference}, {spp} samples")
        print(f"{'':18s} samples  seconds  error of each, of their mean, block   over the first")
        first: tuple[float, ...] | None = None
        for way in arguments.ways:
            shoot = ways[way]
            found, seconds, spp = [], [], 0
            for seed in range(1, arguments.seeds + 1):
                picture, spp, took = timed(shoot, seed, arguments.seconds, spp)
                found.append(picture)
                seconds.append(took)
            took = sum(seconds) / len(seconds)
            costs = tuple(x * took for x in errors(found, reference))
            first = first or costs
            ratios = (x / y for x, y in zip(costs, first, strict=True))
            values, over = (", ".join(f"{x:.3g}" for x in row) for row in (costs, ratios))
            print(f"{way:18s}{spp:8d}{took:9.1f}  {values}   {over}", flush=True)


def timed(shoot: Shoot, seed: int, seconds: float, spp: int = 0) -> tuple[Tensor, int, float]:
    """Render a picture that takes about so many seconds, of ``spp`` samples if that is not 0.

    Returns:
        The picture, its samples, and its seconds.
    """
    if not spp:
        shoot(4, seed)  # compiles
        spp, took = 4, 0.0
        while took < 0.1 * seconds:  # until a render is so long that its time says that of others
            spp *= 4 if took else 1
            start = time.perf_counter()
            shoot(spp, seed)
            took = time.perf_counter() - start
        spp = max(1, round(spp * seconds / took))
    start = time.perf_counter()
    picture = shoot(spp, seed)
    return picture, spp, time.perf_counter() - start


def errors(pictures: list[Tensor], reference: Tensor) -> tuple[float, float, float]:
    """Return the relative squared error of pictures: trimmed mean of each and of their mean, and the median of its blocks."""
    of_each = torch.stack([relative((x - reference).square(), reference).mean(-1) for x in pictures])
    error = of_each.mean(0)
    each = torch.stack([trimmed_mean(x) for x in of_each]).mean()
    height, width = (side - side % BLOCK for side in error.shape)
    blocks = error[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean((1, 3))
    return float(each), float(trimmed_mean(error)), float(blocks.median())


def trimmed_mean(pixels: Tensor) -> Tensor:
    """Return the mean of pixels without the largest 0.1 %."""
    ordered = pixels.reshape(-1).sort().values
    return ordered[: len(ordered) - len(ordered) // 1000].mean()


def own(scene: Scene, film: dict[str, Any], keys: dict[str, Any], arguments: argparse.Namespace) -> Shoot:
    """Return what renders by an integrator of torchpt."""
    integrator = {**keys, "max_depth": arguments.depth, "rr_depth": 5, "dark_rims": True}

    def shoot(spp: int, seed: int) -> Tensor:
        return torchpt.render(
            scene, film=film, integrator=integrator, spp=spp, seed=seed, threads=arguments.threads, pilots=False
        ).double()

    return shoot


def others(scene: Scene, film: dict[str, Any], arguments: argparse.Namespace, folder: Path) -> dict[str, Shoot]:
    """Return what renders by integrators of Mitsuba."""
    from mitsuba_scene import convert, find_llvm, load_mitsuba

    mitsuba = load_mitsuba("llvm_ad_rgb" if find_llvm() else "scalar_rgb")
    wishes = settings(scene.description, {"film": film, "integrator": {"type": "path"}})
    theirs = mitsuba.load_dict(convert(mitsuba, scene, wishes, folder))

    def by(kind: str) -> Shoot:
        integrator = mitsuba.load_dict({"type": kind, "max_depth": arguments.depth, "rr_depth": 5})

        def shoot(spp: int, seed: int) -> Tensor:
            # In passes: a wave holds all of its paths.
            left, total, k = spp, 0.0, 0
            while left:
                now = min(left, 256)
                picture = mitsuba.render(theirs, integrator=integrator, spp=now, seed=1000 * seed + k)
                total, left, k = total + now * torch.tensor(picture.numpy(), dtype=torch.float64), left - now, k + 1
            return torch.as_tensor(total) / spp

        return shoot

    return {way: by(kind) for way, kind in THEIRS.items()}


if __name__ == "__main__":
    main()
