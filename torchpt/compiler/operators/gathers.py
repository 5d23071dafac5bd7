"""Lowerings of table look-ups, binary searches and products with small matrices.

A *table* is a tensor that does not depend on lanes; a look-up at an index that does is a load from memory (node ``gather``,
whose ``extra`` is the number of the table, the numbers of an entry, and the one that is loaded). A look-up in a tensor that
depends on lanes is supported only at the lane's own index, and among a few values of each lane. The letters of node types
(``i``, ``l``, ``L``) are those of :mod:`torchpt.compiler.graph`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.graph import DTYPES, Unsupported
from torchpt.compiler.tracing import Tracer, register_lowering

__all__: list[str] = []


def _look_up(tracer: Tracer, table: Tensor, axis: int, index: int) -> np.ndarray:
    """Return the nodes of entry ``index`` of a table along an axis, in the table's shape without that axis."""
    graph, ty = tracer.graph, DTYPES[table.dtype]
    number = tracer.table(table, axis)
    shape = (*table.shape[:axis], *table.shape[axis + 1 :])  # of an entry
    width = math.prod(shape)
    components = np.empty(shape, object)
    for k, component in enumerate(np.ndindex(*shape)):
        components[component] = graph.node("gather", ty, graph.cast(index, "i"), extra=(number, width, k))
    return components


@register_lowering("index_select")
def _index_select(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor) -> None:
    axis %= table.dim()
    index_nodes = tracer.get(index).nodes.reshape(-1)
    if tracer.is_traced(table):
        return _from_lanes(tracer, out, table, axis, index_nodes)
    if len(index_nodes) == 1:
        nodes = np.expand_dims(_look_up(tracer, table, axis, index_nodes[0]), axis)
    else:  # several look-ups a lane
        nodes = np.stack([_look_up(tracer, table, axis, node) for node in index_nodes], axis)
    tracer.put(out, nodes)


def _from_lanes(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index_nodes: Any) -> None:
    """Lower a look-up in a tensor of lanes, which must be at the lane's own number (node ``iota``)."""
    value = tracer.get(table)
    if value.lane == axis and len(index_nodes) == 1 and tracer.graph.nodes[index_nodes[0]][0] == "iota":
        return tracer.alias(out, table)
    if value.lane is not None and axis != value.lane:  # selects one of a few values of each lane
        raise Unsupported("a look-up in a tensor that depends on lanes")
    raise Unsupported("a look-up in other lanes")


@register_lowering("index")
def _index(tracer: Tracer, out: Tensor, table: Tensor, indices: Any) -> None:
    axes = [axis for axis, index in enumerate(indices) if index is not None]
    if len(axes) == 1:
        return _index_one(tracer, out, table, axes[0], indices[axes[0]])
    if axes != list(range(len(axes))) or tracer.is_traced(table):
        raise Unsupported(f"a look-up by {len(axes)} indices")
    graph, ty = tracer.graph, DTYPES[table.dtype]
    index_nodes: Any = np.broadcast_arrays(*(tracer.get(index).nodes for index in indices[: len(axes)]))
    shape, entry_shape = index_nodes[0].shape, tuple(table.shape[len(axes) :])
    width, number = math.prod(entry_shape), tracer.table(table, axis=None)
    nodes = np.empty((*shape, *entry_shape), object)
    for entry in np.ndindex(*shape):
        # the index of the entry's first number in the flattened table
        first = graph.constant("i", 0)
        for axis, of_axis in enumerate(index_nodes):
            first = graph.binary("mul", "i", first, graph.constant("i", table.shape[axis])) if axis else first
            first = graph.binary("add", "i", first, graph.cast(of_axis[entry], "i"))
        first = graph.binary("mul", "i", first, graph.constant("i", width))
        # The kernel clamps `flat_index`: beyond the table's end it reads the table's last number, for each component.
        for k, component in enumerate(np.ndindex(*entry_shape)):
            flat_index = graph.binary("add", "i", first, graph.constant("i", k))
            nodes[(*entry, *component)] = graph.node("gather", ty, flat_index, extra=(number, 1, 0))
    tracer.put(out, nodes)


def _index_one(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor) -> None:
    """Lower a look-up by one index, whose shape takes the place of the axis."""
    index_nodes = tracer.get(index).nodes
    if tracer.is_traced(table):
        return _from_lanes(tracer, out, table, axis, index_nodes.reshape(-1))
    entries = [_look_up(tracer, table, axis, node) for node in index_nodes.reshape(-1)]
    nodes = np.stack(entries, axis)
    tracer.put(out, nodes.reshape((*nodes.shape[:axis], *index_nodes.shape, *nodes.shape[axis + 1 :])))


