"""Functions that trace kernels: camera rays, packet searches, emission, bounces, transmission, layers, the film.

Each takes a :class:`~torchpt.engines.kernels.layout.Trace`, runs a stage in it with loads and stores around it, and returns its
sinks (stores, appends, counts). :mod:`torchpt.engines.kernels.programs` has a method for each kernel.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpt.compiler.packet import KINDS
from torchpt.compiler.sinks import AppendIndex, Compact, Scatter, Sinks, Store
from torchpt.compiler.tracing import Tracer
from torchpt.engines.kernels.layout import CONNECTION, PHOTON, Trace, path_state, photon_values
from torchpt.paths import layers as aov
from torchpt.paths.integrators.base import check_fields, check_output
from torchpt.paths.photons import photon_of
from torchpt.paths.state import End, PathState, Shadow, Splat, StoredVertex, VertexInput, VertexOutput, no_shadow
from torchpt.paths.store import PARTNER, kept_values, partner_of, vertex_of
from torchpt.paths.transmission import non_opaque, opacity_at, origins_behind
from torchpt.paths.wave import camera_state
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

if TYPE_CHECKING:
    from torchpt.paths.wave import Wave

__all__ = [
    "CHUNK_FIELDS",
    "accumulate",
    "attenuate_shadow_rays",
    "begin_shadow_rays",
    "bounce",
    "connect",
    "emit",
    "escape",
    "generate",
    "kinds_of",
    "layers",
    "list_ends",
    "list_transmitting",
    "nearest",
    "occluded",
    "samples_of_lanes",
    "search_nearest",
    "search_occluded",
    "search_words",
    "sort_lanes",
    "terminate",
    "transmit",
]

#: Mask of a :class:`~torchpt.compiler.sinks.Scatter` that stores in every lane.
_ALL_LANES = -1


# ---- The search of few primitives inside kernels: each ray of a packet against every primitive
#
# Node types are letters, see :mod:`torchpt.compiler.graph`. ``nearest`` nodes have the type ``S``: a tuple of t, prim, u and v,
# which ``part`` nodes read by their position.


def nearest(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> Hit:
    """Return the nearest hits of rays ``o, d (3, N)`` within ``t_max (N,)``, found inside the kernel."""
    graph = tracer.graph
    hits = graph.node("nearest", "S", *_ray(tracer, o, d, t_max))

    def part(position: int, dtype: torch.dtype, ty: str) -> Tensor:
        """Return one of t, prim, u, v as a traced tensor."""
        node = graph.node("part", ty, hits, extra=position)
        return tracer.lane(torch.zeros(tracer.lanes, dtype=dtype), lambda _: node)

    t, prim = part(0, torch.float32, "f"), part(1, torch.int64, "l")
    u, v = part(2, torch.float32, "f"), part(3, torch.float32, "f")
    return Hit(t, prim, u, v)


def occluded(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
    """Return True ``(N,)`` for shadow rays that are blocked."""
    node = tracer.graph.node("occluded", "b", *_ray(tracer, o, d, t_max))
    return tracer.lane(torch.zeros(tracer.lanes, dtype=torch.bool), lambda _: node)


def _ray(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> list[int]:
    """Return the seven nodes of rays: ``o``, ``d`` and ``t_max``."""
    return [*tracer.nodes(o), *tracer.nodes(d), *tracer.nodes(t_max)]


# -- kernels that only search


def search_nearest(trace: Trace, passed: bool) -> Sinks:
    """Write the nearest hits of all rays of an arena: of paths, or (``passed``) of rays in transit."""
    rows = trace.layout.passed if passed else trace.layout.state
    names = ("pass_o", "pass_d", "pass_t") if passed else ("o", "d", "t_max")
    hit = nearest(trace.tracer, *rows.read(trace.tracer, *names).values())
    return Sinks(write=rows.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v))


def search_occluded(trace: Trace) -> Sinks:
    """Write 1 for shadow rays that are blocked, else 0."""
    rows, tracer = trace.layout.state, trace.tracer
    blocked = occluded(tracer, *rows.read(tracer, "shadow_o", "shadow_d", "shadow_t").values())
    with tracer:
        zero_or_one = blocked.to(torch.int32)
    return Sinks(write=rows.nodes(tracer, blocked=zero_or_one))


# -- arguments of the search


def kinds_of(world: World) -> tuple[str, ...]:
    """Return the kinds of primitives that the scene has, among those that packets can search."""
    return tuple(kind for kind, count in zip(KINDS, world.geometry.counts, strict=False) if count)


def search_words(wave: Wave) -> Any:
    """Return the argument of the functions of :class:`torchpt.compiler.packet.PacketSearch`."""
    accel: Any = wave.accel
    return accel.words


# ---- Kernels of a vertex: camera rays, emission, the bounce, ends of paths
#
# Each function traces one stage of :mod:`torchpt.paths.vertex` with the loads and stores around it.


#: Integers that identify the samples of a chunk. ``first, pixels``: first pixel and number of pixels. ``turn, point``: position
#: of the first sample, its randomization (counted from ``stream``) and its index in the point sequence. ``stream, streams``:
#: first of the randomizations that share the samples of a pixel, and their number. Samples go to them in turn. ``x, y, crop``:
#: corner and width of the crop on the film, in pixels. ``film``: width of the film.
CHUNK_FIELDS = ("first", "pixels", "turn", "point", "stream", "streams", "x", "y", "crop", "film")


def generate(trace: Trace, chosen: bool, given: bool) -> Sinks:
    """Write the first rays of paths, and their hits if the search is part of the stages.

    ``chosen``: True: row ``prim`` of the source arena has the indices of the pixels; False: they are consecutive. ``given``:
    True: its rows ``o`` and ``d`` have the rays; False: they are camera rays.
    """
    layout, tracer, wave = trace.layout, trace.tracer, trace.layout.wave
    pixels = layout.state.read(tracer, "prim")["prim"] if chosen else None
    rays = layout.state.read(tracer, "o", "d") if given else {}
    salts = trace.salts()
    x, y, key = samples_of_lanes(trace, pixels)
    passthrough: dict[str, Tensor] = {}
    with tracer:
        if given:
            state = camera_state(rays["o"], rays["d"], key)
        else:
            state = wave.generate(x, y, key, salts)
        if wave.filter.signed:
            passthrough["weight"] = wave.filter.weight(Draws(layout.plan.sampler, key, salts).two(Dimension.PIXEL))
        state = wave.with_optional_fields(state)
    sinks = Sinks()
    if layout.fused:
        _searched(trace, sinks, state, passthrough)
    else:
        sinks.write += trace.kept(state, passthrough)
    return sinks


def samples_of_lanes(trace: Trace, pixels: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Return column and row of the pixel ``(N,)``, and the random key, of the sample of each lane of a chunk.

    ``pixels``: ``(N,)`` index of the lane's pixel; None: lanes run over the chunk's pixels, then over its samples.
    """
    layout, tracer = trace.layout, trace.tracer
    ones = torch.ones(len(CHUNK_FIELDS), dtype=torch.int32)  # ones: they divide in the trace
    chunk_fields = trace.uniform("place", ones)
    with tracer:
        chunk = dict(zip(CHUNK_FIELDS, chunk_fields.to(torch.int64).unbind(), strict=True))
        lane = torch.arange(tracer.lanes)
        sample = torch.div(lane, chunk["pixels"], rounding_mode="floor")
        pixel = lane - sample * chunk["pixels"] + chunk["first"] if pixels is None else pixels
        row = torch.div(pixel, chunk["crop"], rounding_mode="floor")
        x, y = pixel - row * chunk["crop"] + chunk["x"], row + chunk["y"]
        film_pixel = y * chunk["film"] + x
        # The same randomization and point as in Sampler.key, without the index of the sample, which may exceed 32 bits.
        turn = sample + chunk["turn"]
        group = turn % chunk["streams"] + chunk["stream"]
        point = torch.div(turn, chunk["streams"], rounding_mode="floor") + chunk["point"]
        key = layout.wave.sampler.points.key(layout.numbers, film_pixel, group, point)
        return x.to(layout.plan.dtype), y.to(layout.plan.dtype), key


