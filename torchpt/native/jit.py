"""Compile numba kernels, and run them on several threads.

Importing this module imports numba; only the numba backends import it.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
import threading
from collections.abc import Callable
from typing import Any

import llvmlite
import numba
import torch
from numba.core import config as numba_config
from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.event import Event, Listener, register

from torchpt.core.errors import RenderError
from torchpt.core.memory import CODE_BYTES, check_address_space
from torchpt.core.threads import parallel_for
from torchpt.native import cache, compile_time
from torchpt.native.content import code_of_function

if getattr(numba_config, "DISABLE_JIT", 0):
    raise RenderError("NUMBA_DISABLE_JIT is set, and kernels are machine code that Python cannot run: unset it")

__all__ = ["ensure_compiled", "jit", "jit_internal", "launch", "parallel_allowed"]

_lock = threading.Lock()
_state: dict[str, Any] = {"owner": None, "parallel": None, "forked": False, "said": False}
#: Seconds of compilation after which a message is printed.
_PATIENCE = 1.0


def _after_fork() -> None:
    """Reset the state in a forked child, which has none of the parent's OpenMP threads.

    torch's parallel operations would wait for these threads forever: in the child they run in one thread.
    """
    global _lock
    torch.set_num_threads(1)
    _lock = threading.Lock()
    _state.update(forked=True, parallel=False)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class _Compiling(Listener):
    """A numba listener that reports each compilation to :mod:`torchpt.native.compile_time`."""

    def on_start(self, event: Event) -> None:
        compile_time.begin()

    def on_end(self, event: Event) -> None:
        compile_time.end()


# Numba holds this lock while it compiles, and while it looks a kernel up on disk.
register("numba:compiler_lock", _Compiling())


def jit(**options: Any) -> Callable[[Callable], Any]:
    """Decorate a kernel: ``numba.njit`` without the GIL, cached on disk by content.

    ``error_model="numpy"`` is needed: Python's check for division by zero prevents vectorization.
    """
    settings: dict[str, Any] = {"error_model": "numpy", "nogil": True, **options}

    def wrap(function: Callable) -> Any:
        kernel: Any = numba.njit(**settings)(function)
        kernel._cache = _ByContent(kernel)
        return kernel

    return wrap


class _ByContent(NullCache):
    """A disk cache of a kernel's machine code, by the content of its source; errors are ignored, and the kernel is compiled.

    numba's own cache checks only the time of the kernel's file: a checkout would recompile all kernels, and an edit of an
    inlined function none.
    """

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        self._content: str | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        target_context.refresh()
        content = cache.read(self._entry(sig, target_context.codegen()))
        if content is None:
            return None
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(content))
        except Exception:  # an entry in another format may raise anything: the kernel is compiled
            return None

    def save_overload(self, sig: Any, cres: Any) -> None:
        if not cres.library.has_dynamic_globals:  # addresses of this process
            cache.write(self._entry(sig, cres.library.codegen), serialize.dumps(cres._reduce()))

    def _entry(self, sig: Any, codegen: Any) -> str:
        if self._content is None:
            self._content = code_of_function(self._kernel)
        facts = (
            numba.__version__,
            llvmlite.__version__,
            sys.version_info[:2],
            codegen.magic_tuple(),
            str(sig),
            self._content,
        )
        return hashlib.sha256(repr(facts).encode()).hexdigest()[:40] + ".nbc"


def jit_internal(**options: Any) -> Callable[[Callable], Any]:
    """Decorate a function that only kernels call: as :func:`jit`, without the wrappers for Python and C."""
    return jit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def ensure_compiled(kernel: Any, *args: Any) -> Any:
    """Compile a kernel by a call without work, and return it; a long compilation prints a message to stderr, once."""
    if not kernel.overloads:
        # LLVM aborts the process without memory, and so does the BLAS that numba loads with its first kernel.
        check_address_space(CODE_BYTES if "numba.np.arraymath" in sys.modules else 4 * CODE_BYTES)
        timer = threading.Timer(_PATIENCE, _say)
        timer.daemon = True
        timer.start()
        try:
            kernel(*args)
        finally:
            timer.cancel()
    return kernel


def _say() -> None:
    if not _state["said"]:
        _state["said"] = True
        print("torchpt: compiling the search kernels (once)...", file=sys.stderr, flush=True)


def _most_threads() -> int:
    """Return the number of threads that numba was started with."""
    return int(getattr(numba_config, "NUMBA_NUM_THREADS", 1))


def _probe() -> bool:
    """Return True if numba's threading layer allows parallel kernels in several Python threads; starts the layer."""
    if _most_threads() < 2 or getattr(numba_config, "THREADING_LAYER", "") == "workqueue":
        return False
    try:
        from numba.np.ufunc.parallel import _launch_threads, threading_layer

        _launch_threads()
        return threading_layer() in ("omp", "tbb")
    except (ImportError, ValueError, RuntimeError):
        return False


def parallel_allowed() -> bool:
    """Return True if ``prange`` kernels may run in this process.

    They may run only in the process of the first call, never after a fork (GNU OpenMP kills forked children that use it), and
    never with numba's ``workqueue`` layer, which aborts when two Python threads enter it.
    """
    if _state["forked"]:
        return False
    with _lock:
        if _state["parallel"] is None:
            _state.update(owner=os.getpid(), parallel=_probe())
        return bool(_state["parallel"]) and _state["owner"] == os.getpid()


def launch(serial: Any, parallel: Any, items: int, threads: int, grain: int, args: tuple) -> None:
    """Run a kernel over ``range(items)``.

    Args:
        serial: compiled ``(first, last, *args)``, releases the GIL.
        parallel: compiled ``(chunks, items, *args)``: the same body under ``prange``.
        items: number of items.
        threads: most threads; 1 runs in the calling thread.
        grain: fewest items that are worth another thread.
        args: arguments of both; each item writes its own results into them, so results do not depend on the split.
    """
    threads = min(threads, max(1, items // grain))
    if threads == 1:
        ensure_compiled(serial, 0, 0, *args)(0, items, *args)
    elif parallel_allowed():
        threads = min(threads, _most_threads())
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        try:
            ensure_compiled(parallel, 0, 0, *args)(threads, items, *args)
        finally:
            numba.set_num_threads(before)
    else:
        ensure_compiled(serial, 0, 0, *args)
        parallel_for(lambda first, last: serial(first, last, *args), items, threads)
