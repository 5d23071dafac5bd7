"""Helpers of lowerings: elementwise application with broadcasting, and types.

The nodes of a tensor are a numpy array of node indices, one for each of its elements in one lane
(:class:`torchpt.compiler.tracing.Value`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.graph import DTYPES
from torchpt.compiler.tracing import Tracer

__all__ = ["apply", "cast_all", "type_of"]


#: A function of nodes that adds nodes to the graph and returns the one of the result.
Nodes = Callable[..., int]


def apply(tracer: Tracer, out: Tensor, function: Nodes, *operands: Any) -> None:
    """Set the nodes of ``out``, element by element, to ``function`` of the nodes of the operands.

    The operands are broadcast, as in torch; Python numbers become constants.
    """
    graph = tracer.graph
    arrays = [
        tracer.get(x).nodes if isinstance(x, Tensor) else np.array(_constant_node(graph, x), object) for x in operands
    ]
    shapes = {nodes.shape for nodes in arrays}
    shape = np.broadcast_shapes(*shapes) if len(shapes) > 1 else shapes.pop()
    flat = [(nodes if nodes.shape == shape else np.broadcast_to(nodes, shape)).flat for nodes in arrays]
    result = np.empty(shape, object)
    entries = result.reshape(-1)  # a view
    for k, given in enumerate(zip(*flat, strict=True)):
        entries[k] = function(*given)
    tracer.put(out, result)


def _constant_node(graph: Any, x: float | int | bool) -> int:
    if isinstance(x, bool):
        return graph.constant("b", x)
    return graph.constant("l", x) if isinstance(x, int) else graph.constant("d", x)


def type_of(tracer: Tracer, dtype: torch.dtype, *nodes: int) -> str:
    """Return the node type of a result of ``dtype``: of int64 ``L`` if an operand may need 64 bits, else ``l``."""
    ty = DTYPES[dtype]
    return "L" if ty == "l" and any(tracer.graph.type(node) in "iL" for node in nodes) else ty


def cast_all(tracer: Tracer, nodes: Any, ty: str) -> Any:
    """Cast an array of nodes to a type; ``L`` nodes stay if the type is ``l``."""
    cast = np.empty(nodes.shape, object)
    for entry in np.ndindex(*nodes.shape):
        node = nodes[entry]
        cast[entry] = node if ty == "l" and tracer.graph.type(node) == "L" else tracer.graph.cast(node, ty)
    return cast
