"""Run a renderer as a process that stays warm, for ``bench_mitsuba.py``.

``python scripts/bench_workers.py SCENE ENGINE --size=256 ...`` loads a scene, warms up, writes a line of JSON, and then renders
once for every line of JSON that it reads: ``{"spp": 64, "seed": 1, "out": "picture.npy"}``, where ``out`` may be missing. It
answers with the number of samples taken, the wall time from the call to the picture in memory, and the picture's mean.
Mitsuba's ``multijitter`` takes full rows of as many samples as the root, rounded down: 7 samples are 2 x 4, 128 are 11 x 12.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpt.scene import Scene
    from torchpt.scene.settings import Settings

DEPTH = 8
OURS, LLVM, SCALAR, CUDA = "torchpt", "llvm_ad_rgb", "scalar_rgb", "cuda_ad_rgb"

#: Renders a picture ``(H, W, 3)`` from samples a pixel and seed; also returns the number of samples taken.
Shoot = Callable[[int, int], tuple[Any, int]]
Workers = dict[str, "subprocess.Popen[str]"]


@dataclass(frozen=True)
class Contender:
    """A renderer with its number of threads (None: no limit) and its sampler (None: its default)."""

    engine: str
    threads: int | None = None
    sampler: str | None = None

    def __str__(self) -> str:
        name = self.engine if self.sampler is None else f"{self.engine} {self.sampler}"
        return name if self.threads is None else f"{name}, {self.threads} threads"


@dataclass(frozen=True)
class Turn:
    """The answer of a worker.

    Attributes:
        spp: samples a pixel taken.
        seconds: wall time, from the call to the picture in memory.
        rate: millions of camera paths a second.
        mean: mean of the picture, by channel.
        cold: True for a worker's first turn with this number of samples; Mitsuba may have to compile for it.
    """

    spp: int
    seconds: float
    rate: float
    mean: list[float]
    cold: bool


@contextmanager
def started(scene: str, contenders: Iterable[Contender], arguments: argparse.Namespace) -> Iterator[Workers]:
    """Start the workers by name; inside the context they are warm and wait for :func:`ask`."""
    workers: Workers = {}
    try:
        for contender in contenders:
            wishes = {"size": arguments.size, "spp": arguments.spp, "sampler": contender.sampler}
            wishes |= {"compile": arguments.compile, "threads": contender.threads}
            wishes["device"] = "cuda" if arguments.cuda else "cpu"
            given = [f"--{key}={value}" for key, value in wishes.items() if value is not None]
            command = [sys.executable, __file__, scene, contender.engine, *given]
            worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            workers[str(contender)] = worker
            if _answer(worker) is None:
                raise SystemExit(f"{contender} on {scene} did not start")
        yield workers
    finally:
        for worker in workers.values():
            assert worker.stdin is not None
            worker.stdin.close()
            worker.wait()


def ask(worker: subprocess.Popen[str], spp: int, seed: int, out: Path | None = None) -> Turn:
    """Let a worker take one turn; ``out`` is the file for the picture, as ``.npy``."""
    assert worker.stdin is not None
    wish = {"spp": spp, "seed": seed, "out": None if out is None else str(out)}
    worker.stdin.write(json.dumps(wish) + "\n")
    worker.stdin.flush()
    turn = _answer(worker)
    if turn is None:
        raise SystemExit("a contender ended before its turn")
    return Turn(**turn)


def _answer(worker: subprocess.Popen[str]) -> dict[str, Any] | None:
    """Read the worker's next line of JSON; libraries may print lines of their own in between."""
    assert worker.stdout is not None
    return next((json.loads(line) for line in worker.stdout if line.startswith("{")), None)


def main() -> None:
    """Run a worker: warm up, then answer each line on stdin with the JSON of a turn."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("engine", choices=(OURS, LLVM, SCALAR, CUDA))
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=64, help="of the warm-up")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--sampler")
    parser.add_argument("--compile", default="auto")
    parser.add_argument("--device", default="cpu", help="device of torchpt")
    arguments = parser.parse_args()
    shoot = (torchpt if arguments.engine == OURS else mitsuba)(arguments)
    shoot(arguments.spp, 0)
    print("\n" + json.dumps({"ready": 1}), flush=True)
    seen = {arguments.spp}
    for line in sys.stdin:
        wish = json.loads(line)
        turn = timed(shoot, arguments.size, wish["spp"], wish["seed"], wish["out"])
        print("\n" + json.dumps(turn | {"cold": wish["spp"] not in seen}), flush=True)
        seen.add(wish["spp"])


def timed(shoot: Shoot, size: int, spp: int, seed: int, out: str | None = None) -> dict[str, Any]:
    """Return the fields of a :class:`Turn` except ``cold``."""
    import numpy as np

    begin = time.perf_counter()
    picture, taken = shoot(spp, seed)
    seconds = time.perf_counter() - begin
    if out is not None:
        np.save(out, np.asarray(picture, np.float32), allow_pickle=False)
    mean = np.asarray(picture, np.float64).mean((0, 1)).tolist()
    return {"spp": taken, "seconds": seconds, "rate": size**2 * taken / seconds / 1e6, "mean": mean}


def wishes(scene: Scene, arguments: argparse.Namespace) -> Settings:
    """Return the complete settings of a render."""
    from torchpt.scene.formats.description import settings

    blocks = {
        "film": {"width": arguments.size, "height": arguments.size, "filter": "box"},
        "integrator": {"type": "path", "max_depth": DEPTH, "rr_depth": 5},
        "sampler": arguments.sampler if arguments.engine == OURS else None,
        "render": {"spp": arguments.spp, "compile": arguments.compile, "threads": arguments.threads or "auto"},
    }
    return settings(scene.description, blocks)


def replaced(name: str) -> dict[str, str]:
    """Return what replaces the parts of a scene that Mitsuba lacks."""
    from mitsuba_scene import replacements

    return replacements(name)


def mitsuba(arguments: argparse.Namespace) -> Shoot:
    """Render pictures with Mitsuba."""
    drjit: Any = importlib.import_module("drjit")
    import numpy as np
    from mitsuba_scene import convert, load_mitsuba, nearest

    module = load_mitsuba(arguments.engine)
    if arguments.threads is not None:
        drjit.set_thread_count(arguments.threads)
    scene = nearest(arguments.scene)
    with tempfile.TemporaryDirectory() as folder:
        given = convert(module, scene, wishes(scene, arguments), Path(folder))
        given["sensor"]["sampler"]["type"] = arguments.sampler or "independent"
        theirs = module.load_dict(given)
    sampler = theirs.sensors()[0].sampler()

    def shoot(spp: int, seed: int) -> tuple[Any, int]:
        picture = np.asarray(module.render(theirs, spp=spp, seed=seed))
        return picture, sampler.sample_count()  # as it rounded

    return shoot


def torchpt(arguments: argparse.Namespace) -> Shoot:
    """Render pictures with torchpt."""
    from mitsuba_scene import nearest

    from torchpt.rendering.api import render_scene

    scene = nearest(arguments.scene).to(arguments.device)
    given = wishes(scene, arguments)

    def shoot(spp: int, seed: int) -> tuple[Any, int]:
        found = render_scene(scene, replace(given, render=given.render.but(spp=spp, seed=seed)))
        return found.image.cpu().numpy(), found.spp

    return shoot


if __name__ == "__main__":
    main()
