"""Traced stages, compiled programs, and the tables of a scene in the layout that kernels read.

A stage is traced once (:class:`TracedStage`), compiled (:class:`Program`), and bound to the tables of each scene
(:func:`bind_tables`). *Leaves* are the tensors of a scene by dotted path; *tables* are tensors that do not depend on lanes:
leaves, or results of *steps*, torch operators on leaves that are run before the kernel; *guards* are values of leaves on which
the trace depends (:mod:`torchpt.compiler.prologue`).
"""

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
from torchpt.compiler.prologue import (
    Guard,
    Source,
    Step,
    StepKey,
    Table,
    leaves_of,
    leaves_of_steps,
    run_prologue,
    step_keys,
    write_into_arguments,
)
from torchpt.compiler.searching import RaySearch
from torchpt.compiler.sinks import Sinks

__all__ = ["LaidOut", "Program", "Tables", "TracedStage", "bind_tables", "guards_hold", "lay_out_table"]


# ---- A traced stage


@dataclass(frozen=True)
class TracedStage:
    """A stage as a graph, independent of machine and form.

    Attributes:
        graph: operations of the stage.
        sinks: where results are written.
        tables: tables that the graph reads.
        steps: the prologue, which computes some tables from leaves.
        constants: constant tensors.
        guards: values that the trace depends on.
        uniforms: names of the inputs that all lanes share.
        tensors: number of inputs that are tensors instead of rows of an arena.
        listed: lanes are read at the indices of a list; False: all lanes in order.
        search: generates the functions that nodes ``nearest`` and ``occluded`` call, such as
            :class:`torchpt.compiler.packet.PacketSearch`; None: no rays are searched.
        sums: for each table with gradients its number, the row of the index (-1: none, every lane adds to the whole table), the
            first row of the values, and their number; see :mod:`torchpt.engines.kernels.backward`.
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
    search: RaySearch | None = None
    sums: Sequence[Sequence[Any]] = ()

    def needed(self) -> list[int]:
        """Return the nodes that the results depend on, arguments first."""
        return self.graph.needed(self.sinks.roots())


# ---- A compiled stage, and the tables of a scene in the layout that kernels read


@dataclass(frozen=True)
class Program:
    """A stage compiled for all records of one structure.

    Attributes:
        function: the compiled kernel.
        tables: tables that the kernel reads.
        steps: the prologue, which computes some tables from leaves.
        constants: constant tensors.
        guards: values that the trace depended on.
        uniforms: names of the inputs that all lanes share.
        lists: number of index lists that the kernel writes.
        counters: number of counters, to which the kernel adds how many lanes it wrote to lists or counted.
        tensors: number of input tensors.
        results: number of result tensors.
        shadows: number of shadow rays a lane.
        nodes: number of nodes that each file of the package created.
        sums: for each table with gradients its number, the row of the index (-1: none, every lane adds to the whole table), the
            first row of the values, and their number; see :mod:`torchpt.engines.kernels.backward`.
    """

    function: Function
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
        """Return the program of a stage whose machine code is ``function``."""
        nodes: dict[str, int] = {}
        for node in stage.needed():
            for file in stage.graph.origins[node]:
                nodes[file] = nodes.get(file, 0) + 1
        return cls(
            function=function,
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

    @property
    def call(self) -> Any:
        """Return the machine code, see :class:`torchpt.compiler.cpu.Function`."""
        return self.function.call

    @property
    def code(self) -> str:
        """Return the cache key of the machine code."""
        return self.function.key

    def leaves(self) -> frozenset[str]:
        """Return the paths of the leaves that the tables depend on."""
        return self._leaves

    @cached_property
    def names(self) -> tuple[StepKey | None, ...]:
        """Return the keys by which steps share their results, see :func:`torchpt.compiler.prologue.step_keys`."""
        return step_keys(self.steps)

    @cached_property
    def in_order(self) -> bool:
        """Return True if the steps depend on their order."""
        return write_into_arguments(self.steps)

    @cached_property
    def table_leaves(self) -> tuple[frozenset[str] | None, ...]:
        """Return the paths of the leaves that each table depends on; None for tables that depend on more, as on constants."""
        of_steps = leaves_of_steps(self.steps)
        return tuple(leaves_of(table.source, of_steps) for table in self.tables)

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


#: A table in the layout of kernels, and its number of entries.
LaidOut = tuple[Tensor, int]


@dataclass(frozen=True)
class Tables:
    """Tables in the layout that kernels read.

    Attributes:
        address: address of an array of pairs (pointer, number of entries).
        pairs: the object that owns this array.
        laid_out: each table, and its number of entries.
    """

    address: int
    pairs: Any
    laid_out: tuple[LaidOut, ...]


def lay_out_table(tensor: Tensor, axis: int | None) -> Tensor:
    """Return a table in the layout of kernels: contiguous, integers and bools in 32 bits.

    The axis that lanes index comes first, so that the numbers of an entry lie together; None: the layout stays.

    Raises:
        Unsupported: integers beyond 32 bits, or 2^31 elements or more.
    """
    tensor = tensor.detach()
    if axis in (None, 0) and tensor.dtype == torch.float32 and tensor.numel() < 1 << 31 and tensor.is_contiguous():
        return tensor  # most are so
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
    device: torch.device | None = None,
    placed: Mapping[str, Tensor] | None = None,
    kept: Sequence[LaidOut | None] = (),
    in_order: bool | None = None,
) -> Tables:
    """Compute and lay out the tables of a kernel for one scene.

    Args:
        tables: tables of the trace.
        steps: prologue of the trace.
        constants: constant tensors of the trace.
        leaves: the scene's tensors by path, on the host; the prologue runs there.
        known: leaves that were laid out before, by path and axis; those laid out now are added.
        names: keys of the steps, :attr:`Program.names`.
        results: results of steps of other kernels, see :func:`torchpt.compiler.prologue.run_prologue`; filled.
        device: where kernels read tables; None: the host.
        placed: the leaves on the device by path.
        kept: for each table that of an earlier binding to the same leaves, or None; empty: none.
        in_order: :attr:`Program.in_order`; None: unknown.
    """
    known = {} if known is None else known
    found: list[LaidOut] = []
    with torch.no_grad():
        tensor = run_prologue(steps, constants, leaves, names, results, in_order)
        for number, table in enumerate(tables):
            if kept and (earlier := kept[number]) is not None:
                found.append(earlier)
                continue
            key = (table.source.name, table.axis) if table.source.kind == "leaf" else None
            laid_out = known.get(key) if key is not None else None
            original = tensor(table.source) if key is None or placed is None else placed[str(table.source.name)]
            if laid_out is None:
                laid_out = lay_out_table(original, table.axis)
                laid_out = laid_out if device is None else laid_out.to(device)
                if key is not None:
                    known[key] = laid_out
            found.append((laid_out, original.numel() if table.axis is None else original.shape[table.axis]))
    words = [word for laid_out, entries in found for word in (laid_out.data_ptr(), entries)]
    if device is not None:
        pairs = torch.tensor(words or [0], dtype=torch.int64, device=device)
        return Tables(pairs.data_ptr(), pairs, tuple(found))
    block = (ctypes.c_int64 * max(len(words), 1))(*words)
    return Tables(ctypes.addressof(block), block, tuple(found))


def guards_hold(program: Program, leaves: Mapping[str, Tensor]) -> bool:
    """Return True if the guards of a program hold for these leaves, which are on the host."""
    if not program.guards:
        return True
    tensor = run_prologue(program.steps, program.constants, leaves, in_order=program.in_order)

    def number(value: Any) -> Any:
        return value.item() if isinstance(value, Tensor) else value

    return all(number(tensor(guard.source)) == guard.value for guard in program.guards)
