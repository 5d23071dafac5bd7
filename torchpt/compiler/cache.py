"""Programs that are made once: those of this process by structure, and those on disk by content."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cpu
from torchpt.compiler.graph import DTYPES
from torchpt.compiler.kernel import kernel_ir
from torchpt.compiler.program import Program, TracedStage, guards_hold
from torchpt.compiler.prologue import Guard, Source, Step, Table
from torchpt.native import cache
from torchpt.native.content import code_of_folder

__all__ = ["MOST_PROGRAMS", "cache_key", "clear_programs", "compiled", "load", "program_of", "store"]


# ---- Programs on disk: what a stage was traced to, so that another process need not trace it again
#
# An entry says which machine code it belongs to, which tables that reads and by which operators of torch they are made. It is
# JSON; operators are looked up by name among torch's own, and nothing of it is code.


#: Largest tensor of a program's own that is written.
_MOST = 1 << 16
#: Whose classes are told by name: an entry belongs to a version of their code.
_LIBRARIES = ("torchpt", "torch", "builtins")
_PLAIN = ("uniforms", "lists", "counters", "tensors", "results", "shadows", "nodes", "sums")


class _NotKept(Exception):
    """Something that no entry can hold."""


def cache_key(structure: Any) -> str | None:
    """The name of an entry; None where the structure holds objects that only this process knows."""
    try:
        kernel_ir = "\n".join((code_of_folder(), torch.__version__, cpu.identity(), _canonical(structure)))
    except _NotKept:
        return None
    return hashlib.sha256(kernel_ir.encode()).hexdigest()


def _canonical(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"({','.join(map(_canonical, value))})"
    if value is None or isinstance(value, bool | int | float | str | torch.dtype):
        return repr(value)
    if isinstance(value, type) and value.__module__.partition(".")[0] in _LIBRARIES:
        return f"{value.__module__}.{value.__qualname__}"  # the code of others may change without its name
    if isinstance(value, bytes):
        return value.hex()
    raise _NotKept


def load(key: str) -> Program | None:
    """A program from disk; None where there is none that can be used."""
    content = cache.read(f"{key[:40]}.json")
    if content is None:
        return None
    facts = json.loads(content)
    function = cpu.load_function(facts["code"])
    if function is None:
        return None
    return Program(
        call=function.call,
        code=function.key,
        tables=tuple(Table(_source(x), axis) for x, axis in facts["tables"]),
        steps=tuple(_step(x) for x in facts["steps"]),
        constants=tuple(_tensor(x) for x in facts["constants"]),
        guards=tuple(Guard(_source(x), value) for x, value in facts["guards"]),
        **{name: _frozen(facts[name]) for name in _PLAIN},
    )


def store(key: str, program: Program) -> None:
    """Write a program, where it can be written."""
    try:
        facts = {
            "code": program.code,
            "tables": [[_source_out(t.source), t.axis] for t in program.tables],
            "steps": [[str(s.function), _out(s.args), _out(s.kwargs)] for s in program.steps],
            "constants": [_tensor_out(t) for t in program.constants],
            "guards": [[_source_out(g.source), g.value] for g in program.guards],
            **{name: getattr(program, name) for name in _PLAIN},
        }
    except _NotKept:
        return
    cache.write(f"{key[:40]}.json", json.dumps(facts).encode())


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _source_out(source: Source) -> list[Any]:
    return [source.kind, source.name, source.item]


def _source(value: list[Any]) -> Source:
    return Source(*value)


def _tensor_out(tensor: Tensor) -> list[Any]:
    if tensor.numel() > _MOST or tensor.requires_grad or tensor.dtype not in DTYPES:
        raise _NotKept
    data = base64.b64encode(tensor.detach().contiguous().numpy().tobytes()).decode()
    return [str(tensor.dtype).removeprefix("torch."), list(tensor.shape), data]


def _tensor(value: list[Any]) -> Tensor:
    name, shape, data = value
    return torch.from_numpy(np.frombuffer(base64.b64decode(data), name).reshape(shape).copy())


def _out(value: Any) -> Any:
    if isinstance(value, Source):
        return {"source": _source_out(value)}
    if isinstance(value, torch.dtype | torch.device | torch.layout | torch.memory_format):
        return {type(value).__name__: str(value).removeprefix("torch.")}
    if isinstance(value, dict):
        return {"dict": {name: _out(item) for name, item in value.items()}}
    if isinstance(value, tuple | list):
        return [_out(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise _NotKept


def _in(value: Any) -> Any:
    if isinstance(value, list):
        return [_in(item) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "source":
        return _source(content)
    if kind == "dict":
        return {name: _in(item) for name, item in content.items()}
    return torch.device(content) if kind == "device" else getattr(torch, content)


def _step(value: list[Any]) -> Step:
    name, args, kwargs = value
    space, operator, overload = name.split(".")
    if space != "aten":
        raise ValueError(f"{name} is none of torch's operators")
    return Step(getattr(getattr(torch.ops.aten, operator), overload), tuple(_in(args)), _in(kwargs))


# ---- Programs of a process: each is traced and compiled once for all tensors of one structure, or read from disk


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
    with _tracing:  # one at a time in a process: see torchpt.compiler.tracing.tracing
        program = _programs.get(structure)
        name = cache_key(structure) if program is None else None
        if program is None and name is not None:
            program = load(name)
        if program is None or not guards_hold(program, tensors):
            program = compiled(traced())
            if name is not None:
                store(name, program)
        if _programs.get(structure) is not program:
            _programs.pop(structure, None)
            _programs[structure] = program
            if len(_programs) > MOST_PROGRAMS:
                del _programs[next(iter(_programs))]
        return program


def compiled(stage: TracedStage, target: cpu.Target | None = None) -> Program:
    """Return the program of a stage for a machine; for this one where None."""
    target = target or cpu.host()
    return Program.of(stage, cpu.compiled(kernel_ir(stage, target.form), target))


def clear_programs() -> None:
    """Drop the programs of this process; those on disk stay."""
    _programs.clear()
