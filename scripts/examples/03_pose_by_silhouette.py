"""The pose of a black chair before a white sky: all that the picture tells is its outline.

    python scripts/examples/03_pose_by_silhouette.py --out FOLDER

No point of the chair changes its colour as it moves, so the derivative of every single sample is 0. All of the gradient is
that of edges: how fast an outline sweeps over the film, times the jump across it. `edges=False` would leave nothing.

A pose has six numbers, a rotation vector and a translation (`example_tools.pose`). The start must overlap the target, and
resemble it: a silhouette seen from the opposite side is nearly its own mirror image, and Adam does not jump.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import trimesh
from example_tools import arguments, grid, pose, turned_by
from trimesh.transformations import translation_matrix

import torchpt

#: Size and middle of each board of the chair; where two meet they overlap, as no two faces may lie in one place.
BOARDS = [((1.0, 0.12, 1.0), (0, 0, 0)), ((1.0, 0.9, 0.12), (0, 0.48, -0.42)), ((0.12, 0.5, 0.8), (0.4, 0.28, 0.05))]
BOARDS += [((0.14, 0.9, 0.14), (x, -0.47, z)) for x in (-0.41, 0.41) for z in (-0.41, 0.41)]
TURN, SHIFT = torch.tensor([0.35, -0.45, 0.25]), torch.tensor([0.3, -0.2, 0.35])


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Find the pose; its error at the start and at the end in degrees, which are also printed."""
    args = arguments(__doc__, steps=120, size=48, argv=argv)
    boards = [trimesh.creation.box(extents, translation_matrix(middle)) for extents, middle in BOARDS]
    scene = torchpt.load(
        {
            "camera": {"origin": [1.2, 1.4, 4.5], "target": [0.1, -0.1, 0], "fov": 37},
            "film": {"width": args.size, "height": args.size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "shapes": {
                "chair": {
                    "type": "mesh",
                    "mesh": trimesh.util.concatenate(boards),
                    "material": {"type": "diffuse", "reflectance": 0},
                }
            },
            "lights": {"sky": {"type": "constant"}},
        }
    )
    true = pose(TURN, SHIFT)
    target = torchpt.render(scene, params={"shapes.chair.to_world": true}, spp=256, seed=args.seed + 1000)

    numbers = torch.zeros(6, requires_grad=True)  # radians, then lengths
    optimizer = torch.optim.Adam([numbers], lr=0.03)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.0003)

    def errors() -> tuple[float, float]:
        now = pose(numbers[:3], numbers[3:]).detach()
        return turned_by(now, true), float((now - true)[:3, 3].norm())

    before, seen = errors(), []
    for step in range(args.steps):
        optimizer.zero_grad()
        to_world = pose(numbers[:3], numbers[3:])
        picture = torchpt.render(scene, params={"shapes.chair.to_world": to_world}, spp=8, seed=args.seed + step)
        if step in (0, args.steps // 6):
            seen.append(picture)
        (picture - target).square().mean().backward()
        optimizer.step()
        schedule.step()

    after = errors()
    found = torchpt.render(scene, params={"shapes.chair.to_world": pose(*numbers.detach().split(3))}, spp=64)
    grid(args.out / "03_pose_by_silhouette.png", [target, *seen, found])
    print(f"turned by {before[0]:.2f} -> {after[0]:.3f} degrees, off by {before[1]:.3f} -> {after[1]:.4f}")
    return before[0], after[0]


if __name__ == "__main__":
    main()
