"""The one loop over vertices: the order of events, and that everything which follows paths comes through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

import torchpt
from torchpt.engines import tensors
from torchpt.engines.kernels import engine as chunk
from torchpt.gradients import replay
from torchpt.paths.integrators.base import Limits
from torchpt.paths.walk import Counts, Observer, walk
from torchpt.rendering.one_path import one_path
from torchpt.scene.formats.description import settings

SMALL = {"width": 8, "height": 8}


@dataclass
class Toy:
    """A population of paths that only counts vertices."""

    depth: int = 1


class Noted:
    """An engine that notes its verbs; paths meet an emitter at vertex 2 and all leave the scene at vertex 4."""

    def __init__(self, passes: int = 0) -> None:
        self.verbs: list[str] = []
        self.passes, self.left = passes, passes

    def intersect(self, paths: Toy) -> bool:
        self.verbs.append(f"intersect {paths.depth}")
        self.left = self.passes
        return self.left > 0

    def transmit(self, paths: Toy) -> bool:
        self.verbs.append("transmit")
        self.left -= 1
        return self.left > 0

    def sort(self, paths: Toy) -> Counts:
        self.verbs.append("sort")
        gone = paths.depth == 4
        return Counts([0] if gone else [3, 2], emissive=2 if paths.depth == 2 else 0, missed=5 if gone else 0)

    def emit(self, paths: Toy) -> None:
        self.verbs.append("emit")

    def escape(self, paths: Toy) -> None:
        self.verbs.append("escape")

    def scatter(self, paths: Toy, roulette: float) -> Toy:
        self.verbs.append(f"scatter {roulette:g}")
        return Toy(paths.depth + 1)

    def occlude(self, paths: Toy) -> None:
        self.verbs.append("occlude")

    def terminate(self, paths: Toy, truncated: bool) -> None:
        self.verbs.append("truncate" if truncated else "terminate")


def verbs(
    limits: Limits, observer: Observer[Toy] | None = None, until: int | None = None, passes: int = 0
) -> list[str]:
    engine = Noted(passes)
    walk(engine, Toy(), limits, observer, until)
    return engine.verbs


def test_the_order_of_events() -> None:
    whole = [
        *("intersect 1", "sort", "scatter 0", "occlude"),
        *("intersect 2", "sort", "emit", "scatter 1", "occlude"),
        *("intersect 3", "sort", "scatter 1", "occlude"),
        *("intersect 4", "sort", "escape"),
    ]
    assert verbs(Limits(9, 2)) == whole
    assert verbs(Limits(2, 2)) == [*whole[:7], "terminate"]
    assert verbs(Limits(0, 2)) == ["terminate"]
    assert verbs(Limits(9, 2, first_surface=True)) == [*whole[:4], "terminate"]
    assert verbs(Limits(9, 2), until=3) == whole[:9]
    assert verbs(Limits(1, 1), passes=2) == ["intersect 1", "transmit", "transmit", "sort", "terminate"]


def test_paths_that_only_roulette_ends_are_counted_where_they_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchpt.paths.integrators.base.ENDLESS", 2)
    assert verbs(Limits(-1, 9))[-1] == "truncate"


def test_an_observer_sees_each_vertex_and_may_end_the_walk() -> None:
    class Looks(Observer[Toy]):
        def __init__(self, end: str = "") -> None:
            self.end, self.seen = end, list[str]()

        def note(self, what: str, paths: Toy) -> bool:
            self.seen.append(f"{what} {paths.depth}")
            return self.seen[-1] == self.end

        def on_hits(self, paths: Toy) -> bool:
            return self.note("on_hits", paths)

        def on_sorted(self, paths: Toy, counts: Counts) -> bool:
            return self.note("on_sorted", paths)

        def on_emission(self, paths: Toy) -> None:
            self.note("on_emission", paths)

        def on_scattered(self, paths: Toy) -> None:
            self.note("on_scattered", paths)

    looks = Looks()
    verbs(Limits(2, 9), looks)
    assert looks.seen == [
        "on_hits 1",
        "on_sorted 1",
        "on_emission 1",
        "on_scattered 2",
        "on_hits 2",
        "on_sorted 2",
        "on_emission 2",
    ]
    assert verbs(Limits(9, 9), Looks("on_hits 2"))[-1] == "intersect 2"
    assert verbs(Limits(9, 9), Looks("on_sorted 2"))[-1] == "sort"


def _gradient(compile: str) -> Callable[[torchpt.Scene], Any]:
    def render(scene: torchpt.Scene) -> None:
        name = "materials.white.reflectance"
        colour = scene.params[name].clone().requires_grad_()
        torchpt.render(scene, params={name: colour}, spp=1, film=SMALL, compile=compile).sum().backward()

    return render


def _picture(**wishes: Any) -> Callable[[torchpt.Scene], Any]:
    return lambda scene: torchpt.render(scene, spp=1, film=SMALL, **wishes)


def _layers(compile: str) -> Callable[[torchpt.Scene], Any]:
    return lambda scene: torchpt.render(scene, spp=1, film={**SMALL, "aovs": ["depth"]}, full=True, compile=compile)


def _printed(scene: torchpt.Scene) -> None:
    one_path(scene, settings(scene.description, {"film": SMALL}), (4, 4), 0)


#: What follows paths, and how many walks it takes at least.
JOBS = {
    "picture by kernels": (_picture(compile="on"), 1),
    "picture by tensors": (_picture(compile="off"), 1),
    "first surfaces by kernels": (_picture(compile="on", integrator="ibl"), 1),
    "first surfaces by tensors": (_picture(compile="off", integrator="ibl"), 1),
    "layers by kernels": (_layers("on"), 2),
    "layers by tensors": (_layers("off"), 2),
    "gradient by kernels": (_gradient("on"), 2),
    "gradient by tensors": (_gradient("off"), 2),
    "a path that is printed": (_printed, 1),
}


@pytest.mark.parametrize("name", JOBS)
def test_all_that_follows_paths_is_a_walk(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    walks: list[Any] = []

    def counted(*args: Any) -> None:
        walks.append(args[0])
        walk(*args)

    for module in (tensors, chunk, replay):
        monkeypatch.setattr(module, "walk", counted)
    job, expected = JOBS[name]
    scene = torchpt.load("cornell_box", "cpu")
    job(scene)
    assert len(walks) >= expected
    kind = tensors.TensorsEngine if "tensors" in name or "printed" in name else chunk.KernelsEngine
    assert all(isinstance(engine, kind) for engine in walks)
