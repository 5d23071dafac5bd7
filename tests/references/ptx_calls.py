"""Kernels as PTX on a machine beside the same kernels on one lane of this CPU at a time, on the same memory.

:class:`DeviceProbes` does that with the calls of real renders, :func:`differing_results` and :func:`differing_kernel` with
functions of tensors.
Everything is compared that a kernel may write, all of its arenas, slots and lists, so a store to a wrong place is seen too.
Only the order of packed lanes is free: warps append as they come.
"""

from __future__ import annotations

import ctypes
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from forms import differing, one_lane
from ptx_machine import WARP, DeviceMemory, PtxMachine
from torch import Tensor

import torchpt
from torchpt.compiler import cache, cpu
from torchpt.compiler import function as functions
from torchpt.compiler.cpu import Function
from torchpt.compiler.function import compile_lanewise
from torchpt.compiler.kernel import HEAD, kernel_ir
from torchpt.compiler.program import Tables, TracedStage, bind_tables
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.sinks import Sinks
from torchpt.engines.kernels import calls, programs
from torchpt.engines.kernels.programs import Kernel
from torchpt.scene.formats.description import settings

__all__ = [
    "LANES",
    "WISH",
    "DeviceProbes",
    "Probe",
    "call_backward",
    "call_forward",
    "differing_kernel",
    "differing_results",
    "probed",
    "ptx_of",
    "traced_stages",
]

#: Most lanes of a kernel that are compared.
LANES = 256
#: Instructions of a PTX text beyond which each thread takes one lane only, to save time.
LONG = 1500


LAYERS = ["albedo", "normal", "depth", "position", "uv", "object_id"]
WISH: dict[str, Any] = {"spp": 1, "threads": 1, "compile": "on"}


def call_forward(scene: torchpt.Scene) -> None:
    """Render a picture, and layers."""
    torchpt.render(scene, film={"width": 64, "height": 64}, **_paths(scene), **WISH)
    torchpt.render(scene, film={"width": 24, "height": 24, "aovs": LAYERS}, integrator="aov", **WISH)


def _paths(scene: torchpt.Scene) -> dict[str, Any]:
    """Return the integrator `path` for scenes of `bdpt`, whose store these probes do not map and which has no gradients."""
    return {"integrator": "path"} if settings(scene.description, {}).integrator.name == "bdpt" else {}


