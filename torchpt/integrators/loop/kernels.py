"""The kernels of a render: each stage traced with the loads and stores that the loop needs around it."""

from __future__ import annotations

import ctypes
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchpt import lights
from torchpt.integrators import stages
from torchpt.integrators.loop.rows import HIT, PASS, SHADOW, Rows
from torchpt.integrators.search import beyond, passing
from torchpt.lanes import engine, gathers, pointwise, shelf, views  # noqa: F401  (they register what they lower)
from torchpt.lanes.graph import Unsupported
from torchpt.lanes.kernel import Note, Pack, Scatter, Sinks, Store, text
from torchpt.lanes.packet import KINDS, packet_search
from torchpt.lanes.program import Program, Tables, bound, holds, signature
from torchpt.lanes.tracing import Tracer, lanes_for
from torchpt.records import Hit, PathState, Shadow
from torchpt.samplers import Dimension, Draws

if TYPE_CHECKING:
    from torchpt.integrators.wave import Wave

__all__ = ["PLACE", "Kernel", "Kernels", "leaves_of"]

#: Numbers that say which samples a chunk holds: the first pixel of the picture and how many there are; the randomization
#: and point of the first sample, the number of randomizations; the crop's corner and width, the film's width.
PLACE = ("first", "pixels", "group", "point", "randomizations", "x", "y", "crop", "film")


@dataclass(frozen=True)
class Kernel:
    """A stage's machine code with the tables of one scene."""

    program: Program
    tables: Tables


_PASSED = ("pass_o", "pass_d", "pass_t")
#: Programs by what they were traced for, the latest last; more than this many are not kept.
MOST_PROGRAMS = 512
_programs: dict[Any, Program] = {}
_tracing = threading.Lock()


def leaves_of(record: Any, path: str) -> Iterator[tuple[str, Tensor]]:
    """All tensors of a record by path."""
    if isinstance(record, Tensor):
        yield path, record
    elif isinstance(record, dict):
        for name, value in record.items():
            yield from leaves_of(value, f"{path}.{name}")
    elif isinstance(record, tuple | list):
        for k, value in enumerate(record):
            yield from leaves_of(value, f"{path}.{k}")
    elif is_dataclass(record):
        for field in fields(record):
            yield from leaves_of(getattr(record, field.name), f"{path}.{field.name}")


