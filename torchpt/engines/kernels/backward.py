"""Path replay by kernels: chunks are traced again on threads, and cotangents pulled back vertex by vertex.

A kernel of a VJP traces a stage with its autograd tape, so operators of the backward pass become nodes as those of the stage
do. A look-up in a differentiated table becomes an input of the lane; its gradient is written to rows beside a row of the index,
and the engine adds them up after the kernel. Cotangents between vertices are stored in *slots* by sample: a VJP reads the
cotangents of the rays that left the vertex, and writes those of the rays that came.

*Tables* are the tensors of the scene that stages read. Their differentiated copies are the *leaves* of the tape
(:class:`torchpt.paths.adjoint.Tape`), ``primals`` their values without derivatives, all three in the same order.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.form import CAPACITY
from torchpt.compiler.graph import Unsupported
from torchpt.compiler.operators.derivatives import summand_of
from torchpt.compiler.sinks import Scatter, Sinks
from torchpt.compiler.tracing import Tracer
from torchpt.core.autograd import gradients_of
from torchpt.core.memory import Span
from torchpt.engines.kernels import stages
from torchpt.engines.kernels.engine import Chunk, KernelsEngine, Paths
from torchpt.engines.kernels.layout import HIT, Fields, Layout, Memory, Rows, Trace, path_state
from torchpt.engines.kernels.programs import Kernel, KernelCaches, Kernels
from torchpt.engines.kernels.threads import keep_worker, reuse_worker
from torchpt.math.gathers import recording_gathers
from torchpt.math.sums import ChunkGradientSums
from torchpt.paths import adjoint
from torchpt.paths.adjoint import InputCotangents, Tape, VertexCotangents
from torchpt.paths.integrators.path import follows_ray
from torchpt.paths.state import EXTRA, PathState, Shadow, Splat, VertexInput
from torchpt.paths.walk import KEPT
from torchpt.paths.wave import with_detached_geometry
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit

__all__ = [
    "SLOTS",
    "KernelsBackward",
    "VjpKernels",
    "bounce_vjp",
    "emit_vjp",
    "escape_vjp",
    "slots_of",
    "slots_read",
    "store_hits",
]


# ---- Kernels of VJPs: each traces a function of :mod:`torchpt.paths.adjoint`, its tape included


#: Fields of slots: cotangents of a sample's radiance and ray, transmittance of its latest shadow ray, hit of its next ray.
SLOTS: Fields = {
    "radiance": ((3,), "f"),
    "throughput": ((3,), "f"),
    "o": ((3,), "f"),
    "d": ((3,), "f"),
    "transmittance": ((), "f"),
    **HIT,
}
#: Field of slots if the integrator has splats: transmittance of the latest splat.
_SPLAT: Fields = {"splat_transmittance": ((), "f")}
#: Mask of a :class:`~torchpt.compiler.sinks.Scatter` that stores in every lane.
_ALL_LANES = -1
#: Largest leaf whose gradient may come from every lane as a whole: each lane outputs a row for each of its elements.
_MOST_ELEMENTS = 64


def slots_of(layout: Layout) -> Fields:
    """Return the fields of slots, with the cotangents of the integrator's own fields; whole numbers have none."""
    own_fields = layout.wave.integrator.fields
    extra = {EXTRA + own.name: ((own.rows,) if own.rows > 1 else (), "f") for own in own_fields if not own.whole}
    return {**SLOTS, **extra, **(_SPLAT if layout.wave.integrator.splats else {})}


class _RecordedGathers:
    """Records the gathers of a trace from differentiated tables, and makes them inputs of the lane.

    Attributes:
        taken: for each look-up the number of the table, the index ``(N,)``, and the values, which are autograd leaves.
    """

    def __init__(self, tracer: Tracer, kernels: VjpKernels) -> None:
        self.tracer, self.kernels = tracer, kernels
        self.taken: list[tuple[int, Tensor, Tensor]] = []
        self._values: dict[tuple[int, int], Tensor] = {}  # by number of the table and id of the index

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """See :class:`torchpt.math.gathers.GatherRecorder`."""
        number = self.kernels.numbers_of.get(id(table))
        if number is None or not self.tracer.is_traced(index):
            return None
        key = number, id(index)
        if key not in self._values:
            primal = self.kernels.primals[number]
            with torch.no_grad():
                values = torch.index_select(primal, primal.dim() - 1, index)
            self._values[key] = values.detach().requires_grad_()
            self.taken.append((number, index, self._values[key]))
        return self._values[key]

    def leaves(self) -> list[Tensor]:
        """Return the gathered values as inputs of the lane, then the tables themselves."""
        return [*(leaf for _, _, leaf in self.taken), *self.kernels.tape.leaves]


