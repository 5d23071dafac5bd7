"""Programs of a process: each is traced and compiled once for all tensors of one structure, or read from disk."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from torchpt.lanes import engine, shelf
from torchpt.lanes.kernel import text
from torchpt.lanes.program import Program, holds
from torchpt.lanes.stage import TracedStage

__all__ = ["MOST_PROGRAMS", "compiled", "forget", "program_of"]

#: More programs than this are not kept.
MOST_PROGRAMS = 512
#: By what they were traced for, the latest last.
_programs: dict[Any, Program] = {}
_tracing = threading.Lock()


def program_of(structure: Any, tensors: Mapping[str, Tensor], traced: Callable[[], TracedStage]) -> Program:
    """Return the program of a structure: of this process, from disk, or traced and compiled now.

    Args:
        structure: all that the trace may ask, but for the numbers in its tensors; hashable.
        tensors: the leaves by path, whose numbers a trace may rely on.
        traced: traces it.

    Raises:
        Unsupported: for what the lane compiler does not know.
    """
    with _tracing:  # one at a time in a process: see torchpt.lanes.tracing.tracing
        program = _programs.get(structure)
        name = shelf.key_of(structure) if program is None else None
        if program is None and name is not None:
            program = shelf.load(name)
        if program is None or not holds(program, tensors):
            program = compiled(traced())
            if name is not None:
                shelf.store(name, program)
        if _programs.get(structure) is not program:
            _programs.pop(structure, None)
            _programs[structure] = program
            if len(_programs) > MOST_PROGRAMS:
                del _programs[next(iter(_programs))]
        return program


def compiled(stage: TracedStage, target: engine.Target | None = None) -> Program:
    """Return the program of a stage for a machine; for this one where None."""
    target = target or engine.host()
    return Program.of(stage, engine.compiled(text(stage, target.form), target))


def forget() -> None:
    """Drop the programs of this process; those on disk stay."""
    _programs.clear()
