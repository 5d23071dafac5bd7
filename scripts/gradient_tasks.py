"""Solve seventeen inverse problems with Adam.

    python scripts/gradient_tasks.py [--only albedo camera] [--json FILE] [--markdown]

The problems are those of ``tests/references/inverse_tasks.py``: albedo, texture, roughness, environment map, a free
light, a light behind an occluder, a camera, the silhouette of a black ball, a lit ball on a textured floor; a block by its
shadow, a light round a corner, the environment of a mirror ball, heights under two suns, a cylinder on a floor, a figure of
642 vertices, and one with its texture, from six views, a camera turned by five degrees. Each starts from fixed values, and
must make the error of its numbers at least ten times smaller (the maps and the figure five times, the painted figure three).

The loss is the squared difference from the target at full size and at 1/2, 1/4 and 1/8 of it: the small sizes pull
objects towards targets that they do not overlap yet. Its gradient is unbiased, since a backward pass draws its own
samples: it is the product of two independent renders. The target is rendered with another seed and ``--target-spp``
samples a pixel.

``--wish KEY=VALUE`` passes arguments to ``torchpt.render``, values as JSON: ``--wish edges=true --wish edge_spp=4``.
"""

from __future__ import annotations

import argparse
import json
import math
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import bench_files
import from_tests  # noqa: F401
import torch
from inverse_tasks import TASKS, described
from torch import Tensor

import torchpt

#: Seeds of the target and of the first step; the backward pass of a step uses another seed.
TARGET, FIRST = 1_000_003, 17
#: Factor by which Adam's learning rate has fallen at the end.
FALL = 0.01

#: Renders a picture of parameters, samples a pixel and a seed.
Render = Callable[[Mapping[str, Tensor], int, int], Tensor]


def main() -> None:
    """Solve the chosen problems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=TASKS, help="these tasks; by default all")
    parser.add_argument("--steps", type=int, help="in place of each task's own")
    parser.add_argument("--spp", type=int, help="in place of each task's own")
    parser.add_argument("--target-spp", type=int, default=1024)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--wish", action="append", default=[], metavar="KEY=VALUE", help="for torchpt.render")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the figures go")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table as well")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    wishes = {key: json.loads(value) for key, value in (wish.split("=", 1) for wish in arguments.wish)}
    wishes |= {"threads": arguments.threads}
    found: dict[str, Any] = {}
    print(f"{'task':14s}{'error before':>14s}{'after':>10s}{'times less':>12s}{'bar':>6s}{'steps':>7s}{'s':>8s}")
    for name in arguments.only or TASKS:
        row = found[name] = solved(name, wishes, arguments.steps, arguments.spp, arguments.target_spp)
        print(
            f"{name:14s}{row['before']:14.4f}{row['after']:10.4f}{row['ratio']:12.1f}{row['bar']:6.0f}{row['steps']:7d}"
            f"{row['seconds']:8.1f}  {'ok' if row['passes'] else 'fails'}",
            flush=True,
        )
        if arguments.json is not None:
            bench_files.write(arguments.json, {"wishes": wishes, "machine": bench_files.machine(), "tasks": found})
    print(f"{sum(row['passes'] for row in found.values())} of {len(found)} pass")
    if arguments.markdown:
        print(markdown(found))


def solved(
    name: str,
    wishes: dict[str, Any],
    steps: int | None = None,
    spp: int | None = None,
    target_spp: int = 1024,
    render: Render | None = None,
    most_seconds: float = math.inf,
) -> dict[str, Any]:
    """Optimise a problem from its starting point to its last step, or until it took ``most_seconds``.

    ``render``: by default torchpt with ``wishes``.
    """
    task = TASKS[name]
    steps, spp = steps or task.steps, spp or task.spp
    scene = described(task)
    with torch.no_grad():
        plain = {"threads": wishes["threads"]} if "threads" in wishes else {}
        true, views = task.params(scene, task.true(scene)), task.seen()
        targets = [
            torchpt.render(scene, params={**true, **view}, spp=target_spp, seed=TARGET, **plain) for view in views
        ]

    def by_torchpt(params: Mapping[str, Tensor], spp: int, seed: int) -> Tensor:
        return torchpt.render(scene, params=params, spp=spp, seed=seed, **wishes)

    render = by_torchpt if render is None else render
    numbers = task.start(scene).clone().requires_grad_()
    adam = torch.optim.Adam([numbers], lr=task.rate, betas=(0.9, 0.95))
    schedule = torch.optim.lr_scheduler.LambdaLR(
        adam, lambda step: FALL + (1 - FALL) * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1)))
    )
    errors, at = [task.error(scene, numbers)], [0.0]
    begin = time.perf_counter()
    for step in range(steps):
        adam.zero_grad()
        params = task.params(scene, numbers)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", torchpt.EdgeWarning)
            pictures = [render({**params, **view}, spp, FIRST + step) for view in views]
        losses = [loss(picture, target) for picture, target in zip(pictures, targets, strict=True)]
        torch.stack(losses).sum().backward()
        assert numbers.grad is not None
        if not torch.isfinite(numbers.grad).all():
            errors.append(math.inf)
            break
        adam.step()
        schedule.step()
        with torch.no_grad():
            numbers.clamp_(*task.bounds)
        errors.append(task.error(scene, numbers))
        at.append(time.perf_counter() - begin)
        if at[-1] > most_seconds:
            break
    before, after = errors[0], errors[-1]
    ratio = before / max(after, 1e-12)  # 0 where a gradient was not finite
    return {
        "before": before, "after": after, "ratio": ratio, "bar": task.bar, "passes": ratio >= task.bar,
        "steps": len(errors) - 1, "spp": spp, "seconds": time.perf_counter() - begin, "errors": errors, "at": at,
    }  # fmt: skip


def loss(picture: Tensor, target: Tensor) -> Tensor:
    """Return the squared difference of two pictures ``(H, W, 3)``, and of their means over squares of 2, 4 and 8 pixels."""
    off = (picture - target).permute(2, 0, 1)
    return torch.stack([torch.nn.functional.avg_pool2d(off, size).square().mean() for size in (1, 2, 4, 8)]).sum()


def markdown(found: dict[str, Any]) -> str:
    """Return the table for the documentation."""
    lines = [
        "| task | error before | after | times less | bar | steps | s | |",
        "|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for name, row in found.items():
        lines.append(
            f"| `{name}` | {row['before']:.4f} | {row['after']:.4f} | {row['ratio']:.1f} | {row['bar']:.0f} | {row['steps']} | "
            f"{row['seconds']:.0f} | {'ok' if row['passes'] else 'fails'} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
