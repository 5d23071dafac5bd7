"""Memory of kernels: the rows of the path state in an arena, and the trace that turns a stage into a kernel.

An *arena* holds the paths of a vertex: a *row* of 32-bit elements for each component of each field, a column for each lane.
*Slots* are rows of results by sample, such as its radiance, where a path writes when it ends. *Lists* hold the lanes that a
kernel works on, such as those on one BSDF model. *Counters* hold how many lanes an arena or a list has.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.form import CAPACITY
from torchpt.compiler.graph import DTYPES
from torchpt.compiler.sinks import AppendIndex, Scatter, Sinks
from torchpt.compiler.tracing import Tracer
from torchpt.core.autograd import outside_transforms
from torchpt.core.threads import outside_inference_mode
from torchpt.paths import photons
from torchpt.paths.state import EXTRA, PathState, VertexOutput
from torchpt.paths.wave import camera_state
from torchpt.physics.samplers import Dimension
from torchpt.physics.shapes.geometry import Hit
from torchpt.search.tree_rays import TreeSearch

if TYPE_CHECKING:
    from torchpt.paths.wave import Wave

__all__ = [
    "CONNECTION",
    "HIT",
    "PASS",
    "PHOTON",
    "SHADOW",
    "SPLAT",
    "Block",
    "Fields",
    "Layout",
    "Memory",
    "Rows",
    "Trace",
    "path_state",
    "photon_values",
    "state_values",
]


# ---- Rows of an arena: fields of the path state, of a hit, of a shadow ray


#: Fields by name: shape without the lanes, and node type (a letter, see :mod:`torchpt.compiler.graph`).
Fields = dict[str, tuple[tuple[int, ...], str]]

#: Fields of a hit, and of a shadow ray.
HIT: Fields = {"t": ((), "f"), "prim": ((), "l"), "u": ((), "f"), "v": ((), "f")}
SHADOW: Fields = {
    "shadow_o": ((3,), "f"),
    "shadow_d": ((3,), "f"),
    "shadow_t": ((), "f"),
    "shadow_radiance": ((3,), "f"),
}
#: Fields of a splat: its pixel, its shadow ray, and the transmittance of that.
SPLAT: Fields = {
    "splat_pixel": ((), "l"),
    "splat_o": ((3,), "f"),
    "splat_d": ((3,), "f"),
    "splat_t": ((), "f"),
    "splat_radiance": ((3,), "f"),
    "splat_transmittance": ((), "f"),
}
#: Fields of a camera path's end of a connection, of the connection's shadow ray, and of the transmittance of that.
CONNECTION: Fields = {
    "end_p": ((3,), "f"),
    "end_o": ((3,), "f"),
    "end_value": ((3,), "f"),
    "end_pdf": ((), "f"),
    "end_others": ((), "f"),
    "end_cosine": ((), "f"),
    "end_partner": ((), "l"),
    "connection_o": ((3,), "f"),
    "connection_d": ((3,), "f"),
    "connection_t": ((), "f"),
    "connection_radiance": ((3,), "f"),
}
#: Fields of photons, the rows of their data: those that a light path sends, with depth 0 where it sends none, or that a camera
#: path is merged with.
PHOTON: Fields = {f"photon_{name}": (() if rows == 1 else (rows,), "f") for name, rows in photons.FIELDS.items()}
#: Fields of a ray in transit: the ray, the distance before its origin, and its lane in the arena of paths.
PASS: Fields = {
    "pass_o": ((3,), "f"),
    "pass_d": ((3,), "f"),
    "pass_t": ((), "f"),
    "before": ((), "f"),
    "home": ((), "l"),
}

#: Fields of every path state, without those of the integrator.
_STATE = tuple(field.name for field in fields(PathState) if field.name != "extra")

_DTYPES = {ty: dtype for dtype, ty in DTYPES.items()}


def path_state(values: Mapping[str, Tensor]) -> PathState:
    """Return the path state from tensors by row name; other names are ignored.

    Rows of an integrator's own fields have the prefix ``EXTRA`` in their name.
    """
    extra = {name.removeprefix(EXTRA): value for name, value in values.items() if name.startswith(EXTRA)}
    common: dict[str, Any] = {name: value for name, value in values.items() if name in _STATE}
    return PathState(**common, extra=extra)


def state_values(state: PathState) -> dict[str, Tensor]:
    """Return the tensors of a path state by row name."""
    values = {name: getattr(state, name) for name in _STATE}
    extra = {EXTRA + name: value for name, value in state.extra.items()}
    return {name: value for name, value in values.items() if value is not None} | extra


def photon_values(output: VertexOutput) -> dict[str, Tensor]:
    """Return the tensors of the photons that a stage of light paths has sent, by row name; depth 0: none."""
    if output.photon is None:
        return {"photon_depth": torch.zeros_like(output.leaving.t_max)}
    return {"photon_p": output.at.p} | {
        f"photon_{name}": value for name, value in photons.values_of(output.photon).items()
    }


@dataclass(frozen=True)
class Block:
    """Rows of a larger memory, as a kernel sees them."""

    address: int


class Memory:
    """Rows of 32-bit words, padded at the end since kernels write whole vectors.

    Attributes:
        words: ``(rows, CAPACITY)`` int32.
        floats: the same memory as float32.
        address: its address.
    """

    def __init__(self, rows: int) -> None:
        self.words = np.zeros((rows, CAPACITY), np.int32)
        self.floats = self.words.view(np.float32)
        self.address = self.words.ctypes.data

    def below(self, row: int) -> Block:
        """Return the memory from a row on."""
        return Block(self.address + self.words.itemsize * self.words.shape[1] * row)

    def repeat(self, first: int, values: Tensor, times: int) -> None:
        """Write ``values (rows, n)`` to the rows from ``first`` on, ``times`` times side by side."""
        memory = self.floats if values.is_floating_point() else self.words
        # By numpy: torch would start a team of threads for each thread that renders.
        memory[first : first + len(values), : times * values.shape[1]] = np.tile(values.numpy(), times)

    def take(self, first: int, rows: int, lanes: np.ndarray, dtype: torch.dtype) -> Tensor:
        """Return ``(rows, n)``: the values at ``lanes (n,)`` of the rows from ``first`` on."""
        memory = self.floats if dtype.is_floating_point else self.words
        # A tensor of one element would be a plain index to numpy.
        return torch.from_numpy(memory[first : first + rows, np.asarray(lanes)]).to(dtype)

    def put(self, first: int, start: int, values: Tensor) -> None:
        """Write ``values (rows, n)`` to the rows from ``first`` on, at lanes from ``start`` on."""
        memory = self.floats if values.is_floating_point() else self.words
        memory[first : first + len(values), start : start + values.shape[1]] = values.numpy()

    def scatter(self, first: int, lanes: np.ndarray, values: Tensor) -> None:
        """Write ``values (rows, n)`` to the rows from ``first`` on, at ``lanes (n,)``."""
        memory = self.floats if values.is_floating_point() else self.words
        memory[first : first + len(values), np.asarray(lanes)] = values.numpy()


class Rows:
    """Row numbers of an arena by field.

    Args:
        fields: fields of the arena, in the order of their rows.

    Attributes:
        count: number of rows.
    """

    def __init__(self, fields: Fields) -> None:
        self._fields = fields
        self._first: dict[str, int] = {}
        self.count = 0
        for name, (shape, _) in fields.items():
            self._first[name] = self.count
            self.count += math.prod(shape)

    def __contains__(self, name: str) -> bool:
        return name in self._fields

    @property
    def state(self) -> tuple[str, ...]:
        """Return the names of the fields that belong to the path state."""
        return tuple(name for name in self._fields if name in _STATE or name.startswith(EXTRA))

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all fields."""
        return tuple(self._fields)

    def first(self, name: str) -> int:
        """Return the first row of a field."""
        return self._first[name]

    def read(self, tracer: Tracer, *names: str, place: int | None = None) -> dict[str, Tensor]:
        """Return fields as inputs of a trace; names without rows are left out.

        ``place``: node of the index in the slots to read from; None: read the arena at the lane's own index.
        """
        inputs: dict[str, Tensor] = {}
        for name in names:
            if name not in self._fields:
                continue
            shape, ty = self._fields[name]
            first, size = self._first[name], (*shape, tracer.lanes)
            dtype = _DTYPES[ty]
            # Any values do: a trace records operations, not results. torch's default generator is the caller's.
            numbers = torch.Generator().manual_seed(first)
            floats = dtype.is_floating_point
            like = (
                torch.rand(size, generator=numbers, dtype=torch.float32) + 0.25
                if floats
                else torch.zeros(size, dtype=dtype)
            )

            def node(k: int, first: int = first, ty: str = ty) -> int:
                if place is not None:
                    return tracer.graph.node("slot", ty, place, extra=first + k)
                return tracer.graph.node("arena", ty, extra=first + k)

            inputs[name] = tracer.lane(like, node)
        return inputs

    def take(self, memory: Memory, lanes: Any, names: tuple[str, ...], first: int = 0) -> dict[str, Tensor]:
        """Return fields of some lanes as tensors by name, from row ``first`` on; names without rows are left out."""
        values = {}
        for name in names:
            if name in self._fields:
                shape, ty = self._fields[name]
                value = memory.take(first + self._first[name], math.prod(shape), lanes, _DTYPES[ty])
                values[name] = value.view(*shape, len(lanes))
        return values

    def put(self, memory: Memory, start: int, values: dict[str, Tensor | None]) -> None:
        """Write fields of consecutive lanes from tensors; names without rows are ignored."""
        for name, value in values.items():
            if name in self._fields and value is not None:
                shape, _ = self._fields[name]
                memory.put(self._first[name], start, value.reshape(math.prod(shape), -1))

    def scatter(self, memory: Memory, lanes: Any, values: dict[str, Tensor], first: int = 0) -> None:
        """Write fields of some lanes from tensors, from row ``first`` on."""
        for name, value in values.items():
            shape, _ = self._fields[name]
            memory.scatter(first + self._first[name], lanes, value.reshape(math.prod(shape), -1))

    def nodes(self, tracer: Tracer, **fields: Tensor) -> list[tuple[int, int]]:
        """Return pairs of row and node for results by field; values that all lanes share are broadcast."""
        pairs = []
        for name, value in fields.items():
            shape, ty = self._fields[name]
            nodes = tracer.nodes(value)
            if len(nodes) != math.prod(shape):
                raise ValueError(f"{name}: {len(nodes)} numbers for {math.prod(shape)} rows")
            # nodes of int64 may be of type l or L; the store converts both
            pairs += [
                (self._first[name] + k, node if ty == "l" else tracer.graph.cast(node, ty))
                for k, node in enumerate(nodes)
            ]
        return pairs


