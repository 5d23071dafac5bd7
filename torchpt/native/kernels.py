"""The kernels that the package carries as LLVM IR: compiled for this machine when one of them is first called.

A file of the folder ``ir/`` is a *module*: compressed IR of a few kernels that are needed together. ``scripts/make_kernels.py``
makes it of ``scripts/kernel_sources``, and puts before the IR a comment for each kernel with the types of its arguments:
``int``, ``f4*`` for the address of float32, or ``f4[2]`` for a two-dimensional array, whose shape is passed as well.
Compilation takes a tenth of a second to some tenths; its result is cached on disk (:mod:`torchpt.native.cache`).

Kernels run without the GIL. They allocate no memory and raise nothing.
"""

from __future__ import annotations

import ctypes
import lzma
import os
import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchpt.core.threads import parallel_for
from torchpt.native import cache, compile_time, machine

__all__ = ["FOLDER", "Kernel", "bound_to", "kernel", "read_module", "run_parallel"]

FOLDER = Path(__file__).with_name("ir")
#: Parts into which the work is cut for each thread. Items differ in cost, so a thread that finishes early takes another part.
_PARTS_PER_THREAD = 8
#: A kernel's line in the head of a module, such as ``; nearest(int, f4*, f4[2])``: the name, and the types of the arguments.
_SIGNATURE = re.compile(r"^; (\w+)\((.*)\)$", re.MULTILINE)


def _plain_address(array: np.ndarray) -> int:
    return array.ctypes.data


def _fast_address(array: np.ndarray) -> int:
    """Return the address of an array's numbers, in a fifth of the time of :func:`_plain_address`.

    In numpy's binary interface the pointer to the numbers is the first member of an array (``PyArrayObject.data``). It lies
    right behind the members that every Python object has, and CPython's ``id`` is the address of the object.
    """
    return _word_at(id(array) + _OBJECT_BYTES).value


_word_at, _OBJECT_BYTES = ctypes.c_int64.from_address, object.__basicsize__
_sample = np.zeros(3)
_fast_is_right = sys.implementation.name == "cpython" and _fast_address(_sample) == _plain_address(_sample)
address_of = _fast_address if _fast_is_right else _plain_address


class _Argument(NamedTuple):
    """The type of an argument of a kernel.

    Attributes:
        dtype: the type of the numbers that the argument points to; None for an integer.
        dimensions: dimensions of an array, whose shape is passed as well; 0 for an integer or a pointer.
    """

    dtype: np.dtype[Any] | None
    dimensions: int

    @staticmethod
    def parse(text: str) -> _Argument:
        """Return the type that is written as ``int``, ``f4*`` or ``f4[2]``."""
        if text == "int":
            return _Argument(dtype=None, dimensions=0)
        dtype, dimensions = (text[:-1], 0) if text.endswith("*") else (text[:-3], int(text[-2]))
        return _Argument(np.dtype(dtype), dimensions)


class Kernel:
    """A compiled kernel.

    Attributes:
        call: machine code that takes 64-bit integers (:meth:`words`) and returns one, undefined if the kernel returns nothing.
    """

    def __init__(self, name: str, arguments: list[_Argument], address: int, engine: Any) -> None:
        self.name, self._arguments, self._engine = name, arguments, engine  # the engine keeps the code in memory
        words = sum(1 + argument.dimensions for argument in arguments)
        self.call = ctypes.CFUNCTYPE(ctypes.c_int64, *(ctypes.c_int64,) * words)(address)

    def __call__(self, *args: Any) -> int:
        """Call the kernel; the arguments are those of :meth:`words`."""
        return self.call(*self.words(*args))

    def words(self, *args: Any) -> list[int]:
        """Return the 64-bit integers of a call: an array becomes its address, followed by its shape if the type has dimensions.

        The caller keeps the arrays alive.

        Args:
            args: for each argument an integer, or a contiguous array of its type; for a pointer also an address.

        Raises:
            TypeError: the number of arguments is wrong, or an array has another type or layout.
        """
        if len(args) != len(self._arguments):
            raise TypeError(f"{self.name} takes {len(self._arguments)} arguments, got {len(args)}")
        words: list[int] = []
        for value, (dtype, dimensions) in zip(args, self._arguments, strict=True):
            if type(value) is not np.ndarray:
                words.append(value)
                continue
            if value.dtype != dtype or not value.flags.c_contiguous or (dimensions and value.ndim != dimensions):
                form = f"{value.dtype}, shape {value.shape}, strides {value.strides}"
                raise TypeError(f"{self.name} takes a contiguous array of {dtype}, got {form}")
            words.append(address_of(value))
            if dimensions:
                words += value.shape
        return words


