"""Make the convergence pictures of the docs, which compare samplers and strategies at equal numbers of samples.

python scripts/make_convergence.py [--out docs/images] [--only samplers points veach blue_noise]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.images.colour import display
from torchpt.physics.samplers import Dimension, Sampler, points_of, salts

#: Soft shadows of two balls on a floor, under one lamp.
SHADOWS: dict[str, Any] = {
    "camera": {"origin": [0, 3.2, 5], "target": [0, 0.35, 0], "fov": 40},
    "integrator": {"type": "path", "max_depth": 4},
    "materials": {
        "floor": {"type": "diffuse", "reflectance": 0.7},
        "red": {"type": "diffuse", "reflectance": [0.6, 0.2, 0.15]},
        "blue": {"type": "diffuse", "reflectance": [0.2, 0.3, 0.6]},
    },
    "shapes": {
        "floor": {"type": "rectangle", "material": "floor", "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 20}]},
        "left": {"type": "sphere", "center": [-0.8, 0.6, 0], "radius": 0.6, "material": "red"},
        "right": {"type": "sphere", "center": [0.7, 0.45, 0.5], "radius": 0.45, "material": "blue"},
        "lamp": {"type": "rectangle", "emission": 9, "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"scale": 1.2}, {"translate": [2, 4, -1]}]},
    },
}  # fmt: skip


def beside(pictures: list[Tensor], magnify: int = 1, gap: int = 4) -> Tensor:
    """Place pictures in a row: display values ``(H, W, 3)``, white between them; each pixel ``magnify`` wide."""
    shown = [display(p).repeat_interleave(magnify, 0).repeat_interleave(magnify, 1) for p in pictures]
    between = torch.ones(shown[0].shape[0], gap, 3)
    row = [part for picture in shown for part in (picture, between)]
    return torch.cat(row[:-1], 1)


def save(out: Path, name: str, picture: Tensor) -> None:
    """Write display values (already encoded)."""
    torchpt.write_image(out / name, picture, gamma=1.0)
    print(f"{out / name}: {(out / name).stat().st_size / 1000:.0f} kB")


def samplers(out: Path) -> None:
    """Render part of a soft shadow with Sobol' and independent points at 128 samples a pixel."""
    scene = torchpt.load(SHADOWS, device="cpu")
    film = {"width": 320, "height": 320, "filter": "box", "crop": [130, 165, 110, 85]}
    pictures = [torchpt.render(scene, spp=128, film=film, sampler=kind) for kind in ("sobol", "independent")]
    save(out, "sampler_sobol_independent.png", beside(pictures, 3))


def blue_noise(out: Path) -> None:
    """Render with sobol and zsobol at one sample a pixel."""
    scene = torchpt.load(SHADOWS, device="cpu")
    film = {"width": 256, "height": 256, "filter": "box", "crop": [10, 60, 200, 150]}
    keys = {"film": film, "integrator": "direct", "spp": 1}
    save(
        out,
        "sampler_zsobol.png",
        beside([torchpt.render(scene, sampler=kind, **keys) for kind in ("sobol", "zsobol")], 2),
    )


def veach(out: Path) -> None:
    """Render Veach's plates with BSDF sampling, light sampling, and both."""
    scene = torchpt.load("veach_mis", device="cpu")
    pictures = [
        torchpt.render(scene, spp=32, film={"width": 240, "height": 160, "filter": "box"}, sampler="independent",
                       integrator={"type": "direct", "strategy": strategy})
        for strategy in ("bsdf", "light", "mis")
    ]  # fmt: skip
    save(out, "veach_strategies.png", beside(pictures))


def points(out: Path) -> None:
    """Draw scatter plots of 128 points: random, stratified, Hammersley, Sobol'."""
    import matplotlib  # pyright: ignore[reportMissingImports]  (extra `bench`)

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt  # pyright: ignore[reportMissingImports]

    count = 128
    figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
    for axis, kind in zip(axes, ("independent", "stratified", "hammersley", "sobol"), strict=True):
        key = Sampler(kind, 1, 1, count).key(torch.zeros(count, dtype=torch.int64), torch.arange(count))
        x, y = points_of(kind).draw_2d(key, salts(1, torch.device("cpu"))[int(Dimension.LIGHT)])
        axis.plot(x.numpy(), y.numpy(), "o", markersize=2.6, color="black")
        axis.set(title=kind, xlim=(0, 1), ylim=(0, 1), aspect="equal", xticks=[0, 1], yticks=[0, 1])
    figure.savefig(out / "sampler_points.png", dpi=80)
    plt.close(figure)
    print(f"{out / 'sampler_points.png'}: {(out / 'sampler_points.png').stat().st_size / 1000:.0f} kB")


PICTURES: dict[str, Callable[[Path], None]] = {
    "samplers": samplers,
    "points": points,
    "veach": veach,
    "blue_noise": blue_noise,
}


def main() -> None:
    """Make the chosen pictures, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / "docs" / "images")
    parser.add_argument("--only", nargs="+", choices=list(PICTURES), default=list(PICTURES))
    arguments = parser.parse_args()
    for name in arguments.only:
        PICTURES[name](arguments.out)


if __name__ == "__main__":
    main()
