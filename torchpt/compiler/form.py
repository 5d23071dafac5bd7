"""The form of a kernel: lanes in a register, and elements in a row of the arena."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["CAPACITY", "SCALAR", "VECTORS", "Form"]


# ---- Path states between kernels: an *arena* has a row of 32-bit elements for each component of the path state


#: Elements of a row: lanes (a multiple of 16) and one vector of padding, as kernels write whole vectors.
CAPACITY = 16384 + 16


# ---- The form of a kernel. Stages do not depend on it, only the generation of LLVM IR does


@dataclass(frozen=True)
class Form:
    """The layout of lanes in a kernel.

    Results have the same bits in any form: the graph decides which products and sums are fused
    (:mod:`torchpt.compiler.fusing`), and each lane is computed by the same operations.

    Attributes:
        width: lanes of a value; a value is an LLVM vector if there is more than one, else a scalar.
        row: elements from one row of an arena to the next.
    """

    width: int
    row: int = CAPACITY


#: The form of CPU kernels. LLVM splits the vectors on machines with narrower registers.
VECTORS = Form(16)
#: One lane at a time.
SCALAR = Form(1)
