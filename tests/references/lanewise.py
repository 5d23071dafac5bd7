"""Compare the kernels of the compiled loop with the eager stages that they were traced from, lane by lane on the same input.

A wave is traced eagerly and the input of every stage is recorded. Each kernel then runs on that input, so that a path that
diverges by rounding does not affect later vertices.

Counting: a *value* is one number of one lane (a vector has three). It is off if it differs by more than ``TOLERANCE`` times
the eager lane's magnitude: that of the number, or of a vector's largest component, since components near zero have large
relative errors. Where a kernel decides differently (a path survives or not, a ray is blocked or not, another surface is hit)
all values of the lane that depend on the decision are off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchpt
from torchpt.compiler.graph import Unsupported
from torchpt.engines import tensors
from torchpt.engines.kernels.engine import Chunk, KernelsEngine
from torchpt.engines.kernels.layout import HIT, Memory
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.tensors import Paths, TensorsEngine
from torchpt.math.vectors import rows
from torchpt.paths import vertex
from torchpt.paths.integrators.path import partition
from torchpt.paths.state import PathState, Shadow, VertexInput
from torchpt.paths.walk import walk
from torchpt.paths.wave import RayCounts, Wave
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit
from torchpt.rendering import kernels_of, make_wave
from torchpt.scene.formats.description import settings

__all__ = ["ALLOWED", "TOLERANCE", "Differences", "compare", "loaded", "prepared", "run_bounce", "waves"]

TOLERANCE = 1e-3
#: Share of values that may be off. Kernels fuse products and sums, so they round differently: a comparison whose two sides
#: agree to a few 1e-7 may go the other way, and a condition number of 1e4 turns 1e-7 into 1e-3.
ALLOWED = 1e-4

_STATE = tuple(f.name for f in fields(PathState) if f.name != "extra")
_WHOLE = {"lane", "key", "prim"}  # equal or not


@dataclass
class Differences:
    """Counts of compared values and of those that are off, by kernel and field."""

    values: dict[tuple[str, str], int] = field(default_factory=dict)
    off: dict[tuple[str, str], int] = field(default_factory=dict)

    def add(self, kernel: str, name: str, eager: Tensor, found: Tensor, floor: float = 0.0) -> None:
        assert eager.shape == found.shape, (kernel, name, eager.shape, found.shape)
        if name in _WHOLE:
            wrong = eager != found
        else:
            a, b = eager.double(), found.double()
            size = a.abs() if a.dim() == 1 else a.abs().amax(0)
            near = (a - b).abs() <= TOLERANCE * torch.where(size.isfinite(), size, 0.0) + floor
            wrong = ~(near | (a == b) | (a.isnan() & b.isnan()))
        key = kernel, name
        self.values[key] = self.values.get(key, 0) + wrong.numel()
        self.off[key] = self.off.get(key, 0) + int(wrong.sum())

    def share(self, kernel: str | None = None) -> float:
        """Return the share of values that are off."""
        chosen = [key for key in self.values if kernel in (None, key[0])]
        return sum(self.off[key] for key in chosen) / max(sum(self.values[key] for key in chosen), 1)

    def kernels(self) -> list[str]:
        return sorted({kernel for kernel, _ in self.values})

    def worst(self, count: int = 5) -> list[tuple[str, str, int, int]]:
        found = sorted(self.off, key=lambda key: -self.off[key] / max(self.values[key], 1))[:count]
        return [(*key, self.off[key], self.values[key]) for key in found if self.off[key]]


class _Recorder(TensorsEngine):
    """The tensor engine, recording the inputs of its stages."""

    def __init__(self, wave: Wave, lanes: int) -> None:
        super().__init__(wave, lanes)
        self.bounces: list[tuple[int, PathState, Hit, Tensor, int]] = []
        self.emits: list[tuple[PathState, Hit, Tensor]] = []
        self.escapes: list[tuple[PathState, Hit, Tensor]] = []
        self.states: list[PathState] = []

    def _gather(self, paths: Paths, index: Tensor, stage: Any) -> None:
        kept = self.emits if stage == self.wave.integrator.emit else self.escapes
        kept.append((_copied(paths.state), paths.hits, index))
        super()._gather(paths, index, stage)

    def scatter(self, paths: Paths, roulette: float) -> Paths:
        state = _copied(paths.state)
        self.states.append(state)
        self.bounces += [(model, state, paths.hits, index, paths.depth) for model, index in paths.groups or ()]
        return super().scatter(paths, roulette)


def _copied(state: PathState) -> PathState:
    return replace(state, radiance=state.radiance.clone())


def loaded(name: str | Mapping[str, Any]) -> torchpt.Scene:
    return torchpt.load(name, device="cpu")


def prepared(scene: torchpt.Scene, wishes: Mapping[str, Any]) -> tuple[Wave, Any]:
    """Return the wave of a render, and its settings."""
    wish = settings(scene.description, wishes)
    with torch.no_grad():
        return make_wave(scene, wish, None, torch.float32), wish


def waves(wave: Wave, pixels: int, samples: int) -> _Recorder:
    """Return the inputs of the stages of a wave."""
    recorder = _Recorder(wave, pixels * samples)
    with torch.no_grad():
        walk(recorder, recorder.spawn(wave.rays(0, pixels, 0, samples)), wave.integrator.limits)
    return recorder


def compare(scene: torchpt.Scene, wishes: Mapping[str, Any], pixels: int, samples: int) -> Differences:
    """Compare all kernels of a scene, as the loop builds them and, if they search inside stages, also without that."""
    found = Differences()
    wave, _ = prepared(scene, wishes)
    with torch.no_grad():
        chosen = kernels_of(scene, wave)
        if wave.first_surface is not None:
            _first_hits(found, wave, chosen, pixels, samples)
            return found
        recorder = waves(wave, pixels, samples)
        _generate(found, wave, Kernels(wave, chosen.by_kernels, False), pixels, samples)
        for kernels in [chosen] + ([Kernels(wave, chosen.by_kernels, False)] if chosen.fused else []):
            _vertices(found, wave, kernels, recorder)
        _search(found, wave, Kernels(wave, chosen.by_kernels, False), recorder)
    return found


def arena(kernels: Kernels, **values: Tensor | None) -> Memory:
    """Return an arena with the given fields in its first lanes."""
    memory = Memory(kernels.state.count)
    memory.words[:] = 0x7FC00000  # NaN reveals reads of rows that were not written
    kernels.state.put(memory, 0, values)
    return memory


def _fields(state: PathState, hit: Hit) -> dict[str, Tensor | None]:
    found: dict[str, Tensor | None] = {name: getattr(state, name) for name in _STATE}
    return {**found, **{name: getattr(hit, name) for name in HIT}, "weight": torch.ones_like(state.t_max)}


def _listed(index: Tensor) -> Memory:
    places = Memory(1)
    places.words[0, : len(index)] = index.numpy()
    return places


def _generate(found: Differences, wave: Wave, kernels: Kernels, pixels: int, samples: int) -> None:
    eager = wave.rays(0, pixels, 0, samples)
    worker, here = KernelsEngine(kernels), arena(kernels)
    worker.start(Chunk(0, pixels, 0, samples))
    worker.calls.clear()
    worker.calls.set_dimensions(0)
    worker.calls.run(kernels.generate(False, False), pixels * samples, here, here)
    taken = kernels.state.take(here, np.arange(pixels * samples), _STATE)
    for name, value in taken.items():
        if name == "eta":
            assert bool((value == 1).all())
        elif name in ("p", "n"):
            assert torch.equal(value, taken["o"] if name == "p" else torch.zeros_like(value))
        else:
            found.add("generate", name, getattr(eager, name), value, 1e-5 if name == "o" else 0.0)


def run_bounce(
    worker: KernelsEngine, model: int, roulette: bool, state: PathState, hit: Hit, index: Tensor, depth: int
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Run one kernel on some lanes of a wave.

    Returns:
        The rows that it wrote, in the order of ``index``; which lanes go on; the radiance of those that do not.
    """
    kernels = worker.kernels
    if not kernels.listed:
        state, hit = rows(state, index), rows(hit, index)
    here, there = arena(kernels, **_fields(state, hit)), arena(kernels)
    worker.calls.clear()
    worker.calls.set_dimensions(depth, roulette=float(roulette))
    worker.slots.words[:] = 0
    lists = [Memory(1) for _ in range(kernels.models + 2)]
    places = _listed(index) if kernels.listed else None
    worker.calls.run(kernels.bounce(model, roulette), len(index), here, there, places, lists=lists)
    names = tuple(kernels.state._fields)
    lanes = (state.lane[index] if kernels.listed else state.lane).numpy()
    if not kernels.fused:
        return kernels.state.take(there, np.arange(len(index)), names), torch.ones(len(index), dtype=torch.bool), None  # type: ignore[return-value]
    live, counts = worker.calls.counted()
    taken = kernels.state.take(there, np.arange(live), names)
    _routes(worker, taken, lists, counts)
    place = np.full(int(lanes.max()) + 1, -1)
    place[taken["lane"].numpy()] = np.arange(live)
    place = torch.from_numpy(place[lanes])
    values = {
        name: torch.where(place >= 0, value[..., place.clamp_min(0)], 0) if live else None
        for name, value in taken.items()
    }
    ended = torch.from_numpy(worker.slots.floats[:, lanes].copy())
    return values, place >= 0, ended  # type: ignore[return-value]


