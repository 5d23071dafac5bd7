"""Compare gradients by geometry with Mitsuba's ``prb_projective``: how much they vary, and how fast they solve a problem.

    python scripts/bench_projective.py pairs [names] [--spp 16 --seeds 48]
    python scripts/bench_projective.py tasks [names]

``pairs``: for scenes whose derivative is known (``tests/references/known_gradients.py``), mean and standard error of each
program's gradient over seeds, its variance, the CPU time of one, and the ratio of variance times time. Both take as many
samples a pixel, and their own default for edges. ``tasks``: inverse problems of ``scripts/gradient_tasks.py`` by the same
loss, Adam and steps with either program's gradients, and after how many seconds the error of the parameters fell how far.

Each program is a process of its own on one thread; they run one after the other. Mitsuba has no derivative by the camera.
Needs the extra ``bench``.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import from_tests  # noqa: F401

OURS, THEIRS = "torchpt", "prb_projective"
PAIRS = ("ball_on_floor_radius", "block_in_corner", "ball_pose", "silhouette_vertex", "lamp_pose_room")
TASKS = ("shadow", "lit_ball", "black_ball", "round_corner")


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("what", choices=("pairs", "tasks"))
    parser.add_argument("names", nargs="*", help=f"pairs: {', '.join(PAIRS)}; tasks: {', '.join(TASKS)}")
    parser.add_argument("--spp", type=int, help="samples a pixel; by default 16, of tasks their own")
    parser.add_argument("--seeds", type=int, default=48)
    parser.add_argument("--seconds", type=float, default=120.0, help="after which a task ends")
    parser.add_argument("--guided", action="store_true", help="ours keep an EdgeGuide from call to call")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the figures go")
    parser.add_argument("--worker", choices=(OURS, THEIRS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work = pair_of if arguments.what == "pairs" else task_of
        print("\n" + json.dumps(work(arguments.names[0], arguments)), flush=True)
        return
    found: dict[str, Any] = {}
    for name in arguments.names or (PAIRS if arguments.what == "pairs" else TASKS):
        sides = {engine: ask(name, engine, arguments) for engine in (OURS, THEIRS)}
        found[name] = sides
        (print_pair if arguments.what == "pairs" else print_task)(name, sides)
        if arguments.json is not None:
            import bench_files

            bench_files.write(arguments.json, {"machine": bench_files.machine(), arguments.what: found})
    if arguments.what == "pairs":
        mean = statistics.geometric_mean(cost(sides[OURS]) / cost(sides[THEIRS]) for sides in found.values())
        print(f"geometric mean of variance x time: {mean:.3g}")


def ask(name: str, engine: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what a process of one program found."""
    given = [
        f"--{key}={value}" for key in ("spp", "seeds", "seconds") if (value := getattr(arguments, key)) is not None
    ]
    guided = ["--guided"] if arguments.guided else []
    command = [sys.executable, __file__, arguments.what, name, "--worker", engine, *given, *guided]
    answer = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    return json.loads(answer.strip().splitlines()[-1])


def renderer_of(scene: Any, arguments: argparse.Namespace) -> Callable[[Mapping[str, Any], int, int], Any]:
    """Return the renderer of a worker: a picture of parameters, samples a pixel and a seed."""
    import torchpt

    if arguments.worker == THEIRS:
        from mitsuba_gradients import shape_renderer

        return shape_renderer(scene, THEIRS)
    warnings.simplefilter("ignore", torchpt.EdgeWarning)
    guide = torchpt.EdgeGuide() if arguments.guided else None
    return lambda params, spp, seed: torchpt.render(scene, params=params, spp=spp, seed=seed, edge_guide=guide)


def pair_of(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return gradients of a pair by seed, and the CPU seconds of one."""
    import known_gradients as known
    import torch

    torch.set_num_threads(1)
    pair = known.PAIRS[name]
    scene = known.loaded(pair)
    render, weights = renderer_of(scene, arguments), known.weights().float()
    pose, spp = scene.params[pair.parameter], arguments.spp or 16

    def gradient(seed: int) -> float:
        leaf = pose.clone().requires_grad_()
        (render({pair.parameter: leaf}, spp, seed) * weights).sum().backward()
        assert leaf.grad is not None
        return float((leaf.grad * pair.along(pose)).sum())

    for seed in range(2):  # compiles
        gradient(1000 + seed)
    begin = time.process_time()
    values = [gradient(seed) for seed in range(arguments.seeds)]
    return {"values": values, "seconds": (time.process_time() - begin) / arguments.seeds}


def cost(side: Mapping[str, Any]) -> float:
    """Return variance times time."""
    return statistics.variance(side["values"]) * side["seconds"]


def print_pair(name: str, sides: Mapping[str, Mapping[str, Any]]) -> None:
    """Print a line for each program, and the ratio."""
    import gradient_pairs

    print(f"{name}: truth {gradient_pairs.truths()[name]['truth']:.5f}")
    for engine, side in sides.items():
        values = side["values"]
        error = statistics.stdev(values) / len(values) ** 0.5
        print(
            f"  {engine:15s} {statistics.mean(values):9.5f} +- {error:.5f}, variance {statistics.variance(values):.3g}, "
            f"{side['seconds']:.3f} s, variance x time {cost(side):.3g}"
        )
    print(f"  ratio of variance x time {cost(sides[OURS]) / cost(sides[THEIRS]):.3g}", flush=True)


def task_of(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the errors of a task by step, and the seconds after each."""
    import gradient_tasks
    import torch
    from inverse_tasks import TASKS as ALL
    from inverse_tasks import described

    torch.set_num_threads(1)
    render = renderer_of(described(ALL[name]), arguments)
    row = gradient_tasks.solved(name, {"threads": 1}, spp=arguments.spp, render=render, most_seconds=arguments.seconds)
    return {"errors": row["errors"], "at": row["at"]}


def print_task(name: str, sides: Mapping[str, Mapping[str, Any]]) -> None:
    """Print after how many seconds the error stays below parts of that at first, and where it ends."""
    print(name)
    for engine, side in sides.items():
        errors, at = side["errors"], side["at"]
        said = []
        for part in (0.5, 0.1, 0.01):
            above = [k for k, error in enumerate(errors) if not error <= part * errors[0]]
            last = above[-1] + 1
            said.append(f"1/{1 / part:.0f} after {at[last]:.1f} s" if last < len(errors) else f"1/{1 / part:.0f} never")
        times = errors[0] / max(errors[-1], 1e-12) if math.isfinite(errors[-1]) else 0.0
        print(f"  {engine:15s} {', '.join(said)}; {times:.1f} times less after {at[-1]:.1f} s", flush=True)


if __name__ == "__main__":
    main()