# ---- The layout of a render: rows of the path state, and lists of lanes


class Layout:
    """The memory layout of a render's kernels.

    Args:
        wave: the render.
        by_kernels: True: rays are searched by kernels. False: the acceleration structure is called.
        fused: True: the search is part of the stages. False: it runs between them.

    Attributes:
        state: rows of an arena of paths.
        passed: rows of an arena of rays in transit.
        store: rows of a block of the store of vertices of light paths (:mod:`torchpt.paths.store`); None: there is none.
        models: number of BSDF models.
        has_environment: True: the scene has an environment light.
        has_emitters: True: a ray may hit an emitter.
        has_opacity: True: some surface is not opaque.
        has_transmission: True: rays may pass surfaces, or the integrator has its own ``transmit``.
        has_shadows: True: stages of surfaces return shadow rays, those of splats aside.
        listed: True: kernels read lanes by lists. False: all lanes of the arena are on the only model.
        numbers: tensors of the sampler.
        tree: the search of a tree by kernels; None: they intersect each ray with every primitive.
    """

    tree: TreeSearch | None = None

    def __init__(self, wave: Wave, by_kernels: bool, fused: bool) -> None:
        self.wave, self.by_kernels, self.fused = wave, by_kernels, fused
        self.plan, self.world = wave.context.plan, wave.context.world
        self.numbers = wave.sampler.tensors(wave.centre.device)
        table = self.world.lights
        self.models = len(self.world.materials.models)
        self.has_environment = table is not None and table.environment is not None
        self.has_emitters = table is not None and table.row_of_prim is not None
        self.has_opacity = self.world.materials.opacity is not None
        self.has_transmission = self.has_opacity or wave.integrator.has_own_transmit
        first = wave.first_surface
        self.has_shadows = self.world.lights is not None if first is None else first.shadows(self.world)
        self.listed = not fused or self.models > 1 or self.has_environment
        self.state = Rows(_path_fields(self))
        self.store = _store_rows(wave)
        self.passed = Rows({**PASS, "transmittance": ((), "f"), **_key_field(wave), **HIT})

    # Lists 0 .. models - 1 belong to the models. Counter 0 counts the lanes of an arena, counter k + 1 those of list k.

    @property
    def emissive(self) -> int:
        """Return the index of the list of lanes that hit an emitter."""
        return self.models if self.listed else 0

    @property
    def missed(self) -> int:
        """Return the index of the list of lanes that hit nothing, in a scene with an environment."""
        return self.emissive + int(self.has_emitters)


