"""Compile functions of tensors that work lane by lane, for calls outside of traced stages.

The lanes are the last axis of tensors. :class:`Lanewise` compiles a function when it is first called with arguments of a
structure, and caches the kernels; :func:`compile_lanewise` compiles a function at once.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler import cache, operators  # noqa: F401  (the operators register how they are lowered)
from torchpt.compiler.graph import DTYPES, Unsupported
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.program import Program, Tables, TracedStage, bind_tables
from torchpt.compiler.prologue import without_unused_steps
from torchpt.compiler.sinks import Sinks, Store
from torchpt.compiler.target import Target
from torchpt.compiler.tracing import Tracer, choose_lane_count, tracing
from torchpt.core.threads import parallel_for, thread_count
from torchpt.core.tree import leaves, signature
from torchpt.native import compile_time

__all__ = ["Lanewise", "compile_lanewise", "trace_lanewise"]

#: Lanes of a block; threads share the work by blocks.
BLOCK = 64
#: Operations times lanes that are worth another thread: about 50 microseconds.
GRAIN = 3_000_000
#: Most structures of arguments for which kernels of one function are kept.
_MOST_STRUCTURES = 32
#: Index of the address of the tables among the words of a kernel's arguments.
_TABLES = WORD["tables"]


class Lanewise:
    """A compiled function of tensors ``(..., N)``, each lane of whose results depends on the same lane of the arguments.

    The function is traced and compiled once for each structure of arguments: dtypes, shapes except for N, and all values that
    are not in tensors. A call returns NotImplemented if the caller has to run the function itself: for tensors on other devices
    or with gradients, for N = 0, while a stage is traced, and for code that the lane compiler cannot compile.

    Args:
        function: returns a tensor ``(..., N)`` or a tuple of them.
        lanes: names of the parameters that are tensors ``(..., N)`` or None.
        uniforms: names of the parameters that are small tensors whose values change from call to call. Tensors in all other
            parameters are tables: they are copied to the layout of kernels again when they change.
        detached: True: results have no derivatives, so tensors that require gradients are accepted.

    Attributes:
        refused: the message of :class:`Unsupported`, by the structure of arguments that could not be compiled.
    """

    def __init__(
        self, function: Callable[..., Any], lanes: Sequence[str], uniforms: Sequence[str] = (), detached: bool = False
    ) -> None:
        self._function, self._signature, self._detached = function, inspect.signature(function), detached
        kinds = dict.fromkeys(lanes, "lane") | dict.fromkeys(uniforms, "uniform")
        self._kinds = [kinds.pop(name, "table") for name in self._signature.parameters]
        if kinds:
            raise ValueError(f"no parameters {', '.join(kinds)}")
        name = f"{function.__module__}.{getattr(function, '__qualname__', '<')}"
        # Functions of this package are identified by name, on disk too, as keys hold a digest of its code; others, and local
        # functions and lambdas ("<locals>", "<lambda>"), by object.
        self._name = name if name.startswith("torchpt.") and "<" not in name else function
        self._made: dict[Any, _CompiledFunction] = {}  # by the structure of arguments
        self.refused: dict[Any, str] = {}

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Call the function, or return NotImplemented."""
        if tracing():
            return NotImplemented
        if kwargs or len(args) < len(self._kinds):
            bound = self._signature.bind(*args, **kwargs)
            bound.apply_defaults()
            args = bound.args
        structure: list[Any] = []
        inputs: list[Tensor] = []
        uniforms: list[Tensor] = []
        records: list[Any] = []
        count = -1  # of lanes; -1: not known yet
        for kind, value in zip(self._kinds, args, strict=True):
            if kind == "table" or not isinstance(value, Tensor):
                records.append(value)
                structure.append(signature(value))
                continue
            if self._is_unreadable(value):
                return NotImplemented
            if kind == "uniform":
                uniforms.append(value)
                structure.append((value.dtype, value.shape))
            else:
                if count not in (-1, value.shape[-1]):
                    return NotImplemented
                inputs.append(value)
                structure.append((value.dtype, value.shape[:-1]))
                count = value.shape[-1]
        key = tuple(structure)
        if count < 1 or key in self.refused:
            return NotImplemented
        tables = leaves(records)
        compiled = self._made.get(key)
        if compiled is None or not compiled.is_current(tables):
            if any(map(self._is_unreadable, tables)):
                return NotImplemented
            compile_time.begin()
            try:
                compiled = self._make(key, args, tables)
            except Unsupported as error:
                self.refused[key] = str(error)
                return NotImplemented
            finally:
                compile_time.end()
        return compiled.run(inputs, uniforms, count, thread_count(None))

    def _is_unreadable(self, tensor: Tensor) -> bool:
        """Return True for a tensor that kernels cannot read."""
        return tensor.device.type != "cpu" or (tensor.requires_grad and not self._detached)

    def _make(self, key: tuple[Any, ...], args: Sequence[Any], tables: list[Tensor]) -> _CompiledFunction:
        """Return the compiled function for arguments of this structure, with these tables, and cache it."""
        paths = {
            str(k): table for k, table in enumerate(tables)
        }  # tables have no paths here, so their numbers are used
        program_key = self._name, tuple(self._kinds), key
        program = cache.program_of(program_key, paths, trace=lambda: self._trace(args, paths))
        states = [(table, _version(table)) for table in tables]
        before = self._made.get(key)  # compiled for the same structure, with tables that have changed since
        results = self._results_of_no_lanes(args) if before is None else before.results
        compiled = _CompiledFunction(
            program, bind_tables(program.tables, program.steps, program.constants, paths), states, results
        )
        if before is None and len(self._made) >= _MOST_STRUCTURES:
            self._made.pop(next(iter(self._made)), None)
        self._made[key] = compiled
        return compiled

    def _with_tensors_replaced(
        self, args: Sequence[Any], lane: Callable[[Tensor], Tensor], uniform: Callable[[Tensor], Tensor]
    ) -> Any:
        """Return the arguments, with ``lane`` applied to the tensors of lanes and ``uniform`` to the small tensors."""
        replace = {"lane": lane, "uniform": uniform}
        return [
            replace[kind](value) if kind != "table" and isinstance(value, Tensor) else value
            for kind, value in zip(self._kinds, args, strict=True)
        ]

    def _results_of_no_lanes(self, args: Sequence[Any]) -> Tensor | tuple[Tensor, ...]:
        """Return the results for no lanes, which have the number, dtypes and shapes of the real ones."""
        with torch.no_grad():
            return self._function(*self._with_tensors_replaced(args, lambda x: x[..., :0], lambda x: x))

    def _trace(self, args: Sequence[Any], paths: dict[str, Tensor]) -> TracedStage:
        """Trace the function on example lanes of these arguments; ``paths`` has the tables by their path."""
        # The tracer knows the axis of the lanes by its length, so no other axis of an argument may have that length.
        without_lanes = self._with_tensors_replaced(args, lambda x: x[..., 0], lambda x: x)
        lanes = choose_lane_count(leaves(without_lanes))
        tracer = Tracer(lanes, {id(table): (path, table) for path, table in paths.items()})
        slots = 0  # inputs so far

        def lane(x: Tensor) -> Tensor:
            nonlocal slots
            slots += 1
            return _input(tracer, slots - 1, _example_lanes(x, lanes))

        inputs = self._with_tensors_replaced(args, lane, lambda x: tracer.uniform(x.clone()))
        with torch.no_grad(), torch.device("cpu"), tracer:  # whatever the caller's default device
            results = self._function(*inputs)
        stores = _stores(tracer, [results] if isinstance(results, Tensor) else results)
        # Each thread calls the kernel for some of the lanes, which it numbers from 0: the number within all is not known.
        if any(op == "iota" for op, *_ in tracer.graph.nodes):
            raise Unsupported("a use of the lane's own number")
        tables, steps, guards = without_unused_steps(tracer.tables, tracer.steps, tracer.guards)
        names = [str(k) for k in range(len(tracer.uniforms))]
        sinks = Sinks(store=stores)
        return TracedStage(
            tracer.graph, sinks, tables, steps, tuple(tracer.constants), guards, uniforms=names, tensors=slots
        )


