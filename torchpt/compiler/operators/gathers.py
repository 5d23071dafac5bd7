"""How look-ups in tables, searches in sorted ones and products with small matrices are lowered."""

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
    """The nodes of entry ``index`` of a table along an axis: its shape without that axis."""
    graph, ty = tracer.graph, DTYPES[table.dtype]
    number = tracer.table(table, axis)
    lead = (*table.shape[:axis], *table.shape[axis + 1 :])
    width = math.prod(lead)
    entries = np.empty(lead, object)
    for k, entry in enumerate(np.ndindex(*lead)):
        entries[entry] = graph.node("gather", ty, graph.cast(index, "i"), extra=(number, width, k))
    return entries


@register_lowering("index_select")
def _index_select(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor) -> None:
    axis %= table.dim()
    lanes = tracer.get(index)
    rows = lanes.nodes.reshape(-1)
    if tracer.is_traced(table):
        return _from_lanes(tracer, out, table, axis, rows)
    if len(rows) == 1:
        nodes = np.expand_dims(_look_up(tracer, table, axis, rows[0]), axis)
    else:  # several look-ups in every lane, side by side
        nodes = np.stack([_look_up(tracer, table, axis, row) for row in rows], axis)
    tracer.put(out, nodes)


def _from_lanes(tracer: Tracer, out: Tensor, table: Tensor, axis: int, rows: Any) -> None:
    """What depends on lanes may be asked for by the lane's own number alone."""
    value = tracer.get(table)
    if value.lane == axis and len(rows) == 1 and tracer.graph.nodes[rows[0]][0] == "iota":
        return tracer.alias(out, table)
    if value.lane is not None and axis != value.lane:  # of a few numbers in every lane, one by its number
        raise Unsupported("a look-up in what depends on lanes")
    raise Unsupported("a look-up in other lanes")


@register_lowering("index")
def _index(tracer: Tracer, out: Tensor, table: Tensor, indices: Any) -> None:
    axes = [axis for axis, index in enumerate(indices) if index is not None]
    if len(axes) == 1:
        return _index_one(tracer, out, table, axes[0], indices[axes[0]])
    if axes != list(range(len(axes))) or tracer.is_traced(table):
        raise Unsupported(f"a look-up by {len(axes)} indices")
    graph, ty = tracer.graph, DTYPES[table.dtype]
    columns: Any = np.broadcast_arrays(*(tracer.get(index).nodes for index in indices[: len(axes)]))
    rest = tuple(table.shape[len(axes) :])
    width, number = math.prod(rest), tracer.table(table, None)
    nodes = np.empty((*columns[0].shape, *rest), object)
    for entry in np.ndindex(*columns[0].shape):
        place = graph.constant("i", 0)
        for axis, column in enumerate(columns):
            place = graph.binary("mul", "i", place, graph.constant("i", table.shape[axis])) if axis else place
            place = graph.binary("add", "i", place, graph.cast(column[entry], "i"))
        place = graph.binary("mul", "i", place, graph.constant("i", width))
        for k, inner in enumerate(
            np.ndindex(*rest)
        ):  # entries of the table laid flat, where each is brought into range
            one = graph.binary("add", "i", place, graph.constant("i", k))
            nodes[(*entry, *inner)] = graph.node("gather", ty, one, extra=(number, 1, 0))
    tracer.put(out, nodes)


def _index_one(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor) -> None:
    lanes = tracer.get(index).nodes
    if tracer.is_traced(table):
        return _from_lanes(tracer, out, table, axis, lanes.reshape(-1))
    rows = [_look_up(tracer, table, axis, row) for row in lanes.reshape(-1)]
    nodes = np.stack(rows, axis)
    tracer.put(out, nodes.reshape((*nodes.shape[:axis], *lanes.shape, *nodes.shape[axis + 1 :])))


@register_lowering("take")
def _take(tracer: Tracer, out: Tensor, table: Tensor, index: Tensor) -> None:
    if tracer.is_traced(table):
        raise Unsupported("a look-up in what depends on lanes")
    graph, ty, lanes = tracer.graph, DTYPES[table.dtype], tracer.get(index).nodes
    number = tracer.table(table, None)
    nodes = np.empty(lanes.shape, object)
    for entry in np.ndindex(*lanes.shape):
        nodes[entry] = graph.node("gather", ty, graph.cast(lanes[entry], "i"), extra=(number, 1, 0))
    tracer.put(out, nodes)


@register_lowering("gather")
def _gather(tracer: Tracer, out: Tensor, table: Tensor, axis: int, index: Tensor, sparse_grad: bool = False) -> None:
    """One of a few numbers that every lane has: a chain of selections."""
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
        raise Unsupported("a search in what is no single sorted table")
    graph, ty = tracer.graph, DTYPES[table.dtype]
    right = right or side == "right"
    number, lanes = tracer.table(table, None), tracer.get(values).nodes
    nodes = np.empty(lanes.shape, object)
    for entry in np.ndindex(*lanes.shape):
        if graph.type(lanes[entry]) != ty and not (ty == "l" and graph.type(lanes[entry]) in "il"):
            raise Unsupported("a search for numbers of another type than the table's")
        nodes[entry] = graph.node("search", "l", lanes[entry], extra=(number, ty, right))
    tracer.put(out, nodes)


def _matrix(tracer: Tracer, tensor: Tensor) -> np.ndarray:
    nodes = tracer.get(tensor).nodes
    if nodes.ndim != 2:
        raise Unsupported("a product of more than matrices")
    return nodes


def _product(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor, start: Tensor | None) -> None:
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
    _product(tracer, out, a, b, None)


@register_lowering("addmm")
def _addmm(tracer: Tracer, out: Tensor, start: Tensor, a: Tensor, b: Tensor, beta: float = 1, alpha: float = 1) -> None:
    if beta != 1 or alpha != 1:
        raise Unsupported("addmm with factors")
    _product(tracer, out, a, b, start)