def _key_field(wave: Wave) -> Fields:
    """Return the field of the random sequence of a path, of as many integers as the sampler needs."""
    return {"key": ((wave.sampler.points.rows,), "i")}


@cache
def _state_of_one_lane(rows: int) -> PathState:
    """Return a state of one lane whose key has so many rows, of which only names, shapes and types are read."""
    with outside_transforms(), outside_inference_mode():
        vector, key = torch.zeros(3, 1, dtype=torch.float32), torch.zeros(rows, 1, dtype=torch.int32)
        return camera_state(vector, vector, key)


def _store_rows(wave: Wave) -> Rows | None:
    """Return the rows of a block of the store, in a wave of camera paths or of light paths; None: it has no store."""
    light_paths = wave.integrator if wave.integrator.connected else wave.integrator.light_walk()
    if light_paths is None or not light_paths.connected:
        return None
    return Rows({
        "count": ((), "l"), "depth": ((), "l"), "model": ((), "l"), "p": ((3,), "f"),
        "o": ((3,), "f"), "d": ((3,), "f"), "throughput": ((3,), "f"), **_key_field(wave), **HIT,
        **{EXTRA + field.name: ((), "l" if field.whole else "f") for field in light_paths.fields},
    })  # fmt: skip


def _path_fields(layout: Layout) -> Fields:
    """Return the fields of the arena: the path state of this scene, filter weight, hit, shadow ray, splat."""
    wave = layout.wave
    state = wave.with_optional_fields(_state_of_one_lane(wave.sampler.points.rows))
    fields: Fields = {name: (tuple(x.shape[:-1]), DTYPES[x.dtype]) for name, x in state_values(state).items()}
    if wave.filter.signed:
        fields["weight"] = ((), "f")
    fields |= HIT
    if wave.integrator.splats_at_surfaces:
        fields |= SPLAT
    if wave.integrator.connects:
        fields |= CONNECTION
    if wave.integrator.merges or wave.integrator.sends_photons:
        fields |= PHOTON
    if wave.integrator.sends_photons:
        fields["photon_p"] = ((3,), "f")
    if not layout.fused and (layout.has_shadows or wave.integrator.splats_at_surfaces):
        fields |= SHADOW
        if layout.has_opacity:
            fields["transmittance"] = ((), "f")
        if not (layout.has_opacity and layout.by_kernels):
            fields["blocked"] = ((), "i")
    return fields


