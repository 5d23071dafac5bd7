"""Kinds whose instances are the values of their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from torchpt.spec.base import REQUIRED, Spec
from torchpt.spec.kinds import parameters_of

if TYPE_CHECKING:
    from typing import Self

__all__ = ["Valued"]


class Valued:
    """A frozen record with an attribute for each parameter that its class declares.

    Args:
        values: of the parameters, as they are once read; those left out have their defaults.

    Raises:
        TypeError: a value of no parameter, or none for one that must be given.
    """

    parameters: ClassVar[Mapping[str, Spec]] = {}

    def __init__(self, **values: Any) -> None:
        specs = parameters_of(type(self))
        if foreign := values.keys() - specs.keys():
            raise TypeError(f"{type(self).__name__} has no {', '.join(sorted(foreign))}")
        whole = {name: values.get(name, spec.default) for name, spec in specs.items()}
        for name, value in whole.items():
            if value is REQUIRED:
                raise TypeError(f"{type(self).__name__} needs {name}")
        computed = {name: value(whole) for name, value in whole.items() if name not in values and callable(value)}
        self.__dict__.update(whole | computed)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    @property
    def values(self) -> dict[str, Any]:
        """Of the parameters by name."""
        return {name: self.__dict__[name] for name in parameters_of(type(self))}

    def but(self, **values: Any) -> Self:
        """The same with some other values."""
        return type(self)(**{**self.values, **values})

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen: use but({name}=...)")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen")

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, Valued) and other.values == self.values

    def __hash__(self) -> int:
        return hash((type(self), *self.values.values()))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.values.items())})"

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """
