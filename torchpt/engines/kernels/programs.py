"""The kernels of a render: compiled on first use, and shared between renders of the same structure.

To add a kernel: write the function that traces it (in ``stages.py``; it takes a
:class:`~torchpt.engines.kernels.layout.Trace` and returns sinks), add a method to :class:`Kernels`, and call it in
``engine.py``. New fields of the path state are rows in ``layout.py``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cache, cpu, operators  # noqa: F401  (the operators register how they are lowered)
from torchpt.compiler.graph import Unsupported
from torchpt.compiler.packet import PacketSearch
from torchpt.compiler.program import LaidOut, Program, Tables, TracedStage, bind_tables
from torchpt.compiler.prologue import StepKey, without_unused_steps
from torchpt.compiler.sinks import Sinks
from torchpt.compiler.tracing import Tracer, choose_lane_count
from torchpt.core.tree import fingerprint, named_leaves, signature
from torchpt.engines.kernels import stages
from torchpt.engines.kernels.layout import Layout, Trace
from torchpt.engines.kernels.stages import kinds_of
from torchpt.paths.roulette import DEEP
from torchpt.paths.store import BLOCKS
from torchpt.paths.transmission import non_opaque

if TYPE_CHECKING:
    from torchpt.paths.wave import Wave


__all__ = [
    "Kernel",
    "KernelCache",
    "KernelCaches",
    "Kernels",
    "NamedTensors",
    "TableCache",
    "TensorVersion",
    "probed_kernels",
    "program_of",
    "records_of",
    "trace_stage",
]


# ---- The tensors that kernels read, by name, with their versions


#: A tensor and the version of its contents.
TensorVersion = tuple[Tensor, object]


class NamedTensors:
    """The tensors of records by dotted path.

    Args:
        records: records by the first part of the path.
        before: tensors of another render: records that are the same objects are not traversed again.

    Attributes:
        tensors: tensor by path.
        ids: path and tensor by the tensor's id.
        states: tensor and version by path.
    """

    def __init__(self, records: dict[str, Any], before: NamedTensors | None = None) -> None:
        earlier = {} if before is None else before._walked
        self._walked: dict[str, tuple[Any, list[tuple[str, Tensor]]]] = {}  # each record, and its tensors by path
        for name, record in records.items():
            earlier_record, _ = earlier.get(name, (None, []))
            same = (
                name in earlier and earlier_record is record and not isinstance(record, dict)
            )  # a dict may have changed
            self._walked[name] = earlier[name] if same else (record, list(named_leaves(record, name)))
        self.tensors = dict(leaf for _, leaves in self._walked.values() for leaf in leaves)
        self.ids = {id(tensor): (path, tensor) for path, tensor in self.tensors.items()}
        # Writes in place change the version; inference tensors have none, so they never count as unchanged.
        self.states: dict[str, TensorVersion] = {
            path: (tensor, object() if tensor.is_inference() else tensor._version)
            for path, tensor in self.tensors.items()
        }

    def has(self, path: str, state: TensorVersion) -> bool:
        """Return True if the tensor at ``path`` is the same object with the same contents as in ``state``."""
        tensor, version = self.states.get(path, (None, None))  # None: of another structure
        kept_tensor, kept_version = state
        return tensor is kept_tensor and version == kept_version


# ---- What the renders of a scene share: tables of unchanged tensors, and by structure the kernels that read them


class TableCache:
    """Cache of the latest table of each tensor, and of results of prologues.

    Each is stored with the versions of the tensors that it was made of, and returned only if these are unchanged. Renders on
    several threads may share it at the same time.
    """

    def __init__(self) -> None:
        self._tables: dict[tuple[str, Any], tuple[TensorVersion, Tensor]] = {}
        self._results: dict[frozenset[str], tuple[dict[str, TensorVersion], dict[StepKey, Tensor]]] = {}
        self._lock = threading.Lock()

    def tables(self, leaves: NamedTensors) -> dict[Any, Tensor]:
        """Return the cached tables of a render's tensors, by path and axis."""
        with self._lock:
            return {
                (path, axis): table for (path, axis), (state, table) in self._tables.items() if leaves.has(path, state)
            }

    def results(self, leaves: NamedTensors) -> dict[StepKey, Tensor]:
        """Return the cached results of prologue steps on a render's tensors, by key of the step."""
        valid: dict[StepKey, Tensor] = {}
        with self._lock:
            for states, results in self._results.values():
                if all(leaves.has(path, state) for path, state in states.items()):
                    valid |= results
        return valid

    def keep(
        self, tables: Mapping[tuple[str, Any], Tensor], results: Mapping[StepKey, Tensor], leaves: NamedTensors
    ) -> None:
        """Store tables and results of prologue steps of a render."""
        groups: dict[frozenset[str], dict[StepKey, Tensor]] = {}  # by the paths that the steps depend on
        for step, result in results.items():
            groups.setdefault(step.leaves, {})[step] = result
        with self._lock:
            for paths, group in groups.items():
                states, before = self._results.get(paths, ({}, {}))
                same = bool(before) and all(leaves.has(path, state) for path, state in states.items())
                states = states if same else {path: leaves.states[path] for path in paths}
                self._results[paths] = states, {**before, **group} if same else group
            self._tables |= {(path, axis): (leaves.states[path], table) for (path, axis), table in tables.items()}

    def forget(self, paths: Collection[str]) -> None:
        """Drop what was made of tensors at these paths."""
        with self._lock:
            self._tables = {key: entry for key, entry in self._tables.items() if key[0] not in paths}
            self._results = {key: entry for key, entry in self._results.items() if key.isdisjoint(paths)}


@dataclass(frozen=True)
class _Entry:
    """The latest kernel of a stage: its program, its tables (None for those that were dropped), and versions of tensors."""

    program: Program
    kernel: Kernel | None  # None where tables were dropped
    tables: Sequence[LaidOut | None]
    states: Mapping[str, TensorVersion]


class KernelCache:
    """Cache of the latest kernel of each stage, for renders of one structure.

    Args:
        tables: tables of the scene.
    """

    def __init__(self, tables: TableCache) -> None:
        self.tables = tables
        self._entries: dict[Any, _Entry] = {}

    @property
    def known(self) -> bool:
        """Return True if a kernel was stored."""
        return bool(self._entries)

    def program(self, key: Any) -> Program | None:
        """Return the program of a stage's latest kernel; None if there is none, or its trace depends on values of tensors."""
        entry = self._entries.get(key)
        return None if entry is None or entry.program.guards else entry.program

    def find(self, key: Any, program: Program, leaves: NamedTensors) -> tuple[Kernel | None, Sequence[LaidOut | None]]:
        """Return the cached kernel of a stage, if it was made of the same program and tensors, and tables to make another of.

        Tables are None where the tensors that they were made of have changed.
        """
        entry = self._entries.get(key)
        if entry is None or entry.program is not program:
            return None, ()
        states = entry.states
        changed = {path for path in program.leaves() if path not in states or not leaves.has(path, states[path])}
        # Constants are tensors without a path, so nothing tells whether they were written to: their tables are laid out anew.
        if entry.kernel is not None and not changed and not program.constants:
            return entry.kernel, ()
        return None, _without(program, entry.tables, changed)

    def keep(self, key: Any, kernel: Kernel, leaves: NamedTensors) -> None:
        """Store a kernel."""
        states = {path: leaves.states[path] for path in kernel.program.leaves()}
        self._entries[key] = _Entry(kernel.program, kernel, kernel.tables.laid_out, states)

    def forget(self, paths: Collection[str]) -> None:
        """Drop the tables of kernels that depend on tensors at these paths."""
        for key, entry in list(self._entries.items()):
            if not entry.states.keys().isdisjoint(paths):
                tables = _without(entry.program, entry.tables, paths)
                states = {path: state for path, state in entry.states.items() if path not in paths}
                self._entries[key] = _Entry(entry.program, None, tables, states)


def _without(program: Program, tables: Sequence[LaidOut | None], paths: Collection[str]) -> Sequence[LaidOut | None]:
    """Return the tables of a program, with None for those that depend on leaves at these paths, or on more than leaves."""
    return [
        None if leaves is None or not leaves.isdisjoint(paths) else table
        for leaves, table in zip(program.table_leaves, tables, strict=True)
    ]


class KernelCaches:
    """Caches of the kernels of a scene: pictures and gradients have other structures, and share tables."""

    #: Most structures; the one that was not asked for the longest is dropped.
    MOST = 4

    def __init__(self) -> None:
        self._tables = TableCache()
        self._by_structure: dict[Any, KernelCache] = {}
        self._lock = threading.Lock()

    def of(self, structure: Any) -> KernelCache:
        """Return the cache of a structure."""
        with self._lock:
            cache = self._by_structure.pop(structure, None) or KernelCache(self._tables)
            self._by_structure[structure] = cache  # as the latest
            if len(self._by_structure) > self.MOST:
                del self._by_structure[next(iter(self._by_structure))]
            return cache


# ---- Programs: each stage is traced and compiled once for all scenes of one structure


def program_of(
    key: tuple[Any, ...],
    structure: Any,
    leaves: NamedTensors,
    layout: Layout,
    build: Callable[[Trace], Sinks],
    listed: bool,
) -> Program:
    """Return the program of a stage: cached in this process or on disk, or traced and compiled now.

    Args:
        key: name and arguments of the stage.
        structure: everything of the render that the trace may depend on, but for values of tensors.
        leaves: the tensors.
        layout: of the render.
        build: traces the stage.
        listed: True: the kernel reads lanes by a list.
    """
    return cache.program_of((key, structure), leaves.tensors, lambda: trace_stage(leaves, layout, build, listed))


def trace_stage(leaves: NamedTensors, layout: Layout, build: Callable[[Trace], Sinks], listed: bool) -> TracedStage:
    """Trace a stage; arguments as for :func:`program_of`."""
    # A number of lanes that divides no axis of a leaf: axes of lanes are told apart from those of tables by their length.
    tracer = Tracer(choose_lane_count(leaves.tensors.values()), leaves.ids)
    trace = Trace(tracer, layout)
    with torch.no_grad(), torch.device("cpu"):  # whatever the caller's default device
        sinks = build(trace)
    tables, steps, guards = without_unused_steps(tracer.tables, tracer.steps, tracer.guards)
    searches = any(op in ("nearest", "occluded") for op, *_ in tracer.graph.nodes)
    functions = PacketSearch(kinds_of(layout.world)) if layout.tree is None else layout.tree
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
        search=functions if searches else None,
        sums=tuple(trace.sums),
    )


# ---- The kernels of a render


def records_of(layout: Layout, cotangent: Tensor | None) -> dict[str, Any]:
    """Return the records that kernels of a render may read, by name; ``cotangent``: see :class:`Kernels`."""
    wave = layout.wave
    return {
        "world": layout.world,
        "camera": wave.camera,
        "filter": wave.filter.tensors(),
        "sampler": layout.numbers,
        "centre": wave.centre,  # origin of the lanes' coordinates in the scene
        "pixel": wave.context.pixel,
        "near": wave.context.near,
        "first": wave.first_surface,
        "cotangent": cotangent,
    }


@dataclass(frozen=True)
class Kernel:
    """Machine code of a stage with the tables of one scene."""

    program: Program
    tables: Tables


#: Models of a scene from which on their kernels have the bound of roulette as an input.
MANY_MODELS = 3


