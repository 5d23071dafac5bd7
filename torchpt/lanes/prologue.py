"""The prologue of a kernel: arithmetic on tables alone, kept as steps, and run anew for each scene.

So other tables of the same shapes can take the place of those that a stage was traced with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

__all__ = ["Guard", "Source", "Step", "Table", "pruned", "replayed"]


@dataclass(frozen=True)
class Source:
    """Where a tensor that holds no lanes comes from.

    Attributes:
        kind: ``leaf`` (of the records that the stage was given), ``step`` (of the prologue) or ``held`` (an object of the
            program's own, a network's weights among them).
        name: of a leaf its path, else a number.
        item: which result of a step that gives several; -1 where it gives one.
    """

    kind: str
    name: str | int
    item: int = -1


@dataclass(frozen=True)
class Step:
    """One operator on tables: ``function(*args, **kwargs)`` with a :class:`Source` in place of each tensor."""

    function: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]


@dataclass(frozen=True)
class Table:
    """A tensor as a kernel reads it.

    Attributes:
        source: where it comes from.
        axis: which axis is indexed: its entries come first in memory, the numbers of one entry side by side. None: as it is.
    """

    source: Source
    axis: int | None


@dataclass(frozen=True)
class Guard:
    """A number that was read from a table while tracing, and holds for this trace alone."""

    source: Source
    value: Any


def pruned(
    tables: Sequence[Table], steps: Sequence[Step], guards: Sequence[Guard]
) -> tuple[tuple[Table, ...], tuple[Step, ...], tuple[Guard, ...]]:
    """The same without the steps that nothing asks for."""
    needed: set[int] = set()

    def asked(value: Any) -> None:
        if isinstance(value, Source):
            if value.kind == "step" and int(value.name) not in needed:
                needed.add(int(value.name))
                step = steps[int(value.name)]
                asked((step.args, tuple(step.kwargs.values())))
        elif isinstance(value, list | tuple):
            for x in value:
                asked(x)

    asked([table.source for table in tables])
    asked([guard.source for guard in guards])
    numbers = {old: new for new, old in enumerate(sorted(needed))}

    def renamed(value: Any) -> Any:
        if isinstance(value, Source):
            return replace(value, name=numbers[int(value.name)]) if value.kind == "step" else value
        return type(value)(renamed(x) for x in value) if isinstance(value, list | tuple) else value

    kept = [steps[old] for old in sorted(needed)]
    return (
        tuple(replace(table, source=renamed(table.source)) for table in tables),
        tuple(
            replace(step, args=renamed(step.args), kwargs={k: renamed(v) for k, v in step.kwargs.items()})
            for step in kept
        ),
        tuple(replace(guard, source=renamed(guard.source)) for guard in guards),
    )


def replayed(steps: Sequence[Step], held: Sequence[Tensor], leaves: Mapping[str, Tensor]) -> Any:
    """Runs a prologue; returns ``tensor(source)``."""
    results: list[Any] = []

    def tensor(source: Source) -> Tensor:
        if source.kind == "leaf":
            return leaves[str(source.name)]
        if source.kind == "held":
            return held[int(source.name)]
        result = results[int(source.name)]
        return result if source.item < 0 else result[source.item]

    def filled(value: Any) -> Any:
        if isinstance(value, Source):
            return tensor(value)
        return type(value)(filled(x) for x in value) if isinstance(value, list | tuple) else value

    with torch.no_grad():
        for step in steps:
            results.append(step.function(*filled(step.args), **{k: filled(v) for k, v in step.kwargs.items()}))
    return tensor