@register_lowering("take")
def _take(tracer: Tracer, out: Tensor, table: Tensor, index: Tensor) -> None:
    if tracer.is_traced(table):
        raise Unsupported("a look-up in a tensor that depends on lanes")
    graph, ty, index_nodes = tracer.graph, DTYPES[table.dtype], tracer.get(index).nodes
    number = tracer.table(table, axis=None)
    nodes = np.empty(index_nodes.shape, object)
    for entry in np.ndindex(*index_nodes.shape):
        nodes[entry] = graph.node("gather", ty, graph.cast(index_nodes[entry], "i"), extra=(number, 1, 0))
    tracer.put(out, nodes)


@register_lowering("gather")
def _gather(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor, sparse_grad: bool = False) -> None:
    """Lower the selection of one of a few values of each lane, to a chain of selects."""
    value, rows, graph = tracer.get(table), tracer.get(index).nodes, tracer.graph
    axis %= table.dim()
    if value.lane == axis:
        raise Unsupported("a look-up in other lanes")
    choices = np.moveaxis(value.nodes, axis, 0)
    rows = np.moveaxis(rows, axis, 0)
    nodes = np.empty(rows.shape, object)
    for entry in np.ndindex(*rows.shape):
        row = graph.cast(rows[entry], "i")
        node = choices[(0, *entry[1:])]
        for k in range(1, len(choices)):
            node = graph.select(graph.node("eq", "b", row, graph.constant("i", k)), choices[(k, *entry[1:])], node)
        nodes[entry] = node
    tracer.put(out, np.moveaxis(nodes, 0, axis))


@register_lowering("bucketize")
def _bucketize(
    tracer: Tracer, out: Tensor, values: Tensor, table: Tensor, out_int32: bool = False, right: bool = False
) -> None:
    _searchsorted(tracer, out, table, values, right=right)


@register_lowering("searchsorted")
def _searchsorted(
    tracer: Tracer,
    out: Tensor,
    table: Tensor,
    values: Tensor,
    out_int32: bool = False,
    right: bool = False,
    side: str | None = None,
    sorter: Any = None,
) -> None:
    if tracer.is_traced(table) or table.dim() != 1 or sorter is not None:
        raise Unsupported("a search in a table with more than one axis, a sorter, or lanes")
    graph, ty = tracer.graph, DTYPES[table.dtype]
    right = right or side == "right"
    number, value_nodes = tracer.table(table, axis=None), tracer.get(values).nodes
    nodes = np.empty(value_nodes.shape, object)
    for entry in np.ndindex(*value_nodes.shape):
        value_type = graph.type(value_nodes[entry])
        if value_type != ty and not (ty == "l" and value_type in "il"):
            raise Unsupported("a search for values of another type than the table's")
        nodes[entry] = graph.node("search", "l", value_nodes[entry], extra=(number, ty, right))
    tracer.put(out, nodes)


def _matrix(tracer: Tracer, tensor: Tensor) -> np.ndarray:
    nodes = tracer.get(tensor).nodes
    if nodes.ndim != 2:
        raise Unsupported("a matrix product of tensors with more than two axes")
    return nodes


def _product(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor, start: Tensor | None) -> None:
    """Lower the matrix product ``start + a b``; ``start`` None: 0. Sums are in the order of the rows of ``b``."""
    graph, ty = tracer.graph, "L" if out.dtype == torch.int64 else DTYPES[out.dtype]
    if (tracer.is_traced(a) and tracer.get(a).lane == 1) or (tracer.is_traced(b) and tracer.get(b).lane == 0):
        raise Unsupported("a sum over lanes")
    x, y = _matrix(tracer, a), _matrix(tracer, b)
    lane = tracer.lane_axis(out.shape)
    nodes = np.empty(tracer.inner(out.shape, lane), object)
    begin: Any = None if start is None else np.broadcast_to(tracer.get(start).nodes, nodes.shape)
    for i, j in np.ndindex(*nodes.shape):
        total = None if begin is None else graph.cast(begin[i, j], ty)
        for k in range(x.shape[1]):
            term = graph.binary("mul", ty, graph.cast(x[i, k], ty), graph.cast(y[k, j], ty))
            total = term if total is None else graph.binary("add", ty, total, term)
        nodes[i, j] = graph.constant(ty, 0) if total is None else total
    tracer.put(out, nodes, lane)


@register_lowering("mm", "matmul")
def _mm(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor) -> None:
    _product(tracer, out, a, b, start=None)


@register_lowering("addmm")
def _addmm(tracer: Tracer, out: Tensor, start: Tensor, a: Tensor, b: Tensor, beta: float = 1, alpha: float = 1) -> None:
    if beta != 1 or alpha != 1:
        raise Unsupported("addmm with alpha or beta")
    _product(tracer, out, a, b, start)