# ---- Traces: inputs of a stage from the arena, and stores of its results
#
# The functions of :mod:`~torchpt.engines.kernels.stages` take a :class:`Trace` and return sinks.


class Trace:
    """Trace of one stage.

    Args:
        tracer: records the operations on lanes, inside ``with trace.tracer``.
        layout: of the render.

    Attributes:
        uniforms: names of the arguments that all lanes share, in order.
        tensors: number of inputs that are tensors instead of rows of an arena.
        sums: what a VJP outputs for the gradients of tables, see :func:`torchpt.engines.kernels.backward.bounce_vjp`.
    """

    def __init__(self, tracer: Tracer, layout: Layout) -> None:
        self.tracer, self.layout = tracer, layout
        self.uniforms: list[str] = []
        self.tensors = 0
        self.sums: list[tuple[Any, ...]] = []

    # -- inputs

    def uniform(self, name: str, like: Tensor) -> Tensor:
        """Return an input that all lanes share, passed by name when the kernel is called."""
        self.uniforms.append(name)
        return self.tracer.uniform(like)

    def salts(self) -> Tensor:
        """Return the salts of the vertex, hashes of its sampling dimensions, one for each :class:`Dimension`."""
        return self.uniform("salts", torch.zeros(len(Dimension), dtype=torch.int32))

    def start_salts(self) -> Tensor:
        """Return the salts of depth 0."""
        return self.uniform("start_salts", torch.zeros(len(Dimension), dtype=torch.int32))

    def depth(self) -> Tensor:
        """Return the number of the vertex."""
        return self.uniform("depth", torch.ones(1, dtype=torch.int32))

    def merging(self) -> Tensor | None:
        """Return the ratio of densities of a merge ``(1,)``; None for an integrator without merges."""
        counts = self.layout.wave.context.merging is not None
        return self.uniform("merging", torch.ones(1, dtype=torch.float32)) if counts else None

    def roulette(self, bound: float | None) -> float | Tensor:
        """Return the upper bound of the survival probability; 0: no roulette at the vertex. None: an input ``(1,)``."""
        return self.uniform("roulette", torch.zeros(1, dtype=torch.float32)) if bound is None else bound

    def state(self) -> tuple[PathState, dict[str, Tensor]]:
        """Return the path state, and rows that stages do not read but that are passed on: the filter ``weight``."""
        rows = self.layout.state
        return path_state(rows.read(self.tracer, *rows.state)), rows.read(self.tracer, "weight")

    def hit(self, rows: Rows | None = None) -> Hit:
        """Return the hits of the rays; ``rows``: of which arena, None: of paths."""
        return Hit(**(rows or self.layout.state).read(self.tracer, *HIT))

    def place(self) -> Tensor:
        """Return the index of each lane in the arena."""
        numbers = torch.zeros(self.tracer.lanes, dtype=torch.int64)
        return self.tracer.lane(numbers, lambda _: self.tracer.graph.node("place", "l"))

    # -- results

    def node(self, result: Tensor) -> int:
        """Return the node of a result with one number a lane."""
        return self.tracer.nodes(result)[0]

    def kept(self, state: PathState, passthrough: dict[str, Tensor]) -> list[tuple[int, int]]:
        """Return the stores of a path state to an arena of paths, as pairs of row and node."""
        return self.layout.state.nodes(self.tracer, **state_values(state), **passthrough)

    def ended(self, mask: int, lane: Tensor, radiance: Tensor, passthrough: dict[str, Tensor]) -> Scatter:
        """Return the store of radiance to the slots of samples, for paths that end where node ``mask`` is true (-1: all)."""
        if "weight" in passthrough:
            with self.tracer:
                radiance = radiance * passthrough["weight"]
        rows = tuple(enumerate(self.tracer.nodes(radiance)))
        return Scatter(mask, self.node(lane), rows, slots=True)

    def sorted(
        self, sinks: Sinks, state: PathState, prim: Tensor, passthrough: dict[str, Tensor]
    ) -> tuple[int, list[AppendIndex]]:
        """List lanes by model, emitter or missing hit, and end paths that neither hit a surface nor see an environment.

        Returns:
            The node of the mask of lanes that go on, and the appends to their lists.
        """
        layout, world = self.layout, self.layout.world
        with self.tracer:
            # keys: m for an emissive surface of model m, models + m for another surface of it, 2 models for a miss
            key = torch.index_select(world.materials.key, 0, world.geometry.slot(prim) + 1)
            has_hit, alive = prim >= 0, state.t_max > 0  # a medium ends paths by t_max = 0
            of_models = [(key == m) | (key == layout.models + m) for m in range(layout.models)]
            emissive = (key < layout.models) & has_hit
            missed = ~has_hit & alive
            goes_on = has_hit | missed if layout.has_environment else has_hit
            ends = ~goes_on
        lists: list[tuple[int, Tensor]] = list(enumerate(of_models)) if layout.listed else []
        if layout.has_emitters:
            lists.append((layout.emissive, emissive))
        if layout.has_environment:
            lists.append((layout.missed, missed))
        appends = [AppendIndex(self.node(mask), list=number, counter=number + 1) for number, mask in lists]
        sinks.scatter.append(self.ended(self.node(ends), state.lane, state.radiance, passthrough))
        return self.node(goes_on), appends
