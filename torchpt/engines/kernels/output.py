"""What leaves a chunk, as kernels: layers of first surfaces, and samples added to the film."""

from __future__ import annotations

import torch

from torchpt.engines.kernels.trace import Trace
from torchpt.lanes.sinks import Scatter, Sinks, Store

__all__ = ["deposit", "layers"]


def layers(trace: Trace, model: int, names: tuple[str, ...]) -> Sinks:
    """Write what the first surfaces of a model are."""
    from torchpt.integrators import aov

    wave = trace.layout.wave
    state, unseen = trace.state()
    hit = trace.hit()
    with trace.tracer:
        values = aov.values(names, wave.context, model, state.o, state.d, hit, wave.centre)
        if "weight" in unseen:
            values = aov.weighted(values, unseen["weight"])
    nodes = [node for name in names for node in trace.tracer.nodes(values[name])]
    return Sinks(scatter=[Scatter(-1, trace.node(state.lane), tuple(enumerate(nodes)), slots=True)])


def deposit(trace: Trace, channels: int, clamp: bool) -> Sinks:
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
