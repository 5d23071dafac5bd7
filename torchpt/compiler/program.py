"""A stage that was traced, and its machine code with the tables of a scene bound to it."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler.cpu import Function
from torchpt.compiler.graph import Graph, Unsupported
from torchpt.compiler.prologue import Guard, Source, Step, StepKey, Table, run_prologue, step_keys
from torchpt.compiler.sinks import Sinks

__all__ = ["Program", "Tables", "TracedStage", "bind_tables", "guards_hold", "lay_out_table"]


# ---- A stage as it was traced: a graph. What it is compiled to is another thing, see :mod:`torchpt.compiler.program`


@dataclass(frozen=True)
class TracedStage:
    """A stage as a graph, with nothing in it of the machine or the form that kernels are made for.

    Attributes:
        graph: its operations.
        sinks: what becomes of its results.
        tables: what it reads.
        steps: the prologue, which makes some of that from leaves.
        constants: tensors of its own.
        guards: numbers that must be what they were.
        uniforms: names of the inputs that all lanes share.
        tensors: how many inputs are tensors instead of rows of an arena.
        listed: whether its lanes are those that a list names, else all in order.
        searched: kinds of primitives that its rays are searched among, see :mod:`torchpt.compiler.packet`; None where it has
            none.
        sums: what rows of its results are derivatives by, see :mod:`torchpt.engines.kernels.backward`.
    """

    graph: Graph
    sinks: Sinks
    tables: Sequence[Table] = ()
    steps: Sequence[Step] = ()
    constants: Sequence[Tensor] = ()
    guards: Sequence[Guard] = ()
    uniforms: Sequence[str] = ()
    tensors: int = 0
    listed: bool = False
    searched: Sequence[str] | None = None
    sums: Sequence[Sequence[Any]] = ()

    def needed(self) -> list[int]:
        """Return the nodes that its results depend on, arguments first."""
        return self.graph.needed(self.sinks.roots())


# ---- What a stage was compiled to, and the tables of a scene as its machine code reads them


@dataclass(frozen=True)
class Program:
    """A stage compiled for all records of one structure.

    Attributes:
        call: its machine code, see :class:`torchpt.compiler.cpu.Function`.
        code: the name of that on disk.
        tables: what it reads.
        steps: the prologue, which makes some of that from leaves.
        constants: tensors of the program's own.
        guards: numbers that must be what they were.
        uniforms: names of the inputs that all lanes share.
        lists: how many lists of places it writes.
        counters: how many counters it has.
        tensors: how many input tensors.
        results: how many result tensors.
        shadows: how many shadow rays each lane asks for.
        nodes: how many of its nodes each file of the package asked for.
        sums: what rows of its results are derivatives by, see :mod:`torchpt.engines.kernels.backward`.
    """

    call: Any
    code: str
    tables: tuple[Table, ...]
    steps: tuple[Step, ...]
    constants: tuple[Tensor, ...]
    guards: tuple[Guard, ...]
    uniforms: tuple[str, ...]
    lists: int
    counters: int
    tensors: int
    results: int
    shadows: int
    nodes: Mapping[str, int]
    sums: Sequence[Sequence[Any]] = ()

    @classmethod
    def of(cls, stage: TracedStage, function: Function) -> Program:
        """Return a stage's program with the machine code that was made of it."""
        nodes: dict[str, int] = {}
        for node in stage.needed():
            for file in stage.graph.origins[node]:
                nodes[file] = nodes.get(file, 0) + 1
        return cls(
            call=function.call,
            code=function.key,
            tables=tuple(stage.tables),
            steps=tuple(stage.steps),
            constants=tuple(stage.constants),
            guards=tuple(stage.guards),
            uniforms=tuple(stage.uniforms),
            lists=stage.sinks.lists(),
            counters=stage.sinks.counters(),
            tensors=stage.tensors,
            results=len(stage.sinks.store),
            shadows=stage.sinks.shadows,
            nodes=nodes,
            sums=stage.sums,
        )

    def leaves(self) -> frozenset[str]:
        """Paths of the leaves that enter its tables."""
        return self._leaves

    @cached_property
    def names(self) -> tuple[StepKey | None, ...]:
        """Of its steps, see :func:`torchpt.compiler.prologue.step_keys`."""
        return step_keys(self.steps)

    @cached_property
    def _leaves(self) -> frozenset[str]:
        paths: set[str] = set()

        def visit(value: Any) -> None:
            if isinstance(value, Source):
                if value.kind == "leaf":
                    paths.add(str(value.name))
            elif isinstance(value, list | tuple):
                for x in value:
                    visit(x)

        for step in self.steps:
            visit((step.args, tuple(step.kwargs.values())))
        visit([table.source for table in self.tables])
        return frozenset(paths)


@dataclass(frozen=True)
class Tables:
    """Tables in memory.

    Attributes:
        address: of pairs of pointer and number of entries.
        keep: what must live as long.
    """

    address: int
    keep: tuple[Any, ...]


def lay_out_table(tensor: Tensor, axis: int | None) -> Tensor:
    """A table as kernels read it: entries first, contiguous, integers and truth values in 32 bits.

    Raises:
        Unsupported: numbers beyond 32 bits, or more of them than 32 bits count.
    """
    tensor = tensor.detach()
    if tensor.numel() >= 1 << 31:
        raise Unsupported(f"a table of {tensor.numel()} numbers")
    if axis is not None and tensor.dim() > 1:
        tensor = tensor.movedim(axis, 0)
    if tensor.dtype == torch.int64:
        if tensor.numel() and (int(tensor.max()) >= 1 << 31 or int(tensor.min()) < -(1 << 31)):
            raise Unsupported("a table of integers beyond 32 bits")
        tensor = tensor.to(torch.int32)
    elif tensor.dtype in (torch.bool, torch.uint8):
        tensor = tensor.to(torch.int32)
    return tensor.contiguous()


def bind_tables(
    tables: Sequence[Table],
    steps: Sequence[Step],
    constants: Sequence[Tensor],
    leaves: Mapping[str, Tensor],
    known: dict[Any, Tensor] | None = None,
    names: Sequence[StepKey | None] = (),
    results: dict[StepKey, Tensor] | None = None,
) -> Tables:
    """The tables of a kernel for one scene.

    Args:
        tables: of the trace.
        steps: its prologue.
        constants: its own tensors.
        leaves: the scene's tensors by path.
        known: leaves that were laid out before, by path and axis; filled.
        names: of the steps.
        results: what steps of other kernels came to, see :func:`torchpt.compiler.prologue.run_prologue`; filled.
    """
    known = {} if known is None else known
    tensor = run_prologue(steps, constants, leaves, names, results)
    words: list[int] = []
    keep: list[Tensor] = []
    for table in tables:
        key = (table.source.name, table.axis) if table.source.kind == "leaf" else None
        numbers = known.get(key) if key is not None else None
        plain = tensor(table.source)
        if numbers is None:
            numbers = lay_out_table(plain, table.axis)
            if key is not None:
                known[key] = numbers
        keep.append(numbers)
        words += [numbers.data_ptr(), plain.numel() if table.axis is None else plain.shape[table.axis]]
    block = (ctypes.c_int64 * max(len(words), 1))(*words)
    return Tables(ctypes.addressof(block), (block, keep))


def guards_hold(program: Program, leaves: Mapping[str, Tensor]) -> bool:
    """Return True where the numbers that a trace relied on are the same for other leaves."""
    if not program.guards:
        return True
    tensor = run_prologue(program.steps, program.constants, leaves)

    def number(value: Any) -> Any:
        return value.item() if isinstance(value, Tensor) else value

    return all(number(tensor(guard.source)) == guard.value for guard in program.guards)