class Kernels:
    """The kernels of one render, made when they are first asked for.

    Args:
        wave: the render.
        packets: whether primitives are so few that rays are searched by kernels; else the search structure is called.
        fused: whether that is done inside of the stages.
        before: kernels of another render, whose tables are taken over where they are made of the same tensors.

    Attributes:
        state: rows of a path.
        passed: rows of rays that pass surfaces.
        models: how many BSDF models there are.
        around: whether something shines from outside.
        emitters: whether a ray may meet an emitter.
        listed: whether lanes are taken by lists: else all lanes of the arena are of the one model.
        eager: models whose stage does what no kernel can, and what that is; they run as tensor operations.
        seconds: spent on making kernels.
    """

    def __init__(self, wave: Wave, packets: bool, fused: bool, before: Kernels | None = None) -> None:
        self.wave, self.packets, self.fused = wave, packets, fused
        self.plan, self.world = wave.stages.plan, wave.stages.world
        self.numbers = wave.sampler.numbers(torch.device("cpu"))
        world, table = self.world, self.world.lights
        self.models = len(world.materials.models)
        self.around = table is not None and table.environment is not None
        self.emitters = table is not None and table.row_of_prim is not None
        self.listed = not fused or self.models > 1 or self.around
        self.has_opacity = world.materials.opacity is not None
        self.state, self.passed = (
            _state_rows(wave, packets, fused, self.has_opacity),
            Rows({**PASS, "clear": ((), "f"), **_key(wave), **HIT}),
        )
        self._leaves = dict(
            item
            for name, record in (
                ("world", world),
                ("camera", wave.camera),
                ("filter", wave.filter.tensors()),
                ("sampler", self.numbers),
                ("centre", wave.centre),
                ("pixel", wave.stages.pixel),
                ("preview", wave.preview),
            )
            for item in leaves_of(record, name)
        )
        # A tensor is the same one only as long as nobody wrote into it; of inference tensors that cannot be known.
        self._states = {
            path: (id(tensor), object() if tensor.is_inference() else tensor._version)
            for path, tensor in self._leaves.items()
        }
        self._ids = {id(tensor): (path, tensor) for path, tensor in self._leaves.items()}
        structure = (world, wave.camera.kind(), wave.filter.kind(), self.plan, wave.preview, self._leaves)
        self._structure = (*map(signature, structure), packets, fused)
        self._before = before if before is not None and before._structure == self._structure else None
        self._laid_out: dict[Any, Tensor] = {}
        if self._before is not None:
            old = self._before
            same = {path for path, state in self._states.items() if old._states[path] == state}
            self._laid_out |= {key: table for key, table in old._laid_out.items() if key[0] in same}
            self._same, old._before = same, None
        self._made: dict[tuple[Any, ...], Kernel] = {}
        self._lock = threading.Lock()
        self.search = _search_words(wave) if packets else None
        #: For each primitive whether a ray may pass it, as uint8.
        self.non_opaque: np.ndarray | None = None
        if self.has_opacity and not packets:
            self.non_opaque = self._passing(torch.arange(sum(world.geometry.counts))).to(torch.uint8).numpy()
        self.seconds = 0.0
        self.eager: dict[int, str] = {}

    def probe(self, numbers: Iterable[int]) -> dict[int, str]:
        """Which of the models' stages no kernel can be made of, and why."""
        found = {}
        for number in numbers:
            try:
                self.bounce(number, 0.0)
            except Unsupported as error:
                found[number] = str(error)
        return found

    # -- which list and counter is which

    @property
    def emissive(self) -> int:
        """The list of lanes that met an emitter."""
        return self.models if self.listed else 0

    @property
    def missed(self) -> int:
        """The list of lanes that met nothing, where something shines from there."""
        return self.emissive + int(self.emitters)

    # -- kernels

    def generate(self) -> Kernel:
        """Camera rays; with their first hits where the search is inside."""
        return self._get(("generate",), self._generate)

    def settle(self, shadow: bool) -> Kernel:
        """What the lanes of the arena met: light that was not blocked, lists of lanes by model, ends of paths."""
        return self._get(("settle", shadow), lambda tracer: self._settle(tracer, shadow))

    def emit(self) -> Kernel:
        """Light of emitters that were met."""
        return self._get(("emit",), self._emit, listed=True)

    def escape(self) -> Kernel:
        """Light from outside, and the ends of those paths."""
        return self._get(("escape",), self._escape, listed=True)

    def bounce(self, model: int, roulette: float) -> Kernel:
        """One vertex of the paths on surfaces of a model."""
        return self._get(
            ("bounce", model, roulette), lambda tracer: self._bounce(tracer, model, roulette), listed=self.listed
        )

    def retire(self) -> Kernel:
        """Ends of paths that are cut."""
        return self._get(("retire",), self._retire, listed=self.listed)

    def find(self, passed: bool) -> Kernel:
        """The nearest hits of all rays of the arena, by packets."""
        return self._get(("find", passed), lambda tracer: self._find(tracer, passed))

    def block(self) -> Kernel:
        """Which shadow rays are blocked, by packets."""
        return self._get(("block",), self._block)

    def sift(self) -> Kernel:
        """A list of the rays that met a surface which may let them pass."""
        return self._get(("sift",), self._sift)

    def meet(self, again: bool) -> Kernel:
        """Which rays a surface stops by chance, and where the others go on."""
        return self._get(("meet", again), lambda tracer: self._meet(tracer, again), listed=not again)

    def begin(self) -> Kernel:
        """Shadow rays that meet what may let light pass as rays that pass surfaces; what is known of the others."""
        return self._get(("begin",), self._begin)

    def through(self) -> Kernel:
        """How much light surfaces let through."""
        return self._get(("through",), self._through)

    def layers(self, model: int, names: tuple[str, ...]) -> Kernel:
        """What the first surfaces are, where they are of a model."""
        return self._get(
            ("layers", model, names), lambda tracer: self._layers(tracer, model, names), listed=self.listed
        )

    def preview(self, model: int) -> Kernel:
        """The first surfaces of a model under the environment's prefiltered maps."""
        return self._get(("preview", model), lambda tracer: self._preview(tracer, model), listed=True)

    def deposit(self, channels: int, clamp: bool) -> Kernel:
        """One sample of each pixel added to sums; those that are not finite are counted, and taken as black."""
        return self._get(("deposit", channels, clamp), lambda tracer: self._deposit(tracer, channels, clamp))

    # -- how each is traced

    def _get(
        self,
        key: tuple[Any, ...],
        build: Callable[[Tracer], Sinks],
        listed: bool = False,
    ) -> Kernel:
        made = self._made.get(key)
        if made is not None:
            return made
        with self._lock:
            made = self._made.get(key)
            if made is None:
                begin = time.perf_counter()
                made = self._made[key] = self._make(key, build, listed)
                self.seconds += time.perf_counter() - begin
            return made

    def _make(self, key: tuple[Any, ...], build: Callable[[Tracer], Sinks], listed: bool) -> Kernel:
        whole = key, self._structure
        with _tracing:  # one at a time in a process: see torchpt.lanes.tracing.tracing
            program = _programs.get(whole)
            name = shelf.key_of(whole) if program is None else None
            if program is None and name is not None:
                program = shelf.load(name)
            if program is None or not holds(program, self._leaves):
                program = self._traced(build, listed)
                if name is not None:
                    shelf.store(name, program)
                _programs.pop(whole, None)
                _programs[whole] = program
                if len(_programs) > MOST_PROGRAMS:
                    del _programs[next(iter(_programs))]
        before = None if self._before is None else self._before._made.get(key)
        if before is not None and before.program is program and not program.held and program.leaves() <= self._same:
            return before
        tables = bound(program.tables, program.steps, program.held, self._leaves, self._laid_out)
        return Kernel(program, tables)

    def _traced(self, build: Callable[[Tracer], Sinks], listed: bool) -> Program:
        tracer = Tracer(lanes_for(self._leaves.values()), self._ids)
        self._uniforms: list[str] = []
        self._tensors = 0
        with torch.no_grad():
            sinks = build(tracer)
        search = None
        if any(op in ("nearest", "occluded") for op, *_ in tracer.graph.nodes):
            search = packet_search(_kinds(self.world.geometry.counts), engine.estimates())
        ir, needed = text(tracer.graph, sinks, len(tracer.tables), len(self._uniforms), self._tensors, listed, search)
        made = engine.compiled(ir)
        nodes: dict[str, int] = {}
        for node in needed:
            for file in tracer.graph.origins[node]:
                nodes[file] = nodes.get(file, 0) + 1
        return Program(
            call=made.call,
            code=made.key,
            tables=tuple(tracer.tables),
            steps=tuple(tracer.steps),
            held=tuple(tracer.held),
            guards=tuple(tracer.guards),
            uniforms=tuple(self._uniforms),
            lists=sinks.lists(),
            counters=sinks.counters(),
            tensors=self._tensors,
            results=len(sinks.store),
            shadows=sinks.shadows,
            nodes=nodes,
        )

    def _uniform(self, tracer: Tracer, name: str, like: Tensor) -> Tensor:
        self._uniforms.append(name)
        return tracer.uniform(like)

    def _salts(self, tracer: Tracer) -> Tensor:
        return self._uniform(tracer, "salts", torch.zeros(len(Dimension), dtype=torch.int32))

    def _state(self, tracer: Tracer) -> tuple[PathState, dict[str, Tensor]]:
        """The state of the paths, and what else travels with them."""
        names = [field.name for field in fields(PathState)]
        found = self.state.read(tracer, *names)
        rest = self.state.read(tracer, "weight")
        return PathState(**{"eta": None, "p": None, "n": None, **found}), rest  # type: ignore[arg-type]

    def _hit(self, tracer: Tracer) -> Hit:
        return Hit(**self.state.read(tracer, *HIT))

    def _kept(self, tracer: Tracer, state: PathState, rest: dict[str, Tensor]) -> list[tuple[int, int]]:
        values = {field.name: getattr(state, field.name) for field in fields(PathState)}
        given = {name: value for name, value in values.items() if value is not None}
        return self.state.nodes(tracer, **given, **rest)

    def _ended(self, tracer: Tracer, mask: int, lane: Tensor, radiance: Tensor, rest: dict[str, Tensor]) -> Scatter:
        """Paths that end: their radiance goes to the slots of their samples."""
        if "weight" in rest:
            with tracer:
                radiance = radiance * rest["weight"]
        rows = tuple(enumerate(tracer.nodes(radiance)))
        return Scatter(mask, tracer.nodes(lane)[0], rows, slots=True)

    def _routed(
        self, tracer: Tracer, sinks: Sinks, state: PathState, prim: Tensor, rest: dict[str, Tensor]
    ) -> tuple[int, list[Note]]:
        """Which lanes go on, by the surfaces that they met; those that do not are ended.

        Returns:
            The mask of the lanes that go on, and the notes of their places.
        """
        world = self.world
        with tracer:
            key = torch.index_select(world.materials.key, 0, world.geometry.slot(prim) + 1)
            met, alive = prim >= 0, state.t_max > 0
            masks = [(key == m) | (key == self.models + m) for m in range(self.models)]
            shining = (key < self.models) & met
            out = ~met & alive
            on = met | out if self.around else met
            off = ~on
        notes: list[Note] = []
        counter = 1
        if self.listed:
            for mask in masks:
                notes.append(Note(tracer.nodes(mask)[0], len(notes), counter + len(notes)))
        if self.emitters:
            notes.append(Note(tracer.nodes(shining)[0], self.emissive, counter + self.emissive))
        if self.around:
            notes.append(Note(tracer.nodes(out)[0], self.missed, counter + self.missed))
        sinks.scatter.append(self._ended(tracer, tracer.nodes(off)[0], state.lane, state.radiance, rest))
        return tracer.nodes(on)[0], notes

    def _with_hit(self, tracer: Tracer, sinks: Sinks, state: PathState, rest: dict[str, Tensor]) -> None:
        """Search inside the kernel, and keep the lanes that go on."""
        t, prim, u, v = _nearest(tracer, state.o, state.d, state.t_max)
        on, notes = self._routed(tracer, sinks, state, prim, rest)
        rows = self._kept(tracer, state, rest) + self.state.nodes(tracer, t=t, prim=prim, u=u, v=v)
        sinks.pack.append(Pack(on, tuple(rows), 0, tuple(notes)))

    def _generate(self, tracer: Tracer) -> Sinks:
        place = self._uniform(tracer, "place", torch.ones(len(PLACE), dtype=torch.int32))
        salts = self._salts(tracer)
        wave = self.wave
        rest: dict[str, Tensor] = {}
        with tracer:
            at = dict(zip(PLACE, place.to(torch.int64).unbind(), strict=True))
            lane = torch.arange(tracer.lanes)
            sample = torch.div(lane, at["pixels"], rounding_mode="floor")
            pixel = lane - sample * at["pixels"] + at["first"]
            row = torch.div(pixel, at["crop"], rounding_mode="floor")
            x, y = pixel - row * at["crop"] + at["x"], row + at["y"]
            number = y * at["film"] + x
            turn = sample + at["group"]
            group = turn % at["randomizations"]
            point = torch.div(turn, at["randomizations"], rounding_mode="floor") + at["point"]
            key = wave.sampler.points.key(self.numbers, number, group, point)
            x, y = x.to(self.plan.dtype), y.to(self.plan.dtype)
            state = stages.generate(self.plan, wave.camera, wave.filter, x, y, key, salts)
            if wave.filter.signed:
                rest["weight"] = wave.filter.weight(Draws(self.plan.sampler, key, salts).two(Dimension.PIXEL))
            if "eta" in self.state:
                state = replace(state, eta=torch.ones_like(state.t_max))
            if "p" in self.state:
                state = replace(state, p=state.o, n=torch.zeros_like(state.o))
        sinks = Sinks()
        if self.fused:
            self._with_hit(tracer, sinks, state, rest)
        else:
            sinks.write += self._kept(tracer, state, rest)
        return sinks

    def _settle(self, tracer: Tracer, shadow: bool) -> Sinks:
        state, rest = self._state(tracer)
        prim = self.state.read(tracer, "prim")["prim"]
        sinks = Sinks()
        if shadow:
            found = self.state.read(tracer, "shadow_radiance", "clear", "blocked")
            with tracer:
                light = found["shadow_radiance"]
                if "clear" in found:
                    radiance = torch.addcmul(state.radiance, light, found["clear"])
                else:
                    radiance = state.radiance + torch.where(found["blocked"] != 0, 0.0, light)
            state = replace(state, radiance=radiance)
            sinks.write += self.state.nodes(tracer, radiance=radiance)
        _, notes = self._routed(tracer, sinks, state, prim, rest)
        sinks.notes += notes
        return sinks

    def _emit(self, tracer: Tracer) -> Sinks:
        state, _ = self._state(tracer)
        hit = self._hit(tracer)
        place = tracer.lane(torch.zeros(tracer.lanes, dtype=torch.int64), lambda _: tracer.graph.node("place", "l"))
        with tracer:
            light = stages.emit(self.world, state, hit, torch.arange(tracer.lanes), False)
            radiance = state.radiance + light
        rows = tuple(self.state.nodes(tracer, radiance=radiance))
        return Sinks(scatter=[Scatter(-1, tracer.nodes(place)[0], rows)])

    def _escape(self, tracer: Tracer) -> Sinks:
        state, rest = self._state(tracer)
        hit = self._hit(tracer)
        with tracer:
            light = stages.escape(self.world, state, hit, torch.arange(tracer.lanes))
            radiance = state.radiance + light
        return Sinks(scatter=[self._ended(tracer, -1, state.lane, radiance, rest)])

    def _retire(self, tracer: Tracer) -> Sinks:
        state, rest = self._state(tracer)
        return Sinks(scatter=[self._ended(tracer, -1, state.lane, state.radiance, rest)])

    def _bounce(self, tracer: Tracer, model: int, roulette: float) -> Sinks:
        salts = self._salts(tracer)
        state, rest = self._state(tracer)
        hit = self._hit(tracer)
        with tracer:
            index = torch.arange(tracer.lanes)
            after, _, shadow = stages.bounce(
                self.plan, self.world, model, roulette, False, _none, state, hit, index, salts, self.wave.stages.pixel
            )
        if self.fused:
            sinks = Sinks(shadows=int(shadow is not None))
            if shadow is not None:
                blocked = _occluded(tracer, shadow.o, shadow.d, shadow.t_max)
                with tracer:
                    light = after.radiance + torch.where(blocked, 0.0, shadow.radiance)
                after = replace(after, radiance=light)
            self._with_hit(tracer, sinks, after, rest)
            return sinks
        return self._with_shadow(tracer, after, shadow, rest)

    def _with_shadow(self, tracer: Tracer, state: PathState, shadow: Shadow | None, rest: dict[str, Tensor]) -> Sinks:
        """Keep all lanes, with the shadow rays that are still to be searched."""
        sinks = Sinks(shift=0, write=self._kept(tracer, state, rest), shadows=int(shadow is not None))
        if "shadow_o" not in self.state:
            return sinks
        with tracer:
            if shadow is None:
                nothing = torch.zeros_like(state.o)
                shadow = Shadow(nothing, nothing, torch.zeros_like(state.t_max), nothing)
        sinks.write += self.state.nodes(
            tracer,
            shadow_o=shadow.o,
            shadow_d=shadow.d,
            shadow_t=shadow.t_max,
            shadow_radiance=shadow.radiance,
        )
        return sinks

    def _layers(self, tracer: Tracer, model: int, names: tuple[str, ...]) -> Sinks:
        from torchpt.integrators import aov

        state, rest = self._state(tracer)
        hit = self._hit(tracer)
        wave = self.wave
        with tracer:
            found = aov.values(
                names, self.world, model, state.o, state.d, hit, wave.centre, self.plan.dtype, wave.stages.pixel
            )
            if "weight" in rest:
                found = {name: value if name in aov.NAMES else value * rest["weight"] for name, value in found.items()}
        nodes = [node for name in names for node in tracer.nodes(found[name])]
        return Sinks(scatter=[Scatter(-1, tracer.nodes(state.lane)[0], tuple(enumerate(nodes)), slots=True)])

    def _preview(self, tracer: Tracer, model: int) -> Sinks:
        from torchpt.integrators import ibl

        salts = self._salts(tracer)
        state, rest = self._state(tracer)
        hit = self._hit(tracer)
        assert self.wave.preview is not None
        with tracer:
            radiance, shadow = ibl.shaded(
                self.plan, self.world, self.wave.preview, model, state, hit, salts, self.wave.stages.pixel, False
            )
            # No ray goes on: the lane ends where its shadow ray is known.
            after = replace(state, radiance=state.radiance + radiance, t_max=torch.zeros_like(state.t_max))
        return self._with_shadow(tracer, after, shadow, rest)

    def _find(self, tracer: Tracer, passed: bool) -> Sinks:
        rows, names = (self.passed, _PASSED) if passed else (self.state, ("o", "d", "t_max"))
        t, prim, u, v = _nearest(tracer, *rows.read(tracer, *names).values())
        return Sinks(write=rows.nodes(tracer, t=t, prim=prim, u=u, v=v))

    def _block(self, tracer: Tracer) -> Sinks:
        blocked = _occluded(tracer, *self.state.read(tracer, "shadow_o", "shadow_d", "shadow_t").values())
        with tracer:
            number = blocked.to(torch.int32)
        return Sinks(write=self.state.nodes(tracer, blocked=number))

    def _sift(self, tracer: Tracer) -> Sinks:
        prim = self.state.read(tracer, "prim")["prim"]
        with tracer:
            some = self._passing(prim) & (prim >= 0)
        return Sinks(notes=[Note(tracer.nodes(some)[0], 0, 0)])

    def _passing(self, prim: Tensor) -> Tensor:
        """Which primitives may let a ray pass."""
        world = self.world
        assert world.materials.opacity is not None
        slot = world.geometry.slot(prim)
        some = torch.index_select(world.materials.opacity, 0, slot) < 1
        if world.textures.opacity is not None:
            some = some | (torch.index_select(world.textures.opacity.nodes, 0, slot) >= 0)
        return some

    def _meet(self, tracer: Tracer, again: bool) -> Sinks:
        salts = self._salts(tracer)
        graph = tracer.graph
        rows = self.passed if again else self.state
        hit = Hit(**rows.read(tracer, *HIT))
        key = rows.read(tracer, "key")["key"]
        if again:
            ray = self.passed.read(tracer, "pass_o", "pass_d", "pass_t", "before", "home")
            o, d, t_max, before, home = ray.values()
        else:
            ray = self.state.read(tracer, "o", "d", "t_max")
            o, d, t_max = ray.values()
            before = None
            home = tracer.lane(torch.zeros(tracer.lanes, dtype=torch.int64), lambda _: graph.node("place", "l"))
        with tracer:
            opacity = passing(self.world, o, d, hit, 1.0)
            met = Draws(self.plan.sampler, key, salts).one(Dimension.OPACITY) < opacity
            on = ~met
            behind = beyond(self.world, o, d, hit)
            whole = hit.t if before is None else hit.t + before
        rows_on = self.passed.nodes(tracer, pass_o=behind, pass_d=d, pass_t=t_max, before=whole, home=home, key=key)
        sinks = Sinks(pack=[Pack(tracer.nodes(on)[0], tuple(rows_on), 0)])
        if again:
            found = self.state.nodes(tracer, t=whole, prim=hit.prim, u=hit.u, v=hit.v)
            sinks.scatter.append(Scatter(tracer.nodes(met)[0], tracer.nodes(home)[0], tuple(found), slots=True))
        return sinks

    def _begin(self, tracer: Tracer) -> Sinks:
        ray = self.state.read(tracer, "shadow_o", "shadow_d", "shadow_t", "blocked")
        o, d, t_max = list(ray.values())[:3]
        home = tracer.lane(torch.zeros(tracer.lanes, dtype=torch.int64), lambda _: tracer.graph.node("place", "l"))
        with tracer:
            one = torch.ones_like(t_max)
            if "blocked" in ray:
                on, off = ray["blocked"] == 2, ray["blocked"] != 2
                clear = torch.where(ray["blocked"] == 0, one, 0.0)
            else:
                on, off, clear = t_max > 0, t_max <= 0, one
        rows = self.passed.nodes(tracer, pass_o=o, pass_d=d, pass_t=t_max, home=home, clear=one)
        known = tuple(self.state.nodes(tracer, clear=clear))
        done = Scatter(tracer.nodes(off)[0], tracer.nodes(home)[0], known, slots=True)
        return Sinks(pack=[Pack(tracer.nodes(on)[0], tuple(rows), 0)], scatter=[done])

    def _through(self, tracer: Tracer) -> Sinks:
        hit = Hit(**self.passed.read(tracer, *HIT))
        ray = self.passed.read(tracer, "pass_o", "pass_d", "pass_t", "home", "clear")
        o, d, t_max, home, clear = ray.values()
        with tracer:
            opacity = passing(self.world, o, d, hit, 0.0)
            clear = clear * (1.0 - opacity)
            on = (hit.prim >= 0) & (opacity < 1)
            off = ~on
            behind = beyond(self.world, o, d, hit)
            rest = (t_max - hit.t).clamp_min(0.0)
        rows = self.passed.nodes(tracer, pass_o=behind, pass_d=d, pass_t=rest, home=home, clear=clear)
        done = Scatter(
            tracer.nodes(off)[0], tracer.nodes(home)[0], tuple(self.state.nodes(tracer, clear=clear)), slots=True
        )
        return Sinks(pack=[Pack(tracer.nodes(on)[0], tuple(rows), 0)], scatter=[done])

    def _deposit(self, tracer: Tracer, channels: int, clamp: bool) -> Sinks:
        graph = tracer.graph
        self._tensors = 2
        sample = tracer.lane(torch.zeros(channels, tracer.lanes), lambda k: graph.node("tensor", "f", extra=(0, k)))
        total = tracer.lane(
            torch.zeros(channels, tracer.lanes, dtype=torch.float64), lambda k: graph.node("tensor", "d", extra=(1, k))
        )
        limit = self._uniform(tracer, "clamp", torch.ones(1)) if clamp else None
        with tracer:
            finite = torch.isfinite(sample).all(0)
            bad = ~finite
            value = torch.where(finite, sample, 0.0)
            if limit is not None:
                value = value * (limit / value.abs().amax(0).clamp_min(limit)).clamp_max(1.0)
            total = total + value
        results = [Store(tuple(tracer.nodes(total)), "d")]
        if clamp:
            results.append(Store(tuple(tracer.nodes(value)), "f"))
        return Sinks(count=[(tracer.nodes(bad)[0], 0)], store=results)


