"""Vectors of 4, 8 or 16 lanes as values in numba kernels.

``x = load(a, i, 8)`` is an LLVM vector ``<8 x float>`` (or int32); control flow stays Python. LLVM turns one source into
AVX-512, AVX2, SSE or NEON code, in several instructions where the machine's vectors are shorter. No operation is fused
and none is reordered: each lane has the bits that the scalar operation gives. Indices are taken as they are: neither
bounds nor negative numbers are looked at.
"""

from torchpt.native.simd.arithmetic import (
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
from torchpt.native.simd.lanes import (
    bits,
    highest,
    lane_numbers,
    lowest,
    mask,
    popcount,
    sort_descending,
    trailing_zeros,
)
from torchpt.native.simd.memory import gather, item, load, load_masked, pointer, prefetch, put, store, store_masked
from torchpt.native.simd.types import Vector, splat

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
    "lowest",
    "mask",
    "maximum",
    "minimum",
    "narrow",
    "pointer",
    "popcount",
    "prefetch",
    "put",
    "select",
    "sort_descending",
    "splat",
    "square_root",
    "store",
    "store_masked",
    "trailing_zeros",
    "widen",
]
