"""Memory that runs out: the picture has the same bits, or there is one line."""

from __future__ import annotations

import gc
import importlib
import os
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from trials import film_of

import torchpt
from torchpt.core.errors import RenderError, SceneError, warn_once
from torchpt.core.memory import is_out_of_memory, release_memory
from torchpt.engines.kernels import layout
from torchpt.engines.kernels import threads as spare
from torchpt.engines.kernels.engine import KernelsEngine

#: How allocations fail, on a CPU and on CUDA.
FAILURES: dict[str, Callable[[], Exception]] = {
    "torch on a CPU": lambda: RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to"),
    "torch on CUDA": lambda: torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
    "python": lambda: MemoryError(),
    "numpy": lambda: np._core._exceptions._ArrayMemoryError((1 << 40,), np.dtype(np.float32)),  # pyright: ignore
    "C++": lambda: RuntimeError("std::bad_alloc"),
}


class Fails(TorchDispatchMode):
    """Operations of torch fail, by their number, counted from 0."""

    def __init__(self, which: Callable[[int], bool], error: Callable[[], Exception]) -> None:
        super().__init__()
        self.which, self.error, self.count = which, error, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        if self.which(self.count - 1):
            raise self.error()
        return func(*args, **(kwargs or {}))


@pytest.fixture(scope="module")
def box() -> torchpt.Scene:
    return torchpt.load("cornell_box", "cpu")


@contextmanager
def map_in_pieces(which: Callable[[int], bool], error: Callable[[], Exception]) -> Iterator[list[int]]:
    """Context in which operations within pieces of passes fail, counted over the whole render; gives how many there were."""
    from torchpt.engines.tensors_forward import TensorsForward

    counted = [0]

    def failing(original: Callable[..., Any]) -> Callable[..., Any]:
        def work(*args: Any) -> Any:
            with Fails(lambda k: which(counted[0] + k), error) as mode:
                try:
                    return original(*args)
                finally:
                    counted[0] += mode.count

        return work

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(TensorsForward, "_render_piece", failing(TensorsForward._render_piece))
        yield counted


def eager(scene: torchpt.Scene, width: int = 3, **wish: Any) -> Any:
    film = {**film_of(width, 2), "filter": "mitchell", "aovs": ["depth", "albedo"]}
    integrator = {"type": "path", "max_depth": 2, "clamp": 2.0}
    return torchpt.render(scene, spp=2, integrator=integrator, film=film, compile="off", threads=1, full=True, **wish)


def same(a: Any, b: Any) -> bool:
    facts = all(
        getattr(a, name) == getattr(b, name) for name in ("rays", "paths", "spp", "nonfinite_samples", "relmse")
    )
    return (
        facts
        and torch.equal(a.image, b.image)
        and all(torch.equal(a.layers[name], b.layers[name]) for name in ("depth", "albedo"))
    )