def _none(state: PathState) -> Hit:
    raise AssertionError("hits are found between stages where there is no tape")


def _key(wave: Wave) -> dict[str, tuple[tuple[int, ...], str]]:
    return {"key": ((wave.sampler.points.rows,), "i")}


def _state_rows(wave: Wave, packets: bool, fused: bool, has_opacity: bool) -> Rows:
    """Only what the scene needs."""
    world = wave.stages.world
    found: dict[str, tuple[tuple[int, ...], str]] = {
        "o": ((3,), "f"),
        "d": ((3,), "f"),
        "t_max": ((), "f"),
        "throughput": ((3,), "f"),
        "radiance": ((3,), "f"),
        "pdf": ((), "f"),
        "lane": ((), "l"),
        **_key(wave),
    }
    if any(model.refracts for model in world.materials.models):
        found["eta"] = ((), "f")
    if lights.local(world.lights):
        found |= {"p": ((3,), "f"), "n": ((3,), "f")}
    if wave.filter.signed:
        found["weight"] = ((), "f")
    found |= HIT
    if not fused and world.lights is not None:
        found |= SHADOW
        found |= {"clear": ((), "f")} if has_opacity else {}
        found |= {} if has_opacity and packets else {"blocked": ((), "i")}
    return Rows(found)


