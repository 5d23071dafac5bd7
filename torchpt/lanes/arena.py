"""Where lanes live between kernels: an *arena* has a row of 32-bit numbers for each number of a path's state."""

from __future__ import annotations

__all__ = ["CAPACITY"]

#: Numbers of a row: lanes, a multiple of a vector's, and a vector's to spare, for kernels write whole ones.
CAPACITY = 16384 + 16
