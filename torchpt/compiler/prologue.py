"""The prologue of a kernel: torch operators on tables alone, recorded in the trace and run again for each scene.

A *table* is a tensor that does not depend on lanes. Some tables of a kernel are *leaves*, tensors of the scene that a stage
gets as arguments, named by their path in these (``geometry.p0``); others are computed from leaves by the steps of the
prologue. A kernel reads all of them from memory, so it serves every scene whose tables have the same shapes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import torch
from torch import Tensor

__all__ = [
    "Guard",
    "Source",
    "Step",
    "StepKey",
    "Table",
    "leaves_of",
    "leaves_of_steps",
    "run_prologue",
    "step_keys",
    "without_unused_steps",
    "write_into_arguments",
]

#: Largest result of a step, in bytes, that is kept for other prologues. Larger ones would hold much memory.
SMALL = 1 << 16


@dataclass(frozen=True)
class Source:
    """The origin of a tensor without lanes.

    Attributes:
        kind: ``leaf`` (of the stage's arguments), ``step`` (result of a prologue step) or ``constants`` (a constant of the
            program, such as the weights of a network).
        name: path of a leaf, else the number of the step or constant.
        item: index into the results of a step that returns several tensors; -1 if it returns one.
    """

    kind: str
    name: str | int
    item: int = -1


@dataclass(frozen=True)
class Step:
    """A call of a torch operator on tables: ``function(*args, **kwargs)``, with a :class:`Source` for each tensor."""

    function: Any
    args: tuple[Any, ...]
    kwargs: dict[str, Any]


@dataclass(frozen=True)
class Table:
    """A tensor as a kernel reads it.

    Attributes:
        source: origin of the tensor.
        axis: the indexed axis, which becomes the first one in memory; None: the layout stays.
    """

    source: Source
    axis: int | None


@dataclass(frozen=True)
class Guard:
    """A value that the trace has read from a table: the trace holds only for this value."""

    source: Source
    value: Any


def without_unused_steps(
    tables: Sequence[Table], steps: Sequence[Step], guards: Sequence[Guard]
) -> tuple[tuple[Table, ...], tuple[Step, ...], tuple[Guard, ...]]:
    """Return tables, steps and guards, with the steps dropped that neither a table nor a guard depends on."""
    needed: set[int] = set()  # numbers of steps

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

    def renumbered(value: Any) -> Any:
        """Return a source, or nested arguments with sources, with the new numbers of steps."""
        if isinstance(value, Source):
            return replace(value, name=numbers[int(value.name)]) if value.kind == "step" else value
        return type(value)(renumbered(x) for x in value) if isinstance(value, list | tuple) else value

    kept = [steps[old] for old in sorted(needed)]
    return (
        tuple(replace(table, source=renumbered(table.source)) for table in tables),
        tuple(
            replace(step, args=renumbered(step.args), kwargs={k: renumbered(v) for k, v in step.kwargs.items()})
            for step in kept
        ),
        tuple(replace(guard, source=renumbered(guard.source)) for guard in guards),
    )


@dataclass(frozen=True, eq=False)
class StepKey:
    """An identity of a step, by which prologues share its result.

    Two steps have the same key, one object in all prologues of the process, if they are the same operators on leaves of the
    same paths.

    Attributes:
        number: a unique number.
        leaves: paths of the leaves that the step depends on.
    """

    number: int
    leaves: frozenset[str]


def step_keys(steps: Sequence[Step]) -> tuple[StepKey | None, ...]:
    """Return the key of each step.

    None for a step that depends on a constant tensor, has arguments without a hash, or writes into its arguments.
    """
    keys: list[StepKey | None] = []
    leaves: set[str] = set()  # of the current step

    def content_of(value: Any) -> Any:
        """Return hashable content by which an argument is compared; adds to ``leaves``."""
        if isinstance(value, Source):
            if value.kind == "constants":
                raise TypeError("a tensor of the program's own")
            if value.kind == "leaf":
                leaves.add(str(value.name))
                return "leaf", value.name
            earlier = keys[int(value.name)]
            if earlier is None:
                raise TypeError("a step that has no key")
            leaves.update(earlier.leaves)
            return "step", earlier.number, value.item
        if isinstance(value, list | tuple):
            return type(value), tuple(content_of(x) for x in value)
        # As text 0.0 and -0.0 differ, and NaN equals itself.
        return type(value), repr(value) if isinstance(value, float) else value

    for step in steps:
        leaves.clear()
        schema = getattr(step.function, "_schema", None)
        try:
            if schema is None or schema.is_mutable:
                raise TypeError("a step that writes into its arguments")
            content = (
                step.function,
                content_of(step.args),
                tuple((k, content_of(value)) for k, value in step.kwargs.items()),
            )
            key = _keys.get(content)
            keys.append(key or _keys.setdefault(content, StepKey(next(_count), frozenset(leaves))))
        except TypeError:  # raised above, or by hash()
            keys.append(None)
    return tuple(keys)


#: Key of each step, by operator and arguments.
_keys: dict[Any, StepKey] = {}
_count = count()


def _small(result: Any) -> bool:
    """Return True for a single tensor that is small enough to be kept."""
    return isinstance(result, Tensor) and result.untyped_storage().nbytes() <= SMALL


def run_prologue(
    steps: Sequence[Step],
    constants: Sequence[Tensor],
    leaves: Mapping[str, Tensor],
    names: Sequence[StepKey | None] = (),
    known: dict[StepKey, Tensor] | None = None,
    in_order: bool | None = None,
) -> Any:
    """Return a function that returns the tensor of a :class:`Source`; it runs the steps that the tensor depends on, once.

    Args:
        steps: the prologue.
        constants: the program's constant tensors.
        leaves: the scene's tensors by path, on the host.
        names: keys of the steps, see :func:`step_keys`.
        known: results of steps of other prologues on the same leaves, by key; small results are added.
        in_order: True: all steps are run at once, in their order; None: if :func:`write_into_arguments` says so.
    """
    results: list[Any] = [None] * len(steps)

    # These functions are called some hundred times for each new scene: so they are short.

    def tensor(source: Source) -> Tensor:
        kind, name = source.kind, source.name
        if kind == "leaf":
            return leaves[name]  # pyright: ignore[reportArgumentType]
        if kind == "constants":
            return constants[int(name)].cpu()  # weights of a user's module may be on a device
        result = results[name]  # pyright: ignore[reportCallIssue, reportArgumentType]
        if result is None:
            result = run(int(name))
        return result if source.item < 0 else result[source.item]

    def filled(value: Any) -> Any:
        """Return an argument with tensors in place of sources."""
        kind = type(value)
        if kind is Source:
            return tensor(value)
        if kind is tuple:
            return tuple([filled(x) for x in value])
        return [filled(x) for x in value] if kind is list else value

    def run(number: int) -> Any:
        """Return the result of a step."""
        key = names[number] if names and known is not None else None
        result = None if key is None or known is None else known.get(key)
        if result is None:
            step = steps[number]
            kwargs = {k: filled(v) for k, v in step.kwargs.items()} if step.kwargs else {}
            with torch.no_grad() if torch.is_grad_enabled() else nullcontext():
                result = step.function(*[filled(x) for x in step.args], **kwargs)
            if key is not None and known is not None and _small(result):
                known[key] = result
        results[number] = result
        return result

    if write_into_arguments(steps) if in_order is None else in_order:
        for number in range(len(steps)):
            if results[number] is None:
                run(number)
    return tensor


def write_into_arguments(steps: Sequence[Step]) -> bool:
    """Return True if steps may write into their arguments: then results depend on the order of all steps."""
    return any(map(_writes, steps))


def _writes(step: Step) -> bool:
    """Return True if a step may write into its arguments."""
    schema = getattr(step.function, "_schema", None)
    return schema is None or schema.is_mutable


def leaves_of_steps(steps: Sequence[Step]) -> tuple[frozenset[str] | None, ...]:
    """Return the paths of the leaves that each step depends on; None for steps that depend on more, such as constants."""
    found: list[frozenset[str] | None] = []
    for step in steps:
        paths = leaves_of((step.args, tuple(step.kwargs.values())), found)
        found.append(None if _writes(step) else paths)
    return tuple(found)


def leaves_of(value: Any, of_steps: Sequence[frozenset[str] | None]) -> frozenset[str] | None:
    """Return the paths of the leaves that a source, or nested arguments with sources, depend on.

    ``of_steps``: as from :func:`leaves_of_steps`, of the steps before.
    """
    if isinstance(value, Source):
        if value.kind == "constants":
            return None
        return frozenset({str(value.name)}) if value.kind == "leaf" else of_steps[int(value.name)]
    paths: frozenset[str] = frozenset()
    if isinstance(value, list | tuple):
        for item in value:
            inner = leaves_of(item, of_steps)
            if inner is None:
                return None
            paths |= inner
    return paths
