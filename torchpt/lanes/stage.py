"""A stage as it was traced: a graph. What it is compiled to is another thing, see :mod:`torchpt.lanes.program`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from torchpt.lanes.graph import Graph
from torchpt.lanes.prologue import Guard, Step, Table
from torchpt.lanes.sinks import Sinks

__all__ = ["TracedStage"]


@dataclass(frozen=True)
class TracedStage:
    """A stage as a graph, with nothing in it of the machine or the form that kernels are made for.

    Attributes:
        graph: its operations.
        sinks: what becomes of its results.
        tables: what it reads.
        steps: the prologue, which makes some of that from leaves.
        held: tensors of its own.
        guards: numbers that must be what they were.
        uniforms: names of the inputs that all lanes share.
        tensors: how many inputs are tensors instead of rows of an arena.
        listed: whether its lanes are those that a list names, else all in order.
        searched: kinds of primitives that its rays are searched among, see :mod:`torchpt.lanes.packet`; None where it has none.
        sums: what rows of its results are derivatives by, see :mod:`torchpt.engines.kernels.joint`.
    """

    graph: Graph
    sinks: Sinks
    tables: Sequence[Table] = ()
    steps: Sequence[Step] = ()
    held: Sequence[Tensor] = ()
    guards: Sequence[Guard] = ()
    uniforms: Sequence[str] = ()
    tensors: int = 0
    listed: bool = False
    searched: Sequence[str] | None = None
    sums: Sequence[Sequence[Any]] = ()

    def needed(self) -> list[int]:
        """Return the nodes that its results depend on, arguments first."""
        return self.graph.needed(self.sinks.roots())