@dataclass
class _CompiledFunction:
    """A kernel for one structure of arguments, with its tables.

    Attributes:
        program: the compiled program.
        tables: tables in the layout of kernels, as of the last call.
        states: the tensors that the tables were made from, each with its version.
        results: results for no lanes; a tuple if the function returns one.
        outputs: shape without lanes, and dtype, of each result.
        arguments: C type of the kernel's arguments: the words of :data:`HEAD`, an address for each uniform, address and row
            length for each input and output.
        grain: fewest blocks that are worth another thread.
    """

    program: Program
    tables: Tables
    states: list[tuple[Tensor, object]]
    results: Tensor | tuple[Tensor, ...]

    def __post_init__(self) -> None:
        results = [self.results] if isinstance(self.results, Tensor) else self.results
        self.outputs = [(x.shape[:-1], x.dtype) for x in results]
        self.arguments = ctypes.c_int64 * (
            len(HEAD) + len(self.program.uniforms) + 2 * (self.program.tensors + len(self.outputs))
        )
        operations = max(self.program.nodes.values(), default=1)  # for each lane
        self.grain = max(GRAIN // operations // BLOCK, 1)

    def is_current(self, tables: list[Tensor]) -> bool:
        """Return True if the tables were made from these tensors in their present versions."""
        return all(
            table is used and _version(table) == version
            for table, (used, version) in zip(tables, self.states, strict=True)
        )

    def run(self, inputs: Sequence[Tensor], uniforms: Sequence[Tensor], count: int, threads: int) -> Any:
        """Return the results for ``count`` lanes, computed by at most ``threads`` threads."""
        inputs, uniforms = [x.detach().contiguous() for x in inputs], [x.detach().contiguous() for x in uniforms]
        outputs = [torch.empty((*shape, count), dtype=dtype) for shape, dtype in self.outputs]
        head = [0] * len(HEAD)
        head[_TABLES] = self.tables.address
        head += [x.data_ptr() for x in uniforms]
        tensors = [(x.data_ptr(), x.element_size()) for x in (*inputs, *outputs)]

        def run_blocks(first: int, last: int) -> None:  # blocks first .. last - 1
            start, end = first * BLOCK, min(last * BLOCK, count)
            words = head.copy()
            for address, size in tensors:
                words += (address + start * size, count)
            arguments = self.arguments(*words)
            self.program.call(ctypes.addressof(arguments), end - start)

        blocks = -(-count // BLOCK)
        parallel_for(run_blocks, blocks, min(threads, max(blocks // self.grain, 1)))
        return outputs[0] if isinstance(self.results, Tensor) else tuple(outputs)


def compile_lanewise(
    function: Callable[..., Sequence[Tensor]], like: Sequence[Tensor], target: Target | None = None
) -> Callable[..., list[Tensor]]:
    """Compile a function of tensors ``(..., N)`` at once, for one thread.

    Args:
        function: returns a sequence of tensors ``(..., N)``.
        like: example arguments with the shapes and dtypes of later calls; N may differ.
        target: machine to compile for; None: this one.

    Raises:
        Unsupported: the function does something that the lane compiler cannot compile.
    """
    stage, results = trace_lanewise(function, like)
    tables = bind_tables(stage.tables, stage.steps, stage.constants, leaves={})
    program = cache.compile_stage(stage, target)
    compiled = _CompiledFunction(program, tables, states=[], results=tuple(x[..., :0] for x in results))

    def run(*arguments: Tensor) -> list[Tensor]:
        return list(compiled.run(arguments, uniforms=(), count=arguments[0].shape[-1], threads=1))

    return run


def trace_lanewise(
    function: Callable[..., Sequence[Tensor]], like: Sequence[Tensor]
) -> tuple[TracedStage, list[Tensor]]:
    """Trace a function, see :func:`compile_lanewise`; return the stage, and results for some lanes."""
    lanes = choose_lane_count([x[..., 0] for x in like if x.numel()])  # see Lanewise._trace
    tracer = Tracer(lanes, leaves={})
    inputs = [_input(tracer, slot, _example_lanes(x, lanes)) for slot, x in enumerate(like)]
    with torch.no_grad(), tracer:
        results = list(function(*inputs))
    sinks = Sinks(store=_stores(tracer, results))
    stage = TracedStage(tracer.graph, sinks, tracer.tables, tracer.steps, tracer.constants, tensors=len(inputs))
    return stage, results


def _input(tracer: Tracer, slot: int, x: Tensor) -> Tensor:
    """Declare a tensor as input number ``slot`` of a trace."""
    ty = DTYPES[x.dtype]
    return tracer.lane(x, lambda k: tracer.graph.node("tensor", ty, extra=(slot, k)))


def _stores(tracer: Tracer, results: Sequence[Tensor]) -> list[Store]:
    """Return the stores of a trace's results, one for each tensor."""
    return [Store(tuple(tracer.nodes(x)), DTYPES[x.dtype]) for x in results]


def _version(tensor: Tensor) -> object:
    """Return the version of a tensor's content. Inference tensors have none: they get one that equals no other."""
    return object() if tensor.is_inference() else tensor._version


def _example_lanes(x: Tensor, lanes: int) -> Tensor:
    """Return the first ``lanes`` lanes of an argument, repeated if it has fewer."""
    columns = torch.arange(lanes) % max(x.shape[-1], 1)
    if not x.numel():
        return torch.zeros(*x.shape[:-1], lanes, dtype=x.dtype)
    return x[..., columns].contiguous()
