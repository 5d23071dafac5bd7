"""The prologue of a kernel: arithmetic on tables alone, kept as steps, and run anew for each scene.

So other tables of the same shapes can take the place of those that a stage was traced with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import torch
from torch import Tensor

__all__ = ["Guard", "Source", "Step", "StepKey", "Table", "run_prologue", "step_keys", "without_unused_steps"]

#: Bytes of a tensor up to which it is kept for other prologues.
SMALL = 1 << 16


@dataclass(frozen=True)
class Source:
    """Where a tensor that holds no lanes comes from.

    Attributes:
        kind: ``leaf`` (of the records that the stage was given), ``step`` (of the prologue) or ``constants`` (an object of the
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


def without_unused_steps(
    tables: Sequence[Table], steps: Sequence[Step], guards: Sequence[Guard]
) -> tuple[tuple[Table, ...], tuple[Step, ...], tuple[Guard, ...]]:
    """The same without the steps that nothing asks for."""
    needed: set[int] = set()

    def mark_needed(value: Any) -> None:
        if isinstance(value, Source):
            if value.kind == "step" and int(value.name) not in needed:
                needed.add(int(value.name))
                step = steps[int(value.name)]
                mark_needed((step.args, tuple(step.kwargs.values())))
        elif isinstance(value, list | tuple):
            for x in value:
                mark_needed(x)

    mark_needed([table.source for table in tables])
    mark_needed([guard.source for guard in guards])
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


@dataclass(frozen=True)
class StepKey:
    """Of a step: the same in all prologues of the process for the same arithmetic on leaves of the same paths.

    Attributes:
        number: tells it from others.
        leaves: paths of those that enter it.
    """

    number: int
    leaves: frozenset[str]


def step_keys(steps: Sequence[Step]) -> tuple[StepKey | None, ...]:
    """Names of steps; None where a tensor of the program's own has part in one, or what its arguments are cannot be told."""
    names: list[StepKey | None] = []
    leaves: set[str] = set()  # of the step that is looked at

    def content_of(value: Any) -> Any:
        if isinstance(value, Source):
            if value.kind == "constants":
                raise TypeError("a tensor of the program's own")
            if value.kind == "leaf":
                leaves.add(str(value.name))
                return "leaf", value.name
            name = names[int(value.name)]
            if name is None:
                raise TypeError("a step that has no name")
            leaves.update(name.leaves)
            return "step", name.number, value.item
        if isinstance(value, list | tuple):
            return type(value), tuple(content_of(x) for x in value)
        return type(value), repr(value) if isinstance(value, float) else value

    for step in steps:
        leaves.clear()
        schema = getattr(step.function, "_schema", None)
        try:
            if schema is None or schema.is_mutable:
                raise TypeError("what writes into its arguments")
            key = (
                step.function,
                content_of(step.args),
                tuple((k, content_of(value)) for k, value in step.kwargs.items()),
            )
            names.append(StepKey(_numbers.setdefault(key, next(_count)), frozenset(leaves)))
        except TypeError:  # of what cannot be hashed, too
            names.append(None)
    return tuple(names)


#: Numbers of steps by what they do.
_numbers: dict[Any, int] = {}
_count = count()


def _small(result: Any) -> bool:
    return isinstance(result, Tensor) and result.untyped_storage().nbytes() <= SMALL


def run_prologue(
    steps: Sequence[Step],
    constants: Sequence[Tensor],
    leaves: Mapping[str, Tensor],
    names: Sequence[StepKey | None] = (),
    known: dict[StepKey, Tensor] | None = None,
) -> Any:
    """Runs a prologue; returns ``tensor(source)``.

    Args:
        steps: the prologue.
        constants: the program's own tensors.
        leaves: the scene's by path.
        names: of the steps, see :func:`step_keys`.
        known: what steps came to in other prologues on the same leaves, by name; filled with what is small.
    """
    results: list[Any] = []

    def tensor(source: Source) -> Tensor:
        if source.kind == "leaf":
            return leaves[str(source.name)]
        if source.kind == "constants":
            return constants[int(source.name)]
        result = results[int(source.name)]
        return result if source.item < 0 else result[source.item]

    def filled(value: Any) -> Any:
        if isinstance(value, Source):
            return tensor(value)
        return type(value)(filled(x) for x in value) if isinstance(value, list | tuple) else value

    with torch.no_grad():
        for number, step in enumerate(steps):
            name = names[number] if names and known is not None else None
            result = None if name is None or known is None else known.get(name)
            if result is None:
                result = step.function(*filled(step.args), **{k: filled(v) for k, v in step.kwargs.items()})
                if name is not None and known is not None and _small(result):
                    known[name] = result
            results.append(result)
    return tensor