def bounce_vjp(trace: Trace, model: int, roulette: float | None, follow_ray: bool) -> Sinks:
    """Pull cotangents back through the surfaces of a BSDF model, see :func:`torchpt.paths.adjoint.bounce_vjp`.

    ``roulette``: see :meth:`torchpt.engines.kernels.layout.Trace.roulette`.

    Besides sinks, a VJP sets ``trace.sums``: for each table with gradients its number, the row of the index (-1: the gradient
    of the whole table comes from every lane), the first row of the values, and their number.
    """
    kernels, tracer = _begin_vjp(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
    cotangents = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
    next_hit = Hit(*(rows[name] for name in HIT)) if kernels.taped.plan.attached else None

    def transmittance(_: Shadow) -> Tensor:
        return rows["transmittance"]

    integrator, cotangent = trace.layout.wave.integrator, kernels.cotangent

    def of_splat(splat: Splat) -> tuple[Tensor, Tensor]:
        return adjoint.splat_contributions(integrator.clamp, cotangent, splat, rows["splat_transmittance"])

    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        context = kernels.taped.at(salts, follow_ray=follow_ray, roulette=trace.roulette(roulette), depth=trace.depth())
        vertex = VertexInput(state, hit)
        input_cotangents = adjoint.bounce_vjp(
            integrator.bounce, context, model, vertex, next_hit, transmittance, cotangents, gathers.leaves, of_splat
        )
    return _stores(trace, gathers, state, input_cotangents, added={})


def emit_vjp(trace: Trace, follow_ray: bool) -> Sinks:
    """Pull cotangents back through the emission of emitters, see :func:`torchpt.paths.adjoint.emission_vjp`."""
    kernels, tracer = _begin_vjp(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        context = kernels.taped.at(salts, follow_ray=follow_ray, depth=trace.depth())
        stage, vertex = trace.layout.wave.integrator.emit, VertexInput(state, hit)
        input_cotangents = adjoint.emission_vjp(stage, context, vertex, rows["radiance"], gathers.leaves)
    return _stores(trace, gathers, state, input_cotangents, added=rows)


def escape_vjp(trace: Trace) -> Sinks:
    """Pull cotangents back through the emission of the environment, see :func:`torchpt.paths.adjoint.emission_vjp`."""
    kernels, tracer = _begin_vjp(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        stage, vertex = trace.layout.wave.integrator.escape, VertexInput(state, hit)
        input_cotangents = adjoint.emission_vjp(
            stage, kernels.taped.at(salts, depth=trace.depth()), vertex, rows["radiance"], gathers.leaves
        )
    return _stores(trace, gathers, state, input_cotangents, added=rows)


def rays_vjp(trace: Trace) -> Sinks:
    """Pull the cotangents of a chunk's camera rays back to the camera, see :func:`torchpt.paths.adjoint.rays_vjp`."""
    kernels, tracer = _begin_vjp(trace)
    salts = trace.salts()
    x, y, key = stages.samples_of_lanes(trace)
    with tracer:
        lane = torch.arange(tracer.lanes, dtype=torch.int32)  # the slot of its sample
    rows = Rows(slots_of(trace.layout)).read(tracer, "o", "d", place=trace.node(lane))
    taped, gathers = kernels.tape.taped, _RecordedGathers(tracer, kernels)

    def rays() -> PathState:
        return taped.generate(x, y, key, salts)

    sinks = Sinks()
    with tracer, recording_gathers(gathers):
        gradients = adjoint.rays_vjp(rays, rows["o"], rows["d"], gathers.leaves)
    _store_sums(trace, sinks, gathers, gradients)
    return sinks


def store_hits(trace: Trace) -> Sinks:
    """Write hits of rays and transmittance of shadow rays from an arena to the slots, for the VJP of the vertex before."""
    layout, tracer = trace.layout, trace.tracer
    lane = layout.state.read(tracer, "lane")["lane"]
    hit = layout.state.read(tracer, *HIT)
    light = layout.state.read(tracer, "transmittance", "blocked")
    splat = layout.state.read(tracer, *_SPLAT)
    slots = Rows(slots_of(layout))
    with tracer:
        transmittance = (
            light["transmittance"] if "transmittance" in light else torch.zeros(tracer.lanes, dtype=torch.float32)
        )
        if "blocked" in light and "transmittance" not in light:
            transmittance = (light["blocked"] == 0).to(torch.float32)
    rows = tuple(slots.nodes(tracer, transmittance=transmittance, **hit, **splat))
    return Sinks(scatter=[Scatter(_ALL_LANES, trace.node(lane), rows, slots=True)])


def slots_read(kernels: VjpKernels) -> tuple[str, ...]:
    """Return the fields of the slots that the VJP of a vertex reads."""
    extra = tuple(name for name in slots_of(kernels) if name.startswith(EXTRA) or name in _SPLAT)
    return (*SLOTS, *extra) if kernels.taped.plan.attached else ("radiance", "throughput", "transmittance", *extra)


def _begin_vjp(trace: Trace) -> tuple[Any, Tracer]:
    """Trace derivatives from now on; return the kernels of the backward pass (:class:`VjpKernels`) and the tracer."""
    trace.tracer.graph.derivatives = True
    return trace.layout, trace.tracer


def _inputs(trace: Trace) -> tuple[PathState, Hit, dict[str, Tensor]]:
    """Return path state, hits, and the fields of the slots of the lanes' samples by name."""
    state, _ = trace.state()
    hit = trace.hit()
    tracer, lane, slots = trace.tracer, trace.node(state.lane), Rows(slots_of(trace.layout))
    kernels: Any = trace.layout
    return state, hit, slots.read(tracer, *slots_read(kernels), place=lane)


def _stores(
    trace: Trace,
    gathers: _RecordedGathers,
    state: PathState,
    input_cotangents: InputCotangents,
    added: dict[str, Tensor],
) -> Sinks:
    """Return the stores of a VJP.

    Args:
        trace: the trace; its ``sums`` are set.
        gathers: look-ups in differentiated tables.
        state: path state.
        input_cotangents: cotangents of the stage's inputs, the results.
        added: cotangents of the incoming ray by name, to which those found here are added; empty: they replace what the slots
            have.
    """
    kernels: Any = trace.layout
    tracer = trace.tracer
    fields: dict[str, Tensor] = {}
    with tracer:
        for name, cotangent, like in input_cotangents.of_rays(state, attached=kernels.taped.plan.attached):
            if cotangent is None and added:
                continue
            cotangent = torch.zeros_like(like) if cotangent is None else cotangent
            fields[name] = cotangent + added[name] if added else cotangent
    sinks = Sinks()
    if fields:
        rows = tuple(Rows(slots_of(trace.layout)).nodes(tracer, **fields))
        sinks.scatter.append(Scatter(_ALL_LANES, trace.node(state.lane), rows, slots=True))
    _store_sums(trace, sinks, gathers, input_cotangents.extra_leaves)
    return sinks


def _store_sums(trace: Trace, sinks: Sinks, gathers: _RecordedGathers, gradients: Sequence[Tensor | None]) -> None:
    """Store the gradients of look-ups, then of whole tables, in rows, and append to ``trace.sums`` what they are.

    Args:
        trace: the trace.
        sinks: gets the stores.
        gathers: look-ups in differentiated tables.
        gradients: of :meth:`_RecordedGathers.leaves`.
    """
    kernels: Any = trace.layout
    tracer, graph = trace.tracer, trace.tracer.graph
    # Gradients of look-ups: by number of the table and node of the index the nodes of an entry's gradient. Look-ups at the same
    # index are added up in the lane.
    entries: dict[tuple[int, int], list[int]] = {}
    for (number, index, _), gradient in zip(gathers.taken, gradients, strict=False):
        if gradient is None:
            continue
        index_nodes = tracer.get(index).nodes.reshape(-1)
        values: Any = tracer.get(gradient).nodes.reshape(-1, len(index_nodes))
        for k, index_node in enumerate(index_nodes):
            key = number, graph.cast(index_node, "i")
            nodes, earlier = [int(x) for x in values[:, k]], entries.get(key)
            if earlier is not None:
                nodes = [graph.binary("add", "f", a, b) for a, b in zip(earlier, nodes, strict=True)]
            entries[key] = nodes
    row_of_index: dict[int, int] = {}  # by node of the index

    def append_rows(nodes: list[int]) -> int:
        """Append stores of nodes to consecutive new rows; return the first row."""
        first = len(sinks.write)
        sinks.write += [(first + k, node) for k, node in enumerate(nodes)]
        return first

    zero = graph.constant("f", 0)
    for (number, index_node), nodes in entries.items():
        if all(node == zero for node in nodes):
            continue
        if index_node not in row_of_index:
            row_of_index[index_node] = append_rows([index_node])
        trace.sums.append((number, row_of_index[index_node], append_rows(nodes), len(nodes)))
    # Gradients of whole tables are sums over lanes; a lane outputs its summand.
    for number, gradient in enumerate(gradients[len(gathers.taken) :]):
        if gradient is None:
            continue
        nodes = np.broadcast_to(tracer.get(gradient).nodes, tuple(kernels.primals[number].shape)).reshape(-1)
        lane_nodes = [summand_of(graph, int(node)) for node in nodes]
        if any(node is not None for node in lane_nodes):
            if len(lane_nodes) > _MOST_ELEMENTS:
                raise Unsupported("a derivative by all of a table in every lane")
            first = append_rows([zero if node is None else node for node in lane_nodes])
            trace.sums.append((number, -1, first, len(lane_nodes)))


# ---- The kernels of a backward pass: those that trace paths again, and those of VJPs


_STAGES = {"bounce": bounce_vjp, "emit": emit_vjp, "escape": escape_vjp, "rays": rays_vjp}


class VjpKernels(Kernels):
    """The kernels of one backward pass.

    Args:
        tape: the wave and its differentiated tensors.
        by_kernels: see :class:`~torchpt.engines.kernels.layout.Layout`.
        cotangent: ``(3, H W)`` float32 of the picture, divided by the samples a pixel, for the VJP of splats.
        caches: those of the scene; None: nothing is kept for other passes.

    Attributes:
        taped: stage context whose tables are autograd leaves.
        primals: the tables without derivatives.
        numbers_of: number of a table by the id of its leaf.
        eager_vjps: stages that cannot be compiled, with the reasons.
        slots: rows of :func:`torchpt.engines.kernels.backward.slots_of`.
    """

    def __init__(
        self, tape: Tape, by_kernels: bool, cotangent: Tensor | None = None, caches: KernelCaches | None = None
    ) -> None:
        super().__init__(with_detached_geometry(tape.wave), by_kernels, fused=False, cotangent=cotangent)
        self.tape, self.cotangent = tape, cotangent
        self.taped = tape.taped.context
        self.primals = tape.primals
        self.numbers_of = {id(leaf): number for number, leaf in enumerate(tape.leaves)}
        # A trace that reads a leaf reads the primal's memory. The path of a primal is None if no record has it.
        paths = [self._leaves.ids[id(x)][0] if id(x) in self._leaves.ids else None for x in tape.primals]
        for path, leaf in zip(paths, tape.leaves, strict=True):
            if path is not None:
                self._leaves.ids[id(leaf)] = path, leaf
        self.structure = (*self.structure, self.taped.plan.attached, tuple(paths))
        self._use(caches or KernelCaches())
        self._of_this_pass = {"cotangent", *(path for path in paths if path is not None)}
        self.slots = Rows(slots_of(self))
        self.eager_vjps: dict[tuple[Any, ...], str] = {}

    def vjp_kernel(self, key: tuple[Any, ...]) -> Kernel | None:
        """Return the kernel of a stage's VJP; None if it cannot be compiled, see :attr:`eager_vjps`.

        ``key``: ``("bounce", model, roulette, follow_ray)``, ``("emit", follow_ray)``, ``("escape",)`` or ``("rays",)``.
        """
        if key in self.eager_vjps:
            return None
        try:
            return self._get(
                key[0] != "rays", _STAGES[key[0]], *self._vjp_arguments(key)
            )  # all lanes of a chunk have a ray
        except Unsupported as error:
            self.eager_vjps[key] = str(error)
            return None

    def _vjp_arguments(self, key: tuple[Any, ...]) -> tuple[Any, ...]:
        stage, *arguments = key
        if stage == "bounce":
            arguments[1] = self.bound(arguments[1])
        return tuple(arguments)

    def large_kernels(self) -> Iterator[tuple[bool, Callable[..., Sinks], tuple[Any, ...]]]:
        """See :class:`torchpt.engines.kernels.programs.Kernels`."""
        yield from super().large_kernels()
        attached = self.taped.plan.attached  # then all hits follow their rays
        keys: list[tuple[Any, ...]] = [("bounce", *key, attached) for key in self.bounces()]
        if self.has_emitters:
            keys.append(("emit", attached))
        if self.has_environment:
            keys.append(("escape",))
        for key in keys:
            yield True, _STAGES[key[0]], key[1:]

    def release(self, engines: Sequence[KernelsBackward]) -> None:
        """Keep the engines of threads for the next pass of the same structure, and drop what no other pass can use again.

        Tables of differentiated tensors are dropped: every pass makes them anew.
        """
        for engine in engines:
            keep_worker(self.structure, engine)
        self.kernel_cache.forget(self._of_this_pass)
        self.kernel_cache.tables.forget(self._of_this_pass)

    def store_hits(self) -> Kernel:
        """Return the kernel :func:`torchpt.engines.kernels.backward.store_hits`."""
        return self._get(False, store_hits)

    def engine(self) -> KernelsBackward:
        """Return an engine for one more thread: an idle one of an earlier pass of the same structure, or a new one."""
        engine = reuse_worker(self.structure)
        if engine is None:
            return KernelsBackward(self)
        assert isinstance(engine, KernelsBackward)
        engine.rebind(self, threading.Event())
        return engine

    def bytes_per_lane(self, levels: int) -> int:
        """Return the bytes that a lane takes if ``levels`` vertices are kept."""
        # of 32-bit words: an arena and lists for each kept vertex, and for the two that alternate behind them
        return 4 * (levels + 2) * (self.state.count + self.models + 2)


# ---- The backward engine of one thread


@dataclass(frozen=True)
class Mark:
    """Checkpoint of a replay: depth of a vertex, and a copy of its arena before its lanes were listed."""

    depth: int
    words: np.ndarray


class KernelsBackward(KernelsEngine):
    """Backward engine of kernels in one thread; see :class:`torchpt.engines.engine.Backward`.

    Gradients are added in the order of samples, as :mod:`torchpt.math.sums` requires, not in that of lanes.

    Args:
        kernels: of the backward pass.
        calls: see :class:`KernelsEngine`.
    """

    keeps_splats = False  # their VJP needs the vertices, not the splats

    def __init__(self, kernels: VjpKernels, calls: Any = None, store: Memory | None = None) -> None:
        super().__init__(kernels, calls=calls, store=store)
        self.back = kernels
        self._levels: list[Paths] = []  # memory of the vertices of a walk that are kept
        self._sample_slots = self.calls.memory(kernels.slots.count)
        self._results = self.calls.memory(1)  # rows that a VJP's kernel writes
        self._sorted_slots = Memory(2)  # slots of a list's lanes, sorted, and scratch memory
        self._slot_is_taken = np.zeros(CAPACITY, np.uint8)  # scratch memory for sorting
        self._first = 1  # depth of the first vertex of the walk

    def memories(self) -> list[Memory]:
        """See :class:`KernelsEngine`."""
        kept = [memory for room in self._levels for memory in (room.arena, *room.lists)]
        return [*super().memories(), *kept, self._sample_slots, self._results, self._sorted_slots]

    def unbind(self) -> int:
        """See :class:`KernelsEngine`."""
        del self.back, self.sums
        self._weight = None
        return super().unbind()

    def rebind(self, kernels: Any, halt: threading.Event) -> None:
        """See :class:`KernelsEngine`."""
        super().rebind(kernels, halt)
        self.back = kernels

    def begin(self, span: Span, sums: ChunkGradientSums) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        self.sums, self._chunk, self._first = sums, Chunk(*span), 1
        paths = self.spawn(self._chunk)
        self._weight = None
        if "weight" in self.kernels.state:
            row = self.kernels.state.first("weight")
            self._weight = torch.from_numpy(paths.arena.floats[row, : paths.count].copy())
        return paths

    def room(self, depth: int) -> Paths:
        """See :class:`KernelsEngine`. The first `KEPT` vertices of a walk are all kept; behind them two buffers alternate."""
        number = depth - self._first
        if number >= KEPT:
            return self._rooms[number % 2]
        if number == len(self._levels):
            self._levels.append(self._room())
        return self._levels[number]

    def mark(self, paths: Paths) -> Mark:
        """See :class:`torchpt.engines.engine.Backward`."""
        return Mark(paths.depth, paths.arena.words[:, : paths.count].copy())

    def resume(self, mark: Mark) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        self._first, count = mark.depth, mark.words.shape[1]
        self._lost.clear()
        paths = self._begin(self.room(mark.depth), mark.depth, count)
        paths.arena.words[:, :count] = mark.words
        paths.arrived = True
        return paths

    def radiance_of_samples(self) -> Tensor:
        """See :class:`torchpt.engines.engine.Backward`."""
        self.mark_lost()
        return torch.from_numpy(self.slots.floats[:, : self._chunk.pixels * self._chunk.samples])

    def receive(self, cotangent: Tensor) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        n, first = cotangent.shape[1], self.back.slots.first("radiance")
        self._sample_slots.words[:, :n] = 0
        weighted = cotangent if self._weight is None else cotangent * self._weight
        self._sample_slots.floats[first : first + 3, :n] = weighted.numpy()

    def vjp(self, paths: Paths) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        kernels, calls, depth = self.back, self.calls, paths.depth
        limits = self.wave.integrator.limits
        follow_ray = follows_ray(kernels.taped.plan, kernels.world, depth)
        calls.set_dimensions(depth, roulette=limits.roulette(depth))
        if depth < limits.last:
            for model, count in enumerate(paths.groups):
                if count:
                    key = ("bounce", model, limits.roulette(depth), follow_ray)
                    self._vjp_of_stage(key, paths, paths.lists[model], count, added=False)
        if kernels.has_emitters and paths.places[kernels.emissive]:
            number = kernels.emissive
            self._vjp_of_stage(("emit", follow_ray), paths, paths.lists[number], paths.places[number], added=True)
        if kernels.has_environment and paths.places[kernels.missed]:
            number = kernels.missed
            self._vjp_of_stage(("escape",), paths, paths.lists[number], paths.places[number], added=True)
        if depth > 1:
            calls.run(kernels.store_hits(), paths.count, paths.arena, paths.arena, slots=self._sample_slots)

    def _vjp_of_stage(self, key: tuple, paths: Paths, places: Memory, count: int, *, added: bool) -> None:
        """Pull cotangents back through one stage on the lanes of a list, by its kernel or by tensor operations.

        Args:
            key: see :meth:`VjpKernels.vjp_kernel`.
            paths: the vertex.
            places: the list of lanes; sorted by sample if gradients are added.
            count: number of lanes.
            added: True: cotangents of the rays that came are added to those in the slots; False: they replace them.
        """
        kernel = self.back.vjp_kernel(key)
        slots = self._sort_by_sample(paths, places, count) if kernel is None or kernel.program.sums else None
        if kernel is None:
            self._vjp_eagerly(key, paths, places, count, added=added)
            return
        self._results = self._results_of(kernel)
        self.calls.run(kernel, count, paths.arena, self._results, places, slots=self._sample_slots)
        if slots is not None:
            self._add_sums(kernel, count, slots)

    def _sort_by_sample(self, paths: Paths, places: Memory, count: int) -> np.ndarray:
        """Sort the lanes of a list by sample, in place; return their slots in ascending order."""
        from torchpt.math.sum_kernels import sort_by_sample

        slot_of_lane = paths.arena.words[self.back.state.first("lane")]
        slots, lane_of_slot = self._sorted_slots.words
        sort_by_sample(places.words[0], count, slot_of_lane, slots, lane_of_slot, self._slot_is_taken)
        return slots[:count]

    def _results_of(self, kernel: Kernel) -> Memory:
        """Return memory with at least the rows that a kernel writes."""
        rows = max((max(index + 1, first + width) for _, index, first, width in kernel.program.sums), default=1)
        return self._results if len(self._results.words) >= rows else self.calls.memory(rows)

    def _vjp_eagerly(self, key: tuple, paths: Paths, places: Memory, count: int, *, added: bool) -> None:
        """Pull cotangents back through a stage by tensor operations, if it cannot be compiled; arguments as above."""
        kernels, integrator, salt = self.back, self.wave.integrator, salts(paths.depth, torch.device("cpu"))
        plan = kernels.taped.plan
        lanes = places.words[0, :count]
        state = path_state(kernels.state.take(paths.arena, lanes, kernels.state.state))
        vertex = VertexInput(state, Hit(**kernels.state.take(paths.arena, lanes, tuple(HIT))))
        lane = state.lane.numpy()
        rows = kernels.slots.take(self._sample_slots, lane, slots_read(kernels))

        def transmittance(_: Shadow) -> Tensor:
            return rows["transmittance"]

        def of_splat(splat: Splat) -> tuple[Tensor, Tensor]:
            assert kernels.cotangent is not None
            return adjoint.splat_contributions(integrator.clamp, kernels.cotangent, splat, rows["splat_transmittance"])

        input_cotangents: InputCotangents
        with recording_gathers(self.sums):
            if key[0] == "bounce":
                extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
                cotangents = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
                next_hit = Hit(*(rows[name] for name in HIT)) if plan.attached else None
                _, model, roulette, follow_ray = key
                context = kernels.taped.at(salt, follow_ray=follow_ray, roulette=roulette, depth=paths.depth)
                input_cotangents = adjoint.bounce_vjp(
                    integrator.bounce,
                    context,
                    model,
                    vertex,
                    next_hit,
                    transmittance,
                    cotangents,
                    self._tables,
                    of_splat,
                )
            else:
                stage_name, *follow_ray = key  # the environment does not depend on `follow_ray`
                stage = integrator.emit if stage_name == "emit" else integrator.escape
                input_cotangents = adjoint.emission_vjp(
                    stage,
                    kernels.taped.at(salt, *follow_ray, depth=paths.depth),
                    vertex,
                    rows["radiance"],
                    self._tables,
                )
        for name, cotangent, like in input_cotangents.of_rays(state, attached=plan.attached):
            first = kernels.slots.first(name)
            values = np.zeros(like.shape, np.float32) if cotangent is None else cotangent.numpy()
            values = values.reshape(-1, count)
            slots = self._sample_slots.floats[first : first + len(values)]
            slots[:, lane] = values + slots[:, lane] if added else values
        self.sums.add_each(input_cotangents.extra_leaves)

    def _tables(self) -> Sequence[Tensor]:
        return self.back.tape.tables

    def vjp_rays(self) -> None:
        """See :class:`torchpt.engines.engine.Backward`. Runs tensor operations for rays of a user's, which are tables."""
        if not self.back.taped.plan.attached:
            return
        kernel = self.back.vjp_kernel(("rays",)) if self.wave.start_rays is None else None
        if kernel is not None:
            self._vjp_of_camera(kernel)
            return
        chunk, first, n = self._chunk, self.back.slots.first, self._chunk.pixels * self._chunk.samples
        with torch.enable_grad(), recording_gathers(self.sums):
            state = self.back.tape.taped.rays(chunk.first_pixel, chunk.pixels, chunk.first_sample, chunk.samples)
            pairs = [(x, first(name)) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if not pairs:
                return
            cotangents = [self._ray_cotangents(row, n) for _, row in pairs]
            gradients = gradients_of([x for x, _ in pairs], self._tables(), cotangents)
        self.sums.add_each(gradients)

    def _vjp_of_camera(self, kernel: Kernel) -> None:
        """Add the gradients of the camera from the chunk's rays."""
        if not kernel.program.sums:
            return
        n = self._chunk.pixels * self._chunk.samples
        self._results = self._results_of(kernel)
        self.calls.set_dimensions(depth=0)
        self.calls.run(kernel, self.calls.lanes(n), self._results, self._results, slots=self._sample_slots)
        self._add_all_lanes(kernel, n)

    def _add_all_lanes(self, kernel: Kernel, count: int) -> None:
        """Add the rows that a VJP's kernel wrote for the chunk's samples, one lane each in their order, to the sums."""
        self._add_sums(kernel, count, np.arange(count, dtype=np.int32))

    def _add_sums(self, kernel: Kernel, count: int, slots: np.ndarray) -> None:
        """Add the rows that a VJP's kernel wrote for lanes of rising ``slots`` to the sums."""
        floats, words = self._results.floats, self._results.words
        for number, index_row, first, width in kernel.program.sums:
            values = floats[first : first + width, :count]
            if index_row < 0:
                self.sums.add_all(number, values, slots)
            else:
                self.sums.add_rows(number, words[index_row, :count], values, slots)

    def _ray_cotangents(self, row: int, n: int) -> Tensor:
        """Return a copy of three rows of the slots ``(3, n)``."""
        return torch.from_numpy(self._sample_slots.floats[row : row + 3, :n].copy())
