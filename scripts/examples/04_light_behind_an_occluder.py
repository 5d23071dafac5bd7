"""A lamp that hides behind a fence, found by the shadow of the fence.

    python scripts/examples/04_light_behind_an_occluder.py --out FOLDER

Three coordinates and a power; the lamp is a point, which no picture shows. A near, dim one and a far, bright one may light
the floor alike, but not throw the same shadow. What tells the place is where the borders of shadows run: jumps, which the
renderer samples by themselves (docs/explanations/gradients.md, "Edges that move").
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from example_tools import arguments, grid
from torch import Tensor

import torchpt

PLACE, POWER = torch.tensor([0.55, 1.3, -1.1]), 10.0
START, POWER_AT_START = torch.tensor([0.0, 1.8, -1.7]), 5.0
#: Middle and half-widths of the fence's boards.
BOARDS = [((x, 0.45, 0.05), (0.12, 0.44, 0.04)) for x in (-0.75, 0, 0.75)]
BOARDS += [((0, y, -0.05), (1.2, 0.1, 0.04)) for y in (0.3, 0.75)]


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Find it; how far its place is off at the start and at the end, which are also printed."""
    args = arguments(__doc__, steps=120, size=48, argv=argv)
    flat = {"rotate": {"axis": [1, 0, 0], "angle": -90}}
    white, red = ({"type": "diffuse", "reflectance": colour} for colour in ([0.7, 0.7, 0.7], [0.6, 0.15, 0.1]))
    fence = {
        f"board{k}": {"type": "cube", "material": red, "transform": [{"scale": [*half]}, {"translate": [*middle]}]}
        for k, (middle, half) in enumerate(BOARDS)
    }
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 4.2, 3.6], "target": [0, 0, 0.7], "fov": 42},
            "film": {"width": args.size, "height": args.size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "shapes": {"floor": {"type": "rectangle", "material": white, "transform": [flat, {"scale": 8}]}, **fence},
            "lights": {
                "lamp": {"type": "point", "position": PLACE.tolist(), "intensity": POWER},
                "sky": {"type": "constant", "radiance": 0.05},
            },
        }
    )

    def lamp(place: Tensor, power: Tensor) -> dict[str, Tensor]:
        return {"lights.lamp.position": place, "lights.lamp.intensity": power.expand(3)}

    target = torchpt.render(scene, spp=256, seed=args.seed + 1000)

    place = START.clone().requires_grad_()
    log_power = torch.tensor(
        math.log(POWER_AT_START), requires_grad=True
    )  # a power is positive: Adam moves its logarithm
    optimizer = torch.optim.Adam([place, log_power], lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.0005)

    def off() -> float:
        return float((place.detach() - PLACE).norm())

    before, seen = off(), []
    for step in range(args.steps):
        optimizer.zero_grad()
        picture = torchpt.render(scene, params=lamp(place, log_power.exp()), spp=8, seed=args.seed + step)
        if step == 0:
            seen.append(picture)
        # Relative to the target, so that shadows count. (A difference of logarithms would count noise as darkness, and find
        # too bright a lamp: the mean of a logarithm is below the logarithm of the mean.)
        ((picture - target) / (target + 0.05)).square().mean().backward()
        optimizer.step()
        schedule.step()

    seen.append(torchpt.render(scene, params=lamp(place.detach(), log_power.detach().exp()), spp=64))
    power = float(log_power.detach().exp())
    grid(args.out / "04_light_behind_an_occluder.png", [target, *seen])
    print(f"place off by {before:.3f} -> {off():.4f}, power {POWER_AT_START:g} -> {power:.2f} (true {POWER:g})")
    return before, off()


if __name__ == "__main__":
    main()
