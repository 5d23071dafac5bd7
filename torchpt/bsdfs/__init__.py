"""Materials: one model a file, and the visible tuple of them. Lanes are grouped by model before they come here."""

from __future__ import annotations

from types import ModuleType

from torch import Tensor

from torchpt.bsdfs import diffuse
from torchpt.bsdfs.base import Parameters
from torchpt.math.vectors import take

__all__ = ["KINDS", "Parameters", "gather"]

#: Models by name.
KINDS: dict[str, ModuleType] = {"diffuse": diffuse}

#: Models that draw a number to choose among their lobes; the others are spared it.
LOBED: frozenset[str] = frozenset()


def gather(stacked: Parameters, row: Tensor) -> Parameters:
    """Lane values of a model's stacked parameters at rows ``(N,)``: the one place where parameters are resolved."""
    return {name: None if value is None else take(value, row) for name, value in stacked.items()}
