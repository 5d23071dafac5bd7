"""The form of a kernel, and the arenas that lanes live in between kernels."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAPACITY", "SCALAR", "VECTORS", "Form"]


# ---- Where lanes live between kernels: an *arena* has a row of 32-bit numbers for each number of a path's state


#: Numbers of a row: lanes, a multiple of a vector's, and a vector's to spare, for kernels write whole ones.
CAPACITY = 16384 + 16


# ---- The form of a kernel: how it holds lanes. Stages know nothing of it; what writes LLVM IR asks it


@dataclass(frozen=True)
class Form:
    """A form in which kernels hold lanes.

    Results are the same bits in any form: whatever is rounded once is said in the graph (:mod:`torchpt.compiler.fusing`), and
    each lane is computed by the same operations.

    Attributes:
        width: lanes of a value: a vector of them where more than one, else a plain number.
        row: numbers from one row of an arena to the next.
    """

    width: int
    row: int = CAPACITY


#: Of this CPU's kernels. Where a machine's vectors are narrower, LLVM takes several of them for one.
VECTORS = Form(16)
#: One lane at a time.
SCALAR = Form(1)
