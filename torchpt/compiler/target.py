"""The machines that kernels are compiled for."""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.compiler.form import VECTORS, Form

__all__ = ["Target"]


@dataclass(frozen=True)
class Target:
    """A machine that kernels are compiled for, as LLVM names it, and the form of its kernels.

    Attributes:
        cpu: LLVM's name of the processor.
        features: LLVM's list of processor features.
        triple: LLVM's target triple; None: this machine.
        form: layout of lanes; with ``form.threads`` the code is PTX, else machine code.
    """

    cpu: str
    features: str
    triple: str | None = None
    form: Form = VECTORS