def sort_lanes(trace: Trace, shadow: bool) -> Sinks:
    """Append lanes to lists by their hits, and end paths that hit nothing, unless the scene has an environment.

    ``shadow``: True: the contributions of the shadow rays from the vertex before are added first.
    """
    tracer, rows = trace.tracer, trace.layout.state
    state, passthrough = trace.state()
    prim = rows.read(tracer, "prim")["prim"]
    sinks = Sinks()
    if shadow:
        shadow_rays = rows.read(tracer, "shadow_radiance", "transmittance", "blocked")
        with tracer:
            light = shadow_rays["shadow_radiance"]
            if "transmittance" in shadow_rays:
                radiance = torch.addcmul(state.radiance, light, shadow_rays["transmittance"])
            else:
                radiance = state.radiance + torch.where(shadow_rays["blocked"] != 0, 0.0, light)
        state = replace(state, radiance=radiance)
        sinks.write += rows.nodes(tracer, radiance=radiance)
    _, appends = trace.sorted(sinks, state, prim, passthrough)
    sinks.appends += appends
    return sinks


def emit(trace: Trace) -> Sinks:
    """Add the emission of emitters that were hit to the radiance of the paths, in place in the arena: these paths go on."""
    tracer, layout = trace.tracer, trace.layout
    context = layout.wave.context.at(trace.salts(), depth=trace.depth())
    state, _ = trace.state()
    hit = trace.hit()
    place = trace.place()
    with tracer:
        radiance = state.radiance + layout.wave.integrator.emit(context, VertexInput(state, hit)).brought
    rows = tuple(layout.state.nodes(tracer, radiance=radiance))
    return Sinks(scatter=[Scatter(_ALL_LANES, trace.node(place), rows)])


