"""The engine of tensor operations: any device, float32 or float64, with or without autograd, models of any kind.

It is the readable reference for kernels. A *wave* is a range of pixels and samples whose paths are traced together, one path a
*lane*; :func:`torchpt.paths.walk.walk` calls the methods of the engine in their order along a path. Each method is a few
operations on all lanes, or a stage (:mod:`torchpt.paths.vertex`) on some of the lanes.

N is the number of samples of a wave, n that of the lanes at hand: ended paths leave the population, so lanes move, and
``PathState.lane`` says which sample a path belongs to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from torchpt.core.tree import map_leaves
from torchpt.math.vectors import concatenate_lanes, rows, take
from torchpt.paths import layers as aov
from torchpt.paths.integrators.base import TO_FIRST_SURFACE, check_fields, check_output
from torchpt.paths.integrators.path import Ends, follows_ray, partition
from torchpt.paths.layers import LAYERS
from torchpt.paths.photons import PhotonMap
from torchpt.paths.state import Emission, End, PathState, Photon, Shadow, Splat, StageContext, VertexInput, VertexOutput
from torchpt.paths.store import VertexStore, partner_of, vertex_of
from torchpt.paths.transmission import non_opaque, opacity_at, origins_behind
from torchpt.paths.walk import Counts, Observer, find_hits, walk
from torchpt.paths.wave import PixelSet, RayCounts, Wave
from torchpt.physics.film.splats import LARGEST, Splats
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit

__all__ = ["Paths", "TensorsEngine", "hits", "layers", "radiance", "seen", "trace", "weighted_radiance"]

#: Value of `Paths.ends` before lanes are sorted.
_UNSORTED = Ends(torch.empty(0, dtype=torch.int64), torch.empty(0, dtype=torch.int64))


@dataclass
class RaysInTransit:
    """Rays that have passed surfaces, or may pass their next hit.

    Attributes:
        lanes: ``(n,)`` int64, their lanes in the population.
        state: the rays, with origins behind the surfaces that they passed.
        hit: their next hits.
        before: ``(n,)`` distance from the start of the path segment (the vertex, or where a medium scattered the ray) to the
            present origin.
        step: number of steps so far.
    """

    lanes: Tensor
    state: PathState
    hit: Hit
    before: Tensor
    step: int = 0


@dataclass
class Paths:
    """The population of this engine: paths of a wave at a vertex. Lanes are those of the state.

    Attributes:
        state: the paths as they arrive.
        depth: number of the vertex.
        hit: hits of their rays; None: not searched yet.
        in_transit: rays that may still pass their hits; None where everything is opaque.
        ends: lanes that hit an emitter or nothing, once they are sorted.
        groups: index and lanes of each BSDF model that was hit; None before lanes are sorted.
        pending: shadow rays from the vertex before, which are not traced yet: for each BSDF model of that vertex the first lane
            of its paths, and one shadow ray for each of them.
        transmittance: ``(n,)`` of each of ``pending``, once they are traced.
        splats: splats from the vertex before, with the samples ``(n,)`` that they come from.
        splat_transmittance: ``(n,)`` of each of ``splats``, once their shadow rays are traced.
        camera_ends: ends of connections at the vertex before, which are not made yet: for each BSDF model the first lane of its
            paths, the samples ``(n,)``, and an end for each.
        connections: samples ``(n,)``, shadow rays and their transmittance ``(n,)`` of connections that were made.
        emissions: lanes and emission at this vertex, if the engine keeps them.
        outputs: index of the BSDF model, samples ``(n,)`` and stage outputs of the vertex before, if the engine keeps them.
        passed: in a backward engine ``transmittance`` and ``splat_transmittance`` of the shadow rays that leave this vertex.
    """

    state: PathState
    depth: int = 1
    hit: Hit | None = None
    in_transit: RaysInTransit | None = None
    ends: Ends = field(default=_UNSORTED)
    groups: list[tuple[int, Tensor]] | None = None
    pending: list[tuple[int, Shadow]] = field(default_factory=list)
    transmittance: list[Tensor] = field(default_factory=list)
    splats: list[tuple[Tensor, Splat]] = field(default_factory=list)
    splat_transmittance: list[Tensor] = field(default_factory=list)
    camera_ends: list[tuple[int, Tensor, End]] = field(default_factory=list)
    connections: list[tuple[Tensor, Shadow, Tensor]] = field(default_factory=list)
    emissions: list[tuple[Tensor, Emission]] = field(default_factory=list)
    outputs: list[tuple[int, Tensor, VertexOutput]] = field(default_factory=list)
    passed: tuple[list[Tensor], list[Tensor]] = field(default_factory=lambda: ([], []))

    @property
    def hits(self) -> Hit:
        """Return the hits, which must be known."""
        assert self.hit is not None
        return self.hit


class TensorsEngine:
    """The engine of tensor operations, for one wave.

    Args:
        wave: stages, acceleration structure and settings.
        lanes: number of camera samples.
        tally: counts rays and truncated paths.
        keeps: True: populations keep stage outputs (``Paths.emissions``, ``Paths.outputs``), for an observer.
        splats: a list to append splats to; None: splats are dropped.
        store: where light paths keep vertices, and camera paths find them; None: paths are not connected.
        photons: of the sample, for camera paths that are merged with them; None: they are not.
        sent: a list to append the photons of light paths to, with lanes ``(n,)`` and points ``(3, n)``; None: they are dropped.

    Attributes:
        radiance: ``(3, lanes)`` radiance of samples whose paths have ended, by sample.
        lost: ``(lanes,)`` bool, True for samples with a splat that is not finite; None: the integrator has no splats.
    """

    def __init__(
        self,
        wave: Wave,
        lanes: int,
        tally: RayCounts | None = None,
        keeps: bool = False,
        splats: list[Splats] | None = None,
        store: VertexStore | None = None,
        photons: PhotonMap | None = None,
        sent: list[tuple[Tensor, Tensor, Photon]] | None = None,
    ) -> None:
        self.keeps, self.store, self.photons, self.sent = keeps, store, photons, sent
        self.wave, self.context, self.tally = wave, wave.context, RayCounts() if tally is None else tally
        self.plan, self.world = wave.context.plan, wave.context.world
        self.has_transmission = self.world.materials.opacity is not None or wave.integrator.has_own_transmit
        self.splats = splats
        self._clear(lanes)

    def _clear(self, lanes: int) -> None:
        """Set the radiance of ``lanes`` samples to zero."""
        self.radiance = torch.zeros(3, lanes, dtype=self.plan.dtype, device=self.wave.centre.device)
        self.lost = (
            torch.zeros_like(self.radiance[0], dtype=torch.bool) if self.wave.integrator.splats_at_surfaces else None
        )

    def spawn(self, state: PathState) -> Paths:
        """Return the population of paths that start with rays."""
        return Paths(self.wave.with_optional_fields(state))

    def intersect(self, paths: Paths) -> bool:
        """See :class:`torchpt.paths.walk.Engine`."""
        self.tally.rays += len(paths.state.lane)
        if paths.hit is None:
            state = paths.state
            paths.hit = self._nearest(state.o, state.d, state.t_max)
            if self.has_transmission:
                lanes = self._may_transmit(state, paths.hit)
                before = torch.zeros_like(take(state.t_max, lanes))
                paths.in_transit = RaysInTransit(lanes, rows(state, lanes), rows(paths.hit, lanes), before)
        return paths.in_transit is not None

    def _nearest(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hit:
        """Return the nearest hits, opaque or not."""
        t, prim, u, v = self.wave.accel.intersect(o.detach(), d.detach(), t_max)
        return Hit(t.to(self.plan.dtype), prim.to(torch.int64), u.to(self.plan.dtype), v.to(self.plan.dtype))

    def _may_transmit(self, state: PathState, hit: Hit) -> Tensor:
        """Return the lanes that the stage ``transmit`` runs for."""
        if self.wave.integrator.has_own_transmit:
            may_pass = state.t_max > 0
        else:
            may_pass = (hit.prim >= 0) & non_opaque(self.world, hit.prim)
        return may_pass.nonzero().squeeze(1)

    def transmit(self, paths: Paths) -> bool:
        """See :class:`torchpt.paths.walk.Engine`."""
        in_transit = paths.in_transit
        if in_transit is None or not len(in_transit.lanes):
            return False
        salt = salts(paths.depth, in_transit.lanes.device, in_transit.step)
        out = self.wave.integrator.transmit(self.context.at(salt), VertexInput(in_transit.state, in_transit.hit))
        hit, passing = paths.hits, out.on.nonzero().squeeze(1)  # indices into the rays in transit
        if out.chance is not None:
            chance = torch.ones_like(hit.t) if hit.chance is None else hit.chance
            hit = replace(
                hit, chance=chance.index_copy(0, in_transit.lanes, take(chance, in_transit.lanes) * out.chance)
            )
        # From here on of the rays that pass: their lanes in the population, the rays behind the surface, their distance.
        lanes, state = take(in_transit.lanes, passing), replace(rows(in_transit.state, passing), o=take(out.o, passing))
        before = take(in_transit.before, passing) + take(in_transit.hit.t, passing)
        if out.state is not None and out.scattered is not None:  # in a medium: those paths go on with a new state
            scattered, new_state = take(out.scattered, passing), rows(out.state, passing)
            state = map_leaves(lambda new, old: torch.where(scattered, new, old), new_state, state)
            before = torch.where(scattered, 0.0, before)
            index = scattered.nonzero().squeeze(1)
            scattered_lanes, new_state = take(lanes, index), rows(new_state, index)
            check_fields(self.wave.integrator, new_state)
            paths.state = map_leaves(lambda old, new: old.index_copy(-1, scattered_lanes, new), paths.state, new_state)
        behind = self._nearest(state.o, state.d, state.t_max)
        # Distances are counted from the start of the segment; the offset across a surface is below their rounding error.
        values = {"t": behind.t + before, "prim": behind.prim, "u": behind.u, "v": behind.v}
        paths.hit = replace(hit, **{name: getattr(hit, name).index_copy(0, lanes, x) for name, x in values.items()})
        again = self._may_transmit(state, behind)
        state = rows(state, again)
        lanes, before = take(lanes, again), take(before, again)
        paths.in_transit = RaysInTransit(lanes, state, rows(behind, again), before, in_transit.step + 1)
        return True

    def hits(self, state: PathState, depth: int) -> Hit:
        """Return the hits of rays on their way to a vertex, behind all surfaces that they pass; the rays are not counted."""
        paths = Paths(state, depth)
        find_hits(TensorsEngine(self.wave, lanes=0), paths)  # another engine, so that this one counts no rays
        return paths.hits

    def sort(self, paths: Paths) -> Counts:
        """See :class:`torchpt.paths.walk.Engine`. Needs one sort of small keys and one transfer of the counts."""
        paths.ends, paths.groups = partition(self.world, paths.hits)
        return Counts([len(index) for _, index in paths.groups], len(paths.ends.emissive), len(paths.ends.missed))

    def emit(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        if self.world.lights is not None:
            self._gather(paths, paths.ends.emissive, self.wave.integrator.emit)

    def escape(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        if self.world.lights is not None and self.world.lights.environment is not None:
            self._gather(paths, escaped(self.wave, paths.state, paths.ends), self.wave.integrator.escape)
        self._end(paths, paths.ends.missed)

    def _gather(self, paths: Paths, index: Tensor, stage: Callable[[StageContext, VertexInput], Emission]) -> None:
        """Run an emission stage on the lanes ``index`` and add the contributions to the radiance of their paths."""
        emission = stage(self._context(paths), self._input(paths, index))
        paths.state.radiance.scatter_add_(1, index.expand(3, -1), emission.brought)
        if self.keeps:
            paths.emissions.append((index, emission))

    def _context(self, paths: Paths, roulette: float = 0.0) -> StageContext:
        """Return the stage context of a vertex."""
        follow_ray = follows_ray(self.plan, self.world, paths.depth)
        salt = salts(paths.depth, paths.state.lane.device)
        search = partial(self.hits, depth=paths.depth + 1)
        start_salts = self.wave.integrator.start_salts(paths.depth, paths.state.lane.device)
        return self.context.at(salt, follow_ray, roulette, search, start_salts, paths.depth)

    def _input(self, paths: Paths, index: Tensor) -> VertexInput:
        return VertexInput(rows(paths.state, index), rows(paths.hits, index))

    def _with_light_paths(self, vertex: VertexInput, depth: int) -> VertexInput:
        """Return the input of the stage of surfaces, with what these may be connected to and merged with."""
        state = vertex.state
        if self.store is not None and self.wave.integrator.connects:
            values = self.store.read(state.lane, depth)
            vertex = vertex if values is None else replace(vertex, partner=partner_of(values))
        if self.photons is not None and self.wave.integrator.merges:
            p = state.o + state.d * vertex.hit.t
            vertex = replace(vertex, photon=self.photons.photons(p, state.key, depth))
        return vertex

    def scatter(self, paths: Paths, roulette: float) -> Paths:
        """See :class:`torchpt.paths.walk.Engine`."""
        assert paths.groups is not None
        context, bounce = self._context(paths, roulette), self.wave.bounce
        leaving: list[PathState] = []
        next_hit: list[Hit] = []
        after = Paths(paths.state, paths.depth + 1)
        start = 0  # the first lane, in the new population, of the paths of a model
        for model, index in paths.groups:
            vertex = self._with_light_paths(self._input(paths, index), paths.depth)
            output = bounce(context, model, vertex)
            check_output(self.wave.integrator, output)
            leaving.append(output.leaving)
            if output.next_hit is not None:
                next_hit.append(output.next_hit)
            if output.shadow is not None:
                after.pending.append((start, output.shadow))
                self.tally.rays += len(index)
            if output.splat is not None:
                after.splats.append((take(paths.state.lane, index), output.splat))
                self.tally.rays += len(index)
            if output.kept is not None and self.store is not None:
                self.store.keep(vertex.state.lane, vertex, output.kept)
            if output.photon is not None and self.sent is not None:
                self.sent.append((vertex.state.lane, output.at.p, output.photon))
            if output.end is not None:
                after.camera_ends.append((start, vertex.state.lane, output.end))
            if self.keeps:
                after.outputs.append((model, take(paths.state.lane, index), output))
            start += len(index)
        after.state = concatenate_lanes(leaving)
        after.hit = concatenate_lanes(next_hit) if next_hit else None
        return after

    def occlude(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        if paths.camera_ends:
            self._connect(paths)
        # The radiance of all lanes is put together of lanes with a shadow ray and of those between, which stay as they are.
        radiance = paths.state.radiance
        parts, done = [], 0
        for start, shadow in paths.pending:
            paths.transmittance.append(self.transmittance(shadow))
            end = start + len(shadow.t_max)
            if start > done:
                parts.append(radiance[:, done:start])
            parts.append(torch.addcmul(radiance[:, start:end], shadow.radiance, paths.transmittance[-1]))
            done = end
        if parts:
            if done < radiance.shape[1]:
                parts.append(radiance[:, done:])
            paths.state = replace(paths.state, radiance=parts[0] if len(parts) == 1 else torch.cat(parts, 1))
        paths.pending.clear()
        for lane, splat in paths.splats:
            paths.splat_transmittance.append(self.transmittance(splat.light))
            self._splat(lane, splat, paths.splat_transmittance[-1])

    def _splat(self, lane: Tensor, splat: Splat, transmittance: Tensor) -> None:
        """Record splats that reach the film. One that is not finite is left out and makes its sample NaN.

        Args:
            lane: ``(n,)`` the samples that the splats come from.
            splat: the splats; their pixel is -1 where there is none.
            transmittance: ``(n,)`` of their shadow rays.
        """
        value = splat.light.radiance * transmittance
        finite = (value.detach().abs() < LARGEST).all(0)
        arrives = (splat.pixel >= 0) & (transmittance.detach() != 0)
        assert self.lost is not None
        self.lost = self.lost.index_copy(0, lane, take(self.lost, lane) | (arrives & ~finite))
        if self.splats is not None:
            index = (arrives & finite).nonzero().squeeze(1)
            self.splats.append(Splats(take(lane, index), take(splat.pixel, index), take(value, index)))

    def _connect(self, paths: Paths) -> None:
        """Connect the vertices that ``paths`` have left to those that their light paths keep, and add the light."""
        assert self.store is not None
        depth, radiance = paths.depth - 1, paths.state.radiance
        device = radiance.device
        context = self.context.at(salts(depth, device), start_salts=salts(0, device), depth=depth)
        ends = concatenate_lanes([end for _, _, end in paths.camera_ends])
        samples = torch.cat([sample for _, sample, _ in paths.camera_ends])
        lanes = torch.cat([
            torch.arange(start, start + len(sample), device=device) for start, sample, _ in paths.camera_ends
        ])  # fmt: skip
        for model, kind in enumerate(self.world.materials.models):
            if kind.smooth:
                continue
            index = (ends.partner == model).nonzero().squeeze(1)
            if not len(index):
                continue
            sample, end = take(samples, index), rows(ends, index)
            values = self.store.read(sample, depth)
            assert values is not None
            light = self.wave.integrator.connect(context, model, vertex_of(values), values["depth"], end)
            transmittance = self.transmittance(light)
            self.tally.rays += len(index)
            radiance = radiance.index_add(1, take(lanes, index), light.radiance * transmittance)
            paths.connections.append((sample, light, transmittance))
        paths.state = replace(paths.state, radiance=radiance)
        paths.camera_ends.clear()

    def path_radiance(self) -> Tensor:
        """Return the radiance ``(3, lanes)`` of all samples, once all paths ended; NaN where a splat is not finite."""
        return self.radiance if self.lost is None else torch.where(self.lost, math.nan, self.radiance)

    def transmittance(self, shadow: Shadow) -> Tensor:
        """Return the transmittance of shadow rays ``(n,)``: the product of ``1 - opacity`` over all surfaces that they hit.

        Where all surfaces are opaque it is 0 or 1, by an any-hit search.
        """
        if self.world.materials.opacity is None:
            return (~self.wave.accel.occluded(shadow.o, shadow.d, shadow.t_max)).to(self.plan.dtype)
        transmittance = torch.ones_like(shadow.t_max)
        o, d, t_max = shadow.o, shadow.d, shadow.t_max
        if not self.plan.attached:
            o, d = o.detach(), d.detach()
        lanes = torch.arange(len(t_max), device=t_max.device)
        while len(lanes):
            hit = self._nearest(o, d, t_max)
            opacity = opacity_at(self.world, o, d, hit, miss=0.0)
            transmittance = transmittance.index_copy(0, lanes, take(transmittance, lanes) * (1.0 - opacity))
            passing = ((hit.prim >= 0) & (opacity.detach() < 1)).nonzero().squeeze(1)
            passed, o, d = rows(hit, passing), take(o, passing), take(d, passing)
            lanes, t_max = take(lanes, passing), (take(t_max, passing) - passed.t).clamp_min(0.0)
            if len(lanes):
                o = origins_behind(self.world, o, d, passed)
        return transmittance

    def terminate(self, paths: Paths, truncated: bool) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        if paths.groups is None:  # not sorted: all paths end here
            self._end(paths, index=None)
            return
        for _, index in paths.groups:
            self._end(paths, index)
            if truncated:
                self.tally.truncated += len(index)

    def _end(self, paths: Paths, index: Tensor | None) -> None:
        """End the paths at lanes ``index`` (None: all): store their radiance with their samples."""
        state = paths.state
        if index is None or len(index):
            self.radiance.scatter_(1, take(state.lane, index).expand(3, -1), take(state.radiance, index))


def escaped(wave: Wave, state: PathState, ends: Ends) -> Tensor:
    """Return the lanes that get the radiance of the environment: rays without a hit, except for those that a medium has ended.

    A medium ends a path by setting ``t_max`` to 0.
    """
    index = ends.missed
    return index[take(state.t_max, index) > 0] if wave.integrator.has_own_transmit else index


def trace(
    wave: Wave,
    state: PathState,
    tally: RayCounts | None = None,
    observer: Observer[Paths] | None = None,
    splats: list[Splats] | None = None,
    store: VertexStore | None = None,
    photons: PhotonMap | None = None,
    sent: list[tuple[Tensor, Tensor, Photon]] | None = None,
) -> Tensor:
    """Return the radiance ``(3, N)`` along rays, not weighted by the filter.

    Args:
        wave: of a scene.
        state: camera rays, or rays that start elsewhere; N lanes without radiance.
        tally: counts rays and truncated paths.
        observer: gets the callbacks of the walk; populations then keep stage outputs.
        splats: a list to append splats to; None: splats are dropped.
        store: of the vertices of light paths, see :class:`TensorsEngine`.
        photons: likewise.
        sent: likewise.
    """
    keeps = observer is not None
    engine = TensorsEngine(wave, len(state.lane), tally, keeps, splats, store, photons, sent)
    if len(state.lane):
        walk(engine, engine.spawn(state), wave.integrator.limits, observer)
    return engine.path_radiance()


def hits(wave: Wave, state: PathState) -> Hit:
    """Return the first hits of camera rays, behind all surfaces that they pass."""
    engine = TensorsEngine(wave, lanes=0)
    return engine.hits(engine.spawn(state).state, depth=1)


def weighted_radiance(
    wave: Wave,
    state: PathState,
    tally: RayCounts | None = None,
    observer: Observer[Paths] | None = None,
    splats: list[Splats] | None = None,
    store: VertexStore | None = None,
    photons: PhotonMap | None = None,
) -> Tensor:
    """Return the radiance ``(3, N)`` of camera rays times their filter weights; arguments as for :func:`trace`."""
    samples = trace(wave, state, tally, observer, splats, store, photons)
    # other filters are importance sampled, with weight 1
    return samples * wave.weight(state) if wave.filter.signed else samples


def radiance(
    wave: Wave,
    first_pixel: int,
    pixels: int,
    first_sample: int,
    samples: int,
    pixel_set: PixelSet | None = None,
    splats: list[Splats] | None = None,
) -> Tensor:
    """Return the radiance ``(3, samples, pixels)`` of consecutive pixels of a pixel set, weighted by the filter."""
    state = wave.rays(first_pixel, pixels, first_sample, samples, pixel_set)
    return weighted_radiance(wave, state, splats=splats).view(3, samples, pixels)


class _Layers(Observer[Paths]):
    """Evaluates layers (AOVs) of first surfaces, and ends the walk there.

    Attributes:
        values: the layers by name, each ``(C, N)``; 0 where a ray hits nothing.
    """

    def __init__(self, wave: Wave, names: tuple[str, ...], *, follow_ray: bool) -> None:
        self.names, self.context, self.centre = names, replace(wave.context, follow_ray=follow_ray), wave.centre
        self.values: dict[str, Tensor] = {}

    def on_sorted(self, paths: Paths, counts: Counts) -> bool:
        """See :class:`Observer`."""
        state, hit = paths.state, paths.hits
        self.values = {k: state.d.new_zeros(len(LAYERS[k].channels), len(state.lane)) for k in self.names}
        for model, index in paths.groups or ():
            o, d = take(state.o, index), take(state.d, index)
            of_model = aov.values(self.names, self.context, model, o, d, rows(hit, index), self.centre)
            for name, value in of_model.items():
                self.values[name].scatter_(1, index.expand(len(value), -1), value)
        return True


def seen(wave: Wave, names: tuple[str, ...], state: PathState, follow_ray: bool = False) -> dict[str, Tensor]:
    """Return the layers ``names`` of the first hits of camera rays, each ``(C, N)``; 0 where a ray hits nothing.

    They are not weighted by the filter. ``follow_ray``: True: points are intersected anew along their rays, for derivatives.
    """
    engine, observer = TensorsEngine(wave, len(state.lane)), _Layers(wave, names, follow_ray=follow_ray)
    walk(engine, engine.spawn(state), TO_FIRST_SURFACE, observer)
    return observer.values


def layers(
    wave: Wave,
    names: tuple[str, ...],
    first_pixel: int,
    pixels: int,
    first_sample: int,
    samples: int,
    pixel_set: PixelSet | None = None,
    follow_ray: bool = False,
) -> dict[str, Tensor]:
    """Return the layers ``names`` of consecutive pixels, each ``(C, samples, pixels)``, weighted by the filter."""
    state = wave.rays(first_pixel, pixels, first_sample, samples, pixel_set)
    values = seen(wave, names, state, follow_ray=follow_ray)
    if wave.filter.signed:
        values = aov.weighted(values, wave.weight(state))
    return {name: value.view(-1, samples, pixels) for name, value in values.items()}