def call_backward(scene: torchpt.Scene) -> None:
    """Render a gradient by all parameters; of scenes with opacity by colours of their materials alone.

    Opacity is differentiated by tensor operations, and so are textures of its table, and geometry (indices bend rays).
    """
    owners, named = (*scene.built.parts, *scene.built.copies), dict(scene.params)
    if any(owner.material.opacity != 1.0 for owner in owners):
        named = {
            name: value
            for name, value in named.items()
            if ".material" in f".{name}" and ".color" not in name and value.dim() == 1
        }
    given = {name: value.clone().requires_grad_() for name, value in named.items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # which edges a gradient leaves out does not matter here
        image = torchpt.render(scene, params=given, film={"width": 32, "height": 32}, **_paths(scene), **WISH)
        torch.autograd.grad(image.mean(), list(given.values()), allow_unused=True)


@contextmanager
def traced_stages() -> Iterator[dict[str, TracedStage]]:
    """Compile kernels of renders for single lanes meanwhile, and keep their stages by the keys of their code.

    Nothing is read from caches of programs.
    """
    found: dict[str, TracedStage] = {}
    compiled, program_of = cache.compile_stage, programs.program_of

    def noted(stage: TracedStage, target: Any = None) -> Any:
        program = compiled(stage, target)
        found[program.code] = stage
        return program

    def single(*given: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cache, "compile_stage", lambda stage, target=None: noted(stage, one_lane()))
            return program_of(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(programs, "program_of", single)
        patch.setattr(cache, "cache_key", lambda structure, target=None: None)
        cache.clear_programs()
        yield found
        cache.clear_programs()


def ptx_of(stage: TracedStage) -> str:
    """Return the PTX of a stage."""
    return cpu.compile_ir(kernel_ir(stage, ptx_target().form), ptx_target()).code.decode()


def _grid(lanes: int, machine: PtxMachine) -> tuple[int, int]:
    """Return blocks and threads of a block; short kernels run in too few threads, so that each takes several lanes."""
    threads = math.ceil(lanes / WARP) * WARP
    if sum(machine.instructions.values()) < LONG:
        threads = max(math.ceil(threads / 2 / WARP) * WARP, WARP)
    return (threads // (2 * WARP), 2 * WARP) if threads % (2 * WARP) == 0 else (threads // WARP, WARP)


def _add_tables(memory: DeviceMemory, tables: Tables) -> None:
    block, keep = tables.pairs, [table for table, _ in tables.laid_out]
    memory.add(np.ctypeslib.as_array(block), constant=True)
    for table in keep:
        memory.add(table.numpy(), constant=True)


# ---- Calls of renders


@dataclass
class Probe:
    """The comparisons of one kernel.

    Attributes:
        stage: that it computes.
        machine: that ran its PTX.
        ptx: its text.
        lanes: most lanes of a call that was compared.
        calls: number of calls.
        numbers: how many numbers the kernel wrote in them.
        wrong: descriptions of what differed.
    """

    stage: TracedStage
    machine: PtxMachine
    ptx: str
    lanes: int = 0
    calls: int = 0
    total: int = 0
    numbers: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def instructions(self) -> float:
        """Return the instructions that a lane took."""
        return sum(self.machine.executed.values()) / self.total

    @property
    def issues(self) -> float:
        """Return the instructions that warps issued for a lane, times the threads of a warp."""
        return WARP * sum(self.machine.issued.values()) / self.total


class DeviceProbes:
    """Makes calls of :meth:`Calls.run` twice more, on at most :data:`LANES` of their lanes.

    The first call of each kernel is compared, and later ones that have more lanes, as long as none had :data:`LANES`.

    Attributes:
        found: comparisons by kernel.
    """

    def __init__(self, stages: Mapping[str, TracedStage], patch: pytest.MonkeyPatch) -> None:
        self.stages, self._kept = stages, calls.Calls.run
        self.found: dict[str, Probe] = {}
        self._devices: dict[int, tuple[Kernel, Kernel]] = {}
        self._memory = DeviceMemory()
        patch.setattr(calls.Calls, "run", lambda *given, **named: self._run(*given, **named))

    def _run(
        self, own: Any, kernel: Kernel, count: int, source: Any, target: Any, places: Any = None, lists: Any = None,
        slots: Any = None,
    ) -> None:  # fmt: skip
        given = source, target, places, lists, slots
        name = "_".join(map(str, next(key for key, made in own.kernels._made.items() if made is kernel)))
        probe = self.found.get(name)
        lanes = min(count, LANES)
        if lanes and (probe is None or lanes > probe.lanes):
            self._compare(own, name, kernel, lanes, *given)
        self._kept(own, kernel, count, *given)

    def _compare(
        self,
        own: Any,
        name: str,
        kernel: Kernel,
        lanes: int,
        source: Any,
        target: Any,
        places: Any,
        lists: Any,
        slots: Any,
    ) -> None:
        device = self._on_machine(name, kernel)
        probe = self.found[name]
        lists = lists or []
        written = [target.words, (own.slots if slots is None else slots).words, own.counters, *(x.words for x in lists)]
        before = [words.copy() for words in written]
        self._map(own, kernel, source, places, written)
        results = []
        for other in (kernel, device):
            for words, old in zip(written, before, strict=True):
                words[:] = old
            self._kept(own, other, lanes, source, target, places, lists, slots)
            results.append([words.copy() for words in written])
        for words, old in zip(written, before, strict=True):
            words[:] = old
        probe.lanes, probe.calls, probe.total = lanes, probe.calls + 1, probe.total + lanes
        if (results[0][2] != results[1][2]).any():
            probe.wrong.append(f"counters: {results[0][2]} and {results[1][2]}")
            return
        for result in results:
            _sort_packed(probe.stage.sinks, result, before[2])
        names = ["arena", "slots", "counters", *(f"list {k}" for k in range(len(lists)))]
        for what, a, b, old in zip(names, *results, before, strict=True):
            probe.numbers += int((a != old).sum())
            if what in ("arena", "slots"):
                a, b = a.view(np.float32), b.view(np.float32)
            wrong = differing(torch.from_numpy(a), torch.from_numpy(b)).numpy()
            if wrong.any():
                first = np.argwhere(wrong)[0]
                told = f"{a[tuple(first)]!r} and {b[tuple(first)]!r}"
                probe.wrong.append(f"{int(wrong.sum())} of {what}, first at {first.tolist()}: {told}")

    def _on_machine(self, name: str, kernel: Kernel) -> Kernel:
        """Return the kernel with a call that runs its PTX."""
        if id(kernel) not in self._devices:
            stage = self.stages[kernel.program.code]
            ptx = ptx_of(stage)
            probe = self.found[name] = Probe(stage, PtxMachine(ptx), ptx)

            def call(address: int, lanes: int) -> None:
                count = np.array([lanes])
                self._memory.add(count, constant=True)
                arguments = ctypes.string_at(address, probe.machine.sizes[0]), np.int64(count.ctypes.data).tobytes()
                probe.machine.launch(self._memory, arguments, *_grid(lanes, probe.machine), seed=lanes)

            device = replace(kernel, program=replace(kernel.program, function=Function(call, b"", None)))
            self._devices[id(kernel)] = kernel, device  # both live, so that their ids stay their own
        return self._devices[id(kernel)][1]

    def _map(self, own: Any, kernel: Kernel, source: Any, places: Any, written: Sequence[np.ndarray]) -> None:
        """Map the memory of a call, and no other."""
        memory = self._memory = DeviceMemory()
        for words in written:
            memory.add(words)
        for words in (source.words, None if places is None else places.words):
            if words is not None and all(words is not other for other in written):
                memory.add(words, constant=True)
        _add_tables(memory, kernel.tables)
        memory.add(own.place, constant=True)
        for salts in (*own._salts.values(), own._start_salts):
            memory.add(salts.numpy(), constant=True)
        for numbers in (*own._bounds.values(), *own._depths.values(), own._merging):
            memory.add(numbers, constant=True)
        if own.kernels.search is not None:
            accel = own.kernels.wave.accel
            memory.add(np.ctypeslib.as_array(own.kernels.search), constant=True)
            for table in accel.tables:
                memory.add(table.numpy(), constant=True)


def _sort_packed(sinks: Sinks, result: Sequence[np.ndarray], before: np.ndarray) -> None:
    """Put the lanes that a kernel packed, and the lists that it wrote, in an order of their own."""
    target, after, lists = result[0], result[2], result[3:]

    def span(counter: int) -> slice:
        return slice(int(before[counter]), int(after[counter]))

    for compact in sinks.compact:
        own, rows = span(compact.counter), [row for row, _ in compact.rows]
        order = np.lexsort(target[rows, own])
        places = np.empty(len(order), np.int32)
        places[order] = np.arange(own.start, own.stop)
        target[rows, own] = target[rows, own][:, order]
        for append in compact.appends:
            entries = lists[append.list][0, span(append.counter)]
            entries[:] = np.sort(places[entries - own.start])
    for append in sinks.appends:
        lists[append.list][0, span(append.counter)].sort()


def probed(scene: Any, run: Callable[[Any], Any], **loading: Any) -> dict[str, Probe]:
    """Return the comparisons of all kernels that ``run(scene)`` calls; the scene is loaded here, with ``loading``."""
    with traced_stages() as stages, pytest.MonkeyPatch.context() as patch:
        loaded = torchpt.load(scene, "cpu", **loading)
        probes = DeviceProbes(stages, patch)
        run(loaded)
    return probes.found


def named_stages(scene: Any, run: Callable[[Any], Any]) -> dict[str, TracedStage]:
    """Return the stages of all kernels that ``run(scene)`` asks for, by the names that :func:`probed` gives them."""
    codes: dict[str, str] = {}
    with traced_stages() as stages, pytest.MonkeyPatch.context() as patch:
        program_of = programs.program_of

        def noted(key: tuple[Any, ...], *given: Any) -> Any:
            program = program_of(key, *given)
            codes["_".join(map(str, key))] = program.code
            return program

        patch.setattr(programs, "program_of", noted)
        run(torchpt.load(scene, "cpu"))
        return {name: stages[code] for name, code in codes.items()}


# ---- Functions of tensors


def differing_kernel(
    stage: TracedStage,
    uniforms: Sequence[np.ndarray],
    inputs: Sequence[np.ndarray],
    outputs: Sequence[np.ndarray],
    counters: np.ndarray,
) -> list[str]:
    """Run a stage whose tables are constants on tensors ``(rows, N)``, by single lanes and on the machine; return what differs.

    ``outputs`` and ``counters`` are written to.
    """
    lanes, start = inputs[0].shape[1], counters.copy()
    words = [0] * len(HEAD)
    tables = bind_tables(stage.tables, stage.steps, stage.constants, {})
    words[HEAD.index("counters")], words[HEAD.index("tables")] = counters.ctypes.data, tables.address
    words += [x.ctypes.data for x in uniforms]
    for x in (*inputs, *outputs):
        words += [x.ctypes.data, x.shape[1]]
    block = np.array(words)
    cpu.compile_ir(kernel_ir(stage, one_lane().form), one_lane()).call(block.ctypes.data, lanes)
    wanted = [x.copy() for x in (*outputs, counters)]
    for x in outputs:
        x[:] = 0
    counters[:] = start
    memory, count = DeviceMemory(), np.array([lanes])
    _add_tables(memory, tables)
    for x in (*outputs, counters):
        memory.add(x)
    for x in (*inputs, *uniforms, count):
        memory.add(x, constant=True)
    machine = PtxMachine(ptx_of(stage))
    machine.launch(memory, [block.tobytes(), np.int64(count.ctypes.data).tobytes()], *_grid(lanes, machine))
    pairs = enumerate(zip(wanted, (*outputs, counters), strict=True))
    return [f"result {k}" for k, (a, b) in pairs if differing(torch.from_numpy(a), torch.from_numpy(b)).any()]


def differing_results(
    function: Callable[..., Sequence[Tensor]], given: Sequence[Tensor]
) -> tuple[int, list[str], PtxMachine]:
    """Compare a function's results on the machine with those of single lanes.

    Args:
        function: as for :func:`torchpt.compiler.function.compile_lanewise`.
        given: its arguments ``(..., N)``.

    Returns:
        How many numbers were compared, what differs, and the machine.
    """
    machines: list[PtxMachine] = []
    compiled = cache.compile_stage

    def noted(stage: TracedStage, target: Any = None) -> Any:
        program = compiled(stage, target)
        machine = PtxMachine(program.function.code.decode())
        machines.append(machine)

        def call(address: int, lanes: int) -> None:
            memory, count = DeviceMemory(), np.array([lanes])
            words = np.frombuffer(ctypes.string_at(address, machine.sizes[0]), np.int64)
            _add_tables(memory, tables[0])
            for k, x in enumerate((*arguments[0], *results[0])):
                assert words[len(HEAD) + 2 * k] == x.data_ptr()
                memory.add(x.numpy(), constant=k < len(arguments[0]))
            memory.add(count, constant=True)
            arguments_of_entry = words.tobytes(), np.int64(count.ctypes.data).tobytes()
            machine.launch(memory, arguments_of_entry, *_grid(lanes, machine), seed=1)

        return replace(program, function=Function(call, b"", None))

    tables: list[Tables] = []
    arguments: list[list[Tensor]] = []
    results: list[list[Tensor]] = []
    bind, empty = functions.bind_tables, torch.empty

    def bound(*x: Any, **named: Any) -> Tables:
        tables.append(bind(*x, **named))
        return tables[-1]

    contiguous = [x.contiguous() for x in given]
    single = compile_lanewise(function, contiguous, one_lane())(*contiguous)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "compile_stage", noted)
        patch.setattr(functions, "bind_tables", bound)
        device = compile_lanewise(function, contiguous, ptx_target())
        arguments.append(contiguous)
        results.append([])

        def noted_empty(*shape: Any, **named: Any) -> Tensor:
            results[0].append(empty(*shape, **named))
            return results[0][-1]

        patch.setattr(functions.torch, "empty", noted_empty)
        found = device(*contiguous)
    wrong = []
    for k, (a, b) in enumerate(zip(single, found, strict=True)):
        bad = differing(a, b)
        if bad.any():
            at = tuple(torch.nonzero(bad)[0].tolist())
            wrong.append(
                f"result {k}: {int(bad.sum())} of {bad.numel()}, first at {at}: {a[at].item()} and {b[at].item()}"
            )
    return sum(x.numel() for x in single), wrong, machines[0]