@pytest.mark.parametrize("step", [997, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_failure_at_any_operation_of_a_piece_changes_no_bit(box, step):
    """Each operation of a render fails once, the copies into the films included."""
    with map_in_pieces(lambda k: False, MemoryError) as counted:
        whole = eager(box)
    count = counted[0]
    assert count > 300 and whole.lanes is None
    kinds = list(FAILURES.values())
    # The last ones are those that put the piece into the films.
    for number in (*range(0, count - 25, step), *range(count - 25, count)):
        with map_in_pieces(lambda k, number=number: k == number, kinds[number % len(kinds)]):
            found = eager(box)
        assert same(found, whole), number


@pytest.mark.parametrize("kind", FAILURES)
@pytest.mark.slow
def test_failures_again_and_again_halve_waves_further(box, kind, capsys):
    warn_once.cache_clear()
    whole = eager(box, 24, pilots=True)
    with map_in_pieces(lambda k: k in (299, 1010, 1300, 1700), FAILURES[kind]):
        found = eager(box, 24, pilots=True)
    assert same(found, whole) and found.lanes is not None and found.lanes < 13
    assert found.summary()["lanes"] == found.lanes
    assert capsys.readouterr().err.count("memory ran out") == 1


@pytest.mark.slow
def test_where_a_single_lane_does_not_fit_it_is_one_line(box):
    with (
        map_in_pieces(lambda k: True, MemoryError),
        pytest.raises(RenderError, match="not enough memory for a wave") as told,
    ):
        eager(box)
    assert "\n" not in str(told.value)


def test_other_errors_are_not_taken_for_it(box):
    def other() -> Exception:
        return RuntimeError("shapes do not match")

    with map_in_pieces(lambda k: k == 40, other), pytest.raises(RuntimeError, match="shapes"):
        eager(box)
    assert not is_out_of_memory(RenderError("not enough memory for it")) and not is_out_of_memory(ValueError("memory"))
    assert is_out_of_memory(OSError(12, "Cannot allocate memory"))


# -- gradients


def gradient(scene: torchpt.Scene, adjoint: str) -> torch.Tensor:
    """The gradient of a small picture, by tensor operations."""
    name = "materials.white.reflectance"
    colour = scene.params[name].clone().requires_grad_()
    wish: dict[str, Any] = {
        "integrator": {"type": "path", "max_depth": 2},
        "film": film_of(4, 3),
        "spp": 2,
        "threads": 1,
        "compile": "off",
        "adjoint": adjoint,
    }
    image = torchpt.render(scene, params={name: colour}, **wish)
    image.sum().backward()
    assert colour.grad is not None
    return colour.grad


def backward_failing(
    scene: torchpt.Scene, adjoint: str, which: Callable[[int], bool], monkeypatch: Any
) -> tuple[torch.Tensor, int]:
    """The gradient where operations within chunks fail, and how many operations there were."""
    module = importlib.import_module("torchpt.gradients." + {"autograd": "tape", "replay": "replay"}[adjoint])
    counted, original = [0], module.chunk_sums

    def failing(*args: Any) -> Any:
        with Fails(lambda k: which(counted[0] + k), MemoryError) as mode:
            try:
                return original(*args)
            finally:
                counted[0] += mode.count

    with monkeypatch.context() as patched:
        patched.setattr(module, "chunk_sums", failing)
        return gradient(scene, adjoint), counted[0]


@pytest.mark.parametrize("adjoint", ["autograd", pytest.param("replay", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_failure_anywhere_in_the_backward_pass_changes_rounding_at_most(box, adjoint, monkeypatch):
    whole, count = backward_failing(box, adjoint, lambda k: False, monkeypatch)
    assert count > 300 and float(whole.abs().min()) > 0
    for number in range(0, count, 97):
        found, _ = backward_failing(box, adjoint, lambda k, number=number: k == number, monkeypatch)
        assert torch.allclose(found, whole, rtol=1e-5), number
    with pytest.raises(RenderError, match="of a single lane"):
        backward_failing(box, adjoint, lambda k: True, monkeypatch)


# -- the compiled loop


def looped(scene: torchpt.Scene, threads: int = 2, **film: Any) -> Any:
    film = {**film_of(48, 40), "aovs": ["depth", "albedo"], **film}
    return torchpt.render(scene, spp=4, film=film, threads=threads, full=True, pilots=True)


@pytest.mark.parametrize("threads", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.slow
def test_the_compiled_loop_goes_on_with_one_thread_and_fewer_lanes(box, monkeypatch, capsys, threads):
    whole = looped(box, threads)
    made, kept = [0], layout.Memory.__init__
    for number in (*range(0, 8), 17, 23, 31):
        warn_once.cache_clear()
        made[0] = 0

        def failing(self: layout.Memory, count: int, number: int = number) -> None:
            made[0] += 1
            if made[0] == number + 1:
                raise MemoryError
            kept(self, count)

        with monkeypatch.context() as patched:
            patched.setattr(layout.Memory, "__init__", failing)
            found = looped(box, threads)
        assert same(found, whole), number
        assert capsys.readouterr().err.count("memory ran out") == int(made[0] > number)


@pytest.mark.parametrize("method", ["trace", "layers"])
def test_chunks_of_the_loop_are_added_whole(box, monkeypatch, method):
    whole, kept, calls = looped(box), getattr(KernelsEngine, method), [0]

    def failing(self: KernelsEngine, *args: Any) -> Any:
        calls[0] += 1
        found = kept(self, *args)
        if calls[0] % 5 == 3 and calls[0] < 30:
            raise MemoryError
        return found

    monkeypatch.setattr(KernelsEngine, method, failing)
    assert same(looped(box), whole)


@pytest.mark.slow
def test_the_loop_ends_in_a_line_where_nothing_fits(box, monkeypatch):
    def failing(self: KernelsEngine, *args: Any) -> Any:
        raise MemoryError

    monkeypatch.setattr(KernelsEngine, "trace", failing)
    with pytest.raises(RenderError, match="not enough memory for the compiled loop on one thread"):
        looped(box)


# -- limits of the system

LIMITED = """
import hashlib, resource, sys, torchpt
mode, more = sys.argv[1], int(sys.argv[2])
path = {"type": "path", "max_depth": 2}
def shot(width, height):
    film = {"width": width, "height": height, "filter": "box"}
    scene = torchpt.load("cornell_box", "cpu")
    return torchpt.render(scene, spp=1, film=film, integrator=path, compile=mode, threads=2, full=True)
shot(100, 100)  # code and libraries are there
if more:
    with open("/proc/self/status") as file:
        held = next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmSize"))
    resource.setrlimit(resource.RLIMIT_AS, (held + more,) * 2)
try:
    found = shot(500, 400)
except torchpt.TorchptError as error:
    print("refused", error)
else:
    print(hashlib.sha256(found.image.numpy().tobytes()).hexdigest(), found.lanes)
"""


def limited(mode: str, more: int) -> tuple[str, str]:
    command = [sys.executable, "-c", LIMITED, mode, str(more)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env=os.environ | {"OMP_NUM_THREADS": "2"}
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout.strip(), done.stderr


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
@pytest.mark.parametrize("mode", [pytest.param("off", marks=pytest.mark.slow), "on"])
@pytest.mark.slow
def test_under_a_limit_of_addresses_the_bits_are_the_same_or_it_is_one_line(mode):
    whole, _ = limited(mode, 0)
    same_bits = 0
    for more in (2, 30, 90):
        found, told = limited(mode, more * 1_000_000)
        lines = [line for line in told.splitlines() if "memory ran out" in line]
        assert len(lines) <= 1 and len(found.splitlines()) == 1
        if not found.startswith("refused"):
            assert found.split()[0] == whole.split()[0]
            same_bits += 1
    assert same_bits


# -- render.max_memory


def measured(wish: str, more: str = "{}") -> tuple[str, int]:
    """Return what a render of a process of its own says, and bytes that it held above import at most."""
    text = f"""
import torchpt
from torchpt.core.memory import MemoryMeter
scene = torchpt.load("cornell_box", "cpu")
try:
    found = torchpt.render(scene, spp=1, full=True, max_memory={wish!r}, **{more})
    print(found.peak_memory)
except torchpt.SceneError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    said = done.stdout.strip()
    return said, int(said) if said.isdigit() else 0


WISHES = {
    "compiled": "{'film': {'width': 900, 'height': 700}}",
    "pilots": "{'film': {'width': 900, 'height': 700}, 'pilots': True}",
    "eager": "{'film': {'width': 160, 'height': 120}, 'compile': 'off'}",
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux")
@pytest.mark.parametrize("name", ["compiled", "pilots", "eager"])
@pytest.mark.slow
def test_too_small_a_limit_names_the_least_that_works(name):
    measured("8GB", WISHES[name])  # kernels are compiled once a machine, which takes memory of its own
    said, _ = measured("1MB", WISHES[name])
    assert said.startswith("render.max_memory: expected at least ") and said.endswith(
        " for this scene and film, got '1MB'"
    )
    least = int(said.split("at least ")[1].split("MB")[0]) + 1  # what is held differs by some pages
    _, peak = measured(f"{least}MB", WISHES[name])
    assert 0 < peak < 1.1e6 * least


def test_a_limit_changes_no_bit(box):
    whole = torchpt.render(box, spp=2, film=film_of(100, 80), compile="off", threads=2)
    with pytest.raises(SceneError, match="render.max_memory: expected at least"):
        torchpt.render(box, spp=2, film=film_of(100, 80), max_memory="1MB")
    with pytest.raises(SceneError, match="at least [0-9]+MB .*, as bytes or with a unit such as 4GB, got '10 bytes'"):
        torchpt.render(box, spp=2, film=film_of(100, 80), max_memory=10)
    limit = str(int(torchpt.render(box, spp=1, film=film_of(4), full=True).peak_memory / 1e6) + 300) + "MB"
    found = torchpt.render(box, spp=2, film=film_of(100, 80), compile="off", threads=2, max_memory=limit, full=True)
    assert torch.equal(found.image, whole) and found.peak_memory > 0


# -- what is kept between renders


def test_the_next_render_takes_over_the_memory_of_threads(box, monkeypatch):
    release_memory()
    assert not spare._kept
    wish: dict[str, Any] = {"spp": 2, "film": film_of(64, 60)}
    whole, made, new = torchpt.render(box, **wish, threads=2), [], layout.Memory.__init__
    assert 1 <= len(spare._kept) <= 2

    def making(self: layout.Memory, count: int) -> None:
        made.append(count)
        new(self, count)

    monkeypatch.setattr(layout.Memory, "__init__", making)
    for _ in range(3):
        assert torch.equal(torchpt.render(box, **wish, threads=1), whole) and not made
    other = torchpt.load("veach_mis", "cpu")  # of another structure
    torchpt.render(other, spp=1, film=film_of(8, 8), threads=1)
    assert made and len({one[0] for one in spare._kept}) == 2
    limit = str(int(torchpt.render(box, spp=1, film=film_of(4), full=True).peak_memory / 1e6) + 300) + "MB"
    torchpt.render(box, **wish, threads=2, max_memory=limit)
    assert not spare._kept  # asked for before, and none of its own


def test_memory_of_threads_is_bounded_and_holds_no_scene(monkeypatch):
    release_memory()
    scene = torchpt.load("cornell_box", "cpu")
    for k in range(4):
        torchpt.render(scene, spp=1, film=film_of(64, 60), threads=2, seed=k)
    sizes = [one[2] for one in spare._kept]
    assert len(sizes) <= 2 and all(1e6 < size < 1e7 for size in sizes)
    watch = weakref.ref(scene)
    del scene
    gc.collect()
    assert watch() is None and spare._kept
    for size, left in ((max(sizes), 1), (max(sizes) - 1, 0)):
        monkeypatch.setattr(spare, "MAX_KEPT_BYTES", size)
        torchpt.render(torchpt.load("cornell_box", "cpu"), spp=1, film=film_of(64, 60), threads=2)
        assert len(spare._kept) <= left


def test_memory_of_threads_goes_where_a_chunk_needs_it(box, monkeypatch, capsys):
    """Workers that nobody has are given back before lanes are made fewer."""
    warn_once.cache_clear()
    torchpt.render(box, spp=1, film=film_of(64, 60), threads=2)
    whole, calls, there = torchpt.render(box, spp=2, film=film_of(64, 60)), [0], []
    torchpt.render(torchpt.load("veach_mis", "cpu"), spp=1, film=film_of(8, 8), threads=1)
    trace = KernelsEngine.trace

    def failing(self: KernelsEngine, *args: Any) -> Any:
        calls[0] += 1
        there.append(len(spare._kept))
        if calls[0] == 1:
            raise MemoryError
        return trace(self, *args)

    monkeypatch.setattr(KernelsEngine, "trace", failing)
    assert torch.equal(torchpt.render(box, spp=2, film=film_of(64, 60), threads=2), whole)
    assert there[0] and not there[-1] and "memory ran out" in capsys.readouterr().err
