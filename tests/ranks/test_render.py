"""`torchpt.render(ranks=...)` gives what one process gives, on every rank; errors of one rank are known to all."""

from __future__ import annotations

import copy
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from few import few
from forks import in_ranks

import torchpt
from torchpt.core.errors import LostRankError, OtherRankError, RenderError, SceneError, TorchptError
from torchpt.rendering import render_scene
from torchpt.scene.formats.description import settings

FILM = {"width": 24, "height": 16, "filter": "box"}
CASES: dict[str, dict[str, Any]] = {
    "plain": {"spp": 6, "film": {**FILM, "filter": "mitchell"}},
    "eager": {"spp": 5, "compile": "off"},
    "pilots": {"spp": 8, "pilots": True, "film": {**FILM, "crop": [3, 2, 17, 11]}},
    "adaptive": {"spp": 40, "sampler": {"type": "sobol", "adaptive": True}, "film": {**FILM, "aovs": ["samples"]}},
    "target": {"spp": 500, "target_error": 0.05},
    "layers": {"spp": 5, "film": {**FILM, "aovs": ["variance", "normal", "object_id"]}},
    "clamp": {"spp": 4, "integrator": {"type": "path", "clamp": 0.5}},
}
NUMBERS = ("spp", "paths", "rays", "nonfinite_samples", "nonfinite_causes", "nonfinite_first", "truncated_paths")
NUMBERS += ("relmse", "relmse_interval", "stopped_by", "complete")


@pytest.fixture(scope="module")
def box() -> torchpt.Scene:
    return torchpt.load("cornell_box", device="cpu")


@pytest.fixture(scope="module")
def broken() -> torchpt.Scene:
    """Some of its samples are not finite."""
    scene = torchpt.load("cornell_box", device="cpu")
    scene.params["materials.red.reflectance"].fill_(torch.nan)
    scene.check_own = lambda: None  # which refuses that  # type: ignore[method-assign]
    return scene


def facts(scene: torchpt.Scene, wishes: dict[str, Any], group: Any = None) -> dict[str, Any]:
    more: Any = {"film": FILM, "threads": 1, **wishes}
    found = torchpt.render(scene, full=True, ranks=group, **more)
    return {name: found[name].numpy().copy() for name in found} | {name: getattr(found, name) for name in NUMBERS}


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def test_a_stop_that_comes_too_late_stops_nothing(box: torchpt.Scene, tmp_path: Path) -> None:
    """A rank that is asked to stop at its last samples has a whole picture, with its error, as one process has."""

    def work(group: Any) -> dict[str, Any]:
        wish = {"film": FILM, "render": {"spp": 32, "threads": 1, "pilots": True}}
        wishes = settings(box.description, wish)
        found = render_scene(box, wishes, lambda state: state.done >= state.total, ranks=group)
        return {"image": found.image.numpy().copy()} | {name: getattr(found, name) for name in NUMBERS}

    alone = work(None)
    assert alone["complete"] and alone["spp"] == 32
    for found in in_ranks(2, work, tmp_path):
        assert not isinstance(found, Exception), found
        assert same(found, alone), {name: (found[name], alone[name]) for name in NUMBERS}


@pytest.mark.parametrize("size", few([2, 3], 1))
def test_the_bits_of_one_process(box: torchpt.Scene, broken: torchpt.Scene, size: int, tmp_path: Path) -> None:
    """Picture, layers, error, counts and what is not finite, however the render ends."""

    def work(group: Any) -> dict[str, Any]:
        return {name: facts(scene, wishes, group) for name, (scene, wishes) in cases.items()}

    cases = {name: (box, wishes) for name, wishes in CASES.items()} | {"broken": (broken, {"spp": 4})}
    alone = work(None)
    assert alone["broken"]["nonfinite_samples"] > 64 and alone["target"]["stopped_by"] == "target_error"
    for found in in_ranks(size, work, tmp_path):
        assert not isinstance(found, Exception), found
        assert [name for name in cases if not same(found[name], alone[name])] == []


def test_a_batch(box: torchpt.Scene, tmp_path: Path) -> None:
    """Pictures of a batch have the bits of one process too, and gradients those of all ranks."""
    poses = box.params["camera.to_world"].repeat(2, 1, 1)
    poses[1, 0, 3] += 0.1

    def work(group: Any) -> tuple[Any, Any]:
        leaf = torch.tensor([[0.5, 0.1, 0.1]], requires_grad=True)
        wishes: dict[str, Any] = {"film": FILM, "threads": 1, "spp": 3, "ranks": group, "edges": False}
        images = torchpt.render_batch(box, poses, {"materials.red.reflectance": leaf}, **wishes)
        images.square().mean().backward()
        assert leaf.grad is not None
        return images.detach().numpy().copy(), leaf.grad.numpy().copy()

    images, gradient = work(None)
    found = in_ranks(2, work, tmp_path)
    for one in found:
        assert not isinstance(one, Exception), one
        assert np.array_equal(one[0], images)
        assert np.array_equal(one[1], found[0][1]) and np.allclose(one[1], gradient, rtol=1e-5)


