"""The paints of a room from eight views, shared by the processes of DistributedDataParallel.

    python scripts/examples/08_distributed.py --out FOLDER
    torchrun --nproc-per-node 2 scripts/examples/08_distributed.py --out FOLDER

Each process renders its own views and differentiates them; DistributedDataParallel averages the gradients, so that all take
the same step. Seeds belong to views and steps, not to processes: two processes find what one finds, up to rounding. The first
gradient and the paints are saved beside the picture, as 08_distributed.pt.
"""

from __future__ import annotations

import gc
import os
from collections.abc import Sequence

import torch
import torch.distributed as dist
from example_tools import arguments, grid
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

import torchpt

VIEWS, SPP = 8, 8
PAINTS = {"left": [0.7, 0.15, 0.1], "right": [0.1, 0.5, 0.2], "back": [0.3, 0.35, 0.7], "ball": [0.8, 0.6, 0.2]}


def room() -> torchpt.Scene:
    """Return a room of three walls, a floor, a ball and a lamp; all that is painted is grey."""
    walls = {
        "back": ([], [0, 0, -1]),
        "left": ([0, 1, 0, 90], [-1, 0, 0]),
        "right": ([0, 1, 0, -90], [1, 0, 0]),
        "floor": ([1, 0, 0, -90], [0, -1, 0]),
    }
    shapes: dict = {"ball": {"type": "sphere", "center": [0.2, -0.6, 0], "radius": 0.4, "material": "ball"}}
    for name, (turn, place) in walls.items():
        turns = [{"rotate": {"axis": turn[:3], "angle": turn[3]}}] if turn else []
        transform = [*turns, {"translate": place}]
        shapes[name] = {"type": "rectangle", "transform": transform, "material": name if name in PAINTS else "white"}
    down = [{"scale": 0.4}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 0.99, 0]}]
    shapes["lamp"] = {"type": "rectangle", "emission": 8, "transform": down}
    grey = {"type": "diffuse", "reflectance": [0.5, 0.5, 0.5]}
    return torchpt.load(
        {
            "camera": {"origin": [0, 0, 3.2], "target": [0, 0, 0], "fov": 45},
            "film": {"filter": "box"},
            "integrator": {"type": "path", "max_depth": 4},
            "materials": {name: grey for name in (*PAINTS, "white")},
            "shapes": shapes,
        },
        device="cpu",
    )


def views() -> Tensor:
    """Return the poses of all cameras ``(VIEWS, 4, 4)``: on an arc before the room."""
    angle = torch.linspace(-0.4, 0.4, VIEWS)
    origin = torch.stack((3.2 * angle.sin(), 0.2 * (5 * angle).cos(), 3.2 * angle.cos()), 1)
    return torchpt.nn.look_at_pose(origin, torch.zeros_like(origin))


class Paints(nn.Module):
    """Colours between 0 and 1, one for each paint, and the pictures of a room that is painted with them."""

    def __init__(self, scene: torchpt.Scene, size: int) -> None:
        super().__init__()
        self.scene, self.size = scene, size
        self.raw = nn.Parameter(torch.zeros(len(PAINTS), 3))

    def forward(self, cameras: Tensor, seeds: list[int]) -> Tensor:
        """Return pictures ``(V, H, W, 3)`` by cameras ``(V, 4, 4)``, each with its own seed."""
        colours = torch.sigmoid(self.raw)
        return pictures(self.scene, colours, cameras, seeds, SPP, self.size)


def pictures(scene: torchpt.Scene, colours: Tensor, cameras: Tensor, seeds: list[int], spp: int, size: int) -> Tensor:
    """Return pictures ``(V, H, W, 3)`` of the room with paints ``colours (4, 3)``."""
    params = {f"materials.{name}.reflectance": colour[None] for name, colour in zip(PAINTS, colours, strict=True)}
    return torchpt.render_batch(scene, cameras, params, spp=spp, seed=[seeds], film=(size, size))[0]


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Fit the paints; their root mean square error at the start and at the end, which the first process also prints."""
    args = arguments(__doc__, steps=120, size=32, argv=argv)
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    if VIEWS % world:
        raise SystemExit(f"08_distributed: {world} processes cannot share {VIEWS} views evenly")
    if world > 1:
        dist.init_process_group("gloo")

    own = list(range(rank, VIEWS, world))  # as many for each process: the mean of means is the mean
    scene, cameras = room(), views()[own]
    truth = torch.tensor(list(PAINTS.values()))
    targets = pictures(scene, truth, cameras, [10_000 + view for view in own], 64, args.size)
    paints = Paints(scene, args.size)
    model = DistributedDataParallel(paints) if world > 1 else paints
    optimizer = torch.optim.Adam(model.parameters(), lr=0.2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps)

    def error() -> float:
        return float((torch.sigmoid(paints.raw.detach()) - truth).square().mean().sqrt())

    before, first_gradient = error(), torch.empty(0)
    for step in range(args.steps):
        optimizer.zero_grad()
        seeds = [args.seed + step * VIEWS + view for view in own]
        (model(cameras, seeds) - targets).square().mean().backward()
        assert paints.raw.grad is not None
        if step == 0:
            first_gradient = paints.raw.grad.clone()
        optimizer.step()
        schedule.step()

    after = error()
    if rank == 0:
        found = torch.sigmoid(paints.raw.detach())
        torch.save({"gradient": first_gradient, "paints": found}, args.out / "08_distributed.pt")
        shown = views()[[0, 2, 5, 7]]
        rows = [
            pictures(scene, colours, shown, [0, 1, 2, 3], 64, args.size)
            for colours in (truth, torch.full((len(PAINTS), 3), 0.5), found)
        ]
        grid(args.out / "08_distributed.png", *[list(row) for row in rows], width=128)
        print(f"{world} processes: error of the paints (rms) {before:.3f} -> {after:.4f}")
    if world > 1:
        # What holds the group has to go before it: else gloo's threads now and then abort a process that ends.
        del model
        gc.collect()
        dist.destroy_process_group()
    return before, after


if __name__ == "__main__":
    main()
