"""Kernels that renders call, in both forms: each call is made by single lanes and again by vectors, and leaves the same bits.

What a call leaves: the rows that it writes as far as it writes them, the slots of samples, the counters, and its lists up to
where the counters say. Behind that vectors leave what they like.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from forms import differing, one_lane
from gradient_rooms import gradient_of, room
from torch import Tensor

import torchpt
from torchpt.compiler import cache, cpu
from torchpt.compiler.form import CAPACITY, SCALAR, VECTORS
from torchpt.compiler.kernel import kernel_ir
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import Sinks
from torchpt.compiler.target import Target
from torchpt.engines.kernels import engine as calls
from torchpt.engines.kernels.programs import Kernel

COLOURED = {"type": "principled", "base_color": [0.6, 0.5, 0.4], "roughness": 0.4}
SMALL = {"film": {"width": 16, "height": 16}, "threads": 1, "compile": "on"}


@pytest.fixture
def stages(monkeypatch) -> Iterator[dict[str, TracedStage]]:
    """Stages by the names of their machine code; all that renders ask for is traced."""
    found: dict[str, TracedStage] = {}
    compiled = cache.compile_stage

    def noted(stage: TracedStage, target: Target | None = None) -> Any:
        program = compiled(stage, target)
        found[program.code] = stage
        return program

    monkeypatch.setattr(cache, "compile_stage", noted)
    monkeypatch.setattr(cache, "cache_key", lambda structure, target: None)
    cache.clear_programs()
    yield found
    cache.clear_programs()


class ErrorProbes:
    """Makes each call of :meth:`Calls.run` twice, from the same memory, and compares.

    Attributes:
        seen: how many calls of each kernel were compared.
        numbers: and how many numbers that they write.
        wrong: what differs.
    """

    def __init__(self, stages: dict[str, TracedStage], monkeypatch: pytest.MonkeyPatch) -> None:
        self.stages, self._kept = stages, calls.Calls.run
        self.seen, self.numbers = Counter[str](), Counter[str]()
        self.wrong: list[str] = []
        self._singles: dict[int, tuple[Kernel, Kernel]] = {}
        monkeypatch.setattr(calls.Calls, "run", lambda *given, **named: self._run(*given, **named))

    def _run(
        self, own: Any, kernel: Any, count: int, source: Any, target: Any, places: Any = None, lists: Any = None,
        slots: Any = None,
    ) -> None:  # fmt: skip
        stage = self.stages[kernel.program.code]
        name = "_".join(map(str, next(key for key, made in own.kernels._made.items() if made is kernel)))
        lists = lists or []
        memory = [target.words, (own.slots if slots is None else slots).words, own.counters, *(x.words for x in lists)]
        before = [words.copy() for words in memory]
        self._kept(own, self._single(kernel, stage), count, source, target, places, lists, slots)
        after = [words.copy() for words in memory]
        for words, old in zip(memory, before, strict=True):
            words[:] = old
        self._kept(own, kernel, count, source, target, places, lists, slots)
        self.seen[name] += 1
        for what, row, first, last in spans(stage.sinks, count, before[2], after[2]):
            a, b = (torch.from_numpy(x[what][row, first:last].view(np.float32)) for x in (memory, after))
            self.numbers[name] += a.numel()
            if differing(a, b).any():
                self.wrong.append(
                    f"{name}: {int(differing(a, b).sum())} of row {row} of {what}, lanes {first} to {last}"
                )
        for what in (1, 2):
            if (memory[what] != after[what]).any():
                self.wrong.append(f"{name}: {('', 'slots', 'counters')[what]}")

    def _single(self, kernel: Kernel, stage: TracedStage) -> Kernel:
        """The kernel on one lane at a time."""
        if id(kernel) not in self._singles:
            made = cpu.compile_ir(kernel_ir(stage, SCALAR), one_lane())
            single = replace(kernel, program=replace(kernel.program, function=made))
            self._singles[id(kernel)] = kernel, single  # both live, so that their ids stay their own
        return self._singles[id(kernel)][1]


def spans(sinks: Sinks, count: int, before: np.ndarray, after: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Return where a kernel writes: memory (0: its target, from 3 on: lists), row, first place and that after the last."""
    shift = 0 if sinks.shift is None else int(before[sinks.shift])
    for row, _ in sinks.write:
        yield 0, row, shift, shift + count
    for compact in sinks.compact:
        for row, _ in compact.rows:
            yield 0, row, int(before[compact.counter]), int(after[compact.counter])
    for append in [
        *sinks.appends,
        *(append for compact in sinks.compact for append in compact.appends),
    ]:
        yield 3 + append.list, 0, int(before[append.counter]), int(after[append.counter])
    for scatter in sinks.scatter:
        for row, _ in () if scatter.slots else scatter.rows:
            yield 0, row, 0, CAPACITY - VECTORS.width


#: By what kernels they call: searches inside with and without other models, trees between, opacity, maps, a light tree.
SCENES = {
    "cornell_box": {"generate", "emit", "bounce"},
    "cornell_spheres": {"generate", "emit", "bounce"},
    "veach_mis": {"generate", "emit", "bounce"},
    "shapes_and_maps": {"generate", "sort_lanes", "emit", "escape", "bounce", "transmit", "list_transmitting"},
    "env_teapot": {"generate", "sort_lanes", "escape", "bounce"},
    "many_lights": {"generate", "sort_lanes", "emit", "bounce"},
}
FAST = ("cornell_box",)


@pytest.mark.parametrize("name", [x if x in FAST else pytest.param(x, marks=pytest.mark.slow) for x in SCENES])
def test_calls(name, stages, monkeypatch):
    scene = torchpt.load(name, "cpu")
    twice = ErrorProbes(stages, monkeypatch)
    torchpt.render(scene, spp=4, **SMALL)
    assert not twice.wrong
    assert all(any(kernel.startswith(stage) for kernel in twice.seen) for stage in SCENES[name]), twice.seen
    print(dict(twice.seen), dict(twice.numbers))
    assert sum(twice.numbers.values()) > 10_000


OTHERS = {"one lane": one_lane, "haswell": lambda: Target("haswell", ""), "nehalem": lambda: Target("nehalem", "")}


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_pictures_and_gradients(name, monkeypatch):
    """One lane at a time, and by older vectors (without fused multiply and add): the same from the camera to film and back."""
    if name != "one lane" and "+fma" not in cpu.host().features.split(","):
        pytest.skip("these are x86 machines that have what Haswell has")

    def made() -> list[Tensor]:
        cache.clear_programs()
        scene = torchpt.load(room(COLOURED), "cpu")
        picture = torchpt.render(scene, spp=4, **SMALL)
        return [picture, gradient_of(scene, "materials.plate.base_color", adjoint="replay")]

    vectors, before = made(), cpu.counts()
    monkeypatch.setitem(cpu._state, "host", OTHERS[name]())
    other = made()
    assert sum(cpu.counts()) > sum(before)  # kernels of their own
    monkeypatch.undo()
    cache.clear_programs()
    assert float(vectors[1].norm()) > 0
    for a, b in zip(vectors, other, strict=True):
        assert not differing(a, b).any()
