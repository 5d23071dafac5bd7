"""The kernels of a render: which there are, how each is made once, and what renders of the same structure share.

To add a kernel: write the function that traces it (in ``stages.py``; it takes a
:class:`~torchpt.engines.kernels.layout.Trace` and returns sinks), give it a method of :class:`Kernels`, and run it where
``engine.py`` needs it. What a path must carry for it is a row in ``layout.py``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cache, operators  # noqa: F401  (the operators register how they are lowered)
from torchpt.compiler.graph import Unsupported
from torchpt.compiler.program import Program, Tables, TracedStage, bind_tables
from torchpt.compiler.prologue import StepKey, without_unused_steps
from torchpt.compiler.sinks import Sinks
from torchpt.compiler.tracing import Tracer, choose_lane_count
from torchpt.core.tree import fingerprint, named_leaves, signature
from torchpt.engines.kernels import stages
from torchpt.engines.kernels.layout import Layout, Trace
from torchpt.engines.kernels.stages import kinds_of
from torchpt.paths.transmission import non_opaque

if TYPE_CHECKING:
    from torchpt.paths.wave import Wave


__all__ = ["Kernel", "KernelCache", "Kernels", "NamedTensors", "TensorVersion", "program_of"]


# ---- The tensors that a render's kernels read, by name, and which of them another render has read before


#: A tensor, and which of the contents that it has had.
TensorVersion = tuple[Tensor, object]


class NamedTensors:
    """The tensors of some records.

    Args:
        records: by the name that the paths begin with.
        before: those of another render: records that are the same ones are not walked through again.

    Attributes:
        tensors: by path.
        ids: path and tensor by the tensor's id.
        states: by path, the tensor and which of its contents it has.
    """

    def __init__(self, records: dict[str, Any], before: NamedTensors | None = None) -> None:
        known = {} if before is None else before._walked
        self._walked: dict[str, tuple[Any, list[tuple[str, Tensor]]]] = {}
        for name, record in records.items():
            same = name in known and known[name][0] is record and not isinstance(record, dict)
            self._walked[name] = known[name] if same else (record, list(named_leaves(record, name)))
        self.tensors = dict(leaf for _, leaves in self._walked.values() for leaf in leaves)
        self.ids = {id(tensor): (path, tensor) for path, tensor in self.tensors.items()}
        # A tensor is the same one only as long as nobody wrote into it; of inference tensors that cannot be known.
        self.states: dict[str, TensorVersion] = {
            path: (tensor, object() if tensor.is_inference() else tensor._version)
            for path, tensor in self.tensors.items()
        }

    def has(self, path: str, state: TensorVersion) -> bool:
        """Return True where a tensor is one that was read before, with the same numbers."""
        tensor, version = self.states[path]
        return tensor is state[0] and version == state[1]


# ---- What renders of one structure hand on to each other: kernels, and tables of tensors that are the same ones, unchanged


class KernelCache:
    """The latest kernel of each stage and the latest table of each tensor, with the tensors that they were made of.

    Renders that share it may run at the same time, on several threads.
    """

    def __init__(self) -> None:
        self._kernels: dict[Any, tuple[Kernel, dict[str, TensorVersion]]] = {}
        self._tables: dict[tuple[str, Any], tuple[TensorVersion, Tensor]] = {}
        self._results: dict[frozenset[str], tuple[dict[str, TensorVersion], dict[StepKey, Tensor]]] = {}
        self._lock = threading.Lock()

    def kernel(self, key: Any, program: Program, leaves: NamedTensors) -> Kernel | None:
        """The kernel of a stage where it was made of the same program and tensors; None where there is none such."""
        found = self._kernels.get(key)
        if found is None or found[0].program is not program or program.constants:
            return None
        same = all(leaves.has(path, state) for path, state in found[1].items())
        return found[0] if same else None

    def tables(self, leaves: NamedTensors) -> dict[Any, Tensor]:
        """Tables of a render's tensors as kernels read them, those that there are, by path and axis."""
        with self._lock:
            return {key: table for key, (state, table) in self._tables.items() if leaves.has(key[0], state)}

    def results(self, leaves: NamedTensors) -> dict[StepKey, Tensor]:
        """Return what steps of prologues came to on a render's tensors, those that were taken, by name."""
        found: dict[StepKey, Tensor] = {}
        with self._lock:
            for states, results in self._results.values():
                if all(leaves.has(path, state) for path, state in states.items()):
                    found |= results
        return found

    def keep(
        self,
        key: Any,
        kernel: Kernel,
        tables: dict[Any, Tensor],
        results: dict[StepKey, Tensor],
        leaves: NamedTensors,
    ) -> None:
        """Hand a kernel on, and all tables and results of steps of its render."""
        groups: dict[frozenset[str], dict[StepKey, Tensor]] = {}
        for name, result in results.items():
            groups.setdefault(name.leaves, {})[name] = result
        with self._lock:
            self._kernels[key] = kernel, {path: leaves.states[path] for path in kernel.program.leaves()}
            for paths, group in groups.items():
                self._results[paths] = {path: leaves.states[path] for path in paths}, group
            self._tables |= {place: (leaves.states[place[0]], table) for place, table in tables.items()}