def escape(trace: Trace) -> Sinks:
    """Add the radiance of the environment, and end these paths."""
    state, passthrough = trace.state()
    hit, wave = trace.hit(), trace.layout.wave
    context = wave.context.at(trace.salts(), depth=trace.depth())
    with trace.tracer:
        radiance = state.radiance + wave.integrator.escape(context, VertexInput(state, hit)).brought
    return Sinks(scatter=[trace.ended(_ALL_LANES, state.lane, radiance, passthrough)])


def terminate(trace: Trace) -> Sinks:
    """End paths at the depth limit."""
    state, passthrough = trace.state()
    return Sinks(scatter=[trace.ended(_ALL_LANES, state.lane, state.radiance, passthrough)])


def bounce(trace: Trace, model: int, roulette: float | None, first: bool = False) -> Sinks:
    """Run the stage of surfaces of one BSDF model, and store the paths that go on.

    ``model``: index of the BSDF model. ``roulette``: see :meth:`torchpt.engines.kernels.layout.Trace.roulette`. ``first``:
    True: at the first vertex of paths that started on lights.
    """
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    state, passthrough = trace.state()
    hit = trace.hit()
    integrator = layout.wave.integrator
    partner = None
    if integrator.connects:
        assert layout.store is not None
        partner = partner_of(layout.store.read(tracer, *PARTNER, place=trace.node(state.lane)))
    photon = None
    if integrator.merges:
        near = layout.state.read(tracer, *PHOTON)
        with tracer:
            photon = photon_of({name.removeprefix("photon_"): value for name, value in near.items()})
    with tracer:
        start_salts = trace.start_salts() if first else None
        context = layout.wave.context.at(
            salts, roulette=trace.roulette(roulette), start_salts=start_salts, depth=trace.depth()
        )
        context = replace(context, merging=trace.merging())
        vertex = VertexInput(state, hit, partner, photon)
        output = layout.wave.bounce(context, model, vertex)
        check_output(integrator, output)
    after, shadow = output.leaving, output.shadow
    if not layout.fused:
        sinks = _with_shadow(trace, after, shadow, output.splat, passthrough)
        if output.kept is not None:
            _keep(trace, sinks, vertex, output.kept)
        if integrator.connects:
            _write_end(trace, sinks, output)
        if integrator.sends_photons:
            with tracer:
                values = photon_values(output)
            sinks.write += layout.state.nodes(tracer, **values)
        return sinks
    sinks = Sinks(shadows=int(shadow is not None))
    if shadow is not None:
        blocked = occluded(tracer, shadow.o, shadow.d, shadow.t_max)
        with tracer:
            radiance = after.radiance + torch.where(blocked, 0.0, shadow.radiance)
        after = replace(after, radiance=radiance)
    _searched(trace, sinks, after, passthrough)
    return sinks


