"""SIMD vectors of 4, 8 or 16 lanes as values in numba kernels.

``x = load(a, i, 8)`` is an LLVM vector ``<8 x float>`` (or int32); control flow stays Python. LLVM compiles the same code to
AVX-512, AVX2, SSE or NEON, with several instructions a vector if the machine's are shorter. No operation is fused or reordered:
each lane has the bits of the scalar operation. Indices are not checked: neither bounds nor negative ones.

A *mask* is a vector of booleans, as comparisons give it. Functions here are *intrinsics* of numba: each is written as a
function of numba's types that returns the signature and a function that writes LLVM instructions, or None for types that it
does not accept. Kernels call them without the first parameter, ``context``.
"""

from kernel_sources.simd.arithmetic import (
    absolute,
    as_float,
    as_int,
    maximum,
    minimum,
    narrow,
    select,
    square_root,
    widen,
)
from kernel_sources.simd.lanes import (
    bits,
    highest,
    lane_numbers,
    lowest,
    mask,
    popcount,
    sort_descending,
    trailing_zeros,
)
from kernel_sources.simd.memory import gather, item, load, load_masked, prefetch, put, store, store_masked
from kernel_sources.simd.pointers import load_pointer, part, stack_memory
from kernel_sources.simd.types import Vector, splat

__all__ = [
    "Vector",
    "absolute",
    "as_float",
    "as_int",
    "bits",
    "gather",
    "highest",
    "item",
    "lane_numbers",
    "load",
    "load_masked",
    "load_pointer",
    "lowest",
    "mask",
    "maximum",
    "minimum",
    "narrow",
    "part",
    "popcount",
    "prefetch",
    "put",
    "select",
    "sort_descending",
    "splat",
    "square_root",
    "stack_memory",
    "store",
    "store_masked",
    "trailing_zeros",
    "widen",
]
