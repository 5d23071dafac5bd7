"""Specs of what is fixed once a scene is loaded: flags, words, whole numbers, files, and whatever a function reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from torchpt.spec import reading
from torchpt.spec.base import Spec
from torchpt.spec.reading import LARGEST, Refused

if TYPE_CHECKING:
    pass

__all__ = ["Choice", "Flag", "Map", "Other", "Pair", "Path", "Whole"]


@dataclass(frozen=True)
class Flag(Spec):
    """True or false."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "true or false"

    def read(self, value: Any) -> bool:
        """See :class:`Spec`."""
        return reading.flag(value)


@dataclass(frozen=True)
class Choice(Spec):
    """One of some words.

    Attributes:
        names: the words.
        booleans: which word a YAML boolean stands for.
    """

    names: tuple[str, ...] = field(default=(), kw_only=True)
    booleans: Mapping[bool, str] | None = field(default=None, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"one of {', '.join(self.names)}"

    def read(self, value: Any) -> str:
        """See :class:`Spec`."""
        if self.booleans is not None and isinstance(value, bool):
            value = self.booleans[value]
        if not isinstance(value, str) or value not in self.names:
            raise Refused(self.expected)
        return value


@dataclass(frozen=True)
class Whole(Spec):
    """A whole number in a range, or one of some other values.

    Attributes:
        low: least.
        high: greatest.
        also: what else is accepted.
    """

    low: int = field(default=0, kw_only=True)
    high: int = field(default=2**31 - 1, kw_only=True)
    also: tuple[Any, ...] = field(default=(), kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        words = "".join(f" or {'null' if item is None else item}" for item in self.also)
        return f"a whole number {self.low}..{self.high}{words}"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        if isinstance(value, bool | np.bool_):
            raise Refused(self.expected)
        if (value is None or isinstance(value, int | str)) and value in self.also:
            return value
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int | np.integer) or not self.low <= value <= self.high:
            raise Refused(self.expected)
        return int(value)


@dataclass(frozen=True)
class Pair(Spec):
    """Two numbers, along u and along v.

    Attributes:
        single: whether one number stands for both.
    """

    single: bool = field(default=False, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a number or [u, v]" if self.single else "two numbers [u, v]"

    def read(self, value: Any) -> tuple[float, float]:
        """See :class:`Spec`."""
        return reading.pair(value, self.expected, single=self.single)


@dataclass(frozen=True)
class Path(Spec):
    """A file's path, or several of which the first that is there is used."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a file path, or a list of them (the first that is there is used)"

    def read(self, value: Any) -> tuple[str, ...]:
        """See :class:`Spec`."""
        return reading.file_paths(value)


@dataclass(frozen=True)
class Map(Spec):
    """A texture that gives numbers, or its name; read by whoever reads textures (:data:`torchpt.spec.declared.ReadTexture`)."""

    texture: bool = field(default=True, kw_only=True)
    words: str = field(default="the name of a texture", kw_only=True)

    #: Numbers that it may give, as of a number that a texture may give.
    bounds: ClassVar[tuple[float, float]] = (-LARGEST, LARGEST)

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Other(Spec):
    """Whatever a function reads.

    Attributes:
        reader: from the value as written to the parameter's; raises :class:`Refused`.
    """

    reader: Callable[[Any], Any] = field(default=lambda value: value, kw_only=True, hash=False)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a value"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return self.reader(value)