# -- the two ways to store paths that go on


def _searched(trace: Trace, sinks: Sinks, state: PathState, passthrough: dict[str, Tensor]) -> None:
    """Search inside the kernel: compact the lanes that go on, end the others; the stores are added to ``sinks``."""
    hit = nearest(trace.tracer, state.o, state.d, state.t_max)
    goes_on, appends = trace.sorted(sinks, state, hit.prim, passthrough)
    rows = trace.kept(state, passthrough)
    rows += trace.layout.state.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v)
    sinks.compact.append(Compact(goes_on, tuple(rows), counter=0, appends=tuple(appends)))


def _with_shadow(
    trace: Trace, state: PathState, shadow: Shadow | None, splat: Splat | None, passthrough: dict[str, Tensor]
) -> Sinks:
    """Search later: store all lanes, with their shadow rays and splats.

    The kernels of the BSDF models write one after another to the same arena, each behind the lanes of those before. The engine
    sets counter 0 to their number, and ``shift=0`` adds it to the indices. Each splat has a shadow ray too, which counts.
    """
    tracer, rows = trace.tracer, trace.layout.state
    sinks = Sinks(
        shift=0, write=trace.kept(state, passthrough), shadows=int(shadow is not None) + int(splat is not None)
    )
    if "shadow_o" not in rows:
        return sinks
    with tracer:
        shadow = no_shadow(state) if shadow is None else shadow
    if "splat_o" in rows:
        if splat is None:
            with tracer:
                no_pixel = torch.full_like(state.lane, -1)
                splat = Splat(no_pixel, no_shadow(state))
        light = splat.light
        sinks.write += rows.nodes(
            tracer,
            splat_pixel=splat.pixel,
            splat_o=light.o,
            splat_d=light.d,
            splat_t=light.t_max,
            splat_radiance=light.radiance,
        )
    sinks.write += rows.nodes(
        tracer,
        shadow_o=shadow.o,
        shadow_d=shadow.d,
        shadow_t=shadow.t_max,
        shadow_radiance=shadow.radiance,
    )
    return sinks


# ---- Kernels of connections: vertices of light paths in the store, and those of camera paths that are connected to them
#
# The store is the slots of these kernels: a column for each sample, and the rows of its blocks below each other. Kernels of
# camera paths see one block of it. ``bounce`` of light paths keeps vertices, and that of camera paths writes their ends of
# connections; ``list_ends`` lists these by the model of the other end, and ``connect`` makes the connections.


