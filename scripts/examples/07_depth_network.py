"""A small network that sees how far things are, trained on rooms that are rendered as it learns.

    python scripts/examples/07_depth_network.py --out FOLDER [--workers 2 --start spawn]

A room is a pure function of its number: the dataset holds nothing, workers give the same bits however they are started, and no
room is seen twice, so nothing can be learned by heart. Pictures are noisy (8 samples), which does for noise what photographs
need; their depth comes with them, as a layer. Rooms of other numbers are for validation.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Sequence
from functools import partial
from random import Random

import torch
from example_tools import arguments, grid
from torch import Tensor, nn
from torch.utils.data import DataLoader, Subset

from torchpt.data import RenderDataset

VALIDATION, BATCH, SPP = 32, 4, 8


def room(size: int, index: int) -> dict:
    """Return the description of a room with three boxes and two balls at random places, of random colours."""
    draw = Random(index)

    def paint() -> dict:
        return {"type": "diffuse", "reflectance": [draw.uniform(0.15, 0.8) for _ in range(3)]}

    walls = [{"scale": [draw.uniform(1.5, 2.2), 1.2, draw.uniform(2, 3.2)]}]
    down = [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [draw.uniform(-0.7, 0.7), 1.19, 0]}]
    shapes = {
        "walls": {"type": "cube", "flip_normals": True, "transform": walls, "material": paint()},
        "lamp": {"type": "rectangle", "emission": 6, "transform": [{"scale": 0.6}, *down]},
    }
    for k in range(3):
        half = [draw.uniform(0.15, 0.4), draw.uniform(0.2, 0.8), draw.uniform(0.15, 0.4)]
        place = [draw.uniform(-1.2, 1.2), half[1] - 1.2, draw.uniform(-1.5, 0.8)]
        turn = {"rotate": {"axis": [0, 1, 0], "angle": draw.uniform(0, 90)}}
        shapes[f"box{k}"] = {
            "type": "cube",
            "transform": [{"scale": half}, turn, {"translate": place}],
            "material": paint(),
        }
    for k in range(2):
        center = [draw.uniform(-1.1, 1.1), draw.uniform(-0.9, 0.5), draw.uniform(-1.2, 0.7)]
        shapes[f"ball{k}"] = {
            "type": "sphere",
            "center": center,
            "radius": draw.uniform(0.15, 0.4),
            "material": paint(),
        }
    return {
        "camera": {"origin": [0, 0, 1.9], "target": [draw.uniform(-0.2, 0.2), -0.2, 0], "fov": 75},
        "film": {"width": size, "height": size, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 3},
        "shapes": shapes,
    }


class DepthNetwork(nn.Module):
    """Down twice, up twice, with what was there before beside it (a small U-Net); it tells logarithms of depths."""

    def __init__(self) -> None:
        super().__init__()

        def block(inside: int, outside: int) -> nn.Module:
            layers = [nn.Conv2d(inside, outside, 3, padding=1), nn.GroupNorm(4, outside), nn.SiLU()]
            return nn.Sequential(*layers, nn.Conv2d(outside, outside, 3, padding=1), nn.SiLU())

        # Two more channels say where in the picture a pixel is: convolutions do not know, and floors lie below.
        self.down = nn.ModuleList([block(5, 16), block(16, 32), block(32, 48)])
        self.up = nn.ModuleList([block(48 + 32, 32), block(32 + 16, 16)])
        self.last = nn.Conv2d(16, 1, 1)

    def forward(self, pictures: Tensor) -> Tensor:
        """Depths ``(B, 1, H, W)`` of linear pictures ``(B, 3, H, W)``."""
        at = torch.linspace(-1, 1, pictures.shape[-1]).expand(len(pictures), 1, *pictures.shape[-2:])
        fine = self.down[0](torch.cat((torch.log(pictures + 0.05), at, at.mT), 1))
        half = self.down[1](nn.functional.avg_pool2d(fine, 2))
        x = self.down[2](nn.functional.avg_pool2d(half, 2))
        for block, beside in zip(self.up, (half, fine), strict=True):
            x = block(torch.cat((nn.functional.interpolate(x, scale_factor=2.0), beside), 1))
        return torch.exp(self.last(x) + 1.0)


def channels_first(batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Pictures ``(B, 3, H, W)`` and depths ``(B, 1, H, W)`` of a batch of the data set."""
    return batch["image"].permute(0, 3, 1, 2), batch["depth"].permute(0, 3, 1, 2)


def worker_arguments(parser: ArgumentParser) -> None:
    """Add the arguments of ``DataLoader``'s workers."""
    parser.add_argument("--workers", type=int, default=0, help="processes that render; 0: this one, by all its threads")
    parser.add_argument("--start", choices=("fork", "spawn"), default="spawn", help="how workers are started")


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Train it; the mean error of depth on the validation rooms at the start and at the end, which are also printed."""
    args = arguments(__doc__, steps=600, size=32, argv=argv, more=worker_arguments)
    torch.manual_seed(args.seed)
    rooms = RenderDataset(partial(room, args.size), VALIDATION + BATCH * args.steps, spp=SPP, layers=["depth"])
    seen, true = channels_first(next(iter(DataLoader(Subset(rooms, range(VALIDATION)), VALIDATION))))
    start = args.start if args.workers else None
    training = Subset(rooms, range(VALIDATION, len(rooms)))
    batches = DataLoader(training, BATCH, num_workers=args.workers, multiprocessing_context=start)

    network = DepthNetwork()
    optimizer = torch.optim.Adam(network.parameters(), lr=0.005)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)

    def error(found: Tensor) -> float:
        return float((found.detach() - true).abs().mean())

    before, mean = error(network(seen)), torch.zeros_like(true[0])
    for step, batch in enumerate(batches):
        pictures, depths = channels_first(batch)
        optimizer.zero_grad()
        # A mirrored room is another room, and costs nothing to render.
        pictures, depths = torch.cat((pictures, pictures.flip(-1))), torch.cat((depths, depths.flip(-1)))
        (network(pictures).log() - depths.log()).abs().mean().backward()
        optimizer.step()
        schedule.step()
        mean += (depths.mean(0) - mean) / (step + 1)
        if step % 100 == 99:
            print(f"after {step + 1} steps: mean error on the validation rooms {error(network(seen)):.3f}")

    after = error(network(seen))
    shown = slice(0, 5)
    grey = [((part - 1) / 4).clamp(0, 1) ** 2.2 for part in (true, network(seen))]  # depth 1 is black, 5 white
    rows = [part[shown].expand(-1, 3, -1, -1).permute(0, 2, 3, 1).unbind() for part in (seen, *grey)]
    grid(args.out / "07_depth_network.png", *rows, width=128)
    # The mean of all depths at each pixel is what could be said without looking.
    print(
        f"mean error of depths of about {float(true.mean()):.2f}: {before:.3f} -> {after:.3f}; the mean map's {error(mean):.3f}"
    )
    return before, after


if __name__ == "__main__":
    main()
