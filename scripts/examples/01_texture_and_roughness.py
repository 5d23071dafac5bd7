"""The texture and the roughness of a painted board, from two pictures of it.

    python scripts/examples/01_texture_and_roughness.py --out FOLDER

The highlight hides the paint and tells the roughness; the second picture shows what the highlight of the first one
hides. The pictures to match have another seed, as a photograph has noise of its own: nothing is found by matching noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from example_tools import arguments, grid
from torch import Tensor

import torchpt

TEXELS = 16
ROUGHNESS = 0.3
EYES = ([0.0, -0.6, 3.2], [1.8, -0.4, 2.6])


def paint() -> Tensor:
    """Rings of changing colours, ``(TEXELS, TEXELS, 3)``."""
    at = (torch.arange(TEXELS) + 0.5) / TEXELS * 2 - 1
    radius, angle = (at[:, None] ** 2 + at**2).sqrt(), torch.atan2(at[:, None], at)
    hue = torch.cos(angle[..., None] + torch.tensor([0.0, 2.1, 4.2]))
    return 0.5 + 0.4 * hue * torch.cos(5 * radius)[..., None]


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Find them; the texture's error (rms) at the start and at the end, which are also printed."""
    args = arguments(__doc__, steps=200, size=48, argv=argv)
    # The map's file says how many texels there are. Their values come by `params`.
    torchpt.write_image(args.out / "01_grey.exr", torch.full((TEXELS, TEXELS, 3), 0.5))
    image = {"type": "image", "path": str(args.out / "01_grey.exr")}
    lamp = [{"scale": 0.4}, {"rotate": {"axis": [1, 0, 0], "angle": 155}}, {"translate": [0, 1.3, 2.6]}]
    views = [
        torchpt.load(
            {
                "camera": {"origin": eye, "target": [0, 0, 0], "fov": 38},
                "film": {"width": args.size, "height": args.size, "filter": "box"},
                "integrator": {"type": "path", "max_depth": 2},
                "materials": {"paint": {"type": "principled", "base_color": image, "roughness": ROUGHNESS}},
                "shapes": {
                    "board": {"type": "rectangle", "material": "paint"},
                    "lamp": {"type": "rectangle", "emission": 30, "transform": lamp},
                },
            }
        )
        for eye in EYES
    ]

    true = {"materials.paint.base_color": paint()}
    targets = [torchpt.render(view, params=true, spp=256, seed=args.seed + 1000) for view in views]

    # Sigmoids keep both within 0..1, whatever Adam does.
    texels = torch.zeros(TEXELS, TEXELS, 3, requires_grad=True)
    rough = torch.tensor(1.5, requires_grad=True)
    optimizer = torch.optim.Adam([texels, rough], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.001)

    def found() -> dict[str, Tensor]:
        return {"materials.paint.base_color": texels.sigmoid(), "materials.paint.roughness": rough.sigmoid()}

    def error() -> float:
        return float((texels.detach().sigmoid() - paint()).square().mean().sqrt())

    before, at_start = error(), [torchpt.render(view, params=found(), spp=64).detach() for view in views]
    for step in range(args.steps):
        optimizer.zero_grad()
        for view, target in zip(views, targets, strict=True):
            picture = torchpt.render(view, params=found(), spp=8, seed=args.seed + step)
            (picture - target).square().mean().backward()
        optimizer.step()
        schedule.step()

    at_end = [torchpt.render(view, params=found(), spp=64).detach() for view in views]
    rows = [[targets[k], at_start[k], at_end[k]] for k in range(2)]
    bare = [paint(), torchpt.read_image(args.out / "01_grey.exr"), texels.sigmoid()]
    bare = [part.flip(0) for part in bare]  # the board has their first row at the bottom
    grid(args.out / "01_texture_and_roughness.png", *rows, bare)
    print(f"texture, rms error: {before:.3f} -> {error():.4f}")
    print(f"roughness: {1 / (1 + math.exp(-1.5)):.3f} -> {float(rough.detach().sigmoid()):.4f} (true {ROUGHNESS})")
    return before, error()


if __name__ == "__main__":
    main()
