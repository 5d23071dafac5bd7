"""The compiled loop under faults: samples that are no numbers, errors, early ends, forks, and renders side by side."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from few_lanes import few_lanes
from showcase import showcase
from trials import film_of

import torchpt
from torchpt.core.errors import RenderError
from torchpt.engines.kernels.engine import Chunk, KernelsEngine
from torchpt.paths.wave import RayCounts
from torchpt.rendering.api import Progress, Rendering, render_scene
from torchpt.scene.formats.description import settings

FILM = {**film_of(37, 23), "filter": "mitchell", "aovs": ["albedo", "normal", "variance"]}


def rendered(
    scene: torchpt.Scene, spp: int, film: Any = None, integrator: Any = None, on_progress: Any = None, **render: Any
) -> Rendering:
    wish = {
        "film": film or FILM,
        "integrator": {"type": "path", "max_depth": 4, "rr_depth": 2, **(integrator or {})},
        "render": {"spp": spp, "seed": 3, "compile": "on", **render},
    }
    return render_scene(scene, settings(scene.description, wish), on_progress)


def same(a: Rendering, b: Rendering) -> bool:
    facts = (a.rays, a.paths, a.spp, a.relmse, a.truncated_paths, a.nonfinite_samples)
    assert facts == (b.rays, b.paths, b.spp, b.relmse, b.truncated_paths, b.nonfinite_samples)
    return torch.equal(a.image, b.image) and all(torch.equal(a.layers[name], b.layers[name]) for name in a.layers)


# -- samples that are no numbers


@pytest.fixture
def broken(monkeypatch) -> set[tuple[int, int]]:
    """Samples ``(pixel, sample)`` that come out as NaN or infinite."""
    chosen: set[tuple[int, int]] = set()
    kept = KernelsEngine.trace

    def spoiled(self: KernelsEngine, chunk: Chunk, traced: Any) -> RayCounts:
        tally = kept(self, chunk, traced)
        for number, (pixel, sample) in enumerate(sorted(chosen)):
            s, p = sample - chunk.first_sample, pixel - chunk.first_pixel
            if 0 <= s < chunk.samples and 0 <= p < chunk.pixels:
                self.slots.floats[number % 3, s * chunk.pixels + p] = (math.nan, math.inf, -math.inf)[number % 3]
        return tally

    monkeypatch.setattr(KernelsEngine, "trace", spoiled)
    return chosen


@pytest.mark.parametrize("threads", few([1, 2], 1))
def test_samples_that_are_not_finite_are_black_and_counted(broken, threads):
    scene = torchpt.load("cornell_box", "cpu")
    film = {**film_of(24, 20), "filter": "box"}
    clean = rendered(scene, 6, film, threads=threads)
    broken |= {(0, 0), (7, 3), (479, 5), (100, 2)}
    spoiled = rendered(scene, 6, film, threads=threads)
    assert clean.nonfinite_samples == 0 and spoiled.nonfinite_samples == 4
    assert bool(torch.isfinite(spoiled.image).all())
    differs = (spoiled.image != clean.image).any(-1).reshape(-1).nonzero().squeeze(1).tolist()
    assert set(differs) <= {0, 7, 479, 100} and len(differs) >= 2  # a black sample may be black anyway


@pytest.mark.parametrize("threads", few([1, 2], 1))
def test_strict_names_pixel_and_sample(broken, threads):
    scene = torchpt.load("cornell_box", "cpu")
    film = {**film_of(40, 30), "crop": [5, 3, 24, 20]}
    broken.add((7 * 24 + 11, 4))
    with pytest.raises(RenderError, match=r"sample 4 of pixel \(16, 10\) is not finite"):
        rendered(scene, 6, film, {"strict": True}, threads=threads)
    assert rendered(scene, 6, film, threads=threads).nonfinite_samples == 1


def test_paths_without_end_are_counted(monkeypatch):
    monkeypatch.setattr("torchpt.paths.integrators.base.ENDLESS", 5)
    scene = torchpt.load("cornell_box", "cpu")
    wish = {"max_depth": -1, "rr_depth": 100}
    on, off = (rendered(scene, 2, integrator=wish, compile=mode) for mode in ("on", "off"))
    assert off.truncated_paths > 100
    assert on.truncated_paths == pytest.approx(off.truncated_paths, rel=1e-3)
    assert on.rays == pytest.approx(off.rays, rel=1e-3)


# -- ends


@pytest.mark.parametrize("threads", few([1, 2], 1))
def test_progress_may_end_it_early(threads):
    scene = torchpt.load("cornell_box", "cpu")
    film = {**film_of(64), "filter": "box"}
    seen: list[Progress] = []

    def stop(progress: Progress) -> bool:
        seen.append(progress)
        return len(seen) == 9

    with few_lanes(1000):
        rendered(scene, 1, film, threads=threads)  # progress is also told of while kernels are made
        found = rendered(scene, 64, film, on_progress=stop, threads=threads)
    assert not found.complete and found.paths < 64 * 64 * 64
    assert len(seen) == 9  # who has asked for an end is not asked again
    assert [p.done for p in seen] == sorted({p.done for p in seen}) and seen[-1].done <= found.paths
    # Each pixel holds the first samples of its own: as many as some whole pass, and they are those of a shorter render.
    counted = {n: rendered(scene, n, film).image for n in (1, 2, 4, 8)}
    right = torch.stack([(found.image == image).all(-1) for image in counted.values()]).any(0)
    black = (found.image == 0).all(-1)
    assert bool((right | black).all()) and float(right.float().mean()) > 0.5
    whole = rendered(scene, 4, film, on_progress=lambda p: False, threads=threads)
    assert whole.complete and torch.equal(whole.image, counted[4])


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_task_ends_the_render(monkeypatch, threads):
    scene = torchpt.load("cornell_box", "cpu")
    film = film_of(64)
    whole, before = rendered(scene, 4, film, threads=threads), set(threading.enumerate())  # the pool keeps its threads
    kept = KernelsEngine.trace

    def fails(self: KernelsEngine, chunk: Chunk, traced: Any) -> RayCounts:
        if chunk.first_pixel > 1000:
            raise RuntimeError("out of order")
        return kept(self, chunk, traced)

    with monkeypatch.context() as patched:
        patched.setattr(KernelsEngine, "trace", fails)
        begin = time.monotonic()
        with pytest.raises(RuntimeError, match="out of order"), few_lanes(500):
            rendered(scene, 4, film, threads=threads)
        assert time.monotonic() - begin < 30
    assert set(threading.enumerate()) <= before  # no thread of the render is left
    assert same(rendered(scene, 4, film, threads=threads), whole)


def test_an_error_in_a_callback_ends_the_render():
    scene, before = torchpt.load("cornell_box", "cpu"), set(threading.enumerate())

    def fails(progress: Progress) -> bool:
        raise KeyboardInterrupt

    for threads in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            rendered(scene, 64, film_of(64), on_progress=fails, threads=threads)
    assert set(threading.enumerate()) <= before


def test_renders_side_by_side():
    """Two Python threads, one scene and another; the first kernels of both are made at once."""
    scenes = [torchpt.load("cornell_box", "cpu"), torchpt.load(showcase("gold", "lattice"), "cpu")]
    found: dict[int, list[Rendering]] = {0: [], 1: []}

    def work(number: int) -> None:
        for k in range(3):
            found[number].append(rendered(scenes[(number + k) % 2], 8, threads=1 + number))

    threads = [threading.Thread(target=work, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
        assert not thread.is_alive()
    alone = [rendered(scene, 8, threads=1) for scene in scenes]
    for number in range(2):
        for k in range(3):
            assert same(found[number][k], alone[(number + k) % 2])


FORK = """
import os, sys, torch, torchpt
scene = torchpt.load("cornell_box", "cpu")
wish = dict(spp=4, film={"width": 64, "height": 64}, threads=2)
before = torchpt.render(scene, **wish)
child = os.fork()
if child == 0:
    same = torch.equal(torchpt.render(scene, **wish), before)
    other = torchpt.load("games101", "cpu")  # kernels that the parent has not made
    os._exit(0 if same and torchpt.render(other, **wish).amax() > 0 else 3)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.skipif(not hasattr(torch, "get_num_threads") or sys.platform == "win32", reason="needs fork")
