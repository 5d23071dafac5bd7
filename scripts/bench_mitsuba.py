"""Throughput beside Mitsuba 3 in the same run: ``python scripts/bench_mitsuba.py [--compile] [--rounds 5] [--quick]``.

Every contender is a process of its own that has loaded and warmed up; they render in turn, round after round, and medians
are compared, so that a noisy machine disturbs all alike. Box filter, max_depth 8, 256 x 256 on both sides. The ``torch``
traversal is timed alone. Needs the extra ``bench``; the bunny needs ``$TORCHPT_ASSETS/bunny.ply`` (else its stand-in).
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

SCENES = ("cornell_box", "cornell_bunny")
MITSUBA = ("scalar_rgb", "llvm_ad_rgb")
#: scene, contender, rival, least ratio of their rates.
BARS = (
    ("cornell_box", "eager sobol", "scalar_rgb", 0.6),
    ("cornell_box", "eager independent", "scalar_rgb", 0.9),
    ("cornell_box", "compiled sobol", "llvm_ad_rgb", 0.5),
    ("cornell_bunny", "eager sobol", "scalar_rgb", 0.5),
)


def main() -> None:
    """Run all contenders in turn and print rates and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, help=f"of {', '.join(SCENES)}")
    parser.add_argument("--compile", action="store_true", help="compiled stages too (half a minute to warm up)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--quick", action="store_true", help="one round of small pictures: that it works, no more")
    parser.add_argument("--worker", nargs=2, metavar=("SCENE", "CONTENDER"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.rounds, arguments.size, arguments.spp = 1, 64, 4
    if arguments.worker:
        scene, contender = arguments.worker
        serve(scene, contender, arguments.size, arguments.spp)
        return
    modes = ("eager", "compiled") if arguments.compile else ("eager",)
    contenders = [*MITSUBA, *(f"{mode} {sampler}" for mode in modes for sampler in ("sobol", "independent"))]
    for scene in arguments.scenes:
        report(scene, compete(scene, contenders, arguments))
        searcher = start(scene, "traversal", arguments)
        for kind, rate in ask(searcher).items():
            print(f"  {kind:50s} {rate:7.2f} Mrays/s")
        stop(searcher)


def compete(scene: str, contenders: list[str], arguments: argparse.Namespace) -> dict[str, float]:
    """Median Mpaths/s of each contender, over rounds in which all take their turn."""
    workers = {name: start(scene, name, arguments) for name in contenders}
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(arguments.rounds):
        for name, worker in workers.items():
            rates[name].append(ask(worker)["rate"])
    for worker in workers.values():
        stop(worker)
    return {name: statistics.median(values) for name, values in rates.items()}


def report(scene: str, rates: dict[str, float]) -> None:
    """Rates, ratios to both of Mitsuba's variants, and the bars of this scene."""
    print(f"{scene:42s} {'Mpaths/s':>8s}" + "".join(f"  / {name}" for name in MITSUBA))
    for name, rate in rates.items():
        ratios = "".join(f"  {rate / rates[rival]:{len(rival) + 2}.2f}" for rival in MITSUBA)
        print(f"  {name:40s} {rate:8.2f}{ratios}")
    for where, name, rival, least in BARS:
        if where == scene and name in rates:
            ratio = rates[name] / rates[rival]
            print(f"  {'ok  ' if ratio >= least else 'LOW '} {name} / {rival} = {ratio:.2f} (bar {least})", flush=True)


def start(scene: str, contender: str, arguments: argparse.Namespace) -> subprocess.Popen[str]:
    """A process that has loaded and warmed up, and renders once for every line it reads."""
    sizes = ["--size", str(arguments.size), "--spp", str(arguments.spp)]
    command = [sys.executable, __file__, *sizes, "--worker", scene, contender]
    worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    if answer(worker) != {"ready": 1}:
        raise SystemExit(f"{contender} on {scene} did not start")
    return worker


def answer(worker: subprocess.Popen[str]) -> dict[str, float] | None:
    """The next JSON of a worker; libraries may write lines of their own in between."""
    assert worker.stdout is not None
    return next((json.loads(line) for line in worker.stdout if line.startswith("{")), None)


def stop(worker: subprocess.Popen[str]) -> None:
    """Let a worker end."""
    assert worker.stdin is not None
    worker.stdin.close()
    worker.wait()


def ask(worker: subprocess.Popen[str]) -> dict[str, float]:
    """One turn of a worker."""
    assert worker.stdin is not None
    worker.stdin.write("go\n")
    worker.stdin.flush()
    rates = answer(worker)
    if rates is None:
        raise SystemExit("a contender ended before its turn")
    return rates


def serve(scene: str, contender: str, size: int, spp: int) -> None:
    """The worker: warm up, then answer each line on stdin with a JSON of rates in millions a second."""
    if contender == "traversal":
        turn = traversal(scene, size)
    elif contender in MITSUBA:
        turn = partial(timed, mitsuba(scene, contender, size, spp), size * size * spp)
    else:
        turn = partial(timed, torchpt(scene, contender, size, spp), size * size * spp)
    turn()
    print("\n" + json.dumps({"ready": 1}), flush=True)
    for _ in sys.stdin:
        print("\n" + json.dumps(turn()), flush=True)


def timed(shoot: Callable[[], Any], paths: int) -> dict[str, float]:
    """One render and its rate."""
    begin = time.perf_counter()
    shoot()
    return {"rate": paths / (time.perf_counter() - begin) / 1e6}


def wishes(size: int, spp: int, sampler: str = "sobol", compile: str = "off") -> dict[str, Any]:
    """Settings that both sides render with."""
    return {
        "film": {"width": size, "height": size, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 8, "rr_depth": 5},
        "sampler": sampler,
        "render": {"spp": spp, "compile": compile},
    }


def mitsuba(name: str, variant: str, size: int, spp: int) -> Callable[[], Any]:
    """A render of Mitsuba's, with a new seed each time."""
    import numpy as np
    from mitsuba_scene import convert, load_mitsuba

    from torchpt.scene import load
    from torchpt.scene.description import settings

    module = load_mitsuba(variant)
    scene = load(name, device="cpu")
    with tempfile.TemporaryDirectory() as folder:
        theirs = module.load_dict(convert(module, scene, settings(scene.description, wishes(size, spp)), Path(folder)))
    seeds = iter(range(1_000_000))
    return lambda: np.asarray(module.render(theirs, spp=spp, seed=next(seeds)))


def torchpt(name: str, contender: str, size: int, spp: int) -> Callable[[], Any]:
    """A render of torchpt's; ``contender`` is ``eager|compiled sobol|independent``."""
    from torchpt.render import render_scene
    from torchpt.scene import load
    from torchpt.scene.description import settings

    mode, sampler = contender.split()
    scene = load(name, device="cpu")
    wish = settings(scene.description, wishes(size, spp, sampler, "on" if mode == "compiled" else "off"))
    return lambda: render_scene(scene, wish)


def traversal(name: str, size: int) -> Callable[[], dict[str, float]]:
    """Searches alone, over camera rays and over diffuse rays from what they hit."""
    import torch

    from torchpt.math.frames import Frame
    from torchpt.math.warps import cosine_hemisphere
    from torchpt.records import Hit
    from torchpt.render import make_wave
    from torchpt.scene import load
    from torchpt.scene.description import settings
    from torchpt.shapes import interact, offset_origin

    scene = load(name, device="cpu")
    wave = make_wave(scene, settings(scene.description, wishes(size, 1)), None, torch.float32, False)
    first = wave.rays(0, size * size, 0, 1)
    t, prim, u, v = scene.accel("torch", None).intersect(first.o, first.d, first.t_max)
    seen = prim >= 0
    world, _ = scene.world(torch.float32)
    hit = Hit(t[seen], prim[seen].long(), u[seen], v[seen])
    at = interact(world, first.o[:, seen], first.d[:, seen], hit)
    frame = Frame.about(at.ns)
    side = frame.to_local(-first.d[:, seen])[2]
    local = cosine_hemisphere(torch.rand(2, len(side), generator=torch.Generator().manual_seed(0)))
    local[2] *= torch.sign(side)
    d = frame.to_world(local)
    o = offset_origin(world, at, d)
    rays = {"coherent": (first.o, first.d), "diffuse": (o, d)}

    def turn() -> dict[str, float]:
        rates = {}
        for kind in ("torch", "auto"):
            accel = scene.accel(kind, None)
            for label, (origin, direction) in rays.items():
                far = torch.full((origin.shape[1],), torch.inf)
                for query in (accel.intersect, accel.occluded):
                    query(origin, direction, far)  # warm
                    begin = time.perf_counter()
                    query(origin, direction, far)
                    rate = origin.shape[1] / (time.perf_counter() - begin) / 1e6
                    rates[f"traversal {accel.name}, {label} rays, {query.__name__}"] = rate
        return rates

    return turn


if __name__ == "__main__":
    main()
