"""Caches of compiled programs: in memory by the structure of a stage's arguments, on disk by content.

The *structure* of arguments is all that a trace depends on except for the values of tensors: names, dtypes, shapes, and all
values that are not tensors.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cpu
from torchpt.compiler.graph import DTYPES
from torchpt.compiler.kernel import kernel_ir
from torchpt.compiler.program import Program, TracedStage, guards_hold
from torchpt.compiler.prologue import Guard, Source, Step, Table
from torchpt.compiler.target import Target
from torchpt.native import cache
from torchpt.native.content import code_of_folder

__all__ = [
    "MOST_PROGRAMS",
    "cache_key",
    "clear_programs",
    "compile_stage",
    "load",
    "note_unasked",
    "prefetch",
    "program_of",
    "store",
]


# ---- Programs on disk: the result of tracing, so that another process need not trace the stage again
#
# An entry names its machine code, the tables that the code reads and the torch operators that compute these tables. It is
# JSON without code: operators are looked up by name in torch.ops.aten.


#: Elements of the largest constant of a program that is written to disk; programs with larger ones are traced in each process.
_MOST_ELEMENTS = 1 << 16
#: Packages whose classes enter a key by name: the key already holds the versions of these packages.
_LIBRARIES = ("torchpt", "torch", "builtins")
#: Attributes of a program that JSON takes as they are.
_PLAIN = ("uniforms", "lists", "counters", "tensors", "results", "shadows", "nodes", "sums")
#: Long parts of structures by ``id``, with their text: tuples of values that never change.
_texts: dict[int, tuple[Any, str]] = {}
#: Characters from which on a text is kept, and the most that are.
_LONG, _MOST_TEXTS = 1000, 16


class _NotStorable(Exception):
    """An error: a value cannot be stored in an entry."""


def cache_key(structure: Any, target: Target | None = None) -> str | None:
    """Return the cache key of a structure for a target (None: this machine).

    None if the structure holds objects that exist in this process alone.
    """
    try:
        parts = structure if isinstance(structure, tuple) else (structure,)
        text = "\0".join(map(_text_of_part, parts))
        return cache.digest(code_of_folder(), torch.__version__, cpu.identity(target), text)
    except _NotStorable:
        return None


def _text_of_part(part: Any) -> str:
    """Return :func:`_canonical` of a part of a structure; that of a long one is kept, as the kernels of a render share it."""
    known = _texts.get(id(part))
    if known is not None and known[0] is part:
        return known[1]
    text = _canonical(part)
    if len(text) >= _LONG and isinstance(part, tuple):
        if len(_texts) >= _MOST_TEXTS:
            _texts.clear()
        _texts[id(part)] = part, text
    return text


def _canonical(value: Any) -> str:
    """Return text that is equal for equal structures, in all processes."""
    if isinstance(value, tuple | list):
        return f"({','.join(map(_canonical, value))})"
    if value is None or isinstance(value, bool | int | float | str | torch.dtype):
        return repr(value)
    if isinstance(value, type) and value.__module__.partition(".")[0] in _LIBRARIES:
        return f"{value.__module__}.{value.__qualname__}"  # the code of other packages may change under the same name
    if isinstance(value, bytes):
        return value.hex()
    raise _NotStorable


def load(key: str, target: Target | None = None) -> Program | None:
    """Load a program for a target (None: this machine) from disk; None if there is no usable entry."""
    content = cache.read(f"{key}.json")
    if content is None:
        return None
    entry = json.loads(content)
    function = cpu.load_function(entry["code"], target)
    if function is None:
        return None
    return Program(
        function=function,
        tables=tuple(Table(_source_from_json(source), axis) for source, axis in entry["tables"]),
        steps=tuple(_step_from_json(step) for step in entry["steps"]),
        constants=tuple(_tensor_from_json(tensor) for tensor in entry["constants"]),
        guards=tuple(Guard(_source_from_json(source), value) for source, value in entry["guards"]),
        **{name: _tuple_if_list(entry[name]) for name in _PLAIN},
    )


def store(key: str, program: Program) -> None:
    """Write a program to disk, unless it holds values that cannot be stored."""
    try:
        entry = {
            "code": program.code,
            "tables": [[_source_to_json(table.source), table.axis] for table in program.tables],
            "steps": [[str(step.function), _to_json(step.args), _to_json(step.kwargs)] for step in program.steps],
            "constants": [_tensor_to_json(tensor) for tensor in program.constants],
            "guards": [[_source_to_json(guard.source), guard.value] for guard in program.guards],
            **{name: getattr(program, name) for name in _PLAIN},
        }
    except _NotStorable:
        return
    cache.write(f"{key}.json", json.dumps(entry).encode())


def _tuple_if_list(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _source_to_json(source: Source) -> list[Any]:
    return [source.kind, source.name, source.item]


def _source_from_json(value: list[Any]) -> Source:
    kind, name, item = value
    return Source(kind, name, item)


def _tensor_to_json(tensor: Tensor) -> list[Any]:
    if tensor.numel() > _MOST_ELEMENTS or tensor.requires_grad or tensor.dtype not in DTYPES:
        raise _NotStorable
    data = base64.b64encode(tensor.detach().contiguous().numpy().tobytes()).decode()
    return [str(tensor.dtype).removeprefix("torch."), list(tensor.shape), data]


def _tensor_from_json(value: list[Any]) -> Tensor:
    name, shape, data = value
    return torch.from_numpy(np.frombuffer(base64.b64decode(data), name).reshape(shape).copy())


def _to_json(value: Any) -> Any:
    """Return an argument of a step as JSON; what JSON has no type for becomes an object with one key, the kind of value."""
    if isinstance(value, Source):
        return {"source": _source_to_json(value)}
    if isinstance(value, torch.dtype | torch.device | torch.layout | torch.memory_format):
        return {type(value).__name__: str(value).removeprefix("torch.")}
    if isinstance(value, dict):
        return {"dict": {name: _to_json(item) for name, item in value.items()}}
    if isinstance(value, tuple | list):
        return [_to_json(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise _NotStorable


def _from_json(value: Any) -> Any:
    """Return the argument that :func:`_to_json` has written."""
    if isinstance(value, list):
        return [_from_json(item) for item in value]
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    if kind == "source":
        return _source_from_json(content)
    if kind == "dict":
        return {name: _from_json(item) for name, item in content.items()}
    return torch.device(content) if kind == "device" else getattr(torch, content)


def _step_from_json(value: list[Any]) -> Step:
    name, args, kwargs = value
    namespace, operator, overload = name.split(".")
    if namespace != "aten":
        raise ValueError(f"{name} is none of torch's operators")
    function = getattr(getattr(torch.ops.aten, operator), overload)
    return Step(function, tuple(_from_json(args)), _from_json(kwargs))


# ---- Programs in memory: each is loaded from disk, or traced and compiled, once for all tensors of one structure


#: Most programs that are kept in memory.
MOST_PROGRAMS = 512
#: Programs by structure and target, the newest last.
_programs: dict[Any, Program] = {}
#: Most programs that are begun and not asked for yet.
MOST_BEGUN = 64
#: Programs without their functions, the IR of these, which other processes compile, and keys on disk; by structure and target.
_begun: dict[Any, tuple[Program, str, str]] = {}
#: Keys on disk of those that :func:`note_unasked` has noted.
_noted: set[str] = set()
_tracing = threading.Lock()


def program_of(
    structure: Any,
    tensors: Mapping[str, Tensor],
    trace: Callable[[], TracedStage],
    target: Target | None = None,
) -> Program:
    """Return the program of a structure: from memory, from disk, or traced and compiled now.

    Args:
        structure: all that a trace depends on, except for the values of tensors; hashable.
        tensors: the leaves by path, on the host; a trace may depend on their values, and then has guards.
        trace: traces the stage.
        target: machine to compile for; None: this one.

    Raises:
        Unsupported: the stage does something that the lane compiler cannot compile.
    """
    with _tracing:  # one at a time in a process: see torchpt.compiler.tracing.tracing
        key = structure, target
        program = _programs.get(key)
        disk_key = cache_key(structure, target) if program is None else None
        if program is None and disk_key is not None:
            program = load(disk_key, target)
        if program is None and key in _begun:
            begun, ir, _ = _begun.pop(key)
            program = replace(begun, function=cpu.compile_ir(ir, target))
            if disk_key is not None:
                store(disk_key, program)
        if program is None or not guards_hold(program, tensors):
            program = compile_stage(trace(), target)
            if disk_key is not None:
                store(disk_key, program)
        if _programs.get(key) is not program:
            _keep(key, program)
        return program


def _keep(key: Any, program: Program) -> None:
    """Store a program in memory as the newest; the oldest goes if there are too many."""
    _programs.pop(key, None)
    _programs[key] = program
    if len(_programs) > MOST_PROGRAMS:
        del _programs[next(iter(_programs))]


def prefetch(
    structure: Any,
    tensors: Mapping[str, Tensor],
    trace: Callable[[], TracedStage],
    target: Target | None = None,
) -> None:
    """Trace a stage and begin to compile it in another process, for a later :func:`program_of`, if its program is not there.

    Args:
        structure: as for :func:`program_of`, and so are the others.
        tensors: see there.
        trace: see there.
        target: see there.

    Raises:
        Unsupported: the stage does something that the lane compiler cannot compile.
    """
    with _tracing:
        key = structure, target
        disk_key = cache_key(structure, target)
        if key in _programs or key in _begun or len(_begun) == MOST_BEGUN or disk_key is None:
            return
        program = load(disk_key, target)
        if program is not None:
            _keep(key, program)
            return
        if cache.read(f"{disk_key}.unasked") is not None:
            return
        stage = trace()
        ir = kernel_ir(stage, (target or cpu.host()).form)
        if cpu.begin(ir, target):
            _begun[key] = Program.of(stage, cpu.NOT_COMPILED), ir, disk_key


def note_unasked() -> None:
    """Note on disk which programs were begun and not asked for by a render that is complete.

    They are of models that no or few paths hit, in scenes of this structure. Later processes do not trace them in vain.
    """
    for _, _, disk_key in list(_begun.values()):  # without the lock: another thread may be compiling for a while
        if disk_key not in _noted:
            _noted.add(disk_key)
            cache.write(f"{disk_key}.unasked", b"")


def compile_stage(stage: TracedStage, target: Target | None = None) -> Program:
    """Compile a traced stage for a target; None is this machine."""
    target = target or cpu.host()
    return Program.of(stage, cpu.compile_ir(kernel_ir(stage, target.form), target))


def clear_programs() -> None:
    """Drop all programs in memory; entries on disk stay."""
    _programs.clear()
    _begun.clear()
