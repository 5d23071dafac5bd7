"""Tables of kinds: the files of a folder, each imported when its kind is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, Generic, TypeVar

from torchpt.spec.base import Spec
from torchpt.spec.numbers import spec_of

__all__ = ["Block", "Kinds", "parameters_of"]

K = TypeVar("K")


class Kinds(Mapping[str, type[K]], Generic[K]):
    """The kinds in a folder by name: ``point`` is the class with ``name = "point"`` in ``point.py``.

    Args:
        package: the folder, as a dotted name.
        first: names that lists begin with; the others follow in the alphabet's order.
    """

    def __init__(self, package: str, first: tuple[str, ...] = ()) -> None:
        self.package, self._first = package, first
        self._known: dict[str, type[K]] = {}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all kinds; nothing is imported for it but the folder itself."""
        found = find_spec(self.package)
        assert found is not None and found.submodule_search_locations is not None
        every = [module.name for module in iter_modules(list(found.submodule_search_locations))]
        rest = sorted(name for name in every if not name.startswith("_") and name not in self._first)
        return (*self._first, *rest)

    def __getitem__(self, name: str) -> type[K]:
        if name not in self._known:
            if name not in self.names:
                raise KeyError(name)
            module = import_module(f"{self.package}.{name}")
            own = [value for value in vars(module).values() if isinstance(value, type) and _named(value, module, name)]
            if len(own) != 1:
                raise TypeError(f"{module.__name__} has to define one class with name = {name!r}")
            self._known[name] = own[0]
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def file(self, name: str) -> Path:
        """The file of a kind."""
        return Path(str(import_module(f"{self.package}.{name}").__file__))


def _named(kind: type[Any], module: Any, name: str) -> bool:
    return kind.__module__ == module.__name__ and vars(kind).get("name") == name


def parameters_of(kind: Any) -> dict[str, Spec]:
    """What a kind declares, that of the classes it is made of first.

    Args:
        kind: a class, or an instance where each declares parameters of its own.
    """
    own = kind if isinstance(kind, type) else type(kind)
    found = dict(_of_class(own))
    if kind is not own:
        found |= _specs_in(vars(kind) if hasattr(kind, "__dict__") else {})
    return found


@lru_cache(maxsize=1024)
def _of_class(own: type[Any]) -> dict[str, Spec]:
    found: dict[str, Spec] = {}
    for base in reversed(own.__mro__):
        found |= _specs_in(vars(base))
    return found


def _specs_in(names: Mapping[str, Any]) -> dict[str, Spec]:
    layer = names.get("parameters", {})
    return {name: spec_of(value) for name, value in layer.items()} if isinstance(layer, Mapping) else {}


@dataclass(frozen=True)
class Block(Spec):
    """A mapping with parameters of its own.

    Attributes:
        kind: what declares them.
    """

    kind: Any = field(default=None, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"a mapping with the keys {', '.join(parameters_of(self.kind))}"