# ---- Programs of a render's stages: each is traced and compiled once for all scenes of one structure


def program_of(
    key: tuple[Any, ...],
    structure: Any,
    leaves: NamedTensors,
    layout: Layout,
    build: Callable[[Trace], Sinks],
    listed: bool,
) -> Program:
    """The program of a stage: of this process, from disk, or traced and compiled now.

    Args:
        key: names the stage.
        structure: what else the trace may ask of the render, but for the numbers in its tensors.
        leaves: the tensors.
        layout: of the render.
        build: traces the stage.
        listed: whether the kernel takes lanes by a list.
    """
    return cache.program_of((key, structure), leaves.tensors, lambda: _traced(leaves, layout, build, listed))


def _traced(leaves: NamedTensors, layout: Layout, build: Callable[[Trace], Sinks], listed: bool) -> TracedStage:
    tracer = Tracer(choose_lane_count(leaves.tensors.values()), leaves.ids)
    trace = Trace(tracer, layout)
    with torch.no_grad():
        sinks = build(trace)
    tables, steps, guards = without_unused_steps(tracer.tables, tracer.steps, tracer.guards)
    searches = any(op in ("nearest", "occluded") for op, *_ in tracer.graph.nodes)
    return TracedStage(
        graph=tracer.graph,
        sinks=sinks,
        tables=tables,
        steps=steps,
        constants=tuple(tracer.constants),
        guards=guards,
        uniforms=tuple(trace.uniforms),
        tensors=trace.tensors,
        listed=listed,
        searched=kinds_of(layout.world) if searches else None,
        sums=tuple(trace.sums),
    )


# ---- The kernels of a render: which there are, and how each is made once


@dataclass(frozen=True)
class Kernel:
    """A stage's machine code with the tables of one scene."""

    program: Program
    tables: Tables


