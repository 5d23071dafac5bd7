"""Decorators of kernels and of the functions that they call, and the types of a kernel's arguments.

Kernels are written in the subset of Python that numba compiles. Importing a source only registers its kernels
(:data:`KERNELS`); ``scripts/make_kernels.py`` lowers them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba.core import types
from numba.np.numpy_support import from_dtype

__all__ = [
    "BYTES",
    "DOUBLES",
    "FLOATS",
    "INT",
    "INTS",
    "KERNELS",
    "LONGS",
    "OPTIONS",
    "Kernel",
    "array",
    "inner",
    "kernel",
]

#: Types of arguments: an integer, and pointers to float32, float64, int32, int64 and uint8. See also :func:`array`.
INT = types.int64
FLOATS, DOUBLES = types.CPointer(types.float32), types.CPointer(types.float64)
INTS, LONGS = types.CPointer(types.int32), types.CPointer(types.int64)
BYTES = types.CPointer(types.uint8)

#: Options of numba. ``error_model="numpy"``: Python's check for division by zero would raise, and prevents vectorization. The
#: wrappers would be numba's own ways to call the function from Python and C.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "nogil": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


@dataclass(frozen=True)
class Kernel:
    """A function that Python calls.

    Attributes:
        module: name of the IR module that holds it: modules are compiled one at a time, when one of their kernels is called.
        function: the Python function.
        arguments: types of the arguments.
        name: its name in the module; by default that of the function.
    """

    module: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    name: str


#: All kernels whose sources have been imported.
KERNELS: list[Kernel] = []


def array(dtype: str, dimensions: int = 1) -> types.Array:
    """Return the type of an argument that is a contiguous array of numbers of a type in numpy's words, such as ``f4``."""
    return types.Array(from_dtype(np.dtype(dtype)), dimensions, "C")


def kernel(module: str, *arguments: Any, name: str = "") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Declare a kernel of an IR module by the types of its arguments; the function itself stays as it is."""

    def declare(function: Callable[..., Any]) -> Callable[..., Any]:
        KERNELS.append(Kernel(module, function, arguments, name or function.__name__))
        return function

    return declare


def inner(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function that only kernels call."""
    return numba.njit(**{**OPTIONS, **options})
