"""Programs of a render's stages: each is traced and compiled once for all scenes of one structure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.leaves import Leaves
from torchpt.engines.kernels.packets import kinds_of
from torchpt.engines.kernels.trace import Trace
from torchpt.lanes import operators, programs  # noqa: F401  (the operators register how they are lowered)
from torchpt.lanes.program import Program
from torchpt.lanes.prologue import pruned
from torchpt.lanes.sinks import Sinks
from torchpt.lanes.stage import TracedStage
from torchpt.lanes.tracing import Tracer, lanes_for

__all__ = ["program_of"]


def program_of(
    key: tuple[Any, ...], structure: Any, leaves: Leaves, layout: Layout, build: Callable[[Trace], Sinks], listed: bool
) -> Program:
    """The program of a stage: of this process, from disk, or traced and compiled now.

    Args:
        key: names the stage.
        structure: what else the trace may ask of the render, but for the numbers in its tensors.
        leaves: the tensors.
        layout: of the render.
        build: traces the stage.
        listed: whether the kernel takes lanes by a list.
    """
    return programs.program_of((key, structure), leaves.tensors, lambda: _traced(leaves, layout, build, listed))


def _traced(leaves: Leaves, layout: Layout, build: Callable[[Trace], Sinks], listed: bool) -> TracedStage:
    tracer = Tracer(lanes_for(leaves.tensors.values()), leaves.ids)
    trace = Trace(tracer, layout)
    with torch.no_grad():
        sinks = build(trace)
    tables, steps, guards = pruned(tracer.tables, tracer.steps, tracer.guards)
    searches = any(op in ("nearest", "occluded") for op, *_ in tracer.graph.nodes)
    return TracedStage(
        graph=tracer.graph,
        sinks=sinks,
        tables=tables,
        steps=steps,
        held=tuple(tracer.held),
        guards=guards,
        uniforms=tuple(trace.uniforms),
        tensors=trace.tensors,
        listed=listed,
        searched=kinds_of(layout.world) if searches else None,
        sums=tuple(trace.sums),
    )
