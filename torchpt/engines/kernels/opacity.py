"""Rays through surfaces that are not opaque, as kernels.

Rays of paths: ``sift`` lists those that met such a surface; ``meet`` stops them by chance and sends the others on behind it,
once from the paths' arena and then (``again``) from that of the rays on their way, until none is left. Shadow rays: ``begin``
and ``through`` do the same with the light that is left. The loop around them is :mod:`torchpt.engines.kernels.search`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.engines.kernels.trace import Trace
from torchpt.integrators.search import beyond, opacity_at
from torchpt.lanes.sinks import Note, Pack, Scatter, Sinks
from torchpt.records import World
from torchpt.samplers import Dimension, Draws

__all__ = ["begin", "meet", "non_opaque", "sift", "through"]


def non_opaque(world: World, prim: Tensor) -> Tensor:
    """Which primitives ``(N,)`` may let a ray pass."""
    assert world.materials.opacity is not None
    slot = world.geometry.slot(prim)
    may_pass = torch.index_select(world.materials.opacity, 0, slot) < 1
    if world.textures.opacity is not None:
        may_pass = may_pass | (torch.index_select(world.textures.opacity.nodes, 0, slot) >= 0)
    return may_pass


def sift(trace: Trace) -> Sinks:
    """A list of the rays that met a surface which may let them pass."""
    prim = trace.layout.state.read(trace.tracer, "prim")["prim"]
    with trace.tracer:
        may_pass = non_opaque(trace.layout.world, prim) & (prim >= 0)
    return Sinks(notes=[Note(trace.node(may_pass), 0, 0)])


def meet(trace: Trace, again: bool) -> Sinks:
    """Which rays a surface stops by chance, and where the others go on."""
    layout, tracer = trace.layout, trace.tracer
    salts = trace.salts()
    rows = layout.passed if again else layout.state
    hit = trace.hit(rows)
    key = rows.read(tracer, "key")["key"]
    if again:
        o, d, t_max, before, home = rows.read(tracer, "pass_o", "pass_d", "pass_t", "before", "home").values()
    else:
        o, d, t_max = rows.read(tracer, "o", "d", "t_max").values()
        before, home = None, trace.place()
    with tracer:
        opacity = opacity_at(layout.world, o, d, hit, 1.0)
        met = Draws(layout.plan.sampler, key, salts).one(Dimension.OPACITY) < opacity
        on = ~met
        behind = beyond(layout.world, o, d, hit)
        whole = hit.t if before is None else hit.t + before
    onward = layout.passed.nodes(tracer, pass_o=behind, pass_d=d, pass_t=t_max, before=whole, home=home, key=key)
    sinks = Sinks(pack=[Pack(trace.node(on), tuple(onward), 0)])
    if again:
        stopped = layout.state.nodes(tracer, t=whole, prim=hit.prim, u=hit.u, v=hit.v)
        sinks.scatter.append(Scatter(trace.node(met), trace.node(home), tuple(stopped), slots=True))
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
    """How much light a surface lets through, and where the shadow rays go on that still carry some."""
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
