"""Functions as operators of torch, so that compiled graphs may call what they cannot trace."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

__all__ = ["hits_like", "operator", "outside_graphs"]

P = ParamSpec("P")
R = TypeVar("R")


def operator(name: str, fake: Callable[..., R]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Makes a function of tensors an operator of torch: compiled graphs call it without tracing into it.

    Outside of them the function itself is called: the first call of an operator costs seconds.

    Args:
        name: of the operator, ``torchpt::...``.
        fake: from the same arguments to tensors of the shapes, dtypes and devices that the function gives.
    """

    def wrap(function: Callable[P, R]) -> Callable[P, R]:
        made = torch.library.custom_op(name, function, mutates_args=())
        made.register_fake(fake)

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            return made(*args, **kwargs) if torch.compiler.is_compiling() else function(*args, **kwargs)

        return call

    return wrap


def outside_graphs(function: Callable[P, R]) -> Callable[P, R]:
    """A function that ``torch.compile`` calls as it is, between two graphs."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():  # not before: this imports the compiler
            outside: Any = torch.compiler.disable(function)
            return outside(*args, **kwargs)
        return function(*args, **kwargs)

    return call


def hits_like(t_max: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Unfilled ``t, prim, u, v`` of a search for rays that end at ``t_max (N,)``."""
    like = torch.empty_like
    return like(t_max), like(t_max, dtype=torch.int32), like(t_max), like(t_max)
