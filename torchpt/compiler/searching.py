"""Ray searches as kernels ask for them: functions to call, and for kernels that only search a loop over lanes of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from torchpt.compiler.block import Block
from torchpt.compiler.form import Form

if TYPE_CHECKING:
    from torchpt.compiler.program import TracedStage

__all__ = ["LoopingSearch", "RaySearch", "SearchLoop", "lone_search"]


class RaySearch(Protocol):
    """A ray search inside kernels."""

    def __call__(self, form: Form) -> Block:
        """Generate the functions that nodes ``nearest`` and ``occluded`` call."""
        ...


@dataclass(frozen=True)
class SearchLoop:
    """A GPU kernel that loads rays, searches, and stores what it found; in its lines ``%i`` is the lane, ``%mask`` true.

    Attributes:
        form: layout of lanes.
        any_hit: True: the search is ``occluded``, else ``nearest``.
        load: lines that load the ray of a lane.
        ray: the seven values of the ray.
        store: lines that store the result, ``%found``, of a lane.
        names: number of names in these lines; other blocks begin behind it.
    """

    form: Form
    any_hit: bool
    load: Sequence[str]
    ray: Sequence[str]
    store: Sequence[str]
    names: int


@runtime_checkable
class LoopingSearch(Protocol):
    """A search whose GPU kernels do not take lanes in turn: threads take new rays once theirs are finished."""

    def lane_loop(self, loop: SearchLoop) -> Block:
        """Generate the loop over lanes, whole warps at a time.

        Before it are ``%n``, the number of lanes; ``%thread`` and ``%threads``, number of this thread and of all, as i64.
        """
        ...


def lone_search(stage: TracedStage, needed: Sequence[int]) -> int | None:
    """Return the search of a stage that does nothing but load rays, search once, and store the results; else None."""
    graph, sinks = stage.graph, stage.sinks
    found = [node for node in needed if graph.nodes[node][0] in ("nearest", "occluded")]
    others = sinks.compact or sinks.appends or sinks.scatter or sinks.count or sinks.shift is not None
    if len(found) != 1 or others or stage.listed:
        return None
    (search,) = found
    rays = set(graph.needed([search]))
    for node in needed:  # the results may not read what was loaded for the ray
        op, _, arguments, _ = graph.nodes[node]
        if node not in rays and op != "const" and (not arguments or rays.intersection(arguments) - {search}):
            return None
    return search
