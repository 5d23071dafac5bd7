"""Where lanes live between kernels: an *arena* has a row of 32-bit numbers for each number of a path's state."""

from __future__ import annotations

from torchpt.lanes.block import WIDTH

__all__ = ["CAPACITY"]

#: Lanes of an arena: a multiple of WIDTH, with WIDTH to spare at the end of each row.
CAPACITY = 16384 + WIDTH
