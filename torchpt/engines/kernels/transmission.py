"""Rays through what lets them pass, as kernels.

Rays of paths: ``sift`` lists those that something may let pass; ``transmit`` holds some up and sends the others on behind it,
once from the paths' arena and then (``again``) from that of the rays on their way, until the walk has none left. Shadow rays:
``begin`` and ``through`` do the same with the light that is left; the loop around them is in
:mod:`torchpt.engines.kernels.search`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.engines.kernels.rows import path_state
from torchpt.engines.kernels.trace import Trace
from torchpt.integrators.base import check_fields
from torchpt.integrators.transmission import beyond, non_opaque, opacity_at
from torchpt.integrators.vertex import VertexInput
from torchpt.lanes.sinks import Note, Pack, Scatter, Sinks

__all__ = ["begin", "sift", "through", "transmit"]


def sift(trace: Trace) -> Sinks:
    """A list of the rays that the stage ``transmit`` is asked for."""
    rows, tracer, layout = trace.layout.state, trace.tracer, trace.layout
    given = rows.read(tracer, "prim", "t_max")
    with tracer:
        if layout.wave.integrator.own_transmit:
            held_up = given["t_max"] > 0
        else:
            held_up = non_opaque(layout.world, given["prim"]) & (given["prim"] >= 0)
    return Sinks(notes=[Note(trace.node(held_up), 0, 0)])


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
    sinks = Sinks(pack=[Pack(trace.node(on), tuple(onward), 0)])
    if again:
        stopped = layout.state.nodes(tracer, t=whole, prim=hit.prim, u=hit.u, v=hit.v)
        sinks.scatter.append(Scatter(trace.node(met), trace.node(home), tuple(stopped), slots=True))
    if out.state is not None and turned is not None:
        check_fields(layout.wave.integrator, out.state)
        scattered = tuple(trace.kept(out.state, {}))
        sinks.scatter.append(Scatter(trace.node(turned), trace.node(home), scattered, slots=True))
    return sinks


def begin(trace: Trace) -> Sinks:
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


def through(trace: Trace) -> Sinks:
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
    return Sinks(pack=[Pack(trace.node(on), tuple(onward), 0)], scatter=[done])
