"""An environment map from one picture of a ball, half mirror and half chalk.

    python scripts/examples/02_environment_map.py --out FOLDER

A mirror ball shows nearly all directions, as light probes do. Here it is blurred by its roughness and mixed with white
that sums up half of the sky at every point; the renderer's gradient takes both apart. Directions behind the ball are seen
only in its rim, squeezed into few pixels, and come out worst.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from example_tools import arguments, grid
from torch import Tensor

import torchpt

ROWS, COLUMNS = 12, 24


def sky() -> Tensor:
    """Blue above, brown below, an orange sun and a window, ``(ROWS, COLUMNS, 3)``."""
    row, column = torch.arange(ROWS)[:, None, None], torch.arange(COLUMNS)[None, :, None]
    blue, brown = torch.tensor([0.3, 0.5, 0.9]), torch.tensor([0.25, 0.18, 0.1])
    ground = torch.sigmoid((row - (ROWS - 1) / 2.0) * 2.0)
    sun = torch.exp(-0.5 * ((row - 3) / 1.2) ** 2 - 0.5 * ((column - 16) / 1.5) ** 2)
    window = ((row >= 3) & (row <= 5) & (column >= 8) & (column <= 10)).float()
    colours = sun * torch.tensor([4.0, 2.2, 0.8]) + window * torch.tensor([1.5, 1.8, 1.2])
    return blue + ground * (brown - blue) + colours


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Find it; the map's error (rms over the sphere) at the start and at the end, which are also printed."""
    args = arguments(__doc__, steps=150, size=40, argv=argv)
    torchpt.write_image(args.out / "02_start.exr", torch.full((ROWS, COLUMNS, 3), 0.6))
    metal = {"type": "roughconductor", "eta": [0.2, 0.3, 0.6], "k": [4, 4, 4], "alpha": 0.08}
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 5], "target": [0, 0, 0], "fov": 24},
            "film": {"width": args.size, "height": args.size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "materials": {"chalk": {"type": "diffuse", "reflectance": 0.8}, "metal": metal},
            "shapes": {
                "ball": {"type": "sphere", "material": {"type": "blend", "a": "chalk", "b": "metal", "weight": 0.6}}
            },
            "lights": {"sky": {"type": "envmap", "path": str(args.out / "02_start.exr")}},
        }
    )
    target = torchpt.render(scene, params={"lights.sky.texels": sky()}, spp=512, seed=args.seed + 1000)

    # Radiance is positive and spans decades, so Adam moves its logarithm. Near the poles texels stand for little of the
    # sphere, and the error weighs them by it.
    logs = torch.full((ROWS, COLUMNS, 3), math.log(0.6), requires_grad=True)
    share = torch.sin(torch.arange(ROWS) * math.pi / (ROWS - 1))[:, None, None].expand(ROWS, COLUMNS, 3)
    optimizer = torch.optim.Adam([logs], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.001)

    def error() -> float:
        return float(((logs.detach().exp() - sky()).square() * share).sum().div(share.sum()).sqrt())

    def shown() -> Tensor:
        return torchpt.render(scene, params={"lights.sky.texels": logs.detach().exp()}, spp=64)

    before, at_start = error(), shown()
    for step in range(args.steps):
        optimizer.zero_grad()
        picture = torchpt.render(scene, params={"lights.sky.texels": logs.exp()}, spp=8, seed=args.seed + step)
        # A relative error: else the sun, ten times as bright as the rest, is all that counts.
        ((picture - target).square() / (target + 0.1)).mean().backward()
        optimizer.step()
        schedule.step()

    maps = [sky(), torch.full_like(sky(), 0.6), logs.exp()]
    grid(args.out / "02_environment_map.png", [target, at_start, shown()], maps, exposure=-1.0)
    print(f"environment map, rms error over the sphere: {before:.3f} -> {error():.3f}")
    return before, error()


if __name__ == "__main__":
    main()
