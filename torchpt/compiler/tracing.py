"""Trace a stage: run it once on a few lanes and record its operations on one lane as a graph.

A stage computes tensors whose last axis is the *lanes* (one lane a path) from lanes and from *tables*, the tensors of the
scene. Under :class:`Tracer` every tensor that depends on lanes has a graph node for each of its elements in one lane: a ``(3,
N)`` tensor has three. Operators on tables alone are run and recorded as a list of steps (the *prologue*), which are run again
for other tables of the same shapes: a kernel reads tables from memory and does not depend on their values.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from torchpt.compiler.graph import DTYPES, Graph, Unsupported
from torchpt.compiler.prologue import Guard, Source, Step, Table

__all__ = [
    "LANES",
    "LOWERINGS",
    "Tracer",
    "Value",
    "choose_lane_count",
    "register_lowering",
    "tracer_of",
    "tracing",
]

#: Candidates for the number of lanes that a stage is traced on. An axis whose length is a multiple of it is taken for the
#: lanes' axis, so it must divide no axis of a table. Primes, as few tables have such lengths.
LANES = (97, 89, 101, 83, 103, 79, 107, 109, 113, 127)
#: Most elements of a table that become a node each, where a stage computes with a whole table in every lane.
_MOST_ELEMENTS = 4096

#: Operators that fill a new tensor with one number.
_FILLED = frozenset(
    {"full", "full_like", "new_full", "ones", "ones_like", "scalar_tensor", "zeros", "zeros_like", "new_zeros"}
)

#: A function that lowers an operator, see :func:`register_lowering`.
Handler = Callable[..., None]
#: Lowering of each torch operator, by its name without overload.
LOWERINGS: dict[str, Handler] = {}

_PACKAGE = __file__.rpartition("compiler")[0]  # the folder of torchpt
_active: list[Tracer] = []  # tracers that are entered, the innermost last
#: While tracers are entered: whether anomaly detection, which they disable, looked for NaN. Empty where it was off.
_anomaly: list[bool] = []


def register_lowering(*names: str) -> Callable[[Handler], Handler]:
    """Register ``handler(tracer, out, *args, **kwargs)``, which lowers an operator: it sets the nodes of ``out``."""

    def register(handler: Handler) -> Handler:
        for name in names:
            LOWERINGS[name] = handler
        return handler

    return register


def choose_lane_count(tables: Iterable[Tensor]) -> int:
    """Return a number of :data:`LANES` that divides no axis of the tables.

    Raises:
        Unsupported: each of them divides one.
    """
    sizes = {size for table in tables for size in table.shape if size}
    for lanes in LANES:
        if all(size % lanes for size in sizes):
            return lanes
    raise Unsupported("tables whose lengths leave no number of lanes to trace on")


def tracing() -> bool:
    """Return True while this process traces a stage: code must then call tensor operations, not kernels."""
    return bool(_active)


def tracer_of(tensor: Tensor) -> Tracer | None:
    """Return the tracer that traces a tensor; None if no tracer does."""
    return next((tracer for tracer in _active if tracer.is_traced(tensor)), None)


@dataclass(frozen=True)
class Value:
    """The nodes of a traced tensor.

    Attributes:
        nodes: numpy array of node indices (Python integers in an array of objects), of the tensor's shape with the length of
            the lanes' axis divided by the number of lanes: 1 for an ordinary axis of lanes.
        lane: the lanes' axis; None: the tensor is the same for all lanes.
    """

    nodes: Any
    lane: int | None


class Tracer(TorchDispatchMode):
    """A dispatch mode that records the torch operators run under it as a graph.

    Args:
        lanes: number of lanes, of :data:`LANES`.
        leaves: path and tensor of each table, by the tensor's ``id``.

    Attributes:
        graph: the recorded operations.
        uniforms: inputs that are the same for all lanes, in order: type and number of elements.
        tables: tables that the graph reads, in order.
        steps: the prologue.
        guards: values that Python code read from tables while it ran; for other values the trace is not valid.
        constants: tensors that are neither leaves nor results of steps, such as the weights of a network.
    """

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        # If True, torch imports torch._dynamo at the first operator, which takes longer than tracing most stages.
        return False

    def __init__(self, lanes: int, leaves: dict[int, tuple[str, Tensor]]) -> None:
        super().__init__()
        self.lanes = lanes
        self.graph = Graph()
        self.uniforms: list[tuple[str, int]] = []
        self.tables: list[Table] = []
        self.steps: list[Step] = []
        self.guards: list[Guard] = []
        self.constants: list[Tensor] = []
        self._values: dict[int, Value] = {}
        self._sources = {key: Source("leaf", path) for key, (path, _) in leaves.items()}
        self._numbers: dict[Table, int] = {}
        self._reads = _Reads(self)
        self._filled: dict[int, Tensor] = {}  # tables that are one number throughout, by id
        self._keep: list[Any] = [leaves]  # ids stay those of the same tensors as long as these live

    def __enter__(self) -> Tracer:
        _active.append(self)
        # Anomaly detection of autograd reads the values of gradients, which lanes of a trace do not have.
        if torch.is_anomaly_enabled():
            _anomaly.append(torch.is_anomaly_check_nan_enabled())
            torch.set_anomaly_enabled(False)
        self._reads.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        _active.remove(self)
        super().__exit__(*error)
        self._reads.__exit__(*error)
        if _anomaly and not _active:
            torch.set_anomaly_enabled(True, _anomaly.pop())

    # -- inputs and results

    def lane(self, like: Tensor, make: Callable[[int], int]) -> Tensor:
        """Declare ``like (..., lanes)`` as an input and return it; ``make(k)`` returns the node of element k of a lane."""
        lead = like.shape[:-1]
        nodes = np.empty((*lead, 1), object)
        for k, entry in enumerate(np.ndindex(*lead)):
            nodes[(*entry, 0)] = make(k)
        self._keep.append(like)
        self._values[id(like)] = Value(nodes, len(lead))
        return like

    def uniform(self, like: Tensor) -> Tensor:
        """Declare a small tensor as an input that all lanes share and that may differ from call to call, and return it."""
        ty = DTYPES[like.dtype]
        nodes = np.empty(tuple(like.shape), object)
        slot = len(self.uniforms)
        self.uniforms.append((ty, like.numel()))
        for k, entry in enumerate(np.ndindex(*like.shape)):
            nodes[entry] = self.graph.node("uniform", ty, extra=(slot, k))
        self._keep.append(like)
        self._values[id(like)] = Value(nodes, None)
        return like

    def nodes(self, tensor: Tensor) -> list[int]:
        """Return the nodes of a result ``(..., lanes)``, its leading axes flattened."""
        value = self.get(tensor)
        if value.lane is not None and value.nodes.shape[value.lane] != 1:
            raise Unsupported(
                f"a result of shape {tuple(tensor.shape)} with several numbers of a lane along its lanes' axis"
            )
        if value.lane is None and tensor.dim() and tensor.shape[-1] == 1:  # the same number for all lanes
            return [int(node) for node in value.nodes.reshape(-1)]
        if value.lane != tensor.dim() - 1:
            raise Unsupported(f"a result of shape {tuple(tensor.shape)} whose last axis is not the lanes'")
        return [int(node) for node in value.nodes.reshape(-1)]

    # -- for handlers, the functions that lower operators

    def is_traced(self, tensor: Tensor) -> bool:
        """Return True if a tensor depends on lanes or on inputs."""
        return id(tensor) in self._values

    def lane_axis(self, shape: Iterable[int]) -> int | None:
        """Return the lanes' axis of a shape, the one whose length is a multiple of the number of lanes; None without lanes."""
        axes = [axis for axis, size in enumerate(shape) if size and size % self.lanes == 0]
        if len(axes) > 1:
            raise Unsupported(f"a tensor of shape {tuple(shape)} with lanes on two axes")
        return axes[0] if axes else None

    def inner(self, shape: Iterable[int], lane: int | None) -> tuple[int, ...]:
        """Return the shape of the nodes of a tensor: its own, with the length of axis ``lane`` divided by the lanes."""
        return tuple(size // self.lanes if axis == lane else size for axis, size in enumerate(shape))

    def put(self, out: Tensor, nodes: Any, lane: int | None = None) -> None:
        """Set the nodes of ``out``, broadcast to its shape; ``lane``: the lanes' axis, None: found from the shape."""
        nodes = np.asarray(nodes, dtype=object)
        lane = self.lane_axis(out.shape) if lane is None else lane
        shape = self.inner(out.shape, lane)
        if nodes.shape != shape:
            nodes = np.broadcast_to(nodes, shape)
        self._keep.append(out)
        self._values[id(out)] = Value(nodes, lane)

    def alias(self, out: Tensor, tensor: Tensor) -> None:
        """Give ``out`` the nodes of ``tensor``."""
        self._keep.append(out)
        self._values[id(out)] = self.get(tensor)

    def get(self, tensor: Tensor) -> Value:
        """Return the nodes of a tensor; a small table gets a node for each element."""
        value = self._values.get(id(tensor))
        if value is not None:
            return value
        lane = self.lane_axis(tensor.shape)
        if lane is not None:
            return self._expanded_table(tensor, lane)
        if tensor.numel() > _MOST_ELEMENTS:
            raise Unsupported(f"a table of shape {tuple(tensor.shape)} read whole in every lane")
        ty = DTYPES[tensor.dtype]
        # Zeros that autograd makes are constants, so that sums over lanes are found (:mod:`.operators.derivatives`). Stages
        # keep their tables: with constants other products would be fused.
        if self.graph.derivatives and id(tensor) in self._filled:
            constant = self.graph.constant(ty, tensor.reshape(-1)[0].item())
            return Value(np.full(tuple(tensor.shape), constant, object), None)
        table = self.table(tensor, axis=None)
        nodes = np.empty(tuple(tensor.shape), object)
        for k, entry in enumerate(np.ndindex(*tensor.shape)):
            nodes[entry] = self.graph.node("element", ty, extra=(table, k))
        return Value(nodes, None)

    def _expanded_table(self, tensor: Tensor, lane: int) -> Value:
        """Return the nodes of a table that was expanded along the axis ``lane``, with the same value in each lane."""
        first = torch.ops.aten.narrow.default(tensor, lane, 0, 1)
        both_nan = (tensor != tensor) & (first != first)
        if not bool(((tensor == first) | both_nan).all()):
            raise Unsupported("a table as long as the lanes that the stage is traced on")
        self._record(torch.ops.aten.narrow.default, (tensor, lane, 0, 1), {}, first)
        value = Value(self.get(first).nodes, lane)
        self._values[id(tensor)] = value
        self._keep.append(tensor)
        return value

    def source(self, tensor: Tensor) -> Source:
        """Return the origin of a tensor without lanes; an unknown tensor becomes a constant."""
        source = self._sources.get(id(tensor))
        if source is None:
            source = self._sources[id(tensor)] = Source("constants", len(self.constants))
            self.constants.append(tensor)
        return source

    def table(self, tensor: Tensor, axis: int | None) -> int:
        """Return the number of a table in :attr:`tables`, to which it is added if it is new.

        Args:
            tensor: the table.
            axis: the axis that lanes index; in the kernel's memory it is the first one. None: the layout stays.
        """
        table = Table(self.source(tensor), axis)
        if table not in self._numbers:
            self._numbers[table] = len(self.tables)
            self.tables.append(table)
        return self._numbers[table]

    # -- dispatch

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        self.graph.origin = _files_on_stack()
        tensors = [x for x in _flattened((args, kwargs)) if isinstance(x, Tensor)]
        traced = any(id(x) in self._values for x in tensors)
        if name == "_local_scalar_dense":  # tensor.item(), bool(tensor)
            if traced:
                raise Unsupported("a lane's value read by Python")
            out = func(*args, **kwargs)
            self.guards.append(Guard(self.source(args[0]), out))
            return out
        out = func(*_with_valid_indices(name, args) if traced else args, **kwargs)
        if traced:
            handler = LOWERINGS.get(name) if func.namespace == "aten" else None
            if handler is None:
                raise Unsupported(f"the operator {name}")
            try:
                handler(self, out, *args, **kwargs)
            except TypeError as error:  # the handler does not accept these arguments
                raise Unsupported(
                    f"the operator {func} with {', '.join(map(str, kwargs)) or 'these arguments'}"
                ) from error
        elif not tensors and isinstance(out, Tensor) and self.lane_axis(out.shape) is not None:
            self._factory(name, out)
        else:
            self._record(func, args, kwargs, out)
        return out

    def _factory(self, name: str, out: Tensor) -> None:
        """Set the nodes of a tensor with lanes that an operator without tensors made, such as ``torch.zeros``."""
        ty = DTYPES[out.dtype]
        if name == "arange":
            if out.shape[0] != self.lanes or out[0] != 0 or out[1] != 1:
                raise Unsupported("an arange over lanes that does not start at 0 with step 1")
            self.put(out, np.array([self.graph.node("iota", ty)], object))
        elif name in ("full", "ones", "zeros", "scalar_tensor"):
            self.put(out, np.array(self.graph.constant(ty, out.reshape(-1)[0].item()), object))
        else:
            raise Unsupported(f"lanes made by {name}")

    def _record(self, func: Any, args: Any, kwargs: dict[str, Any], out: Any) -> None:
        """Record an operator on tables in the prologue."""

        def with_sources(x: Any) -> Any:
            """Return an argument with the source of each tensor in place of the tensor."""
            if isinstance(x, Tensor):
                return self.source(x)
            return type(x)(with_sources(y) for y in x) if isinstance(x, list | tuple) else x

        if func.overloadpacket.__name__ in _FILLED and out.numel():
            self._filled[id(out)] = out
        if func._schema.is_mutable:
            written = {x.untyped_storage().data_ptr() for x in _flattened((args, kwargs)) if isinstance(x, Tensor)}
            kept = self._filled.items()
            self._filled = {k: x for k, x in kept if x.untyped_storage().data_ptr() not in written}
        number = len(self.steps)
        self.steps.append(Step(func, tuple(map(with_sources, args)), {k: with_sources(v) for k, v in kwargs.items()}))
        self._keep.append(out)
        for item, tensor in enumerate(out if isinstance(out, list | tuple) else [out]):
            source = Source("step", number, item if isinstance(out, list | tuple) else -1)
            if isinstance(tensor, Tensor):
                self._sources[id(tensor)] = source
            else:  # a Python number, such as the result of torch.equal
                self.guards.append(Guard(source, tensor))


class _Reads(TorchFunctionMode):
    """A function mode that refuses conversions of traced tensors to Python or numpy that call no operator."""

    def __init__(self, tracer: Tracer) -> None:
        super().__init__()
        self.tracer = tracer

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if getattr(func, "__name__", "") in ("tolist", "numpy", "__array__") and self.tracer.is_traced(args[0]):
            raise Unsupported("lanes' values read by Python")
        return func(*args, **(kwargs or {}))


def _flattened(values: Any) -> Iterable[Any]:
    """Yield the elements of nested lists, tuples and dictionaries."""
    for value in values.values() if isinstance(values, dict) else values:
        if isinstance(value, list | tuple | dict):
            yield from _flattened(value)
        else:
            yield value


def _with_valid_indices(name: str, args: Any) -> Any:
    """Return the arguments of an operator with its indices clamped to the table.

    Values of lanes are meaningless in a trace, so an index may be out of range, which torch would refuse.
    """
    if name == "index_select":
        table, axis, index = args
        return table, axis, index.clamp(0, max(table.shape[axis] - 1, 0))
    if name == "take":
        return args[0], args[1].clamp(0, max(args[0].numel() - 1, 0))
    if name == "gather":
        return args[0], args[1], args[2].clamp(0, max(args[0].shape[args[1]] - 1, 0)), *args[3:]
    if name == "index":
        table, indices = args
        if any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in indices):
            raise Unsupported("a look-up by a boolean mask")
        sizes = table.shape
        return table, [None if i is None else i.clamp(0, max(sizes[k] - 1, 0)) for k, i in enumerate(indices)]
    return args


def _files_on_stack() -> tuple[str, ...]:
    """Return the package's files on the stack, innermost first, without those of the lane compiler."""
    files: dict[str, None] = {}
    frame: Any = sys._getframe(2)  # the caller of __torch_dispatch__
    while frame is not None:
        name = _file_of_package(frame.f_code.co_filename)
        if name:
            files[name] = None
        frame = frame.f_back
    return tuple(files)


@functools.cache
def _file_of_package(path: str) -> str:
    """Return the path of a file of the package within it; empty for other files, and for those of the lane compiler."""
    name = path.removeprefix(_PACKAGE)
    return "" if name == path or name.startswith("compiler") else name
