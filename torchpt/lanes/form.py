"""The form of a kernel: how it holds lanes. Stages know nothing of it; what writes LLVM IR asks it."""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.lanes.arena import CAPACITY

__all__ = ["SCALAR", "VECTORS", "Form"]


@dataclass(frozen=True)
class Form:
    """A form in which kernels hold lanes.

    Results are the same bits in any form: whatever is rounded once is said in the graph (:mod:`torchpt.lanes.fusing`), and
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
