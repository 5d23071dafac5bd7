"""Tensor functions for which engines register faster implementations.

``math`` and ``physics`` mark a function with :func:`dispatched`, such as a hash or the walk down the light tree. An engine (the
code that runs renders: by tensors, or by compiled kernels) registers what replaces it on its devices or while it traces a
kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, ParamSpec, TypeVar

__all__ = ["Dispatched", "dispatched"]

P = ParamSpec("P")
T = TypeVar("T")


class Dispatched(Generic[P, T]):
    """A function that asks its registered implementations first, the latest one before the others.

    Args:
        function: is called where no implementation accepts the arguments.

    Attributes:
        function: as above.
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
