"""The stages of a render as kernels: camera rays, searches by packets, light, bounces, what lets rays pass, the film.

Each function takes a :class:`~torchpt.engines.kernels.layout.Trace`, runs a stage in it with the loads and stores around it,
and returns its sinks. :mod:`torchpt.engines.kernels.programs` says which kernels there are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpt.compiler.packet import KINDS
from torchpt.compiler.sinks import AppendIndex, Compact, Scatter, Sinks, Store
from torchpt.compiler.tracing import Tracer
from torchpt.engines.kernels.layout import Trace, path_state
from torchpt.paths import layers as aov
from torchpt.paths import vertex
from torchpt.paths.integrators.base import check_fields, check_output
from torchpt.paths.state import PathState, Shadow, Splat, VertexInput, no_shadow
from torchpt.paths.transmission import beyond, non_opaque, opacity_at
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
    "emit",
    "escape",
    "generate",
    "kinds_of",
    "layers",
    "list_transmitting",
    "nearest",
    "occluded",
    "search_nearest",
    "search_occluded",
    "search_words",
    "sort_lanes",
    "terminate",
    "transmit",
]


# ---- The search for few primitives, inside of kernels: each ray of a packet against every primitive


def nearest(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> Hit:
    """The nearest hits of rays."""
    graph = tracer.graph
    hits = graph.node("nearest", "S", *_ray(tracer, o, d, t_max))

    def part(number: int, dtype: torch.dtype, ty: str) -> Tensor:
        node = graph.node("part", ty, hits, extra=number)
        return tracer.lane(torch.zeros(tracer.lanes, dtype=dtype), lambda _: node)

    t, prim = part(0, torch.float32, "f"), part(1, torch.int64, "l")
    return Hit(t, prim, part(2, torch.float32, "f"), part(3, torch.float32, "f"))


def occluded(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
    """Return which shadow rays are blocked ``(N,)``."""
    node = tracer.graph.node("occluded", "b", *_ray(tracer, o, d, t_max))
    return tracer.lane(torch.zeros(tracer.lanes, dtype=torch.bool), lambda _: node)


def _ray(tracer: Tracer, o: Tensor, d: Tensor, t_max: Tensor) -> list[int]:
    return [*tracer.nodes(o), *tracer.nodes(d), *tracer.nodes(t_max)]


# -- kernels that do nothing else


def search_nearest(trace: Trace, passed: bool) -> Sinks:
    """The nearest hits of all rays of an arena: of paths, or (``passed``) of rays that pass surfaces."""
    rows = trace.layout.passed if passed else trace.layout.state
    names = ("pass_o", "pass_d", "pass_t") if passed else ("o", "d", "t_max")
    hit = nearest(trace.tracer, *rows.read(trace.tracer, *names).values())
    return Sinks(write=rows.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v))


def search_occluded(trace: Trace) -> Sinks:
    """Write which shadow rays are blocked."""
    rows, tracer = trace.layout.state, trace.tracer
    blocked = occluded(tracer, *rows.read(tracer, "shadow_o", "shadow_d", "shadow_t").values())
    with tracer:
        number = blocked.to(torch.int32)
    return Sinks(write=rows.nodes(tracer, blocked=number))


# -- what the search reads


def kinds_of(world: World) -> tuple[str, ...]:
    """Kinds of primitives that a scene has, of those that packets search."""
    return tuple(kind for kind, count in zip(KINDS, world.geometry.counts, strict=False) if count)


def search_words(wave: Wave) -> Any:
    """Return the argument of :func:`torchpt.compiler.packet.packet_search`."""
    accel: Any = wave.accel
    return accel.words


# ---- The vertices of paths as kernels: camera rays, light that is met, the bounce, ends of paths
#
# Each function traces one stage of :mod:`torchpt.paths.vertex` with the loads and stores around it.


#: Numbers that say which samples a chunk holds: the first pixel of the picture and how many there are; the stream and point
#: of the first sample, the first stream and how many share the samples; the crop's corner and width, the film's width.
CHUNK_FIELDS = ("first", "pixels", "turn", "point", "stream", "streams", "x", "y", "crop", "film")


def generate(trace: Trace, chosen: bool, given: bool) -> Sinks:
    """Rays that paths begin with; with their first hits where the search is inside.

    Row ``prim`` holds the numbers of ``chosen`` pixels; rows ``o`` and ``d`` hold rays that are ``given`` in place of the
    camera's.
    """
    layout, tracer, wave = trace.layout, trace.tracer, trace.layout.wave
    place = trace.uniform("place", torch.ones(len(CHUNK_FIELDS), dtype=torch.int32))
    salts = trace.salts()
    pixels = layout.state.read(tracer, "prim")["prim"] if chosen else torch.empty(0)
    rays = layout.state.read(tracer, "o", "d") if given else {}
    passthrough: dict[str, Tensor] = {}
    with tracer:
        chunk = dict(zip(CHUNK_FIELDS, place.to(torch.int64).unbind(), strict=True))
        # Lanes run over the chunk's pixels, then over its samples.
        lane = torch.arange(tracer.lanes)
        sample = torch.div(lane, chunk["pixels"], rounding_mode="floor")
        pixel = pixels if chosen else lane - sample * chunk["pixels"] + chunk["first"]
        row = torch.div(pixel, chunk["crop"], rounding_mode="floor")
        x, y = pixel - row * chunk["crop"] + chunk["x"], row + chunk["y"]
        number = y * chunk["film"] + x
        turn = sample + chunk["turn"]
        group = turn % chunk["streams"] + chunk["stream"]
        point = torch.div(turn, chunk["streams"], rounding_mode="floor") + chunk["point"]
        key = wave.sampler.points.key(layout.numbers, number, group, point)
        x, y = x.to(layout.plan.dtype), y.to(layout.plan.dtype)
        if given:
            state = camera_state(rays["o"], rays["d"], key)
        else:
            state = vertex.generate(layout.plan, wave.camera, wave.filter, x, y, key, salts)
        if wave.filter.signed:
            passthrough["weight"] = wave.filter.weight(Draws(layout.plan.sampler, key, salts).two(Dimension.PIXEL))
        state = wave.with_optional_fields(state)
    sinks = Sinks()
    if layout.fused:
        _searched(trace, sinks, state, passthrough)
    else:
        sinks.write += trace.kept(state, passthrough)
    return sinks


def sort_lanes(trace: Trace, shadow: bool) -> Sinks:
    """Settle what the lanes of the arena met: light of their shadow rays, lists of lanes by model, ends of paths."""
    tracer, rows = trace.tracer, trace.layout.state
    state, passthrough = trace.state()
    prim = rows.read(tracer, "prim")["prim"]
    sinks = Sinks()
    if shadow:
        arrived = rows.read(tracer, "shadow_radiance", "clear", "blocked")
        with tracer:
            light = arrived["shadow_radiance"]
            if "clear" in arrived:
                radiance = torch.addcmul(state.radiance, light, arrived["clear"])
            else:
                radiance = state.radiance + torch.where(arrived["blocked"] != 0, 0.0, light)
        state = replace(state, radiance=radiance)
        sinks.write += rows.nodes(tracer, radiance=radiance)
    _, appends = trace.sorted(sinks, state, prim, passthrough)
    sinks.appends += appends
    return sinks


def emit(trace: Trace) -> Sinks:
    """Light of emitters that were met, added where the lanes are."""
    tracer, layout = trace.tracer, trace.layout
    context = layout.wave.context.at(trace.salts())
    state, _ = trace.state()
    hit = trace.hit()
    place = trace.place()
    with tracer:
        radiance = state.radiance + layout.wave.integrator.emit(context, VertexInput(state, hit)).brought
    rows = tuple(layout.state.nodes(tracer, radiance=radiance))
    return Sinks(scatter=[Scatter(-1, trace.node(place), rows)])


def escape(trace: Trace) -> Sinks:
    """Light from outside, and the ends of those paths."""
    state, passthrough = trace.state()
    hit, wave = trace.hit(), trace.layout.wave
    context = wave.context.at(trace.salts())
    with trace.tracer:
        radiance = state.radiance + wave.integrator.escape(context, VertexInput(state, hit)).brought
    return Sinks(scatter=[trace.ended(-1, state.lane, radiance, passthrough)])


def terminate(trace: Trace) -> Sinks:
    """Ends of paths that are cut."""
    state, passthrough = trace.state()
    return Sinks(scatter=[trace.ended(-1, state.lane, state.radiance, passthrough)])


def bounce(trace: Trace, model: int, roulette: float) -> Sinks:
    """One vertex of the paths on surfaces of a model."""
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    state, passthrough = trace.state()
    hit = trace.hit()
    with tracer:
        context = layout.wave.context.at(salts, roulette=roulette)
        output = layout.wave.bounce(context, model, VertexInput(state, hit))
        check_output(layout.wave.integrator, output)
    after, shadow = output.leaving, output.shadow
    if not layout.fused:
        return _with_shadow(trace, after, shadow, output.splat, passthrough)
    sinks = Sinks(shadows=int(shadow is not None))
    if shadow is not None:
        blocked = occluded(tracer, shadow.o, shadow.d, shadow.t_max)
        with tracer:
            radiance = after.radiance + torch.where(blocked, 0.0, shadow.radiance)
        after = replace(after, radiance=radiance)
    _searched(trace, sinks, after, passthrough)
    return sinks


# -- the two ways in which lanes go on


def _searched(trace: Trace, sinks: Sinks, state: PathState, passthrough: dict[str, Tensor]) -> None:
    """Search inside the kernel: the lanes that go on are packed together, the others end."""
    hit = nearest(trace.tracer, state.o, state.d, state.t_max)
    on, appends = trace.sorted(sinks, state, hit.prim, passthrough)
    rows = trace.kept(state, passthrough)
    rows += trace.layout.state.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v)
    sinks.compact.append(Compact(on, tuple(rows), 0, tuple(appends)))


def _with_shadow(
    trace: Trace, state: PathState, shadow: Shadow | None, splat: Splat | None, passthrough: dict[str, Tensor]
) -> Sinks:
    """Search later: all lanes are kept, with the shadow rays that are still to be searched."""
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
                splat = Splat(torch.full_like(state.lane, -1), no_shadow(state))
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


# ---- Rays through what lets them pass, as kernels
#
# Rays of paths: ``list_transmitting`` lists those that something may let pass; ``transmit`` holds some up and sends the others on behind it,
# once from the paths' arena and then (``again``) from that of the rays on their way, until the walk has none left. Shadow rays:
# ``begin_shadow_rays`` and ``attenuate_shadow_rays`` do the same with the light that is left; the loop around them is in
# :mod:`torchpt.engines.kernels.engine`.


def list_transmitting(trace: Trace) -> Sinks:
    """A list of the rays that the stage ``transmit`` is asked for."""
    rows, tracer, layout = trace.layout.state, trace.tracer, trace.layout
    given = rows.read(tracer, "prim", "t_max")
    with tracer:
        if layout.wave.integrator.own_transmit:
            held_up = given["t_max"] > 0
        else:
            held_up = non_opaque(layout.world, given["prim"]) & (given["prim"] >= 0)
    return Sinks(appends=[AppendIndex(trace.node(held_up), 0, 0)])


def transmit(trace: Trace, again: bool) -> Sinks:
    """Hold rays up, or send them on; ``again``: those that are on their way."""
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    rows = layout.passed if again else layout.state
    hit = trace.hit(rows)
    if again:
        given = rows.read(tracer, "pass_o", "pass_d", "pass_t", "before", "home", "key")
        o, d, t_max, before, home, key = given.values()
        at_home = layout.state.read(tracer, *layout.state.state, place=trace.node(home))
        state = replace(path_state(at_home), o=o, d=d, t_max=t_max, key=key)
    else:
        state, before, home = trace.state()[0], None, trace.place()
    with tracer:
        out = layout.wave.integrator.transmit(layout.wave.context.at(salts), VertexInput(state, hit))
        on = out.on & (state.t_max > 0) if layout.wave.integrator.own_transmit else out.on
        met = ~on
        whole = hit.t if before is None else hit.t + before
        after, start, turned = replace(state, o=out.o), whole, None
        if out.state is not None and out.scattered is not None:
            turned = on & out.scattered
            ray = {
                name: torch.where(turned, getattr(out.state, name), getattr(after, name))
                for name in ("o", "d", "t_max")
            }
            after, start = replace(after, **ray), torch.where(turned, 0.0, whole)
    onward = layout.passed.nodes(
        tracer, pass_o=after.o, pass_d=after.d, pass_t=after.t_max, before=start, home=home, key=state.key
    )
    sinks = Sinks(compact=[Compact(trace.node(on), tuple(onward), 0)])
    if again:
        stopped = layout.state.nodes(tracer, t=whole, prim=hit.prim, u=hit.u, v=hit.v)
        sinks.scatter.append(Scatter(trace.node(met), trace.node(home), tuple(stopped), slots=True))
    if out.state is not None and turned is not None:
        check_fields(layout.wave.integrator, out.state)
        scattered = tuple(trace.kept(out.state, {}))
        sinks.scatter.append(Scatter(trace.node(turned), trace.node(home), scattered, slots=True))
    return sinks


def begin_shadow_rays(trace: Trace) -> Sinks:
    """Shadow rays that meet what may let light pass become rays that pass surfaces; what is known of the others."""
    layout, tracer = trace.layout, trace.tracer
    ray = layout.state.read(tracer, "shadow_o", "shadow_d", "shadow_t", "blocked")
    o, d, t_max = list(ray.values())[:3]
    home = trace.place()
    with tracer:
        one = torch.ones_like(t_max)
        if "blocked" in ray:
            on, off = ray["blocked"] == 2, ray["blocked"] != 2
            clear = torch.where(ray["blocked"] == 0, one, 0.0)
        else:
            on, off, clear = t_max > 0, t_max <= 0, one
    onward = layout.passed.nodes(tracer, pass_o=o, pass_d=d, pass_t=t_max, home=home, clear=one)
    return _passed(trace, on, onward, off, home, clear)


def attenuate_shadow_rays(trace: Trace) -> Sinks:
    """Let light through a surface in part, and send the shadow rays on that still carry some."""
    layout, tracer = trace.layout, trace.tracer
    hit = trace.hit(layout.passed)
    o, d, t_max, home, clear = layout.passed.read(tracer, "pass_o", "pass_d", "pass_t", "home", "clear").values()
    with tracer:
        opacity = opacity_at(layout.world, o, d, hit, 0.0)
        clear = clear * (1.0 - opacity)
        on = (hit.prim >= 0) & (opacity < 1)
        off = ~on
        behind = beyond(layout.world, o, d, hit)
        rest = (t_max - hit.t).clamp_min(0.0)
    onward = layout.passed.nodes(tracer, pass_o=behind, pass_d=d, pass_t=rest, home=home, clear=clear)
    return _passed(trace, on, onward, off, home, clear)


def _passed(trace: Trace, on: Tensor, onward: list[tuple[int, int]], off: Tensor, home: Tensor, clear: Tensor) -> Sinks:
    """Shadow rays that go on are packed; of those that do not, what is clear goes home to their paths."""
    known = tuple(trace.layout.state.nodes(trace.tracer, clear=clear))
    done = Scatter(trace.node(off), trace.node(home), known, slots=True)
    return Sinks(compact=[Compact(trace.node(on), tuple(onward), 0)], scatter=[done])


# ---- What leaves a chunk, as kernels: layers of first surfaces, and samples added to the film


def layers(trace: Trace, model: int, names: tuple[str, ...]) -> Sinks:
    """Write what the first surfaces of a model are."""
    wave = trace.layout.wave
    state, passthrough = trace.state()
    hit = trace.hit()
    with trace.tracer:
        values = aov.values(names, wave.context, model, state.o, state.d, hit, wave.centre)
        if "weight" in passthrough:
            values = aov.weighted(values, passthrough["weight"])
    nodes = [node for name in names for node in trace.tracer.nodes(values[name])]
    return Sinks(scatter=[Scatter(-1, trace.node(state.lane), tuple(enumerate(nodes)), slots=True)])


def accumulate(trace: Trace, channels: int, clamp: bool) -> Sinks:
    """One sample of each pixel added to sums; those that are not finite are counted, and taken as black."""
    tracer, graph = trace.tracer, trace.tracer.graph
    trace.tensors = 2
    sample = tracer.lane(torch.zeros(channels, tracer.lanes), lambda k: graph.node("tensor", "f", extra=(0, k)))
    total = tracer.lane(
        torch.zeros(channels, tracer.lanes, dtype=torch.float64), lambda k: graph.node("tensor", "d", extra=(1, k))
    )
    limit = trace.uniform("clamp", torch.ones(1)) if clamp else None
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
    return Sinks(count=[(trace.node(bad), 0)], store=results)