_modules: dict[str, dict[str, Kernel]] = {}
_lock = threading.Lock()


def _after_fork() -> None:
    """Make a new lock in a forked child: another thread of the parent may have held the old one."""
    global _lock
    _lock = threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def kernel(module: str, name: str) -> Kernel:
    """Return a kernel of a module, from memory, from the cache on disk, or compiled now with all kernels of the module."""
    kernels = _modules.get(module)
    if kernels is None:
        compile_time.begin()
        try:
            with _lock:
                kernels = _modules.get(module)
                if kernels is None:
                    kernels = _modules[module] = _load(module)
        finally:
            compile_time.end()
    return kernels[name]


def read_module(module: str) -> str:
    """Return the IR of a module as text, with the comments that list its kernels."""
    return lzma.decompress((FOLDER / f"{module}.ll.xz").read_bytes()).decode()


def _load(module: str) -> dict[str, Kernel]:
    ir = read_module(module)
    entry = f"{cache.digest(machine.identity(), ir)}.o"
    code = cache.read(entry)
    if code is None:
        code = machine.object_code(ir)
        cache.write(entry, code)
    engine, address_of_function = machine.load_object(code)
    head = ir.partition("\ndefine ")[0]  # all before the first function
    return {
        name: Kernel(name, [_Argument.parse(text) for text in arguments.split(", ")], address_of_function(name), engine)
        for name, arguments in _SIGNATURE.findall(head)
    }


def bound_to(kernel: Kernel, memory: int, args: tuple[Any, ...]) -> Callable[[int], None]:
    """Return a function that runs a kernel over ``range(items)`` in the calling thread; arguments as for :func:`run_parallel`.

    They are checked once, for kernels that are called often with the same arrays. It has scratch memory of its own, so two
    threads must not call it at once.
    """
    scratch = np.empty(memory, np.uint8)
    words, call = kernel.words(0, 0, address_of(scratch), *args)[2:], kernel.call

    def run(
        items: int, _kept: Any = (scratch, args)
    ) -> None:  # words are addresses: their memory lives as long as this
        call(0, items, *words)

    return run


def run_parallel(kernel: Kernel, items: int, threads: int, grain: int, memory: int, args: tuple[Any, ...]) -> None:
    """Run a kernel over ``range(items)`` on several threads.

    Args:
        kernel: its first three arguments are the first item, one past the last, and scratch memory. Each item writes results
            of its own, so that they do not depend on how the items are shared out.
        items: number of items.
        threads: most threads; 1 runs in the calling thread.
        grain: fewest items that are worth another thread.
        memory: bytes of scratch memory of a call.
        args: the arguments after the first three.
    """
    # the first three words differ from part to part
    words, call = kernel.words(0, items, 0, *args)[3:], kernel.call

    def run_part(first: int, last: int) -> None:
        scratch = np.empty(memory, np.uint8)
        call(first, last, address_of(scratch), *words)

    threads = min(threads, max(1, items // grain))
    if threads == 1:
        run_part(0, items)
        return
    parallel_for(run_part, items, threads, parts_per_thread=_PARTS_PER_THREAD)