class Kernels(Layout):
    """The kernels of one render, made when they are first asked for.

    Args:
        wave: the render.
        packets: see :class:`~torchpt.engines.kernels.layout.Layout`.
        fused: see there.
        before: kernels of another render, whose tables are taken over where they are made of the same tensors.
        fixed: whether a world says the same of itself as long as it is the same one; models of the caller's own may not.
        cotangent: see :class:`~torchpt.engines.kernels.backward.VjpKernels`.

    Attributes:
        eager: models whose stage does what no kernel can, and what that is; they run as tensor operations.
        seconds: spent on making kernels.
        structure: what renders have in common that can share kernels, and threads their memory.
        kernel_cache: what renders of the same structure share.
        search: what the search by packets reads; None where the search structure is called.
        non_opaque: for each primitive whether a ray may pass it, as uint8, for the search structure.
    """

    def __init__(
        self,
        wave: Wave,
        packets: bool,
        fused: bool,
        before: Kernels | None = None,
        fixed: bool = False,
        cotangent: Tensor | None = None,
    ) -> None:
        super().__init__(wave, packets, fused)
        self._leaves = NamedTensors(
            {
                "world": self.world,
                "camera": wave.camera,
                "filter": wave.filter.tensors(),
                "sampler": self.numbers,
                "centre": wave.centre,
                "pixel": wave.context.pixel,
                "first": wave.first,
                "cotangent": cotangent,
            },
            None if before is None else before._leaves,
        )
        same = fixed and before is not None and before.world is self.world
        self._of_world = before._of_world if same else signature(self.world)  # pyright: ignore[reportOptionalMemberAccess]
        own = (fingerprint(wave.integrator), wave.context.crop) if wave.integrator.own_stages else None
        asked = (wave.camera.kind(), wave.filter.kind(), self.plan, wave.first, own, self._leaves.tensors)
        self.structure = (self._of_world, *map(signature, asked), packets, fused)
        alike = before is not None and before.structure == self.structure
        self.kernel_cache = before.kernel_cache if alike else KernelCache()  # pyright: ignore[reportOptionalMemberAccess]
        self._laid_out = self.kernel_cache.tables(self._leaves)
        self._results = self.kernel_cache.results(self._leaves)
        self._made: dict[tuple[Any, ...], Kernel] = {}
        self._lock = threading.Lock()
        self.search = stages.search_words(wave) if packets else None
        self.non_opaque: np.ndarray | None = None
        if self.has_opacity and not packets:
            prims = torch.arange(sum(self.world.geometry.counts))
            self.non_opaque = non_opaque(self.world, prims).to(torch.uint8).numpy()
        self.seconds = 0.0
        self.eager: dict[int, str] = {}

    def probe(self, numbers: Iterable[int]) -> dict[int, str]:
        """Return which of the models' stages no kernel can be made of, and why."""
        reasons = {}
        for number in numbers:
            try:
                self.bounce(number, 0.0)
            except Unsupported as error:
                reasons[number] = str(error)
        return reasons

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Rows of 32-bit numbers that a thread keeps for its lanes, see :mod:`torchpt.engines.kernels.engine`."""
        shown = sum(len(layer.channels) for layer in layers.values())
        return 2 * self.state.count + 2 * (self.models + 2) + 3 + shown

    # -- vertices of paths

    def generate(self, chosen: bool, given: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.generate`."""
        return self._get(False, stages.generate, chosen, given)

    def sort_lanes(self, shadow: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.sort_lanes`."""
        return self._get(False, stages.sort_lanes, shadow)

    def emit(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.emit`."""
        return self._get(True, stages.emit)

    def escape(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.escape`."""
        return self._get(True, stages.escape)

    def bounce(self, model: int, roulette: float) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.bounce`."""
        return self._get(self.listed, stages.bounce, model, roulette)

    def terminate(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.terminate`."""
        return self._get(self.listed, stages.terminate)

    # -- the search by packets

    def search_nearest(self, passed: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.search_nearest`."""
        return self._get(False, stages.search_nearest, passed)

    def search_occluded(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.search_occluded`."""
        return self._get(False, stages.search_occluded)

    # -- surfaces that are not opaque

    def list_transmitting(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.list_transmitting`."""
        return self._get(False, stages.list_transmitting)

    def transmit(self, again: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.transmit`."""
        return self._get(not again, stages.transmit, again)

    def begin_shadow_rays(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.begin_shadow_rays`."""
        return self._get(False, stages.begin_shadow_rays)

    def attenuate_shadow_rays(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.attenuate_shadow_rays`."""
        return self._get(False, stages.attenuate_shadow_rays)

    # -- what leaves a chunk

    def layers(self, model: int, names: tuple[str, ...]) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.layers`."""
        return self._get(self.listed, stages.layers, model, names)

    def accumulate(self, channels: int, clamp: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.accumulate`."""
        return self._get(False, stages.accumulate, channels, clamp)

    # -- how they are made

    def _get(self, listed: bool, build: Callable[..., Sinks], *arguments: Any) -> Kernel:
        """The kernel that ``build(trace, *arguments)`` traces; ``listed``: it takes lanes by a list, else all in order."""
        key = (build.__name__, *arguments)
        made = self._made.get(key)
        if made is not None:
            return made
        with self._lock:
            made = self._made.get(key)
            if made is None:
                begin_shadow_rays = time.perf_counter()
                made = self._made[key] = self._make(key, listed, build, arguments)
                self.seconds += time.perf_counter() - begin_shadow_rays
            return made

    def _make(
        self, key: tuple[Any, ...], listed: bool, build: Callable[..., Sinks], arguments: tuple[Any, ...]
    ) -> Kernel:
        def traced(trace: Any) -> Sinks:
            return build(trace, *arguments)

        program = program_of(key, self.structure, self._leaves, self, traced, listed)
        old = self.kernel_cache.kernel(key, program, self._leaves)
        if old is not None:
            return old
        leaves = self._leaves.tensors
        tables = bind_tables(
            program.tables, program.steps, program.constants, leaves, self._laid_out, program.names, self._results
        )
        made = Kernel(program, tables)
        self.kernel_cache.keep(key, made, self._laid_out, self._results, self._leaves)
        return made