class Kernels(Layout):
    """The kernels of one render, compiled on first use.

    Args:
        wave: the render.
        by_kernels: True: rays are searched by kernels. False: the acceleration structure is called.
        fused: True: the search is part of the stages. False: it runs between them.
        before: kernels of another render; its tables are shared where they were made of the same tensors.
        fixed: True: the structure of a world object never changes. False with models of a user's own, whose code may change.
        cotangent: see :class:`~torchpt.engines.kernels.backward.VjpKernels`.
        caches: those of the scene; None: nothing is kept for other renders.

    Attributes:
        eager: models whose stage cannot be compiled, with the reason; they run as tensor operations.
        structure: key that is equal for renders that can share kernels and memory of threads.
        caches: those of the scene.
        kernel_cache: shared by renders of the same structure.
        light_paths: kernels of the light paths that are traced beside the samples; None: there are none.
        search: argument of searches by kernels; None where the acceleration structure is called.
        non_opaque: uint8 for each primitive, 1 where a ray may pass it, for the acceleration structure.
    """

    def __init__(
        self,
        wave: Wave,
        by_kernels: bool,
        fused: bool,
        before: Kernels | None = None,
        fixed: bool = False,
        cotangent: Tensor | None = None,
        caches: KernelCaches | None = None,
    ) -> None:
        super().__init__(wave, by_kernels, fused)
        self._leaves = NamedTensors(records_of(self, cotangent), None if before is None else before._leaves)
        same = fixed and before is not None and before.world is self.world
        self._of_world = before._of_world if same else signature(self.world)  # pyright: ignore[reportOptionalMemberAccess]
        # The crop is None without splats, which only stages of an integrator's own add.
        own = None
        if wave.integrator.has_own_stages:  # splats choose a pixel within the filter's radius
            own = fingerprint(wave.integrator.as_traced()), wave.context.crop, wave.filter.radius
        parts = (wave.camera.kind(), wave.filter.kind(), self.plan, wave.first_surface, own, self._leaves.tensors)
        self.structure = (self._of_world, *map(signature, parts), by_kernels, fused, signature(self.tree))
        self._use(caches or (KernelCaches() if before is None else before.caches))
        self._made: dict[tuple[Any, ...], Kernel] = {}
        self._lock = threading.Lock()
        self.search, self.non_opaque = self._search_inputs()
        self._seconds = 0.0
        self.eager: dict[int, str] = {}
        self.light_paths: Kernels | None = None

    def with_rays(self, wave: Wave) -> Kernels:
        """Return these kernels for a wave that differs in the rays that paths start with, and in the limits of paths."""
        kernels = copy(self)
        kernels.wave = wave
        return kernels

    def _use(self, caches: KernelCaches) -> None:
        """Use the caches of a scene, once the structure is known."""
        self.caches, self.kernel_cache = caches, caches.of(self.structure)
        self._laid_out = self.kernel_cache.tables.tables(self._leaves)
        self._results = self.kernel_cache.tables.results(self._leaves)

    def _search_inputs(self) -> tuple[Any, np.ndarray | None]:
        """Return :attr:`search` and :attr:`non_opaque`."""
        if self.by_kernels:
            return stages.search_words(self.wave), None
        if not self.has_opacity:
            return None, None
        prims = torch.arange(sum(self.world.geometry.counts))
        return None, non_opaque(self.world, prims).to(torch.uint8).numpy()

    @property
    def seconds(self) -> float:
        """Return the seconds spent on making kernels, those of light paths included."""
        return self._seconds + (0.0 if self.light_paths is None else self.light_paths.seconds)

    def probe(self, models: Iterable[int]) -> dict[int, str]:
        """Compile the stages of BSDF models, by index; return those that cannot be compiled, with the reasons."""
        reasons = {}
        for model in models:
            try:
                self.bounce(model, roulette=0.0)  # the upper bound of survival; 0: no roulette
            except Unsupported as error:
                reasons[model] = str(error)
        return reasons

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a thread allocates for each lane.

        They are two arenas of paths, two sets of lists, the radiance of the samples, the channels of layers, what searches take
        (:class:`torchpt.engines.kernels.searches.ChunkSearch`), and all that light paths and connections need
        (:class:`torchpt.engines.kernels.engine.KernelsEngine`).
        """
        channels = sum(len(layer.channels) for layer in layers.values())
        of_light = 0 if self.light_paths is None else self.light_paths.rows({})
        if self.wave.integrator.connects and self.store is not None:
            of_light += BLOCKS * self.store.count
        of_searches = 1 + (2 * self.passed.count if self.has_transmission else 0)
        return 2 * self.state.count + 2 * (self.models + 2) + 3 + channels + of_searches + of_light

    # -- vertices of paths

    def generate(self, chosen: bool, given: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.generate`; ``chosen``: pixels are listed, ``given``: rays are given."""
        return self._get(False, stages.generate, chosen, given)

    def sort_lanes(self, shadow: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.sort_lanes`; ``shadow``: shadow rays came before."""
        return self._get(False, stages.sort_lanes, shadow)

    def emit(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.emit`."""
        return self._get(True, stages.emit)

    def escape(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.escape`."""
        return self._get(True, stages.escape)

    def bounce(self, model: int, roulette: float, depth: int = 0) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.bounce`; ``depth``: number of the vertex, 0 for any."""
        if self.wave.integrator.starts_on_lights and depth == 1:
            return self._get(self.listed, stages.bounce, model, self.bound(roulette), True)
        return self._get(self.listed, stages.bounce, model, self.bound(roulette))

    def bound(self, roulette: float) -> float | None:
        """Return the bound of the survival probability that kernels are made for; None: it is an input of theirs.

        With an input a model has one kernel, and not two with and without roulette, which then take twice the time to compile.
        It costs some 2 % of a bounce where there is no roulette, so scenes of few models have two.
        """
        return None if self.models >= MANY_MODELS else roulette

    def terminate(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.terminate`."""
        return self._get(self.listed, stages.terminate)

    # -- connections

    def list_ends(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.list_ends`."""
        return self._get(False, stages.list_ends)

    def connect(self, model: int) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.connect`."""
        return self._get(True, stages.connect, model)

    # -- the search by packets

    def search_nearest(self, passed: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.search_nearest`; ``passed``: of rays that pass surfaces, not of paths."""
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

    # -- results of a chunk

    def layers(self, model: int, names: tuple[str, ...]) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.layers`."""
        return self._get(self.listed, stages.layers, model, names)

    def accumulate(self, channels: int, clamp: bool) -> Kernel:
        """See :func:`torchpt.engines.kernels.stages.accumulate`."""
        return self._get(False, stages.accumulate, channels, clamp)

    # -- compilation

    def prefetch(self, processes: int) -> None:
        """Begin to compile the large kernels that paths need in other processes, unless some were made before.

        Kernels of models that no path hits are compiled in vain. They begin with quick code, which the final one replaces.
        ``processes``: most that run at a time.
        """
        cpu.allow(processes)
        if processes < 2 or not self.wave.integrator.light or self.kernel_cache.known:
            return
        if self.light_paths is not None:
            self.light_paths.prefetch(processes)
        start = time.perf_counter()
        for listed, build, arguments in self.large_kernels():
            traced = partial(_with_arguments, build, arguments)
            trace = partial(trace_stage, self._leaves, self, traced, listed)
            with suppress(Unsupported):  # the call of the kernel will say so
                cache.prefetch(((build.__name__, *arguments), self.structure), self._leaves.tensors, trace)
        self._seconds += time.perf_counter() - start

    def large_kernels(self) -> Iterator[tuple[bool, Callable[..., Sinks], tuple[Any, ...]]]:
        """Yield the arguments of :meth:`_get` for the kernels that take long to compile, about in the order of their use."""
        if self.fused:  # with a search inside
            yield False, stages.generate, (False, self.wave.start_rays is not None)
        if self.has_opacity:
            yield True, stages.transmit, (False,)
            yield False, stages.transmit, (True,)
            if "transmittance" in self.state:
                yield False, stages.attenuate_shadow_rays, ()
        if self.has_emitters:
            yield True, stages.emit, ()
        if self.has_environment:
            yield True, stages.escape, ()
        for key in self.bounces():
            yield self.listed, stages.bounce, key
        if self.wave.integrator.connects:
            for model, kind in enumerate(self.world.materials.models):
                if not kind.smooth and model not in self.eager:
                    yield True, stages.connect, (model,)

    def bounces(self) -> Iterator[tuple[Any, ...]]:
        """Yield the arguments of the kernels of surfaces, about in the order of their use."""
        limits = self.wave.integrator.limits
        if self.wave.integrator.starts_on_lights:
            bound = self.bound(limits.roulette(1))
            yield from ((model, bound, True) for model in range(self.models) if model not in self.eager)
        depths = range(1, min(limits.last, DEEP + 2))
        for bound in dict.fromkeys(self.bound(limits.roulette(depth)) for depth in depths):
            for model in range(self.models):
                if model not in self.eager:
                    yield model, bound

    def _get(self, listed: bool, build: Callable[..., Sinks], *arguments: Any) -> Kernel:
        """Return the kernel that ``build(trace, *arguments)`` traces, compiled when it is first asked for.

        ``listed``: True: it reads the lanes of a list; False: all lanes in order.
        """
        key = (build.__name__, *arguments)
        kernel = self._made.get(key)
        if kernel is not None:
            return kernel
        with self._lock:
            kernel = self._made.get(key)  # another thread may have made it
            if kernel is None:
                start = time.perf_counter()
                kernel = self._made[key] = self._make(key, listed, build, arguments)
                self._seconds += time.perf_counter() - start
            return kernel

    def _make(
        self, key: tuple[Any, ...], listed: bool, build: Callable[..., Sinks], arguments: tuple[Any, ...]
    ) -> Kernel:
        program = self._program(key, listed, partial(_with_arguments, build, arguments))
        cached, kept = self.kernel_cache.find(key, program, self._leaves)
        if cached is not None:
            return cached
        tables, results = len(self._laid_out), len(self._results)
        kernel = Kernel(program, self._bind(program, kept))
        self.kernel_cache.keep(key, kernel, self._leaves)
        # Those that were added, at the ends.
        new_tables = dict(islice(self._laid_out.items(), tables, None))
        new_results = dict(islice(self._results.items(), results, None))
        self.kernel_cache.tables.keep(new_tables, new_results, self._leaves)
        return kernel

    def _program(self, key: tuple[Any, ...], listed: bool, build: Callable[[Trace], Sinks]) -> Program:
        # The cache is of one structure, whose key is long to hash.
        known = self.kernel_cache.program(key)
        return known or program_of(key, self.structure, self._leaves, self, build, listed)

    def _bind(self, program: Program, kept: Sequence[LaidOut | None]) -> Tables:
        """Bind a program to the tables of this render; ``kept``: see :func:`torchpt.compiler.program.bind_tables`."""
        return bind_tables(
            program.tables,
            program.steps,
            program.constants,
            self._leaves.tensors,
            self._laid_out,
            program.names,
            self._results,
            kept=kept,
            in_order=program.in_order,
        )


def _with_arguments(build: Callable[..., Sinks], arguments: tuple[Any, ...], trace: Trace) -> Sinks:
    return build(trace, *arguments)


K = TypeVar("K", bound=Kernels)


def probed_kernels(wave: Wave, own: Sequence[int], packets: bool, make: Callable[[bool], K]) -> K:
    """Return the kernels of a render; its ``eager`` lists models that cannot be compiled, with the reasons.

    Args:
        wave: of the render.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        packets: True: rays are searched by packets. This is part of the stages (fused) where nothing has to happen between
            search and stage.
        make: makes the kernels; True: fused.
    """
    opaque = wave.context.world.materials.opacity is None and not wave.integrator.has_own_transmit
    integrator = wave.integrator
    # Shadow rays other than those to lights, or photons.
    sent = integrator.splats_at_surfaces or integrator.connects or integrator.merges or integrator.sends_photons
    kernels = make(packets and opaque and wave.first_surface is None and not sent)
    eager = kernels.probe(own) if wave.integrator.light else {}
    if eager and kernels.fused:  # stages that run as tensor operations need searches between the stages
        kernels = make(False)
    kernels.eager = eager
    return kernels
