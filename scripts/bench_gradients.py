"""Compare gradients with Mitsuba 3.

    python scripts/bench_gradients.py [cases] [--size 256 --spp 16] [--json FILE] [--markdown]

Forward and backward of one loss, a fixed random weight times the picture, by torchpt and by Mitsuba's ``prb``
(llvm_ad_rgb), on the same scenes: albedo of a room, texels of its floor, the index of a glass ball, the vertices of a
mesh; max_depth 8, rr_depth 5, box filter. Each contender is a separate process that has loaded and warmed up; they
take turns, round after round, each time with a new seed (``--rounds 7``). The table shows medians, the median of the
ratios within a round, their geometric mean over cases, and the peak of resident memory above its value after the
imports.

``--texture`` times the backward pass through 8 x 8 and 4096 x 4096 texels beside the forward pass of the same
picture, with torchpt only.

``--memory`` prints the peaks of memory of two gradients, of all cases and of a room with a ball of clear glass at depth 4
and 64, with both renderers' kernels on disk: compiled beforehand, by processes of their own. ``--growth N`` takes N
gradients by an albedo in one process, of 8 x 8 and of 32 x 32 pixels with one sample each, and prints the resident memory
above import as it goes.

``--agree`` compares gradients number by number: three cases with ``prb``, and three with moving edges with
``prb_projective``. For each it prints z-scores of the difference of the means over ``--seeds`` renders: their root mean square
(1 if only noise differs; numbers that both sides leave at 0 are not counted), the largest, and the difference of the
sums along a few directions in per cent.

``--wish KEY=VALUE`` passes arguments to ``torchpt.render``, values as JSON: ``--wish edges=true``. Needs the extra
``bench``.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import from_tests  # noqa: F401
import numpy as np

OURS, THEIRS = "torchpt", "mitsuba"
DEPTH, RR_DEPTH = 8, 5
TEXELS = 128


@dataclass(frozen=True)
class Case:
    """A scene and the parameter to differentiate by.

    Attributes:
        scene: function that returns a description; ``$FILES`` in a path is the folder of ``paint.exr`` and ``sky.exr``.
        parameter: name of the parameter in ``scene.params``.
        theirs: the shape that owns the parameter in Mitsuba's scene, and the suffix of the parameter's name.
        depth: largest path depth.
        projective: use ``prb_projective`` in Mitsuba, with samples of edges.
        texels: width and height of ``paint.exr``.
    """

    scene: Callable[[], Mapping[str, Any]]
    parameter: str
    theirs: tuple[str, str]
    depth: int = DEPTH
    projective: bool = False
    texels: int = TEXELS


def _room(**shapes: Any) -> dict[str, Any]:
    import known_gradients as known

    return known.without(known.ROOM, "block", **shapes)


def _painted(scene: Mapping[str, Any]) -> dict[str, Any]:
    import known_gradients as known

    floor = {**scene["shapes"]["floor"], "uvs": [[0, 0], [1, 0], [1, 1], [0, 1]], "material": known.PAINTED["material"]}
    return known.with_shapes(scene, floor=floor)


def _glass() -> dict[str, Any]:
    return _with_ball({"type": "roughdielectric", "alpha": 0.05})  # the index of smooth glass is constant in Mitsuba


def _clear_glass() -> dict[str, Any]:
    return _with_ball({"type": "dielectric"})


def _with_ball(glass: Mapping[str, Any]) -> dict[str, Any]:
    room = _room(ball={"type": "sphere", "center": [0.2, -0.45, 0.2], "radius": 0.5, "material": "glass"})
    return {**room, "materials": {**room["materials"], "glass": {**glass, "int_ior": 1.5, "ext_ior": 1.0}}}


def _bumpy(rows: int = 48, columns: int = 96) -> dict[str, Any]:
    """Return a slightly uneven ball of triangles; only the vertices of its seam are doubled."""
    t, p = np.meshgrid(
        np.linspace(0.02, math.pi - 0.02, rows), np.arange(columns) * (2 * math.pi / columns), indexing="ij"
    )
    r = 0.45 * (1 + 0.05 * np.sin(5 * p) * np.sin(t) ** 2)
    points = np.stack((r * np.sin(t) * np.cos(p) + 0.1, r * np.cos(t) - 0.4, r * np.sin(t) * np.sin(p)), -1).reshape(
        -1, 3
    )
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns)).ravel()
    b = (np.arange(rows - 1)[:, None] * columns + (np.arange(columns) + 1) % columns).ravel()
    faces = np.concatenate((np.stack((a, b, a + columns), 1), np.stack((b, b + columns, a + columns), 1)))
    return {
        "type": "mesh",
        "vertices": points.tolist(),
        "faces": faces.tolist(),
        "material": "white",
        "face_normals": True,
    }


def _over_floor(**shapes: Any) -> dict[str, Any]:
    import known_gradients as known

    return known.with_shapes(known.TABLE, **shapes)


def _lifted() -> dict[str, Any]:
    import known_gradients as known

    mesh = _bumpy(10, 16)
    mesh["vertices"] = [[x, y + 1.05, z] for x, y, z in mesh["vertices"]]
    return _over_floor(it={**mesh, "material": known.BLUE})


def _screened() -> dict[str, Any]:
    import known_gradients as known

    return _over_floor(it=known.SCREEN)


def _lit_by_mesh() -> dict[str, Any]:
    import known_gradients as known

    lamp = known.quad([-0.2, 0.9, -0.5], [0.4, 0.9, -0.5], [0.4, 0.9, 0.1], [-0.2, 0.9, 0.1], emission=[9, 8, 6])
    return known.without(known.ROOM, "lamp", it=lamp)


def _brushed_floor() -> dict[str, Any]:
    import known_gradients as known

    return _over_floor(floor={**known.FLOOR, "material": known.BRUSHED})


VALUE = "reflectance.value"
CASES: dict[str, Case] = {
    "albedo": Case(_room, "materials.red.reflectance", ("left", VALUE)),
    "texels": Case(lambda: _painted(_room()), "shapes.floor.material.reflectance", ("floor", "reflectance.data")),
    "glass_index": Case(_glass, "materials.glass.int_ior", ("ball", "bsdf.eta")),
    "vertices": Case(lambda: _room(it=_bumpy()), "shapes.it.vertices", ("it", "vertex_positions")),
}
#: Cases of ``--memory``.
MEMORY: dict[str, Case] = {
    **CASES,
    "clear_glass_4": Case(_clear_glass, "materials.red.reflectance", ("left", VALUE), 4),
    "clear_glass_64": Case(_clear_glass, "materials.red.reflectance", ("left", VALUE), 64),
}
#: Cases of ``--agree``, each with its own depth.
AGREE: dict[str, Case] = {
    "albedo": Case(_room, "materials.red.reflectance", ("left", VALUE), 4),
    "texels": Case(
        lambda: _painted(_room()), "shapes.floor.material.reflectance", ("floor", "reflectance.data"), 4, texels=8
    ),
    "roughness": Case(_brushed_floor, "shapes.floor.material.alpha", ("floor", "alpha.value"), 2),
    "bumpy_ball": Case(_lifted, "shapes.it.vertices", ("it", "vertex_positions"), 2, True),
    "screen": Case(_screened, "shapes.it.vertices", ("it", "vertex_positions"), 2, True),
    "lamp_in_room": Case(_lit_by_mesh, "shapes.it.vertices", ("it", "vertex_positions"), 2, True),
}


def main() -> None:
    """Run the chosen benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"of {', '.join(MEMORY)}; with --agree of {', '.join(AGREE)}")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seeds", type=int, default=8, help="with --agree")
    parser.add_argument("--threads", type=int, default=1, help="of every contender")
    parser.add_argument("--wish", action="append", default=[], metavar="KEY=VALUE", help="for torchpt.render")
    parser.add_argument("--texture", action="store_true", help="backward beside forward, few texels and many")
    parser.add_argument("--memory", action="store_true", help="peaks of memory, with kernels compiled beforehand")
    parser.add_argument("--growth", type=int, metavar="N", help="memory over N gradients of small pictures")
    parser.add_argument("--agree", action="store_true", help="gradients number by number")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where the figures go")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table as well")
    parser.add_argument("--texels", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--worker", choices=(OURS, THEIRS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work(arguments)
    elif arguments.texture:
        texture(arguments)
    elif arguments.memory:
        memory(arguments)
    elif arguments.growth:
        growth(arguments)
    elif arguments.agree:
        agree(arguments)
    else:
        race(arguments)


def race(arguments: argparse.Namespace) -> None:
    """Time all cases, torchpt beside Mitsuba."""
    found: dict[str, Any] = {}
    print(
        f"{'forward + backward':20s}{OURS + ' s':>12s}{'prb s':>10s}{'ratio':>8s}{'MB':>9s}{'prb MB':>9s}{'ratio':>8s}"
    )
    for name in arguments.cases or CASES:
        seconds: dict[str, list[float]] = {OURS: [], THEIRS: []}
        peak = {}
        with ExitStack() as stack:
            workers = {engine: stack.enter_context(_Worker(name, engine, arguments)) for engine in seconds}
            for seed in range(1, arguments.rounds + 1):
                for engine, worker in workers.items():
                    turn = worker.ask({"seed": seed})
                    seconds[engine].append(turn["forward"] + turn["backward"])
                    peak[engine] = turn["peak"]
        ratios = [a / b for a, b in zip(seconds[OURS], seconds[THEIRS], strict=True)]
        row = found[name] = {
            "seconds": seconds, "medians": {engine: statistics.median(taken) for engine, taken in seconds.items()},
            "ratio": statistics.median(ratios), "peak": peak, "peak_ratio": peak[OURS] / max(peak[THEIRS], 1e-9),
        }  # fmt: skip
        print(
            f"{name:20s}{row['medians'][OURS]:12.3f}{row['medians'][THEIRS]:10.3f}{row['ratio']:8.2f}"
            f"{peak[OURS]:9.0f}{peak[THEIRS]:9.0f}{row['peak_ratio']:8.2f}",
            flush=True,
        )
        save(arguments, {"cases": found})
    mean = {key: statistics.geometric_mean(row[key] for row in found.values()) for key in ("ratio", "peak_ratio")}
    print(f"{'geometric mean':20s}{mean['ratio']:30.2f}{mean['peak_ratio']:26.2f}")
    save(arguments, {"cases": found, "geometric_means": mean})
    if arguments.markdown:
        print("| case | torchpt s | prb s | ratio | torchpt MB | prb MB | ratio |\n|---|---:|---:|---:|---:|---:|---:|")
        for name, row in found.items():
            cells = (*row["medians"].values(), row["ratio"], *row["peak"].values(), row["peak_ratio"])
            print(f"| {name} | " + " | ".join(f"{cell:.3g}" for cell in cells) + " |")


def texture(arguments: argparse.Namespace) -> None:
    """Time backward over forward passes, for few texels and for many."""
    found: dict[str, Any] = {}
    print(f"{'texels':20s}{'forward s':>12s}{'backward s':>12s}{'ratio':>8s}{'MB':>9s}")
    for texels in (8, 4096):
        with _Worker("texels", OURS, arguments, ["--texels", str(texels)]) as worker:
            turns = [worker.ask({"seed": seed}) for seed in range(1, arguments.rounds + 1)]
        row = found[str(texels)] = {
            "ratio": statistics.median(turn["backward"] / turn["forward"] for turn in turns), "turns": turns,
            **{key: statistics.median(turn[key] for turn in turns) for key in ("forward", "backward")},
        }  # fmt: skip
        peak = turns[-1]["peak"]
        size = f"{texels} x {texels}"
        print(f"{size:20s}{row['forward']:12.3f}{row['backward']:12.3f}{row['ratio']:8.2f}{peak:9.0f}", flush=True)
        save(arguments, {"texture": found})


def memory(arguments: argparse.Namespace) -> None:
    """Compare the peaks of memory of two gradients."""
    found: dict[str, dict[str, float]] = {}
    print(f"{'MB above import':20s}{OURS:>9s}{'prb':>9s}{'ratio':>8s}")
    for name in arguments.cases or MEMORY:
        peaks = {}
        for engine in (OURS, THEIRS, OURS, THEIRS):  # the first processes compile
            with _Worker(name, engine, arguments) as worker:
                peaks[engine] = worker.ask({"seed": 1})["peak"]
        found[name] = peaks
        print(f"{name:20s}{peaks[OURS]:9.0f}{peaks[THEIRS]:9.0f}{peaks[OURS] / peaks[THEIRS]:8.2f}", flush=True)
        save(arguments, {"memory": found})


def growth(arguments: argparse.Namespace) -> None:
    """Print the resident memory of a process that takes many gradients."""
    found: dict[str, dict[int, float]] = {}
    arguments.spp = 1
    for size in (8, 32):
        arguments.size = size
        taken = found[str(size)] = {}
        with _Worker("albedo", OURS, arguments) as worker:
            for k in range(1, arguments.growth + 1):
                held = worker.ask({"seed": k})["held"]
                if k * 10 % arguments.growth == 0 or k == 1:
                    taken[k] = held
                    print(f"{size} x {size} pixels, gradient {k}: {held:.1f} MB above import", flush=True)
        save(arguments, {"growth": found})


def agree(arguments: argparse.Namespace) -> None:
    """Compare the gradients of both renderers number by number."""
    found: dict[str, Any] = {}
    print(f"{'gradient':16s}{'numbers':>8s}{'rms z':>8s}{'largest':>9s}   sums along directions: ours, theirs (off, z)")
    for name in arguments.cases or AGREE:
        sides: dict[str, np.ndarray] = {}
        for engine in (OURS, THEIRS):
            with tempfile.TemporaryDirectory() as folder, _Worker(name, engine, arguments, ["--agree"]) as worker:
                taken = []
                for seed in range(1, arguments.seeds + 1):
                    file = Path(folder) / "gradient.npy"
                    worker.ask({"seed": seed, "out": str(file)})
                    taken.append(np.load(file))
            sides[engine] = np.stack(taken).reshape(arguments.seeds, -1)
        row = found[name] = compared(sides[OURS], sides[THEIRS], AGREE[name].parameter.endswith("vertices"))
        sums = "  ".join(
            f"{key}: {a:.5f} {b:.5f} ({off:+.1%}, {z:+.1f})" for key, (a, b, off, z) in row["directions"].items()
        )
        print(f"{name:16s}{row['numbers']:8d}{row['rms']:8.2f}{row['largest']:9.1f}   {sums}", flush=True)
        save(arguments, {"agree": found})


def compared(ours: np.ndarray, theirs: np.ndarray, vertices: bool) -> dict[str, Any]:
    """Compare gradients ``(seeds, numbers)``: z-scores, and sums over all numbers, or over vertices by axis."""
    z = scores(ours, theirs)
    z = z[np.isfinite(z)]
    columns = {axis: slice(k, None, 3) for k, axis in enumerate("xyz")} if vertices else {"all": slice(None)}
    directions = {}
    for key, column in columns.items():
        a, b = (side[:, column].sum(1) for side in (ours, theirs))
        size = max(abs(b.mean()), 1e-12)
        directions[key] = (a.mean(), b.mean(), (a.mean() - b.mean()) / size, float(scores(a[:, None], b[:, None])[0]))
    return {
        "numbers": len(z), "rms": float(np.sqrt(np.mean(z**2))), "largest": float(np.abs(z).max()),
        "directions": {key: tuple(map(float, row)) for key, row in directions.items()},
    }  # fmt: skip


def scores(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return z-scores ``(numbers,)`` of the difference of means; NaN where both sides are always 0."""
    square = ours.var(0, ddof=1) / len(ours) + theirs.var(0, ddof=1) / len(theirs)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(square > 0, (ours.mean(0) - theirs.mean(0)) / np.sqrt(square), np.nan)


def save(arguments: argparse.Namespace, facts: dict[str, Any]) -> None:
    """Write the figures measured so far, with the settings of the run."""
    if arguments.json is None:
        return
    import bench_files

    settings = {name: getattr(arguments, name) for name in ("size", "spp", "rounds", "seeds", "threads", "wish")}
    bench_files.write(arguments.json, {"settings": settings, "machine": bench_files.machine(), **facts})


class _Worker:
    """A process that has loaded and warmed up, and computes gradients."""

    def __init__(self, case: str, engine: str, arguments: argparse.Namespace, more: list[str] | None = None) -> None:
        keys = ("size", "spp", "threads")
        given = [f"--{key}={getattr(arguments, key)}" for key in keys] + [f"--wish={wish}" for wish in arguments.wish]
        self._command = [sys.executable, __file__, case, "--worker", engine, *given, *(more or [])]
        self._case = f"{engine} on {case}"

    def __enter__(self) -> _Worker:
        self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._answer()
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def ask(self, wish: dict[str, Any]) -> dict[str, Any]:
        """Let the worker compute one gradient."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(wish) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                return json.loads(line)
        raise SystemExit(f"{self._case} ended before its turn")


#: Computes a gradient from a seed; also returns the seconds of the forward and of the backward pass.
Take = Callable[[int], tuple[Any, float, float]]


def work(arguments: argparse.Namespace) -> None:
    """Run a worker: warm up, then answer each line on stdin with the JSON of a turn."""
    (name,) = arguments.cases
    case = (AGREE if arguments.agree else MEMORY)[name]
    case = replace(case, texels=arguments.texels or case.texels)
    take = (ours if arguments.worker == OURS else theirs)(case, arguments)
    begun = arguments.resident
    take(0)
    print("\n" + json.dumps({"ready": 1}), flush=True)
    for line in sys.stdin:
        wish = json.loads(line)
        gradient, forward, backward = take(wish["seed"])
        if wish.get("out"):
            np.save(wish["out"], np.asarray(gradient, np.float64), allow_pickle=False)
        turn = {"forward": forward, "backward": backward, "peak": resident() - begun, "held": held() - begun}
        print("\n" + json.dumps(turn), flush=True)


def resident() -> float:
    """Return the peak of this process's resident memory in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def held() -> float:
    """Return this process's resident memory in MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def opened(case: Case, arguments: argparse.Namespace) -> Any:
    """Load the scene of a case with torchpt."""
    import known_gradients as known
    import torch

    import torchpt

    description = case.scene()
    with tempfile.TemporaryDirectory() as folder:
        if "paint.exr" in json.dumps(description):  # else the library for EXR files would count without need
            paint = 0.2 + 0.6 * torch.rand(case.texels, case.texels, 3, generator=torch.Generator().manual_seed(3))
            torchpt.write_image(str(Path(folder) / "paint.exr"), paint)
        scene = {
            **known.in_folder(description, folder),
            "film": {"width": arguments.size, "height": arguments.size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": case.depth, "rr_depth": RR_DEPTH},
            "render": {"spp": arguments.spp, "threads": arguments.threads},
        }
        return torchpt.load(scene, "cpu")


def weight(size: int) -> np.ndarray:
    """Return the weights of the picture in the loss, ``(size, size, 3)``."""
    at = (np.arange(size, dtype=np.float32) + 0.5) / size
    x, y = at[None, :, None], at[:, None, None]
    return (0.2 + 2.0 * x * x + 0.7 * y * y) * np.array([1.0, 0.8, 0.6], np.float32) / (3 * size * size)


def ours(case: Case, arguments: argparse.Namespace) -> Take:
    """Compute gradients with torchpt."""
    import known_gradients  # noqa: F401  (with torchpt and all that it imports)
    import torch

    import torchpt

    torch.set_num_threads(arguments.threads)
    arguments.resident = resident()
    scene = opened(case, arguments)
    weights = torch.from_numpy(weight(arguments.size))
    wishes = {key: json.loads(value) for key, value in (wish.split("=", 1) for wish in arguments.wish)}
    warnings.simplefilter("ignore", torchpt.EdgeWarning)
    leaf = scene.params[case.parameter].clone().requires_grad_()

    def take(seed: int) -> tuple[Any, float, float]:
        begin = time.perf_counter()
        picture = torchpt.render(scene, params={case.parameter: leaf}, seed=seed, **wishes)
        loss = (picture * weights).sum()
        middle = time.perf_counter()
        (gradient,) = torch.autograd.grad(loss, leaf)
        return gradient.numpy(), middle - begin, time.perf_counter() - middle

    return take


def theirs(case: Case, arguments: argparse.Namespace) -> Take:
    """Compute gradients with Mitsuba."""
    import importlib

    from mitsuba_scene import convert, load_mitsuba

    from torchpt.scene.formats.description import settings

    mi = load_mitsuba("llvm_ad_rgb")
    dr: Any = importlib.import_module("drjit")
    dr.set_thread_count(arguments.threads)
    scene = opened(case, arguments)
    with tempfile.TemporaryDirectory() as folder:
        given = convert(mi, scene, settings(scene.description, {}), Path(folder))
        kind = "prb_projective" if case.projective else "prb"
        given["integrator"] = {"type": kind, "max_depth": case.depth, "rr_depth": RR_DEPTH}
        arguments.resident = resident()  # torchpt's scene, of which Mitsuba's is made, is no work of Mitsuba's
        wanted = their_name(case, scene)
        for optimize in (True, False):  # meshes that Mitsuba merged have no names of their own
            scene_ = mi.load_dict(given, optimize=optimize)
            params = mi.traverse(scene_)
            names = [key for key in params.keys() if key.startswith(wanted[0]) and key.endswith(wanted[1])]
            if names:
                break
    if len(names) != 1:
        raise SystemExit(f"no {' ... '.join(wanted)} in Mitsuba's scene, among: {', '.join(params.keys())}")
    (name,) = names
    weights = mi.TensorXf(weight(arguments.size))
    ours_of = None
    if name.endswith("vertex_positions"):  # there vertices come in another order
        corners = np.asarray(params[name], np.float64).reshape(-1, 1, 3)
        ours_of = ((corners - scene.params[case.parameter].numpy()) ** 2).sum(-1).argmin(1)

    def take(seed: int) -> tuple[Any, float, float]:
        begin = time.perf_counter()
        value = type(params[name])(params[name])
        dr.enable_grad(value)
        params[name] = value
        params.update()
        picture = mi.render(scene_, params, spp=arguments.spp, seed=seed)
        loss = dr.sum(picture * weights, axis=None)
        dr.eval(loss)
        dr.sync_thread()
        middle = time.perf_counter()
        dr.backward(loss)
        gradient = dr.grad(value)
        dr.eval(gradient)
        dr.sync_thread()
        end = time.perf_counter()
        found = np.asarray(gradient, np.float64)
        if ours_of is not None:
            corners, found = found.reshape(-1, 3), np.zeros((int(ours_of.max()) + 1, 3))
            np.add.at(found, ours_of, corners)
        dr.disable_grad(value)
        params[name] = value
        return found, middle - begin, end - middle

    return take


def their_name(case: Case, scene: Any) -> tuple[str, str]:
    """Return prefix and suffix of the parameter's name in Mitsuba's scene."""
    shape, ending = case.theirs
    number = next(k for k, part in enumerate(scene.built.parts) if part.shape == shape)
    return f"part{number}.", ending


if __name__ == "__main__":
    main()
