"""Where a picture of a known room was taken from: position, direction and angle of view of its camera.

    python scripts/examples/05_camera_calibration.py --out FOLDER

Seven numbers: a rotation vector and a translation (`example_tools.pose`), and the logarithm of a size. What they
mean is half of the work. Turning a camera and moving it aside shift the picture alike, and so do a step back and a wider
angle: Adam, which weighs each number by itself, creeps along such valleys. So the camera turns about a point ahead,
where the things are, and as it nears that point its angle widens: things keep their place and size, and
perspective alone tells these numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from example_tools import arguments, grid, pose, turned_by
from torch import Tensor

import torchpt

EYE, FOV = [0.35, 0.2, 2.7], 46.0
TURN, SHIFT, FOV_AT_START = torch.tensor([0.05, -0.06, 0.05]), torch.tensor([0.2, -0.15, 0.25]), 52.0
AHEAD = 3.0


def box(size: list[float], angle: float, place: list[float], colour: list[float]) -> dict:
    """Return a box of half-widths ``size``, turned about y."""
    transform = [{"scale": size}, {"rotate": {"axis": [0, 1, 0], "angle": angle}}, {"translate": place}]
    return {"type": "cube", "transform": transform, "material": {"type": "diffuse", "reflectance": colour}}


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Find it; how far the position is off at the start and at the end, which are also printed."""
    args = arguments(__doc__, steps=280, size=40, argv=argv)
    behind = [{"scale": 0.8}, {"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 0.1, 3.15]}]
    scene = torchpt.load(
        {
            "camera": {"origin": EYE, "target": [0, -0.15, 0], "fov": FOV},
            "film": {"width": args.size, "height": args.size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 3},
            "shapes": {
                "room": {**box([1.6, 1, 3.2], 0, [0, 0, 0], [0.7, 0.7, 0.7]), "flip_normals": True},
                "lamp": {"type": "rectangle", "emission": 9, "transform": behind},
                "red": box([0.25, 0.5, 0.3], 20, [-0.7, -0.5, -0.6], [0.7, 0.1, 0.1]),
                "green": box([0.35, 0.25, 0.25], -30, [0.5, -0.75, 0.3], [0.1, 0.5, 0.15]),
                "blue": box([0.2, 0.7, 0.2], 10, [0.9, -0.3, -1.2], [0.1, 0.2, 0.7]),
                "shelf": box([0.6, 0.04, 0.3], 0, [-0.3, 0.35, -2.8], [0.6, 0.4, 0.1]),
                "door": box([0.35, 0.6, 0.03], 0, [-0.9, -0.4, -3.15], [0.25, 0.15, 0.1]),
            },
        }
    )
    target = torchpt.render(scene, spp=256, seed=args.seed + 1000)  # by the scene's own camera, which is the true one
    true = scene.params["camera.to_world"].clone()
    start = true @ pose(TURN, SHIFT)

    numbers = torch.zeros(7, requires_grad=True)  # radians, lengths, and the logarithm of the size
    optimizer = torch.optim.Adam([numbers], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.0004)

    ahead = pose(torch.zeros(3), torch.tensor([0.0, 0.0, AHEAD]))

    def camera(n: Tensor) -> dict[str, Tensor]:
        half = math.tan(math.radians(FOV_AT_START / 2)) * n[6].exp() * AHEAD / (AHEAD - n[5])
        to_world = start @ ahead @ pose(n[:3], n[3:6]) @ ahead.inverse()
        return {"camera.to_world": to_world, "camera.fov": torch.rad2deg(2 * torch.atan(half))}

    def errors() -> tuple[float, float, float]:
        now = camera(numbers.detach())
        place = float((now["camera.to_world"] - true)[:3, 3].norm())
        return place, turned_by(now["camera.to_world"], true), abs(float(now["camera.fov"]) - FOV)

    before, seen = errors(), []
    for step in range(args.steps):
        optimizer.zero_grad()
        picture = torchpt.render(scene, params=camera(numbers), spp=8, seed=args.seed + step)
        if step == 0:
            seen.append(picture)
        (picture - target).square().mean().backward()
        optimizer.step()
        schedule.step()

    seen.append(torchpt.render(scene, params=camera(numbers.detach()), spp=64))
    # The last one is what is left: ten times the difference, on grey.
    grid(args.out / "05_camera_calibration.png", [target, *seen, 0.2 + 10 * (seen[1] - target)])
    names = ("position off by", "direction (degrees)", "angle of view (degrees)")
    print("; ".join(f"{n} {a:.3f} -> {b:.4f}" for n, a, b in zip(names, before, errors(), strict=True)))
    return before[0], errors()[0]


if __name__ == "__main__":
    main()