def _routes(worker: KernelsEngine, taken: dict[str, Tensor], lists: list[Memory], counts: list[int]) -> None:
    """Check that each lane is on the right list, exactly, for the hits that the kernel itself found."""
    kernels = worker.kernels
    hit = Hit(*(taken[name] for name in HIT))
    ends, groups = partition(kernels.world, hit)
    wanted: dict[int, Tensor] = {model: index for model, index in groups} if kernels.listed else {}
    if kernels.has_emitters:
        wanted[kernels.emissive] = ends.emissive
    if kernels.has_environment:
        wanted[kernels.missed] = ends.missed[taken["t_max"][ends.missed] > 0]
    for number in range(kernels.models + 2):
        count = counts[number] if number < len(counts) else 0
        expected = wanted.get(number)
        if expected is None:
            assert count == 0 or not kernels.listed
            continue
        named = torch.from_numpy(lists[number].words[0, :count].astype(np.int64))
        assert torch.equal(named.sort()[0], expected.sort()[0])


def _vertices(found: Differences, wave: Wave, kernels: Kernels, recorder: _Recorder) -> None:
    worker, world = KernelsEngine(kernels), wave.context.world
    engine = TensorsEngine(wave, 0)
    kind = "fused" if kernels.fused else "apart"
    done: set[tuple[int, bool]] = set()
    for model, state, hit, index, depth in recorder.bounces:
        # What the render itself asks for, and the other form once.
        natural = wave.integrator.light and depth >= wave.integrator.limits.rr_depth
        for roulette in (natural, not natural):
            if roulette is not natural and (model, roulette) in done:
                continue
            done.add((model, roulette))
            name = f"{kind} bounce {world.materials.models[model]}{' with roulette' if roulette else ''}"
            context = wave.context.at(salts(depth, torch.device("cpu")), roulette=roulette)
            output = vertex.bounce(context, model, VertexInput(rows(state, index), rows(hit, index)))
            after, shadow = output.leaving, output.shadow
            try:
                values, on, ended = run_bounce(worker, model, roulette, state, hit, index, depth)
            except Unsupported as error:
                raise AssertionError(f"{name}: {error}") from None
            if not kernels.fused:
                _compare_apart(found, name, after, shadow, values)
                continue
            if shadow is not None:
                transmittance = engine.transmittance(shadow)
                after = replace(after, radiance=torch.addcmul(after.radiance, shadow.radiance, transmittance))
            _compare_fused(found, name, kernels, after, engine.hits(after, depth + 1), values, on, ended)
    for state, hit, index in recorder.emits:
        light = vertex.emit(wave.context, VertexInput(rows(state, index), rows(hit, index))).brought
        here = arena(kernels, **_fields(state, hit))
        worker.calls.run(kernels.emit(), len(index), here, here, _listed(index))
        taken = kernels.state.take(here, index.numpy(), ("radiance",))["radiance"]
        found.add(f"{kind} emit", "radiance", state.radiance[:, index] + light, taken)
    for state, hit, index in recorder.escapes:
        index = index[state.t_max[index] > 0]
        light = vertex.escape(wave.context, VertexInput(rows(state, index), rows(hit, index))).brought
        here = arena(kernels, **_fields(state, hit))
        worker.calls.run(kernels.escape(), len(index), here, here, _listed(index))
        lanes = state.lane[index].numpy()
        taken = torch.from_numpy(worker.slots.floats[:, lanes].copy())
        found.add(f"{kind} escape", "radiance", state.radiance[:, index] + light, taken)


