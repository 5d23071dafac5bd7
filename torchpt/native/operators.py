"""Functions as operators of torch, so that compiled graphs may call what they cannot trace."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

__all__ = ["choose", "operator"]


def operator(name: str, function: Callable[..., Any]) -> Any:
    """``function`` as an operator of torch, which compiled graphs call without tracing into it."""
    return torch.library.custom_op(name, function, mutates_args=())


def choose(function: Callable[..., Any], operator: Any) -> Callable[..., Any]:
    """The operator inside a compiled graph; outside the function itself: the first call of an operator costs seconds."""
    return operator if torch.compiler.is_compiling() else function
