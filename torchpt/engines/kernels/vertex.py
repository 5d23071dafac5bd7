"""The vertices of paths as kernels: camera rays, light that is met, the bounce, ends of paths.

Each function traces one stage of :mod:`torchpt.integrators.stages` with the loads and stores around it.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.engines.kernels.packets import nearest, occluded
from torchpt.engines.kernels.trace import Trace
from torchpt.integrators import stages
from torchpt.integrators.base import check_output
from torchpt.integrators.vertex import Splat, VertexInput, no_shadow
from torchpt.integrators.wave import camera_state
from torchpt.lanes.sinks import Pack, Scatter, Sinks
from torchpt.records import PathState, Shadow
from torchpt.samplers import Dimension, Draws

__all__ = ["PLACE", "bounce", "emit", "escape", "generate", "retire", "settle"]

#: Numbers that say which samples a chunk holds: the first pixel of the picture and how many there are; the stream and point
#: of the first sample, the first stream and how many share the samples; the crop's corner and width, the film's width.
PLACE = ("first", "pixels", "turn", "point", "stream", "streams", "x", "y", "crop", "film")


def generate(trace: Trace, chosen: bool, given: bool) -> Sinks:
    """Rays that paths begin with; with their first hits where the search is inside.

    Row ``prim`` holds the numbers of ``chosen`` pixels; rows ``o`` and ``d`` hold rays that are ``given`` in place of the
    camera's.
    """
    layout, tracer, wave = trace.layout, trace.tracer, trace.layout.wave
    place = trace.uniform("place", torch.ones(len(PLACE), dtype=torch.int32))
    salts = trace.salts()
    pixels = layout.state.read(tracer, "prim")["prim"] if chosen else torch.empty(0)
    rays = layout.state.read(tracer, "o", "d") if given else {}
    unseen: dict[str, Tensor] = {}
    with tracer:
        chunk = dict(zip(PLACE, place.to(torch.int64).unbind(), strict=True))
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
            state = stages.generate(layout.plan, wave.camera, wave.filter, x, y, key, salts)
        if wave.filter.signed:
            unseen["weight"] = wave.filter.weight(Draws(layout.plan.sampler, key, salts).two(Dimension.PIXEL))
        state = wave.begun(state)
    sinks = Sinks()
    if layout.fused:
        _searched(trace, sinks, state, unseen)
    else:
        sinks.write += trace.kept(state, unseen)
    return sinks


def settle(trace: Trace, shadow: bool) -> Sinks:
    """Settle what the lanes of the arena met: light of their shadow rays, lists of lanes by model, ends of paths."""
    tracer, rows = trace.tracer, trace.layout.state
    state, unseen = trace.state()
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
    _, notes = trace.sorted(sinks, state, prim, unseen)
    sinks.notes += notes
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
    state, unseen = trace.state()
    hit, wave = trace.hit(), trace.layout.wave
    context = wave.context.at(trace.salts())
    with trace.tracer:
        radiance = state.radiance + wave.integrator.escape(context, VertexInput(state, hit)).brought
    return Sinks(scatter=[trace.ended(-1, state.lane, radiance, unseen)])


def retire(trace: Trace) -> Sinks:
    """Ends of paths that are cut."""
    state, unseen = trace.state()
    return Sinks(scatter=[trace.ended(-1, state.lane, state.radiance, unseen)])


def bounce(trace: Trace, model: int, roulette: float) -> Sinks:
    """One vertex of the paths on surfaces of a model."""
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    state, unseen = trace.state()
    hit = trace.hit()
    with tracer:
        context = layout.wave.context.at(salts, roulette=roulette)
        output = layout.wave.bounce(context, model, VertexInput(state, hit))
        check_output(layout.wave.integrator, output)
    after, shadow = output.leaving, output.shadow
    if not layout.fused:
        return _with_shadow(trace, after, shadow, output.splat, unseen)
    sinks = Sinks(shadows=int(shadow is not None))
    if shadow is not None:
        blocked = occluded(tracer, shadow.o, shadow.d, shadow.t_max)
        with tracer:
            radiance = after.radiance + torch.where(blocked, 0.0, shadow.radiance)
        after = replace(after, radiance=radiance)
    _searched(trace, sinks, after, unseen)
    return sinks


# -- the two ways in which lanes go on


def _searched(trace: Trace, sinks: Sinks, state: PathState, unseen: dict[str, Tensor]) -> None:
    """Search inside the kernel: the lanes that go on are packed together, the others end."""
    hit = nearest(trace.tracer, state.o, state.d, state.t_max)
    on, notes = trace.sorted(sinks, state, hit.prim, unseen)
    rows = trace.kept(state, unseen)
    rows += trace.layout.state.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v)
    sinks.pack.append(Pack(on, tuple(rows), 0, tuple(notes)))


def _with_shadow(
    trace: Trace, state: PathState, shadow: Shadow | None, splat: Splat | None, unseen: dict[str, Tensor]
) -> Sinks:
    """Search later: all lanes are kept, with the shadow rays that are still to be searched."""
    tracer, rows = trace.tracer, trace.layout.state
    sinks = Sinks(shift=0, write=trace.kept(state, unseen), shadows=int(shadow is not None) + int(splat is not None))
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