def _keep(trace: Trace, sinks: Sinks, vertex: VertexInput, kept: StoredVertex) -> None:
    """Store vertices of light paths in the blocks that they were chosen for; ``count`` in all blocks."""
    tracer, rows = trace.tracer, trace.layout.store
    assert rows is not None
    with tracer:
        values = kept_values(vertex, kept)
    place, counts = trace.node(vertex.state.lane), values.pop("count")
    pairs, count = rows.nodes(tracer, **values), rows.nodes(tracer, count=counts)
    for block, where in enumerate(kept.where):
        first = block * rows.count
        chosen = tuple((first + row, node) for row, node in pairs)
        sinks.scatter.append(Scatter(trace.node(where), place, chosen, slots=True))
        every = tuple((first + row, node) for row, node in count)
        sinks.scatter.append(Scatter(_ALL_LANES, place, every, slots=True))


def _write_end(trace: Trace, sinks: Sinks, output: VertexOutput) -> None:
    """Write the camera paths' ends of connections, and shadow rays of length 0 for those that are not made."""
    tracer, rows, state, end = trace.tracer, trace.layout.state, output.leaving, output.end
    with tracer:
        nothing, no_ray = torch.zeros_like(state.t_max), torch.zeros_like(state.o)
        if end is None:
            no_partner = torch.full_like(state.lane, -1)
            end = End(no_ray, no_ray, no_ray, nothing, nothing, nothing, no_partner)
    values = {f"end_{name}": value for name, value in vars(end).items()}
    sinks.write += rows.nodes(tracer, **values, connection_t=nothing)


def list_ends(trace: Trace) -> Sinks:
    """Append lanes to the lists of the BSDF models that their connections end at."""
    tracer, layout = trace.tracer, trace.layout
    partner = layout.state.read(tracer, "end_partner")["end_partner"]
    with tracer:
        masks = [partner == model for model in range(layout.models)]
    return Sinks(appends=[AppendIndex(trace.node(mask), list=k, counter=k + 1) for k, mask in enumerate(masks)])


def connect(trace: Trace, model: int) -> Sinks:
    """Write the shadow rays of connections with vertices of light paths on BSDF model ``model``, by its index."""
    tracer, layout, wave = trace.tracer, trace.layout, trace.layout.wave
    rows, store = layout.state, layout.store
    assert store is not None
    salts, start_salts = trace.salts(), trace.start_salts()
    lane, place = rows.read(tracer, "lane")["lane"], trace.place()
    ends = rows.read(tracer, *(name for name in CONNECTION if name.startswith("end_")))
    end = End(**{name.removeprefix("end_"): value for name, value in ends.items()})
    values = store.read(tracer, *store.names, place=trace.node(lane))
    with tracer:
        context = wave.context.at(salts, start_salts=start_salts, depth=trace.depth())
        context = replace(context, merging=trace.merging())
        light = wave.integrator.connect(context, model, vertex_of(values), values["depth"], end)
    written = rows.nodes(
        tracer,
        connection_o=light.o,
        connection_d=light.d,
        connection_t=light.t_max,
        connection_radiance=light.radiance,
    )
    return Sinks(scatter=[Scatter(_ALL_LANES, trace.node(place), tuple(written))])


# ---- Kernels of transmission: rays that pass surfaces and media
#
# Rays of paths: ``list_transmitting`` lists the lanes whose hit may let them pass. ``transmit`` stops some of them and moves
# the others behind the surface, first from the arena of the paths, then (``again``) from the arena of the rays in transit,
# until the walk has none left. Shadow rays: ``begin_shadow_rays`` and ``attenuate_shadow_rays`` multiply their transmittance
# surface by surface; the loop around them is in :mod:`torchpt.engines.kernels.searches`.


def list_transmitting(trace: Trace) -> Sinks:
    """Append lanes to the list of rays that the stage ``transmit`` runs for.

    An integrator with its own ``transmit`` (media) gets all live rays, others those whose hit is on a surface that may let
    them pass.
    """
    rows, tracer, layout = trace.layout.state, trace.tracer, trace.layout
    ray = rows.read(tracer, "prim", "t_max")
    with tracer:
        if layout.wave.integrator.has_own_transmit:
            may_pass = ray["t_max"] > 0
        else:
            may_pass = non_opaque(layout.world, ray["prim"]) & (ray["prim"] >= 0)
    return Sinks(appends=[AppendIndex(trace.node(may_pass), list=0, counter=0)])


