"""A stage on its way to become a kernel: what it reads of the arena, and how its results go back.

The functions of :mod:`~torchpt.engines.kernels.vertex`, :mod:`~torchpt.engines.kernels.packets`,
:mod:`~torchpt.engines.kernels.transmission` and :mod:`~torchpt.engines.kernels.output` take a :class:`Trace` and return sinks.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.rows import HIT, Rows, path_state, state_values
from torchpt.lanes.sinks import Note, Scatter, Sinks
from torchpt.lanes.tracing import Tracer
from torchpt.records import Hit, PathState
from torchpt.samplers import Dimension

__all__ = ["Trace"]


class Trace:
    """One stage being traced.

    Args:
        tracer: records what is done to lanes, inside of ``with trace.tracer``.
        layout: of the render.

    Attributes:
        uniforms: names of the inputs that all lanes share, in the order of their slots.
        tensors: how many inputs are tensors instead of rows of an arena.
        sums: of :class:`torchpt.lanes.program.Program`.
    """

    def __init__(self, tracer: Tracer, layout: Layout) -> None:
        self.tracer, self.layout = tracer, layout
        self.uniforms: list[str] = []
        self.tensors = 0
        self.sums: list[tuple[Any, ...]] = []

    # -- what a stage reads

    def uniform(self, name: str, like: Tensor) -> Tensor:
        """An input that all lanes share; callers find it by its name."""
        self.uniforms.append(name)
        return self.tracer.uniform(like)

    def salts(self) -> Tensor:
        """Names of the depth's random dimensions."""
        return self.uniform("salts", torch.zeros(len(Dimension), dtype=torch.int32))

    def state(self) -> tuple[PathState, dict[str, Tensor]]:
        """The state of the paths, and what travels with them unseen by stages: the filter's ``weight``."""
        rows = self.layout.state
        return path_state(rows.read(self.tracer, *rows.state)), rows.read(self.tracer, "weight")

    def hit(self, rows: Rows | None = None) -> Hit:
        """Return what the rays met."""
        return Hit(**(rows or self.layout.state).read(self.tracer, *HIT))

    def place(self) -> Tensor:
        """Return where in the arena each lane is."""
        numbers = torch.zeros(self.tracer.lanes, dtype=torch.int64)
        return self.tracer.lane(numbers, lambda _: self.tracer.graph.node("place", "l"))

    # -- where results go

    def node(self, result: Tensor) -> int:
        """The node of a result that has one number a lane."""
        return self.tracer.nodes(result)[0]

    def kept(self, state: PathState, unseen: dict[str, Tensor]) -> list[tuple[int, int]]:
        """The state as rows and nodes."""
        return self.layout.state.nodes(self.tracer, **state_values(state), **unseen)

    def ended(self, mask: int, lane: Tensor, radiance: Tensor, unseen: dict[str, Tensor]) -> Scatter:
        """Paths that end where the node ``mask`` holds (-1: all): their radiance goes to the slots of their samples."""
        if "weight" in unseen:
            with self.tracer:
                radiance = radiance * unseen["weight"]
        rows = tuple(enumerate(self.tracer.nodes(radiance)))
        return Scatter(mask, self.node(lane), rows, slots=True)

    def sorted(self, sinks: Sinks, state: PathState, prim: Tensor, unseen: dict[str, Tensor]) -> tuple[int, list[Note]]:
        """Sort the lanes by the surfaces that they met, and end those that do not go on.

        Returns:
            The mask of the lanes that go on, and the notes of their places.
        """
        layout, world = self.layout, self.layout.world
        with self.tracer:
            key = torch.index_select(world.materials.key, 0, world.geometry.slot(prim) + 1)
            met, alive = prim >= 0, state.t_max > 0
            masks = [(key == m) | (key == layout.models + m) for m in range(layout.models)]
            shining = (key < layout.models) & met
            out = ~met & alive
            on = met | out if layout.has_environment else met
            off = ~on
        lists: list[tuple[int, Tensor]] = list(enumerate(masks)) if layout.listed else []
        if layout.has_emitters:
            lists.append((layout.emissive, shining))
        if layout.has_environment:
            lists.append((layout.missed, out))
        notes = [Note(self.node(mask), number, number + 1) for number, mask in lists]
        sinks.scatter.append(self.ended(self.node(off), state.lane, state.radiance, unseen))
        return self.node(on), notes
