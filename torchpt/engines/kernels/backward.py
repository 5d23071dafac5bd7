"""Path replay by kernels: chunks traced again over threads, and gone back along vertex by vertex.

The operators of the backward pass are nodes as those of the stage are. A look-up in a table that is differentiated is taken
for an input of the lane, and its derivative is written to a row beside a row of the index: whoever runs the kernel adds them
up. What is handed from vertex to vertex lies in *slots*, by the samples' own numbers: each path reads there what those behind
it ask of the ray that left, and leaves what it asks of the ray that came.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.compiler.operators.derivatives import summands
from torchpt.compiler.sinks import Scatter, Sinks
from torchpt.compiler.tracing import Tracer
from torchpt.engines.kernels.layout import HIT, Fields, Layout, Rows, Trace
from torchpt.engines.kernels.programs import Kernel, Kernels
from torchpt.math.gathers import recording_gathers
from torchpt.paths import adjoint
from torchpt.paths.adjoint import InputCotangents, VertexCotangents
from torchpt.paths.state import EXTRA, PathState, Shadow, Splat, VertexInput
from torchpt.paths.wave import Wave, with_detached_geometry
from torchpt.physics.shapes.geometry import Hit

__all__ = ["SLOTS", "VjpKernels", "bounce_vjp", "emit_vjp", "escape_vjp", "report", "slots_of", "slots_read"]


# ---- Vertices of paths gone back along, as kernels: each traces a stage of :mod:`torchpt.paths.adjoint`, its tape included


#: What lies in slots: what is asked of a sample's radiance and of its ray, how much of the light of its latest shadow ray got
#: through, and what its next ray met.
SLOTS: Fields = {
    "radiance": ((3,), "f"),
    "throughput": ((3,), "f"),
    "o": ((3,), "f"),
    "d": ((3,), "f"),
    "clear": ((), "f"),
    **HIT,
}
#: With splats: how much of the light of the latest one got through.
_SPLAT: Fields = {"splat_clear": ((), "f")}


def slots_of(layout: Layout) -> Fields:
    """Return what lies in slots, with what is asked of the numbers that an integrator carries along."""
    carried = layout.wave.integrator.fields
    extra = {EXTRA + own.name: ((own.rows,) if own.rows > 1 else (), "f") for own in carried if not own.whole}
    return {**SLOTS, **extra, **(_SPLAT if layout.wave.integrator.splats else {})}


class _Noted:
    """Look-ups of a trace in tables that are differentiated."""

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
            plain = self.kernels.plain[number]
            with torch.no_grad():
                found = torch.index_select(plain, plain.dim() - 1, index)
            self._known[key] = found.detach().requires_grad_()
            self.taken.append((number, index, self._known[key]))
        return self._known[key]

    def leaves(self) -> list[Tensor]:
        """Inputs of the lane, then the tables themselves."""
        return [*(leaf for _, _, leaf in self.taken), *self.kernels.tapes]


def bounce_vjp(trace: Trace, model: int, roulette: float, follow_shape: bool) -> Sinks:
    """See :func:`torchpt.paths.adjoint.bounce`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _given(trace)
    extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
    cotangents = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
    next_hit = Hit(*(rows[name] for name in HIT)) if kernels.taped.plan.attached else None

    def clear(_: Shadow) -> Tensor:
        return rows["clear"]

    integrator, cotangent = trace.layout.wave.integrator, kernels.cotangent

    def landed(splat: Splat) -> tuple[Tensor, Tensor]:
        return adjoint.splatted(integrator.clamp, cotangent, splat, rows["splat_clear"])

    noted = _Noted(tracer, kernels)
    with tracer, recording_gathers(noted):
        context = kernels.taped.at(salts, follow_shape, roulette)
        vertex = VertexInput(state, hit)
        before = adjoint.bounce(
            integrator.bounce, context, model, vertex, next_hit, clear, cotangents, noted.leaves, landed
        )
    return _ended(trace, noted, state, before, {})


def emit_vjp(trace: Trace, follow_shape: bool) -> Sinks:
    """See :func:`torchpt.paths.adjoint.gather`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _given(trace)
    noted = _Noted(tracer, kernels)
    with tracer, recording_gathers(noted):
        context = kernels.taped.at(salts, follow_shape)
        stage, vertex = trace.layout.wave.integrator.emit, VertexInput(state, hit)
        before = adjoint.gather(stage, context, vertex, rows["radiance"], noted.leaves)
    return _ended(trace, noted, state, before, rows)


def escape_vjp(trace: Trace) -> Sinks:
    """See :func:`torchpt.paths.adjoint.gather`."""
    kernels, tracer = _begun(trace)
    salts = trace.salts()
    state, hit, rows = _given(trace)
    noted = _Noted(tracer, kernels)
    with tracer, recording_gathers(noted):
        stage, vertex = trace.layout.wave.integrator.escape, VertexInput(state, hit)
        before = adjoint.gather(stage, kernels.taped.at(salts), vertex, rows["radiance"], noted.leaves)
    return _ended(trace, noted, state, before, rows)


def report(trace: Trace) -> Sinks:
    """Write what the rays and shadow rays of an arena met, for the vertex before."""
    layout, tracer = trace.layout, trace.tracer
    lane = layout.state.read(tracer, "lane")["lane"]
    hit = layout.state.read(tracer, *HIT)
    light = layout.state.read(tracer, "clear", "blocked")
    splat = layout.state.read(tracer, *_SPLAT)
    slots = Rows(slots_of(layout))
    with tracer:
        clear = light["clear"] if "clear" in light else torch.zeros(tracer.lanes)
        if "blocked" in light and "clear" not in light:
            clear = (light["blocked"] == 0).to(torch.float32)
    rows = tuple(slots.nodes(tracer, clear=clear, **hit, **splat))
    return Sinks(scatter=[Scatter(-1, trace.node(lane), rows, slots=True)])


def slots_read(kernels: VjpKernels) -> tuple[str, ...]:
    """Return the names of what a vertex reads of the slots."""
    extra = tuple(name for name in slots_of(kernels) if name.startswith(EXTRA) or name in _SPLAT)
    return (*SLOTS, *extra) if kernels.taped.plan.attached else ("radiance", "throughput", "clear", *extra)


def _begun(trace: Trace) -> tuple[Any, Tracer]:
    trace.tracer.graph.derivatives = True
    return trace.layout, trace.tracer


def _given(trace: Trace) -> tuple[PathState, Hit, dict[str, Tensor]]:
    """State, hit, and what lies in the slots."""
    state, _ = trace.state()
    hit = trace.hit()
    tracer, lane, slots = trace.tracer, trace.node(state.lane), Rows(slots_of(trace.layout))
    kernels: Any = trace.layout
    return state, hit, slots.read(tracer, *slots_read(kernels), place=lane)


def _ended(trace: Trace, noted: _Noted, state: PathState, before: InputCotangents, added: dict[str, Tensor]) -> Sinks:
    """Rows of derivatives by tables, and what is asked of the ray that came; ``added`` to what lies there."""
    kernels: Any = trace.layout
    tracer, graph = trace.tracer, trace.tracer.graph
    fields: dict[str, Tensor] = {}
    with tracer:
        for name, found, like in before.of_rays(state, kernels.taped.plan.attached):
            if found is None and added:
                continue
            found = torch.zeros_like(like) if found is None else found
            fields[name] = found + added[name] if added else found
    sinks = Sinks()
    if fields:
        rows = tuple(Rows(slots_of(trace.layout)).nodes(tracer, **fields))
        sinks.scatter.append(Scatter(-1, trace.node(state.lane), rows, slots=True))
    columns: dict[tuple[int, int], list[int]] = {}
    for (number, index, _), gradient in zip(noted.taken, before.others, strict=False):
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
    places_of: dict[int, int] = {}  # rows of indices

    def written(nodes: list[int]) -> int:
        """Rows of their own, side by side; returns the first."""
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
    for number, gradient in enumerate(before.others[len(noted.taken) :]):
        if gradient is None:
            continue
        nodes = np.broadcast_to(tracer.get(gradient).nodes, tuple(kernels.plain[number].shape)).reshape(-1)
        lanes = [summands(graph, int(node)) for node in nodes]
        if any(node is not None for node in lanes):
            if len(lanes) > 64:
                raise Unsupported("a derivative by all of a table in every lane")
            trace.sums.append((number, -1, written([zero if node is None else node for node in lanes]), len(lanes)))
    return sinks


# ---- The kernels of a backward pass: those of the paths as they are traced again, and those that go back along them


_STAGES = {"bounce": bounce_vjp, "emit": emit_vjp, "escape": escape_vjp}


class VjpKernels(Kernels):
    """The kernels of one backward pass.

    Args:
        wave: with plain tensors.
        taped: the same with leaves in place of those that are differentiated.
        plain: tensors that are differentiated, as the wave has them.
        tapes: their leaves.
        packets: see :class:`~torchpt.engines.kernels.layout.Layout`.
        cotangent: ``(3, H W)`` float32 of the picture, over the samples of a pixel: what splats read.

    Attributes:
        taped: what stages read where they are gone back along.
        numbers_of: which of the leaves a tensor is, by its id.
        eager_vjps: stages that no kernel can be made of, and why.
        slots: rows of :func:`torchpt.engines.kernels.backward.slots_of`.
    """

    def __init__(
        self,
        wave: Wave,
        taped: Wave,
        plain: Sequence[Tensor],
        tapes: Sequence[Tensor],
        packets: bool,
        cotangent: Tensor | None = None,
    ) -> None:
        super().__init__(with_detached_geometry(wave), packets, False, cotangent=cotangent)
        self.cotangent = cotangent
        self.taped = taped.context
        self.plain, self.tapes = tuple(plain), tuple(tapes)
        self.numbers_of = {id(tape): number for number, tape in enumerate(tapes)}
        paths = [self._leaves.ids[id(one)][0] if id(one) in self._leaves.ids else None for one in plain]
        for path, tape in zip(paths, tapes, strict=True):
            if path is not None:
                self._leaves.ids[id(tape)] = path, tape
        self.structure = (*self.structure, self.taped.plan.attached, tuple(paths))
        self.slots = Rows(slots_of(self))
        self.eager_vjps: dict[tuple[Any, ...], str] = {}

    def vjp_kernel(self, key: tuple[Any, ...]) -> Kernel | None:
        """The kernel of ``("bounce", model, roulette, follow_shape)``, ``("emit", follow_shape)`` or ``("escape",)`` gone back through.

        None: none can be made; :attr:`eager_vjps` says why.
        """
        if key in self.eager_vjps:
            return None
        try:
            return self._get(True, _STAGES[key[0]], *key[1:])
        except Unsupported as error:
            self.eager_vjps[key] = str(error)
            return None

    def report(self) -> Kernel:
        """See :func:`torchpt.engines.kernels.backward.report`."""
        return self._get(False, report)
