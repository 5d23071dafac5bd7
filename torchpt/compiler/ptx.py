"""The target of PTX, the assembly text that the driver of an NVIDIA GPU compiles to machine code.

llvmlite has LLVM's NVPTX target, so neither the CUDA toolkit nor a GPU is needed here. The text is of PTX 7.0 for compute
capability 7.5 and uses nothing newer: drivers since CUDA 11.0 compile it for any later GPU.
"""

from __future__ import annotations

from torchpt.compiler.form import CAPACITY, Form
from torchpt.compiler.target import Target

__all__ = ["ptx_target"]

_TRIPLE = "nvptx64-nvidia-cuda"


def ptx_target(row: int = CAPACITY) -> Target:
    """Return the target of GPU kernels.

    Args:
        row: elements from one row of the GPU's arenas to the next, a constant in the code.
    """
    return Target(cpu="sm_75", features="+ptx70", triple=_TRIPLE, form=Form(width=1, row=row, threads=True))