def _kinds(counts: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(kind for kind, count in zip(KINDS, counts, strict=False) if count)


def _search_words(wave: Wave) -> Any:
    """What :func:`torchpt.lanes.packet.packet_search` reads."""
    accel: Any = wave.accel
    words = (ctypes.c_int64 * 7)()
    words[0], words[1] = accel.table.data_ptr(), accel.spheres.data_ptr()
    total = 0
    for k in range(4):
        total += accel.counts[k]
        words[2 + k] = total
    ctypes.memmove(ctypes.addressof(words) + 48, ctypes.byref(ctypes.c_double(accel.extent)), 8)
    return words


def _seven(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> list[int]:
    return [*tracer.nodes(o), *tracer.nodes(d), *tracer.nodes(t_max)]


def _nearest(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The nearest hits, found inside the kernel."""
    graph = tracer.graph
    found = graph.node("nearest", "S", *_seven(tracer, o, d, t_max))
    results = []
    for k, (dtype, ty) in enumerate(
        ((torch.float32, "f"), (torch.int64, "l"), (torch.float32, "f"), (torch.float32, "f"))
    ):
        node = graph.node("part", ty, found, extra=k)
        results.append(tracer.lane(torch.zeros(tracer.lanes, dtype=dtype), lambda _, node=node: node))
    return results[0], results[1], results[2], results[3]


def _occluded(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
    """Whether shadow rays are blocked, found inside the kernel."""
    node = tracer.graph.node("occluded", "b", *_seven(tracer, o, d, t_max))
    return tracer.lane(torch.zeros(tracer.lanes, dtype=torch.bool), lambda _: node)