def _compare_apart(
    found: Differences, name: str, after: PathState, shadow: Shadow | None, values: dict[str, Tensor]
) -> None:
    for key in _STATE:
        if key in values:
            found.add(name, key, getattr(after, key), values[key], _floor(key))
    if "shadow_o" not in values:
        assert shadow is None
        return
    if shadow is None:
        assert not values["shadow_t"].any()
        return
    # Where no light is to be had the ray goes nowhere: its direction is of no consequence.
    lit = shadow.t_max > 0
    found.add(name, "shadow_t", shadow.t_max, values["shadow_t"])
    found.add(name, "shadow_o", shadow.o[:, lit], values["shadow_o"][:, lit], _floor("o"))
    found.add(name, "shadow_d", shadow.d[:, lit], values["shadow_d"][:, lit])
    found.add(name, "shadow_radiance", shadow.radiance, values["shadow_radiance"])


def _compare_fused(
    found: Differences,
    name: str,
    kernels: Kernels,
    after: PathState,
    hit: Hit,
    values: dict[str, Tensor],
    on: Tensor,
    ended: Tensor,
) -> None:
    alive = after.t_max > 0
    goes = (hit.prim >= 0) | (alive & kernels.has_environment)
    both, neither, differ = goes & on, ~goes & ~on, goes != on
    if values["lane"] is not None:
        for key in (*_STATE, *HIT):
            if key in values:
                eager = getattr(after if key in _STATE else hit, key)
                found.add(name, key, eager[..., both], values[key][..., both], _floor(key))
    found.add(name, "ended", after.radiance[:, neither], ended[:, neither])
    # Paths that live on in one of both only.
    found.add(name, "lane", torch.ones(int(differ.sum()) * 20), torch.zeros(int(differ.sum()) * 20))