@pytest.mark.slow
def test_after_a_fork():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["0"], done.stderr


VEILED = {
    "camera": {"origin": [0, 0, 3], "target": [0, 0, 0]},
    "shapes": {"it": {"type": "rectangle", "material": {"type": "diffuse", "opacity": 0.5}}},
    "lights": {"sky": {"type": "constant"}},
}


@pytest.mark.parametrize("name", ["cornell_box", "cornell_transmissive", "a veil"])
@pytest.mark.parametrize("integrator", ["path", "bdpt"])
def test_rows_are_the_memory_of_a_lane(name: str, integrator: str):
    """Threads and lanes are chosen by what an engine is said to allocate."""
    from lanewise import prepared

    from torchpt.rendering import kernels_of

    scene = torchpt.load(VEILED if name == "a veil" else name, "cpu")
    connections = {"connections": "one"} if integrator == "bdpt" else {}
    wish = {"film": film_of(8), "render": {"spp": 1}, "integrator": {"type": integrator, **connections}}
    wave, _ = prepared(scene, wish)
    with torch.no_grad():
        kernels = kernels_of(scene, wave)
    engine = KernelsEngine(kernels)
    engines = [engine] if engine.light_paths is None else [engine, engine.light_paths]
    memories = {id(memory): memory for each in engines for memory in each.memories()}
    assert sum(memory.words.shape[0] for memory in memories.values()) == kernels.rows({})


def test_a_worker_is_used_again_as_if_new():
    """What a chunk leaves in arenas, lists and slots does not show in the next."""
    scene = torchpt.load(showcase("lattice", "glass"), "cpu")
    from lanewise import prepared

    from torchpt.rendering import kernels_of

    wave, _ = prepared(scene, {"film": film_of(40), "render": {"spp": 4}})
    with torch.no_grad():
        kernels = kernels_of(scene, wave)
    worker, fresh = KernelsEngine(kernels), KernelsEngine(kernels)
    rooms = [memory for depth in (1, 2) for memory in (worker.room(depth).arena, *worker.room(depth).lists)]
    for memory in (*rooms, *worker.search.passed, worker.slots):
        memory.words[:] = np.float32(np.nan).view(np.int32) if memory.words.shape[0] > 1 else 5
    worker.trace(Chunk(0, 1600, 0, 3))
    a, b = worker.trace(Chunk(64, 99, 1, 3)), fresh.trace(Chunk(64, 99, 1, 3))
    assert a == b and np.array_equal(worker.slots.words[:, :297], fresh.slots.words[:, :297])