def transmit(trace: Trace, again: bool) -> Sinks:
    """Stop rays at their hits or move them on; ``again``: True: rays in transit, False: the rays of the list, at first.

    A ray in transit keeps the distance that it has come since its vertex (row ``before``), so that the hit of its path has the
    whole distance, and the lane of its path (row ``home``), which gets that hit. A ray that a medium scatters starts anew: its
    distance is 0, and its path gets the new state.
    """
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    rows = layout.passed if again else layout.state
    hit = trace.hit(rows)
    if again:
        ray = rows.read(tracer, "pass_o", "pass_d", "pass_t", "before", "home", "key")
        o, d, t_max, before, home, key = ray.values()
        path = layout.state.read(tracer, *layout.state.state, place=trace.node(home))
        state = replace(path_state(path), o=o, d=d, t_max=t_max, key=key)
    else:
        state, _ = trace.state()
        before, home = None, trace.place()
    with tracer:
        out = layout.wave.integrator.transmit(layout.wave.context.at(salts), VertexInput(state, hit))
        passes = out.on & (state.t_max > 0) if layout.wave.integrator.has_own_transmit else out.on
        stops = ~passes
        distance = hit.t if before is None else hit.t + before  # from the vertex to this hit
        after, distance_after, scatters = replace(state, o=out.o), distance, None
        if out.state is not None and out.scattered is not None:
            scatters = passes & out.scattered
            scattered_ray = {
                name: torch.where(scatters, getattr(out.state, name), getattr(after, name))
                for name in ("o", "d", "t_max")
            }
            after, distance_after = replace(after, **scattered_ray), torch.where(scatters, 0.0, distance)
    onward = layout.passed.nodes(
        tracer, pass_o=after.o, pass_d=after.d, pass_t=after.t_max, before=distance_after, home=home, key=state.key
    )
    sinks = Sinks(compact=[Compact(trace.node(passes), tuple(onward), counter=0)])
    # The slots of this kernel are the arena of the paths. In the first step a ray that stops has its hit there already.
    if again:
        final_hit = layout.state.nodes(tracer, t=distance, prim=hit.prim, u=hit.u, v=hit.v)
        sinks.scatter.append(Scatter(trace.node(stops), trace.node(home), tuple(final_hit), slots=True))
    if out.state is not None and scatters is not None:
        check_fields(layout.wave.integrator, out.state)
        scattered = tuple(trace.kept(out.state, passthrough={}))
        sinks.scatter.append(Scatter(trace.node(scatters), trace.node(home), scattered, slots=True))
    return sinks


def begin_shadow_rays(trace: Trace) -> Sinks:
    """Start the rays in transit of shadow rays that may pass surfaces; write the transmittance of all others."""
    layout, tracer = trace.layout, trace.tracer
    ray = layout.state.read(tracer, "shadow_o", "shadow_d", "shadow_t", "blocked")
    # Row ``blocked``: 0 free, 1 blocked, 2 only surfaces that may let light pass. Without it, if packets search, every ray with
    # a positive ``t_max`` is traced.
    o, d, t_max = (ray[name] for name in ("shadow_o", "shadow_d", "shadow_t"))
    home = trace.place()
    with tracer:
        one = torch.ones_like(t_max)
        if "blocked" in ray:
            goes_on, is_known = ray["blocked"] == 2, ray["blocked"] != 2
            transmittance = torch.where(ray["blocked"] == 0, one, 0.0)
        else:
            goes_on, is_known, transmittance = t_max > 0, t_max <= 0, one
    onward = layout.passed.nodes(tracer, pass_o=o, pass_d=d, pass_t=t_max, home=home, transmittance=one)
    return _shadow_ray_sinks(trace, goes_on, onward, is_known, home, transmittance)


