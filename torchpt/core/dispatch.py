"""Functions of whole tensors that engines may take over: physics declares them, engines register."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

__all__ = ["Dispatched", "dispatched"]

P = ParamSpec("P")
T = TypeVar("T")


class Dispatched(Generic[P, T]):
    """A function with the implementations that were registered for it.

    Args:
        function: what is called where no implementation takes the arguments.

    Attributes:
        function: the same.
        implementations: those that are asked, in this order.
    """

    def __init__(self, function: Callable[P, T]) -> None:
        self.function = function
        self.implementations: list[Callable[..., Any]] = []
        update_wrapper(self, function)

    def register(self, implementation: Callable[..., Any]) -> None:
        """Ask ``implementation`` first from now on; it returns NotImplemented for arguments that it leaves to others."""
        if implementation not in self.implementations:
            self.implementations.insert(0, implementation)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> T:
        """Call the function, or the first implementation that takes the arguments."""
        for implementation in self.implementations:
            result = implementation(*args, **kwargs)
            if result is not NotImplemented:
                return result
        return self.function(*args, **kwargs)


def dispatched(function: Callable[P, T]) -> Dispatched[P, T]:
    """Let engines take a function over: they call ``register`` of what is returned."""
    return Dispatched(function)
