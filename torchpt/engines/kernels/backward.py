"""Path replay by kernels: chunks are traced again on threads, and cotangents pulled back vertex by vertex.

A kernel of a VJP traces a stage with its autograd tape, so operators of the backward pass become nodes as those of the stage
do. A look-up in a differentiated table becomes an input of the lane; its gradient is written to rows beside a row of the index,
and the engine adds them up after the kernel. Cotangents between vertices are stored in *slots* by sample: a VJP reads the
cotangents of the rays that left the vertex, and writes those of the rays that came.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from torchpt.core.memory import Span
from torchpt.engines.kernels.engine import Chunk, KernelsEngine, Paths
from torchpt.engines.kernels.layout import HIT, Fields, Layout, Memory, Rows, Trace, path_state
from torchpt.engines.kernels.programs import Kernel, Kernels
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
#: Field of slots with splats: transmittance of the latest splat.
_SPLAT: Fields = {"splat_transmittance": ((), "f")}


def slots_of(layout: Layout) -> Fields:
    """Return the fields of slots, with the cotangents of the integrator's own fields."""
    carried = layout.wave.integrator.fields
    extra = {EXTRA + own.name: ((own.rows,) if own.rows > 1 else (), "f") for own in carried if not own.whole}
    return {**SLOTS, **extra, **(_SPLAT if layout.wave.integrator.splats else {})}


class _RecordedGathers:
    """Records the gathers of a trace from differentiated tables, and makes them inputs of the lane."""

    def __init__(self, tracer: Tracer, kernels: VjpKernels) -> None:
        self.tracer, self.kernels = tracer, kernels
        self.taken: list[tuple[int, Tensor, Tensor]] = []
        self._known: dict[tuple[int, int], Tensor] = {}

    def take(self, table: Tensor, index: Tensor) -> Tensor | None:
        """See :class:`torchpt.math.gathers.GatherRecorder`."""
        number = self.kernels.numbers_of.get(id(table))
        if number is None or not self.tracer.is_traced(index):
            return None
        key = number, id(index)
        if key not in self._known:
            primals = self.kernels.primals[number]
            with torch.no_grad():
                found = torch.index_select(primals, primals.dim() - 1, index)
            self._known[key] = found.detach().requires_grad_()
            self.taken.append((number, index, self._known[key]))
        return self._known[key]

    def leaves(self) -> list[Tensor]:
        """Return the gathered values as inputs of the lane, then the tables themselves."""
        return [*(leaf for _, _, leaf in self.taken), *self.kernels.tape.leaves]


def bounce_vjp(trace: Trace, model: int, roulette: float, follow_ray: bool) -> Sinks:
    """See :func:`torchpt.paths.adjoint.bounce_vjp`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
    cotangents = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
    next_hit = Hit(*(rows[name] for name in HIT)) if kernels.taped.plan.attached else None

    def transmittance(_: Shadow) -> Tensor:
        return rows["transmittance"]

    integrator, cotangent = trace.layout.wave.integrator, kernels.cotangent

    def landed(splat: Splat) -> tuple[Tensor, Tensor]:
        return adjoint.splat_contributions(integrator.clamp, cotangent, splat, rows["splat_transmittance"])

    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        context = kernels.taped.at(salts, follow_ray, roulette)
        vertex = VertexInput(state, hit)
        input_cotangents = adjoint.bounce_vjp(
            integrator.bounce, context, model, vertex, next_hit, transmittance, cotangents, gathers.leaves, landed
        )
    return _stores(trace, gathers, state, input_cotangents, {})


def emit_vjp(trace: Trace, follow_ray: bool) -> Sinks:
    """See :func:`torchpt.paths.adjoint.emission_vjp`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        context = kernels.taped.at(salts, follow_ray)
        stage, vertex = trace.layout.wave.integrator.emit, VertexInput(state, hit)
        input_cotangents = adjoint.emission_vjp(stage, context, vertex, rows["radiance"], gathers.leaves)
    return _stores(trace, gathers, state, input_cotangents, rows)


def escape_vjp(trace: Trace) -> Sinks:
    """See :func:`torchpt.paths.adjoint.emission_vjp`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _inputs(trace)
    gathers = _RecordedGathers(tracer, kernels)
    with tracer, recording_gathers(gathers):
        stage, vertex = trace.layout.wave.integrator.escape, VertexInput(state, hit)
        input_cotangents = adjoint.emission_vjp(
            stage, kernels.taped.at(salts), vertex, rows["radiance"], gathers.leaves
        )
    return _stores(trace, gathers, state, input_cotangents, rows)


def store_hits(trace: Trace) -> Sinks:
    """Write hits of rays and transmittance of shadow rays from an arena to the slots, for the VJP of the vertex before."""
    layout, tracer = trace.layout, trace.tracer
    lane = layout.state.read(tracer, "lane")["lane"]
    hit = layout.state.read(tracer, *HIT)
    light = layout.state.read(tracer, "transmittance", "blocked")
    splat = layout.state.read(tracer, *_SPLAT)
    slots = Rows(slots_of(layout))
    with tracer:
        transmittance = light["transmittance"] if "transmittance" in light else torch.zeros(tracer.lanes)
        if "blocked" in light and "transmittance" not in light:
            transmittance = (light["blocked"] == 0).to(torch.float32)
    rows = tuple(slots.nodes(tracer, transmittance=transmittance, **hit, **splat))
    return Sinks(scatter=[Scatter(-1, trace.node(lane), rows, slots=True)])


def slots_read(kernels: VjpKernels) -> tuple[str, ...]:
    """Return the fields of the slots that the VJP of a vertex reads."""
    extra = tuple(name for name in slots_of(kernels) if name.startswith(EXTRA) or name in _SPLAT)
    return (*SLOTS, *extra) if kernels.taped.plan.attached else ("radiance", "throughput", "transmittance", *extra)


def _begun(trace: Trace) -> tuple[Any, Tracer]:
    trace.tracer.graph.derivatives = True
    return trace.layout, trace.tracer


def _inputs(trace: Trace) -> tuple[PathState, Hit, dict[str, Tensor]]:
    """Return path state, hits, and the fields of the slots."""
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
    """Return stores of table gradients to rows, and of cotangents of the incoming ray to slots, plus ``added`` if given."""
    kernels: Any = trace.layout
    tracer, graph = trace.tracer, trace.tracer.graph
    fields: dict[str, Tensor] = {}
    with tracer:
        for name, found, like in input_cotangents.of_rays(state, attached=kernels.taped.plan.attached):
            if found is None and added:
                continue
            found = torch.zeros_like(like) if found is None else found
            fields[name] = found + added[name] if added else found
    sinks = Sinks()
    if fields:
        rows = tuple(Rows(slots_of(trace.layout)).nodes(tracer, **fields))
        sinks.scatter.append(Scatter(-1, trace.node(state.lane), rows, slots=True))
    columns: dict[tuple[int, int], list[int]] = {}
    for (number, index, _), gradient in zip(gathers.taken, input_cotangents.extra_leaves, strict=False):
        if gradient is None:
            continue
        places = tracer.get(index).nodes.reshape(-1)
        values: Any = tracer.get(gradient).nodes.reshape(-1, len(places))
        for k, place in enumerate(places):
            key = number, graph.cast(place, "i")
            mine, known = [int(x) for x in values[:, k]], columns.get(key)
            if known is not None:
                mine = [graph.binary("add", "f", a, b) for a, b in zip(known, mine, strict=True)]
            columns[key] = mine
    places_of: dict[int, int] = {}  # row of each node of an index

    def written(nodes: list[int]) -> int:
        """Append stores of nodes to consecutive new rows; return the first row."""
        first = len(sinks.write)
        sinks.write += [(first + k, node) for k, node in enumerate(nodes)]
        return first

    zero = graph.constant("f", 0)
    for (number, place), nodes in columns.items():
        if all(node == zero for node in nodes):
            continue
        if place not in places_of:
            places_of[place] = written([place])
        trace.sums.append((number, places_of[place], written(nodes), len(nodes)))
    for number, gradient in enumerate(input_cotangents.extra_leaves[len(gathers.taken) :]):
        if gradient is None:
            continue
        nodes = np.broadcast_to(tracer.get(gradient).nodes, tuple(kernels.primals[number].shape)).reshape(-1)
        lanes = [summand_of(graph, int(node)) for node in nodes]
        if any(node is not None for node in lanes):
            if len(lanes) > 64:
                raise Unsupported("a derivative by all of a table in every lane")
            trace.sums.append((number, -1, written([zero if node is None else node for node in lanes]), len(lanes)))
    return sinks


# ---- The kernels of a backward pass: those that trace paths again, and those of VJPs


_STAGES = {"bounce": bounce_vjp, "emit": emit_vjp, "escape": escape_vjp}


class VjpKernels(Kernels):
    """The kernels of one backward pass.

    Args:
        tape: the wave and its differentiated tensors.
        packets: see :class:`~torchpt.engines.kernels.layout.Layout`.
        cotangent: ``(3, H W)`` float32 of the picture, divided by the samples a pixel, for the VJP of splats.

    Attributes:
        taped: stage context with autograd leaves.
        numbers_of: index of a leaf by its id.
        eager_vjps: stages that cannot be compiled, with the reasons.
        slots: rows of :func:`torchpt.engines.kernels.backward.slots_of`.
    """

    def __init__(self, tape: Tape, packets: bool, cotangent: Tensor | None = None) -> None:
        super().__init__(with_detached_geometry(tape.wave), packets, False, cotangent=cotangent)
        self.tape, self.cotangent = tape, cotangent
        self.taped = tape.taped.context
        self.primals = tape.primals
        self.numbers_of = {id(leaf): number for number, leaf in enumerate(tape.leaves)}
        paths = [self._leaves.ids[id(one)][0] if id(one) in self._leaves.ids else None for one in tape.primals]
        for path, leaf in zip(paths, tape.leaves, strict=True):
            if path is not None:
                self._leaves.ids[id(leaf)] = path, leaf
        self.structure = (*self.structure, self.taped.plan.attached, tuple(paths))
        self.slots = Rows(slots_of(self))
        self.eager_vjps: dict[tuple[Any, ...], str] = {}

    def vjp_kernel(self, key: tuple[Any, ...]) -> Kernel | None:
        """Return the kernel of a stage's VJP; None if it cannot be compiled, see :attr:`eager_vjps`.

        ``key``: ``("bounce", model, roulette, follow_ray)``, ``("emit", follow_ray)`` or ``("escape",)``.
        """
        if key in self.eager_vjps:
            return None
        try:
            return self._get(True, _STAGES[key[0]], *key[1:])
        except Unsupported as error:
            self.eager_vjps[key] = str(error)
            return None

    def store_hits(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.backward.store_hits`."""
        return self._get(False, store_hits)

    def engine(self) -> KernelsBackward:
        """Return an engine for one more thread."""
        return KernelsBackward(self)

    def bytes_per_lane(self, levels: int) -> int:
        """Return the bytes that a lane takes if ``levels`` vertices are kept."""
        return 4 * (levels + 2) * (self.state.count + self.models + 2)


# ---- The backward engine of one thread


@dataclass(frozen=True)
class Mark:
    """Checkpoint of a replay: copy of an arena before its lanes were listed."""

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

    def __init__(self, kernels: VjpKernels, calls: Any = None) -> None:
        super().__init__(kernels, calls=calls)
        self.back = kernels
        self._levels: list[Paths] = []
        self._sample_slots = self.calls.memory(kernels.slots.count)
        self._results = self.calls.memory(1)
        self._sorted = (
            Memory(2),
            np.zeros(CAPACITY, np.uint8),
        )  # slots of a list's lanes, and scratch memory for sorting
        self._first = 1

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
        calls.set_dimensions(depth)
        if depth < limits.last:
            for model, count in enumerate(paths.groups):
                if count:
                    key = ("bounce", model, limits.roulette(depth), follow_ray)
                    self._one(key, paths, paths.lists[model], count, False)
        if kernels.has_emitters and paths.places[kernels.emissive]:
            place = kernels.emissive
            self._one(("emit", follow_ray), paths, paths.lists[place], paths.places[place], True)
        if kernels.has_environment and paths.places[kernels.missed]:
            place = kernels.missed
            self._one(("escape",), paths, paths.lists[place], paths.places[place], True)
        if depth > 1:
            calls.run(kernels.store_hits(), paths.count, paths.arena, paths.arena, slots=self._sample_slots)

    def _one(self, key: tuple, paths: Paths, places: Memory, count: int, added: bool) -> None:
        """Pull cotangents back through one stage on the lanes of a list, by its kernel or by tensor operations."""
        kernel = self.back.vjp_kernel(key)
        slots = self._by_sample(paths, places, count) if kernel is None or kernel.program.sums else None
        if kernel is None:
            self._eagerly(key, paths, places, count, added)
            return
        self._results = self._results_of(kernel)
        self.calls.run(kernel, count, paths.arena, self._results, places, slots=self._sample_slots)
        if slots is None:
            return
        floats, words = self._results.floats, self._results.words
        for number, index, first, width in kernel.program.sums:
            values = floats[first : first + width, :count]
            if index < 0:
                self.sums.add_all(number, values, slots)
            else:
                self.sums.add_rows(number, words[index, :count], values, slots)

    def _by_sample(self, paths: Paths, places: Memory, count: int) -> np.ndarray:
        """Sort the lanes of a list by sample; return their slots in rising order."""
        from torchpt.math.sum_kernels import sort_by_sample

        lanes, (memory, taken) = paths.arena.words[self.back.state.first("lane")], self._sorted
        slots, found = memory.words
        sort_by_sample(places.words[0], count, lanes, slots, found, taken)
        return slots[:count]

    def _results_of(self, kernel: Kernel) -> Memory:
        rows = max((max(index + 1, first + width) for _, index, first, width in kernel.program.sums), default=1)
        return self._results if len(self._results.words) >= rows else self.calls.memory(rows)

    def _eagerly(self, key: tuple, paths: Paths, places: Memory, count: int, added: bool) -> None:
        """Pull cotangents back through a stage by tensor operations, if it cannot be compiled."""
        kernels, integrator, salt = self.back, self.wave.integrator, salts(paths.depth, torch.device("cpu"))
        plan = kernels.taped.plan
        lanes = places.words[0, :count]
        state = path_state(kernels.state.take(paths.arena, lanes, kernels.state.state))
        vertex = VertexInput(state, Hit(**kernels.state.take(paths.arena, lanes, tuple(HIT))))
        lane = state.lane.numpy()
        rows = kernels.slots.take(self._sample_slots, lane, slots_read(kernels))

        def transmittance(_: Shadow) -> Tensor:
            return rows["transmittance"]

        def landed(splat: Splat) -> tuple[Tensor, Tensor]:
            assert kernels.cotangent is not None
            return adjoint.splat_contributions(integrator.clamp, kernels.cotangent, splat, rows["splat_transmittance"])

        input_cotangents: InputCotangents
        with recording_gathers(self.sums):
            if key[0] == "bounce":
                extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
                cotangents = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
                next_hit = Hit(*(rows[name] for name in HIT)) if plan.attached else None
                _, model, roulette, follow_ray = key
                context = kernels.taped.at(salt, follow_ray, roulette)
                input_cotangents = adjoint.bounce_vjp(
                    integrator.bounce, context, model, vertex, next_hit, transmittance, cotangents, self._tables, landed
                )
            else:
                stage = integrator.emit if key[0] == "emit" else integrator.escape
                input_cotangents = adjoint.emission_vjp(
                    stage, kernels.taped.at(salt, *key[1:]), vertex, rows["radiance"], self._tables
                )
        for name, found, like in input_cotangents.of_rays(state, attached=plan.attached):
            first = kernels.slots.first(name)
            values = np.zeros(like.shape, np.float32) if found is None else found.numpy()
            values = values.reshape(-1, count)
            held = self._sample_slots.floats[first : first + len(values)]
            held[:, lane] = values + held[:, lane] if added else values
        self.sums.add_each(input_cotangents.extra_leaves)

    def _tables(self) -> Sequence[Tensor]:
        return self.back.tape.tables

    def vjp_rays(self) -> None:
        """See :class:`torchpt.engines.engine.Backward`. Runs tensor operations."""
        if not self.back.taped.plan.attached:
            return
        chunk, first, n = self._chunk, self.back.slots.first, self._chunk.pixels * self._chunk.samples
        with torch.enable_grad(), recording_gathers(self.sums):
            state = self.back.tape.taped.rays(chunk.first_pixel, chunk.pixels, chunk.first_sample, chunk.samples)
            pairs = [(x, first(name)) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if not pairs:
                return
            cotangents = [self._ray_cotangents(row, n) for _, row in pairs]
            found = torch.autograd.grad([x for x, _ in pairs], self._tables(), cotangents, allow_unused=True)
        self.sums.add_each(found)

    def _ray_cotangents(self, row: int, n: int) -> Tensor:
        """Return a copy of three rows of the slots ``(3, n)``."""
        return torch.from_numpy(self._sample_slots.floats[row : row + 3, :n].copy())
