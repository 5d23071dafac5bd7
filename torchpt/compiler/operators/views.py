"""Lowerings of views and other rearrangements, which cost nothing in a kernel: they rearrange the nodes of tensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from torch import Tensor

from torchpt.compiler.graph import DTYPES, Unsupported
from torchpt.compiler.operators.nodes import cast_all
from torchpt.compiler.tracing import Tracer, register_lowering

__all__: list[str] = []

#: The end of a slice is open if it is beyond this: torch writes an open end as the largest int64.
OPEN_END = 1 << 40


@register_lowering("detach", "alias", "clone", "contiguous", "lift_fresh")
def _same(tracer: Tracer, out: Tensor, a: Tensor, *_: Any, **__: Any) -> None:
    tracer.alias(out, a)


@register_lowering("select")
def _select(tracer: Tracer, out: Tensor, a: Tensor, axis: int, index: int) -> None:
    value = tracer.get(a)
    if axis % a.dim() == value.lane:
        raise Unsupported("the selection of one lane")
    tracer.put(out, np.take(value.nodes, index, axis % a.dim()))


@register_lowering("narrow")
def _narrow(tracer: Tracer, out: Tensor, a: Tensor, axis: int, start: int, length: int) -> None:
    start %= max(a.shape[axis], 1)
    _slice(tracer, out, a, axis, start, start + length)


@register_lowering("slice")
def _slice(
    tracer: Tracer, out: Tensor, a: Tensor, axis: int = 0, start: Any = None, end: Any = None, step: int = 1
) -> None:
    value, axis = tracer.get(a), axis % a.dim()
    if axis == value.lane:
        if out.shape != a.shape:
            raise Unsupported("a slice of the lanes' axis")
        return tracer.alias(out, a)
    selection: list[Any] = [slice(None)] * a.dim()
    selection[axis] = slice(start, None if end is not None and end > OPEN_END else end, step)
    tracer.put(out, value.nodes[tuple(selection)])


@register_lowering("unbind")
def _unbind(tracer: Tracer, out: Any, a: Tensor, axis: int = 0) -> None:
    for k, result in enumerate(out):
        _select(tracer, result, a, axis, k)


@register_lowering("split", "split_with_sizes", "chunk")
def _split(tracer: Tracer, out: Any, a: Tensor, sizes: Any, axis: int = 0) -> None:
    start = 0
    for result in out:
        _slice(tracer, result, a, axis, start, start + result.shape[axis])
        start += result.shape[axis]


@register_lowering("unsqueeze")
def _unsqueeze(tracer: Tracer, out: Tensor, a: Tensor, axis: int) -> None:
    tracer.put(out, np.expand_dims(tracer.get(a).nodes, axis % (a.dim() + 1)))


@register_lowering("squeeze")
def _squeeze(tracer: Tracer, out: Tensor, a: Tensor, axis: Any = None) -> None:
    axes = range(a.dim()) if axis is None else [axis] if isinstance(axis, int) else axis
    removed = tuple(k % a.dim() for k in axes if a.shape[k] == 1)
    tracer.put(out, np.squeeze(tracer.get(a).nodes, removed) if removed else tracer.get(a).nodes)


@register_lowering("permute")
def _permute(tracer: Tracer, out: Tensor, a: Tensor, axes: Any) -> None:
    tracer.put(out, np.transpose(tracer.get(a).nodes, [k % a.dim() for k in axes]))


@register_lowering("t", "numpy_T")
def _t(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    tracer.put(out, tracer.get(a).nodes.T)


@register_lowering("transpose")
def _transpose(tracer: Tracer, out: Tensor, a: Tensor, i: int, j: int) -> None:
    tracer.put(out, np.swapaxes(tracer.get(a).nodes, i, j))


@register_lowering("flip")
def _flip(tracer: Tracer, out: Tensor, a: Tensor, axes: Any) -> None:
    if tracer.get(a).lane in [k % a.dim() for k in axes]:
        raise Unsupported("a flip of the lanes' axis")
    tracer.put(out, np.flip(tracer.get(a).nodes, axes))


@register_lowering("roll")
def _roll(tracer: Tracer, out: Tensor, a: Tensor, shifts: Any, axes: Any = ()) -> None:
    if not axes or tracer.get(a).lane in [k % a.dim() for k in axes]:
        raise Unsupported("a roll along the lanes' axis")
    tracer.put(out, np.roll(tracer.get(a).nodes, shifts, axes))


@register_lowering("expand")
def _expand(tracer: Tracer, out: Tensor, a: Tensor, sizes: Any, implicit: bool = False) -> None:
    tracer.put(out, tracer.get(a).nodes)


@register_lowering("view", "_unsafe_view", "reshape")
def _view(tracer: Tracer, out: Tensor, a: Tensor, sizes: Any) -> None:
    value, lane = tracer.get(a), tracer.lane_axis(out.shape)
    if value.lane is not None and lane is not None:
        # Lanes are contiguous along their axis, so the axes behind it must hold the same number of elements.
        if math.prod(a.shape[value.lane + 1 :]) != math.prod(out.shape[lane + 1 :]):
            raise Unsupported(f"lanes of shape {tuple(a.shape)} mixed into shape {tuple(out.shape)}")
    tracer.put(out, value.nodes.reshape(tracer.inner(out.shape, lane)))


def _cast(tracer: Tracer, tensor: Tensor, out: Tensor) -> np.ndarray:
    """Return the nodes of a tensor, cast to the type of ``out``."""
    return cast_all(tracer, tracer.get(tensor).nodes, DTYPES[out.dtype])


@register_lowering("stack")
def _stack(tracer: Tracer, out: Tensor, tensors: Any, axis: int = 0) -> None:
    parts = np.broadcast_arrays(*(_cast(tracer, tensor, out) for tensor in tensors))
    tracer.put(out, np.stack(parts, axis))


@register_lowering("cat", "concat")
def _cat(tracer: Tracer, out: Tensor, tensors: Any, axis: int = 0) -> None:
    if tracer.lane_axis(out.shape) == axis % out.dim():
        raise Unsupported("a concatenation along the lanes' axis")
    rank = out.dim()
    # torch also accepts empty tensors of one axis among others
    parts = [_cast(tracer, tensor, out) for tensor in tensors if tensor.dim() == rank]
    tracer.put(out, np.concatenate(parts, axis))
