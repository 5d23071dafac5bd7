"""Processes that compile LLVM IR for this one, several modules at a time: llvmlite compiles one at a time in a process.

They run :mod:`torchpt.native.codegen`, and end soon after the last job. A job of a process that cannot be started, or that
dies, is left to the caller.
"""

from __future__ import annotations

import atexit
import itertools
import json
import os
import queue
import subprocess
import sys
import threading
from concurrent.futures import Future
from contextlib import suppress
from pathlib import Path

from torchpt.native import codegen
from torchpt.native.codegen import Job

__all__ = ["submit"]

#: Seconds without a job after which a process ends. One takes some 100 MB.
IDLE = 1.0
#: Most processes, however many threads a render has.
MOST = 16

_lock = threading.Lock()
#: Quick jobs first; the number keeps the order of the others.
_jobs: queue.PriorityQueue[tuple[bool, int, Future[bytes | None], Job]] = queue.PriorityQueue()
_numbers = itertools.count()
_compilers: set[_Compiler] = set()


class _Compiler:
    """A process, and the thread that gives it jobs."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        threading.Thread(target=self._serve, name="torchpt compiler", daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                _, _, future, job = _jobs.get(timeout=IDLE)
            except queue.Empty:
                with _lock:
                    if _jobs.empty():
                        _compilers.discard(self)
                        break
                continue
            code = None
            try:
                code = self._compile(job)
            except Exception:  # the process has died, memory ran out, or the pipes were closed as this process exits
                self.close()
            future.set_result(code)
        self.close()

    def _compile(self, job: Job) -> bytes:
        """Return the code of a job.

        Raises:
            OSError: the process cannot be started, or has died.
        """
        process = self.process
        if process is None:
            # The paths of this process, so that llvmlite is the same.
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
            process = self.process = subprocess.Popen(
                [sys.executable, codegen.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
            )
        into, out = process.stdin, process.stdout  # another thread may call `close` at any time
        assert into is not None and out is not None
        into.write(json.dumps(job).encode() + b"\n")
        into.flush()
        size = out.read(8)
        code = out.read(int.from_bytes(size, "little"))
        if len(size) < 8 or len(code) < int.from_bytes(size, "little"):
            raise OSError("the compiler has ended")
        return code

    def close(self) -> None:
        """End the process, even in the middle of a job."""
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):
                    pipe.close()  # pyright: ignore[reportOptionalMemberAccess]
            process.wait()


def submit(job: Job, most: int) -> Future[bytes | None] | None:
    """Compile a job in another process.

    Args:
        job: the module.
        most: most processes that run at a time; below 2 nothing is done.

    Returns:
        The future code, which is None where the process has died. None where no process would help, or could be started.
    """
    if most < 2 or not _is_python():
        return None
    future: Future[bytes | None] = Future()
    with _lock:
        _jobs.put((not job.quick, next(_numbers), future, job))
        if len(_compilers) < min(most, MOST):
            _compilers.add(_Compiler())
    return future


def _is_python() -> bool:
    """Return True if ``sys.executable`` is an interpreter, and not a program that has one inside."""
    return Path(sys.executable or "").name.lower().startswith(("python", "pypy"))


def _end() -> None:
    """End all processes: this one exits."""
    with suppress(queue.Empty):
        while True:  # so that no thread starts a process again
            _, _, future, _ = _jobs.get_nowait()
            future.set_result(None)
    with _lock:
        compilers = list(_compilers)
    for compiler in compilers:
        compiler.close()


def _after_fork() -> None:
    """Forget the processes, which are the parent's, and its jobs."""
    global _lock, _jobs
    _lock, _jobs = threading.Lock(), queue.PriorityQueue()
    _compilers.clear()


atexit.register(_end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
