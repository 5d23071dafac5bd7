"""Compile LLVM IR by llvmlite: to machine code of this CPU that can be called, or to code for another machine.

Code is cached in memory and on disk; its key is a hash of the IR, the target and the version of llvmlite.
"""

from __future__ import annotations

import ctypes
import threading
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from torchpt.compiler.target import Target
from torchpt.core.memory import check_address_space
from torchpt.native import cache, machine
from torchpt.native.codegen import Job, compile_job
from torchpt.native.compilers import submit

__all__ = [
    "Function",
    "begin",
    "compile_ir",
    "counts",
    "host",
    "identity",
    "load_function",
]

#: Part of every key: raised when compilation changes, so that older entries are not read.
_VERSION = "6"
#: Most modules whose code is kept until it is asked for.
MOST_PENDING = 64
_lock = threading.Lock()
_state: dict[str, Any] = {"compiled": 0, "loaded": 0}  # counters for `counts`, and the target of this machine
_functions: dict[str, Function] = {}  # by key
_pending: dict[str, Future[bytes | None]] = {}  # by key, the code of modules that other processes compile


@dataclass(frozen=True)
class Function:
    """A compiled kernel.

    Attributes:
        call: ``call(address of the arguments, lanes)`` runs the kernel without the GIL; None for another machine's code.
        code: an object file, or the text of PTX.
        engine: keeps the code in memory.
        key: cache key of the code.
    """

    call: Any
    code: bytes
    engine: Any
    key: str = ""


#: Of programs whose code is not there yet.
NOT_COMPILED = Function(call=None, code=b"", engine=None)


def host() -> Target:
    """Return the target of this machine."""
    if "host" not in _state:
        _state["host"] = Target(*machine.host())
    return _state["host"]


def counts() -> tuple[int, int]:
    """Return the numbers of kernels that this process has compiled and has loaded from disk."""
    return _state["compiled"], _state["loaded"]


def compile_ir(ir: str, target: Target | None = None) -> Function:
    """Return the function ``kernel`` of an LLVM module from memory, from disk, or compiled now for the target."""
    with _lock:
        target = target or host()
        key = cache.digest(_identity(target), ir)
        function = _functions.get(key)
        if function is None:
            code = cache.read(_entry(key, target))
            if code is None:
                future = _pending.pop(key, None)
                code = None if future is None else future.result()
                if code is None:
                    check_address_space()  # LLVM ends the process if it gets no memory
                    code = compile_job(_job(ir, target))
                    cache.write(_entry(key, target), code)
                _state["compiled"] += 1
            else:
                _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def begin(ir: str, target: Target | None, processes: int) -> bool:
    """Begin to compile a module in another process, for a later :func:`compile_ir`; return False if none can be started.

    ``processes``: most that run at a time.
    """
    with _lock:
        target = target or host()
        key = cache.digest(_identity(target), ir)
        if key in _functions or key in _pending or cache.read(_entry(key, target)) is not None:
            return True
        future = submit(_job(ir, target), processes)
        if future is None:
            return False
        future.add_done_callback(lambda done: _keep(_entry(key, target), done.result()))
        _pending[key] = future
        if len(_pending) > MOST_PENDING:  # the oldest, which nobody has asked for
            del _pending[next(iter(_pending))]
        return True


def _keep(entry: str, code: bytes | None) -> None:
    """Write code to disk."""
    if code is not None:
        cache.write(entry, code)


def load_function(key: str, target: Target | None = None) -> Function | None:
    """Return a function of a target (None: this machine) by its key, from memory or disk; None if it is in neither."""
    with _lock:
        target = target or host()
        function = _functions.get(key)
        code = cache.read(_entry(key, target)) if function is None else None
        if code is not None:
            _state["loaded"] += 1
            function = _functions[key] = _loaded(code, target, key)
        return function


def identity(target: Target | None = None) -> str:
    """Return text that identifies compiler and target (None: this machine), as part of cache keys."""
    return _identity(target or host())


def _entry(key: str, target: Target) -> str:
    """Return the name of the entry on disk."""
    return f"{key}.{'ptx' if target.form.threads else 'o'}"


def _identity(target: Target) -> str:
    return "\n".join((_VERSION, machine.version(), repr(target)))


def _job(ir: str, target: Target) -> Job:
    return Job(ir, target.cpu, target.features, target.triple, target.form.threads)


def _loaded(code: bytes, target: Target, key: str) -> Function:
    if target.triple is not None:  # code for another machine cannot be called here
        return Function(call=None, code=code, engine=None, key=key)
    engine, address_of_function = machine.load_object(code)
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64)(address_of_function("kernel"))
    return Function(call, code, engine, key)
