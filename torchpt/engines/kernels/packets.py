"""The search for few primitives, inside of kernels: each ray of a packet against every primitive."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpt.engines.kernels.trace import Trace
from torchpt.lanes.packet import KINDS
from torchpt.lanes.sinks import Sinks
from torchpt.lanes.tracing import Tracer
from torchpt.records import Hit, World

if TYPE_CHECKING:
    from torchpt.integrators.wave import Wave

__all__ = ["block", "find", "kinds_of", "nearest", "occluded", "search_words"]


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


def find(trace: Trace, passed: bool) -> Sinks:
    """The nearest hits of all rays of an arena: of paths, or (``passed``) of rays that pass surfaces."""
    rows = trace.layout.passed if passed else trace.layout.state
    names = ("pass_o", "pass_d", "pass_t") if passed else ("o", "d", "t_max")
    hit = nearest(trace.tracer, *rows.read(trace.tracer, *names).values())
    return Sinks(write=rows.nodes(trace.tracer, t=hit.t, prim=hit.prim, u=hit.u, v=hit.v))


def block(trace: Trace) -> Sinks:
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
    """Return the argument of :func:`torchpt.lanes.packet.packet_search`."""
    accel: Any = wave.accel
    return accel.words