def attenuate_shadow_rays(trace: Trace) -> Sinks:
    """Multiply the transmittance of shadow rays by that of their hit, and move those on whose transmittance is not 0."""
    layout, tracer = trace.layout, trace.tracer
    hit = trace.hit(layout.passed)
    o, d, t_max, home, transmittance = layout.passed.read(
        tracer, "pass_o", "pass_d", "pass_t", "home", "transmittance"
    ).values()
    with tracer:
        opacity = opacity_at(layout.world, o, d, hit, miss=0.0)
        transmittance = transmittance * (1.0 - opacity)
        goes_on = (hit.prim >= 0) & (opacity < 1)
        is_known = ~goes_on
        behind = origins_behind(layout.world, o, d, hit)
        t_left = (t_max - hit.t).clamp_min(0.0)
    onward = layout.passed.nodes(tracer, pass_o=behind, pass_d=d, pass_t=t_left, home=home, transmittance=transmittance)
    return _shadow_ray_sinks(trace, goes_on, onward, is_known, home, transmittance)


def _shadow_ray_sinks(
    trace: Trace,
    goes_on: Tensor,
    onward: list[tuple[int, int]],
    is_known: Tensor,
    home: Tensor,
    transmittance: Tensor,
) -> Sinks:
    """Compact shadow rays that go on; write the transmittance of the others to the arena of their paths.

    Args:
        trace: the trace.
        goes_on: mask ``(N,)`` of rays that go on.
        onward: rows and nodes of these rays in transit.
        is_known: mask ``(N,)`` of rays whose transmittance is known.
        home: lanes of all rays in the arena of the paths ``(N,)``.
        transmittance: ``(N,)``.
    """
    rows = tuple(trace.layout.state.nodes(trace.tracer, transmittance=transmittance))
    to_paths = Scatter(trace.node(is_known), trace.node(home), rows, slots=True)
    return Sinks(compact=[Compact(trace.node(goes_on), tuple(onward), counter=0)], scatter=[to_paths])


# ---- Kernels of results: layers of first surfaces, and adding samples to the film


def layers(trace: Trace, model: int, names: tuple[str, ...]) -> Sinks:
    """Write the layers ``names`` of first surfaces of one BSDF model to the slots of their samples; ``model``: its index."""
    wave = trace.layout.wave
    state, passthrough = trace.state()
    hit = trace.hit()
    with trace.tracer:
        values = aov.values(names, wave.context, model, state.o, state.d, hit, wave.centre)
        if "weight" in passthrough:
            values = aov.weighted(values, passthrough["weight"])
    nodes = [node for name in names for node in trace.tracer.nodes(values[name])]
    return Sinks(scatter=[Scatter(_ALL_LANES, trace.node(state.lane), tuple(enumerate(nodes)), slots=True)])


def accumulate(trace: Trace, channels: int, clamp: bool) -> Sinks:
    """Add one sample of each pixel to the film's sums; samples that are not finite are counted, and added as black.

    ``clamp``: True: samples are scaled down to the uniform ``clamp`` as :func:`torchpt.paths.wave.clamp_scale` does, and are
    results, too.
    """
    tracer, graph = trace.tracer, trace.tracer.graph
    trace.tensors = 2  # inputs: the samples and the sums
    sample = tracer.lane(
        torch.zeros(channels, tracer.lanes, dtype=torch.float32), lambda k: graph.node("tensor", "f", extra=(0, k))
    )
    total = tracer.lane(
        torch.zeros(channels, tracer.lanes, dtype=torch.float64), lambda k: graph.node("tensor", "d", extra=(1, k))
    )
    limit = trace.uniform("clamp", torch.ones(1, dtype=torch.float32)) if clamp else None
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
    counter = 0
    return Sinks(count=[(trace.node(bad), counter)], store=results)
