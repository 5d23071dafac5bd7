"""Compile LLVM IR by llvmlite: to machine code of this CPU that can be called, or to code for another machine.

Code is cached in memory and on disk; its key is a hash of the IR, the target and the version of llvmlite.
"""

from __future__ import annotations

import ctypes
import os
import threading
import zlib
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from typing import Any

from torchpt.compiler.target import Target
from torchpt.core.memory import check_address_space
from torchpt.native import cache, machine
from torchpt.native.codegen import Job, compile_job
from torchpt.native.compilers import submit

__all__ = [
    "Function",
    "allow",
    "begin",
    "compile_ir",
    "counts",
    "host",
    "identity",
    "load_function",
    "wait_for_final_code",
]

#: Part of every key: raised when compilation changes, so that older entries are not read.
_VERSION = "6"
#: Most modules whose code is kept until it is asked for.
MOST_PENDING = 64
_lock = threading.Lock()
#: Counters for `counts`, how many processes may compile, and the target of this machine.
_state: dict[str, Any] = {"compiled": 0, "loaded": 0, "processes": 1}
_functions: dict[str, Function] = {}  # by key
_improving: set[Future[bytes | None]] = set()  # final code that will replace quick code
_pending: dict[str, Future[bytes | None]] = {}  # by key, the code of modules that other processes compile


@dataclass(eq=False)
class Function:
    """A compiled kernel. Quick code is replaced by the final one when that is there; the bits are the same.

    Attributes:
        call: ``call(address of the arguments, lanes)`` runs the kernel without the GIL; None for another machine's code.
        code: an object file, or the text of PTX.
        engine: keeps the code in memory, and that which was replaced, as a thread may still run it.
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
            if code is not None:
                _state["loaded"] += 1
                function = _loaded(code, target, key)
            else:
                function = _compiled_by_others(key, ir, target) or _compiled(key, ir, target)
                _state["compiled"] += 1
            _functions[key] = function
        return function


def _compiled(key: str, ir: str, target: Target) -> Function:
    """Compile a module in this process."""
    check_address_space()  # LLVM ends the process if it gets no memory
    code = compile_job(_job(ir, target))
    cache.write(_entry(key, target), code)
    return _loaded(code, target, key)


def _compiled_by_others(key: str, ir: str, target: Target) -> Function | None:
    """Wait for a module that other processes compile; None if they do not, or have died."""
    first = _pending.pop(key, None)
    code = None if first is None else first.result()
    if code is None:
        return None
    function = _loaded(code, target, key)
    if not target.form.threads:
        _improve(function, ir, target)
    return function


def _improve(function: Function, ir: str, target: Target) -> None:
    """Begin to compile the final code of a function in another process, which then replaces the quick one."""
    future = submit(_job(ir, target), _state["processes"])
    if future is not None:
        future.add_done_callback(partial(_replace, function, target))
        _improving.add(future)
        future.add_done_callback(_improving.discard)  # last, as callbacks run in their order


def allow(processes: int) -> None:
    """Allow so many other processes that compile."""
    _state["processes"] = processes


def begin(ir: str, target: Target | None = None) -> bool:
    """Begin to compile a module in another process, for a later :func:`compile_ir`; return False if none can be started.

    For this machine it is quick code.
    """
    with _lock:
        target = target or host()
        key = cache.digest(_identity(target), ir)
        if key in _functions or key in _pending or cache.read(_entry(key, target)) is not None:
            return True
        job = _job(ir, target)._replace(quick=not target.form.threads)
        future = submit(job, _state["processes"])
        if future is None:
            return False
        packed = zlib.compress(ir.encode(), 1)

        def keep(done: Future[bytes | None]) -> None:
            code = done.result()
            if code is not None and job.quick:
                cache.write(f"{key}.quick", len(code).to_bytes(8, "little") + code + packed)
            elif code is not None:
                cache.write(_entry(key, target), code)

        future.add_done_callback(keep)
        _pending[key] = future
        if len(_pending) > MOST_PENDING:  # the oldest, which nobody has asked for
            del _pending[next(iter(_pending))]
        return True


def _replace(function: Function, target: Target, done: Future[bytes | None]) -> None:
    """Replace the quick code of a function."""
    code = done.result()
    if code is not None:
        cache.write(_entry(function.key, target), code)
        final = _loaded(code, target, function.key)
        function.engine = function.engine, final.engine
        function.call, function.code = final.call, code


def _after_fork() -> None:
    """Forget what the parent's compilers make, which never arrives in a forked child."""
    global _lock
    _lock = threading.Lock()  # another thread may have held the old one
    _pending.clear()
    _improving.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def wait_for_final_code() -> None:
    """Wait until no function has quick code that will be replaced."""
    while _improving:
        wait(list(_improving))


def load_function(key: str, target: Target | None = None) -> Function | None:
    """Return a function of a target (None: this machine) by its key, from memory or disk; None if it is in neither."""
    with _lock:
        target = target or host()
        function = _functions.get(key)
        if function is None:
            code = cache.read(_entry(key, target))
            quick = cache.read(f"{key}.quick") if code is None and _state["processes"] > 1 else None
            if code is not None:
                function = _loaded(code, target, key)
            elif quick is not None:
                size = int.from_bytes(quick[:8], "little") + 8
                function = _loaded(quick[8:size], target, key)
                _improve(function, zlib.decompress(quick[size:]).decode(), target)
            if function is not None:
                _state["loaded"] += 1
                _functions[key] = function
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
