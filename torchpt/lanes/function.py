"""Functions of tensors by lanes as kernels of their own: what tests compare with torch, operator by operator."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchpt.lanes import engine, operators  # noqa: F401  (the operators register how they are lowered)
from torchpt.lanes.engine import Target
from torchpt.lanes.graph import DTYPES
from torchpt.lanes.kernel import HEAD, text
from torchpt.lanes.program import bound
from torchpt.lanes.sinks import Sinks, Store
from torchpt.lanes.stage import TracedStage
from torchpt.lanes.tracing import Tracer, lanes_for

__all__ = ["lanewise"]


def lanewise(
    function: Callable[..., Sequence[Tensor]], like: Sequence[Tensor], target: Target | None = None
) -> Callable[..., list[Tensor]]:
    """A function of tensors ``(..., N)``, each result lane made of the arguments' lanes alone, as one loop.

    Args:
        function: gives a sequence of tensors ``(..., N)``.
        like: arguments of the shapes and dtypes to come; N may differ.
        target: machine to compile for; this one where None.

    Raises:
        Unsupported: for what the lane compiler does not know.
    """
    lanes = lanes_for([x[..., 0] for x in like if x.numel()])
    tracer = Tracer(lanes, {})
    given = [_sample(x, lanes) for x in like]
    for slot, x in enumerate(given):
        ty = DTYPES[x.dtype]
        tracer.lane(x, lambda k, slot=slot, ty=ty: tracer.graph.node("tensor", ty, extra=(slot, k)))
    with torch.no_grad(), tracer:
        results = list(function(*given))
    shapes = [tuple(x.shape[:-1]) for x in results]
    stores = [Store(tuple(tracer.nodes(x)), DTYPES[x.dtype]) for x in results]
    stage = TracedStage(tracer.graph, Sinks(store=stores), tracer.tables, tracer.steps, tracer.held, tensors=len(given))
    target = target or engine.host()
    made = engine.compiled(text(stage, target.form), target)
    tables = bound(stage.tables, stage.steps, stage.held, {})

    def run(*arguments: Tensor) -> list[Tensor]:
        inputs = [x.contiguous() for x in arguments]
        count = inputs[0].shape[-1]
        outputs = [torch.empty(*shape, count, dtype=x.dtype) for shape, x in zip(shapes, results, strict=True)]
        words = [0] * len(HEAD)
        words[HEAD.index("tables")] = tables.address
        for x in (*inputs, *outputs):
            words += [x.data_ptr(), count]
        block = (ctypes.c_int64 * len(words))(*words)
        made.call(ctypes.addressof(block), count)
        return outputs

    return run


def _sample(x: Tensor, lanes: int) -> Tensor:
    """An argument's first lanes, repeated as often as it takes."""
    columns = torch.arange(lanes) % max(x.shape[-1], 1)
    if not x.numel():
        return torch.zeros(*x.shape[:-1], lanes, dtype=x.dtype)
    assert math.prod(x.shape)
    return x[..., columns].contiguous()