def _floor(name: str) -> float:
    # The error of positions and surface parameters is relative to the size of the surface.
    return {"o": 1e-5, "p": 1e-5, "u": 1e-4, "v": 1e-4}.get(name, 0.0)


def _search(found: Differences, wave: Wave, kernels: Kernels, recorder: _Recorder) -> None:
    """Compare the search for rays from vertices and for shadow rays, through surfaces that let light pass."""
    worker, engine = KernelsEngine(kernels), TensorsEngine(wave, 0)
    for depth, state in enumerate(recorder.states, 1):
        hit = engine.hits(state, depth)
        here = arena(kernels, **_fields(state, Hit(*(torch.zeros_like(hit.t) for _ in range(4)))))
        worker.search.nearest(here, len(state.lane))
        flying, step = len(state.lane) if kernels.has_transmission else 0, 0
        while flying:
            flying, step = worker.search.transmit(here, flying, depth, step), step + 1
        taken = kernels.state.take(here, np.arange(len(state.lane)), tuple(HIT))
        for key in HIT:
            found.add("nearest", key, getattr(hit, key), taken[key], _floor(key))
    for model, state, hit, index, depth in recorder.bounces:
        context = wave.context.at(salts(depth, torch.device("cpu")))
        shadow = vertex.bounce(context, model, VertexInput(rows(state, index), rows(hit, index))).shadow
        if shadow is None:
            continue
        n = len(index)
        one = torch.ones(n)
        here = arena(
            kernels,
            shadow_o=shadow.o,
            shadow_d=shadow.d,
            shadow_t=shadow.t_max,
            transmittance=one,
            key=state.key[:, index],
        )
        worker.search.light(here, n)
        taken = kernels.state.take(here, np.arange(n), ("transmittance", "blocked"))
        arrived = taken["transmittance"] if "transmittance" in taken else (taken["blocked"] == 0).float()
        lit = shadow.t_max > 0
        found.add("light", "transmittance", engine.transmittance(shadow)[lit], arrived[lit])


def _first_hits(found: Differences, wave: Wave, kernels: Kernels, pixels: int, samples: int) -> None:
    """Compare whole samples of the first-hit preview, which has no later vertices."""
    tally = RayCounts()
    eager = tensors.weighted_radiance(wave, wave.rays(0, pixels, 0, samples), tally)
    worker = KernelsEngine(kernels)
    took = worker.trace(Chunk(0, pixels, 0, samples))
    assert took.rays == tally.rays
    slots = torch.from_numpy(worker.slots.floats[:, : pixels * samples].copy())
    found.add("first", "radiance", eager.reshape(3, -1), slots)