def test_a_checkpoint_of_three_goes_on_in_one_and_back(box: torchpt.Scene, tmp_path: Path) -> None:
    whole = facts(box, {"spp": 12, "pilots": True})
    file = {"checkpoint": str(tmp_path / "a.npz"), "pilots": True, "spp": 12}

    def begun(group: Any) -> None:
        from torchpt.rendering.api import render_scene
        from torchpt.scene.formats.description import settings

        wishes = {"film": FILM, "render": {**file, "threads": 1}}
        render_scene(box, settings(box.description, wishes), lambda state: state.done > 1500, ranks=group)

    def ended(group: Any) -> dict[str, Any]:
        return facts(box, {**file, "resume": True}, group)

    from torchpt.rendering import checkpoint

    for size, again in ((3, 1), (1, 2)):
        Path(file["checkpoint"]).unlink(missing_ok=True)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(checkpoint, "EVERY", 0.0)
            patch.setattr(checkpoint, "PATIENCE", 0.0)
            done = in_ranks(size, begun, tmp_path) if size > 1 else [begun(None)]
        assert done == [None] * size
        assert 0 < int(np.load(file["checkpoint"])["picture.counts"].max()) < 12
        for found in in_ranks(again, ended, tmp_path) if again > 1 else [ended(None)]:
            assert not isinstance(found, Exception) and same(found, whole), found


GRADIENTS: dict[str, tuple[str, Any]] = {
    "kernels": ("materials.red.reflectance", {}),
    "tensors": ("materials.red.reflectance", {"compile": "off"}),
    "tape": ("materials.red.reflectance", {"adjoint": "autograd"}),
    "vertices": ("shapes.short_box.vertices", {}),
    "camera": ("camera.to_world", {}),
}


@pytest.mark.parametrize(
    "names", [("kernels", "vertices"), pytest.param(tuple(GRADIENTS), marks=pytest.mark.slow)], ids=["fast", "all"]
)
def test_gradients_are_shared(names: tuple[str, ...], tmp_path: Path) -> None:
    """The same bits on every rank, and those of one process up to the rounding of sums."""
    scene = torchpt.load("cornell_box", device="cpu")

    def work(group: Any) -> dict[str, Any]:
        found = {}
        for name in names:
            key, wishes = GRADIENTS[name]
            value = scene.params[key].detach().clone().requires_grad_()
            image = torchpt.render(scene, spp=4, film=FILM, params={key: value}, ranks=group, threads=1, **wishes)
            (image * image).sum().backward()
            assert value.grad is not None
            found[name] = value.grad.numpy().copy()
        return found

    alone = work(None)
    every = in_ranks(3, work, tmp_path)
    for name, gradient in alone.items():
        for found in every:
            assert np.array_equal(found[name], every[0][name])
        assert np.abs(gradient).max() > 0.0
        assert np.abs(every[0][name] - gradient).max() <= 1e-5 * np.abs(gradient).max()


def refused(work: Callable[[Any], Any], size: int, folder: Path, timeout: float = 60.0) -> list[Any]:
    found = in_ranks(size, work, folder, timeout)
    assert all(error is None or isinstance(error, TorchptError) for error in found), found
    assert all("\n" not in str(error) for error in found)
    return found


def test_what_differs_is_refused_everywhere(box: torchpt.Scene, tmp_path: Path) -> None:
    def pictures(group: Any) -> None:
        with pytest.raises(RenderError, match="what is rendered must be the same"):
            torchpt.render(box, spp=1, seed=group.rank, film=FILM, ranks=group)
        torchpt.render(box, spp=1, film=FILM, ranks=group)  # the group is of use as before

    def scenes(group: Any) -> None:
        own = copy.copy(box)
        own.params["materials.red.reflectance"] = torch.full((3,), 0.2 + 0.1 * group.rank)
        with pytest.raises(RenderError, match="what is rendered must be the same"):
            torchpt.render(own, spp=1, film=FILM, ranks=group)

    def losses(group: Any) -> None:
        red = scene.params["materials.red.reflectance"].clone().requires_grad_()
        image = torchpt.render(scene, spp=1, film=FILM, params={"materials.red.reflectance": red}, ranks=group)
        with pytest.raises(RenderError, match="the loss must be the same"):
            (image * (1.0 + group.rank)).sum().backward()

    scene = box
    assert in_ranks(2, pictures, tmp_path) == [None, None]
    assert in_ranks(2, scenes, tmp_path) == [None, None]
    assert in_ranks(2, losses, tmp_path) == [None, None]


