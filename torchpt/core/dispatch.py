"""Tensor functions that physics defines and engines may replace by faster implementations."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

__all__ = ["Dispatched", "dispatched"]

P = ParamSpec("P")
T = TypeVar("T")


class Dispatched(Generic[P, T]):
    """A function with registered implementations, the latest of which that accepts the arguments is called.

    Args:
        function: is called where no implementation accepts the arguments.

    Attributes:
        function: the function itself.
        implementations: registered implementations, in the order in which they are tried.
    """

    def __init__(self, function: Callable[P, T]) -> None:
        self.function = function
        self.implementations: list[Callable[..., Any]] = []
        update_wrapper(self, function)

    def register(self, implementation: Callable[..., Any]) -> None:
        """Try ``implementation`` first from now on; it returns NotImplemented for arguments that it does not accept."""
        if implementation not in self.implementations:
            self.implementations.insert(0, implementation)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """Call the first implementation that accepts the arguments, else the function."""
        for implementation in self.implementations:
            result = implementation(*args, **kwargs)
            if result is not NotImplemented:
                return result
        return self.function(*args, **kwargs)


def dispatched(function: Callable[P, T]) -> Dispatched[P, T]:
    """Make a function one for which engines can ``register`` implementations (a decorator)."""
    return Dispatched(function)