def test_an_error_of_one_is_told_to_the_others(box: torchpt.Scene, tmp_path: Path) -> None:
    def work(group: Any) -> None:
        limit: Any = {"max_memory": "1MB"} if group.rank == 1 else {}
        torchpt.render(box, spp=1, film=FILM, ranks=group, **limit)

    first, second, third = refused(work, 3, tmp_path)
    assert isinstance(second, SceneError) and second.key == "render.max_memory"
    for error in (first, third):
        assert isinstance(error, OtherRankError) and "rank 1" in str(error)


def test_a_lost_rank_ends_the_others(box: torchpt.Scene, tmp_path: Path) -> None:
    def work(group: Any) -> None:
        torchpt.render(box, spp=1, film=FILM, ranks=group)
        if group.rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        torchpt.render(box, spp=1, film=FILM, ranks=group)

    begun = time.monotonic()
    first, second, third = refused(work, 3, tmp_path)
    assert second is None and time.monotonic() - begun < 20.0
    assert all(isinstance(error, LostRankError) for error in (first, third))


def test_a_rank_that_says_nothing_is_given_up(box: torchpt.Scene, tmp_path: Path) -> None:
    def work(group: Any) -> None:
        if group.rank == 1:
            time.sleep(5.0)
            return
        torchpt.render(box, spp=1, film=FILM, ranks=group)

    first, second = refused(work, 2, tmp_path, timeout=1.0)
    assert second is None and isinstance(first, LostRankError) and "1 s" in str(first)


def test_a_group_needs_a_process_group() -> None:
    with pytest.raises(RenderError, match="init_process_group"):
        torchpt.ranks.Group()


@pytest.mark.parametrize("timeout", ["a", None, True, 0, -1, float("nan"), float("inf"), 1e300, [1]])
def test_a_timeout_is_a_number_of_seconds(timeout: Any) -> None:
    with pytest.raises(SceneError, match="^timeout: expected a number of seconds above 0") as caught:
        torchpt.ranks.Group(timeout=timeout)
    assert "\n" not in str(caught.value)


def test_what_is_no_process_group(tmp_path: Path) -> None:
    def work(group: Any) -> list[str]:
        said = []
        for wrong in ("x", 3, [0], object()):
            with pytest.raises(
                SceneError, match="^process_group: expected a process group of torch.distributed"
            ) as caught:
                torchpt.ranks.Group(wrong)
            said.append(str(caught.value))
        with pytest.raises(SceneError, match="^group: expected"):
            torchpt.ranks.share([1], "x")  # type: ignore[arg-type]
        return said

    (said,) = in_ranks(1, work, tmp_path)
    assert isinstance(said, list) and not any("\n" in line for line in said)


#: The second of two ranks says nothing. Gloo gives up too just as Python ends, which holds its lock meanwhile.
LEFT_ALONE = """
import atexit, os, sys, time

def hold():
    while time.monotonic() < begun + 2.5:
        pass

atexit.register(hold)  # the first to come is the last to be called

import torch.distributed as dist
import torchpt

other = os.fork()
rank = 0 if other else 1
dist.init_process_group("gloo", init_method="file://" + sys.argv[1], rank=rank, world_size=2)
group = torchpt.ranks.Group(timeout=1.5)
group.barrier()
if rank == 1:
    time.sleep(5.0)
    os._exit(0)
group.timeout, begun = 0.5, time.monotonic()
try:
    group.barrier()
except torchpt.LostRankError as error:
    print(error, flush=True)
sys.setswitchinterval(100.0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.slow
def test_a_process_that_lost_a_rank_ends_well(tmp_path: Path) -> None:
    found = subprocess.run(
        [sys.executable, "-c", LEFT_ALONE, str(tmp_path / "store")], capture_output=True, text=True, timeout=100.0
    )
    assert found.returncode == 0, found.stderr[-300:]
    # Older torch tells of its connections.
    own = [line for line in found.stdout.splitlines() if not line.startswith("[Gloo] ")]
    assert own == ["ranks: another rank did not answer for 0.5 s"]
