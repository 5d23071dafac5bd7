"""Find kinds by name, collect the parameters that they declare, and read whole blocks of a scene file by them.

A kind is a class that a ``type`` in a scene file names, such as ``sphere``; its ``parameters`` are a :class:`Spec` by name. A
block is a mapping of a scene file whose keys are the parameters of one kind. The scene format and the settings read theirs by
:func:`read_typed` and :func:`read_params`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from torchpt.core.errors import SceneError, did_you_mean
from torchpt.core.tree import NOT_FINGERPRINTED
from torchpt.spec import Map, Refused
from torchpt.spec.parameters import REQUIRED, Spec, spec_of
from torchpt.spec.reading import as_refused

if TYPE_CHECKING:
    from typing import Self

__all__ = [
    "Block",
    "FrozenConfig",
    "Kinds",
    "ParsedParams",
    "ResultCache",
    "check_keys",
    "dotted",
    "frozen",
    "parameters_of",
    "read_params",
    "read_typed",
    "refuse_unused_keys",
    "scene_error",
]


# ---- Tables of kinds: the files of a folder, each imported when its kind is looked up


K = TypeVar("K")


class Kinds(Mapping[str, type[K]], Generic[K]):
    """Mapping of the kinds in a folder by name: ``point`` is the class with ``name = "point"`` in ``point.py``.

    Args:
        package: the folder, as a dotted name.
        first: names that lists begin with; the others follow in alphabetical order.
    """

    def __init__(self, package: str, first: tuple[str, ...] = ()) -> None:
        self.package, self._first_names = package, first
        self._imported: dict[str, type[K]] = {}

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return the names of all kinds, without importing their files."""
        package_spec = find_spec(self.package)
        assert package_spec is not None and package_spec.submodule_search_locations is not None
        files = [module.name for module in iter_modules(list(package_spec.submodule_search_locations))]
        others = sorted(name for name in files if not name.startswith("_") and name not in self._first_names)
        return (*self._first_names, *others)

    def __getitem__(self, name: str) -> type[K]:
        if name not in self._imported:
            if name not in self.names:
                raise KeyError(name)
            module = import_module(f"{self.package}.{name}")
            kinds = [
                value
                for value in vars(module).values()
                if isinstance(value, type) and _defines_kind(value, module, name)
            ]
            if len(kinds) != 1:
                raise TypeError(f"{module.__name__} has to define one class with name = {name!r}")
            self._imported[name] = kinds[0]
        return self._imported[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def file(self, name: str) -> Path:
        """Return the path of the file that defines a kind."""
        return Path(str(import_module(f"{self.package}.{name}").__file__))


def _defines_kind(kind: type[Any], module: Any, name: str) -> bool:
    """Return True for the class of that name that the module itself defines."""
    return kind.__module__ == module.__name__ and vars(kind).get("name") == name


def parameters_of(kind: Any) -> dict[str, Spec]:
    """Return the parameters that a kind declares, those of its base classes first.

    Args:
        kind: a class, or an instance that declares parameters of its own.
    """
    cls = kind if isinstance(kind, type) else type(kind)
    found = dict(_class_parameters(cls))
    if kind is not cls:
        found |= _specs_in(vars(kind) if hasattr(kind, "__dict__") else {})
    return found


@lru_cache(maxsize=1024)
def _class_parameters(own: type[Any]) -> dict[str, Spec]:
    """Return the parameters of a class, those of its bases first."""
    found: dict[str, Spec] = {}
    for base in reversed(own.__mro__):
        found |= _specs_in(vars(base))
    return found


def _specs_in(names: Mapping[str, Any]) -> dict[str, Spec]:
    """Return the parameters among the attributes of a class or instance."""
    declared = names.get("parameters", {})
    return {name: spec_of(value) for name, value in declared.items()} if isinstance(declared, Mapping) else {}


@dataclass(frozen=True)
class Block(Spec):
    """Spec of a nested mapping.

    Attributes:
        kind: declares the parameters of the mapping.
    """

    kind: Any = field(default=None, kw_only=True)

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return f"a mapping with the keys {', '.join(parameters_of(self.kind))}"


# ---- Kinds whose instances are the values of their parameters


class FrozenConfig:
    """A frozen record with an attribute for each parameter that its class declares.

    Args:
        values: values of parameters as :meth:`Spec.read` returns them; the others have their defaults.

    Raises:
        TypeError: an unknown parameter, or no value for a required one.
    """

    parameters: ClassVar[Mapping[str, Spec]] = {}

    def __init__(self, **values: Any) -> None:
        specs = parameters_of(type(self))
        if foreign := values.keys() - specs.keys():
            raise TypeError(f"{type(self).__name__} has no {', '.join(sorted(foreign))}")
        all_values = {name: values.get(name, spec.default) for name, spec in specs.items()}
        for name, value in all_values.items():
            if value is REQUIRED:
                raise TypeError(f"{type(self).__name__} needs {name}")
        # A default that is a function follows from the values of the others.
        computed = {
            name: value(all_values) for name, value in all_values.items() if name not in values and callable(value)
        }
        self.__dict__.update(all_values | computed)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    @property
    def values(self) -> dict[str, Any]:
        """Return the values of all parameters by name."""
        return {name: self.__dict__[name] for name in parameters_of(type(self))}

    def but(self, **values: Any) -> Self:
        """Return a copy with some values replaced."""
        return type(self)(**{**self.values, **values})

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen: use but({name}=...)")

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen")

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, FrozenConfig) and other.values == self.values

    def __hash__(self) -> int:
        return hash((type(self), *self.values.values()))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.values.items())})"

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Check values of several parameters against each other.

        Args:
            values: values of all parameters by name, defaults filled in.
            given: names of those that the file or the caller sets.

        Raises:
            Refused: values that exclude each other.
        """


# ---- Cache of results by plain values: the same materials and settings are read again and again


T = TypeVar("T")
#: Longer lists are bulk data, which costs more to hash than to read.
LONGEST_HASHED = 64
#: Types whose values are hashed together with the type: 1, 1.0 and true are different.
_HASHED_WITH_TYPE = frozenset((int, bool, str, type(None)))


def frozen(value: Any) -> Hashable:
    """Return a cache key that two values share only where their types and numbers are equal to the bit.

    Raises:
        TypeError: anything but plain values in lists and dicts, or a list longer than :data:`LONGEST_HASHED`.
    """
    kind = type(value)
    if kind in _HASHED_WITH_TYPE:
        return kind, value
    if kind is float:
        return repr(value)
    if kind is list or kind is tuple:
        if len(value) <= LONGEST_HASHED:
            return kind, tuple([frozen(item) for item in value])
    elif kind is dict:
        return kind, tuple([(key, frozen(item)) for key, item in value.items()])
    raise TypeError(kind.__name__)


class ResultCache(Generic[T]):
    """A cache of results by the plain values that they were made from; the oldest entries are dropped.

    Args:
        most: largest number of entries.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._results: dict[Hashable, T] = {}  # the oldest first

    def get(self, names: Hashable, values: Any, make: Callable[[], T]) -> T:
        """Return the cached result for ``values``, or call ``make`` and cache what it returns; errors are not cached.

        Args:
            names: everything else that the result depends on; hashable.
            values: plain values; for others ``make`` is called each time.
            make: computes the result; must neither keep nor change ``values``.
        """
        try:
            key = names, frozen(values)
            found = self._results.get(key)
        except TypeError:
            return make()
        if found is None:
            found = self._results[key] = make()
            if len(self._results) > self._most:
                with suppress(RuntimeError, StopIteration):  # another thread changed it in between
                    self._results.pop(next(iter(self._results)), None)
        return found


# ---- Checks of mappings, and conversion of :class:`Refused` to a :class:`SceneError` with the dotted key


def dotted(*parts: str | int) -> str:
    """Join names to a dotted key; empty ones are left out."""
    return ".".join(str(part) for part in parts if part != "")


def check_keys(raw: Mapping[str, Any], known: Iterable[str], key: str, what: str, file: str | None) -> None:
    """Raise a SceneError for the first unknown key, with the known keys and the closest one.

    Args:
        raw: the mapping as written.
        known: its known keys.
        key: its dotted key; empty for a whole scene.
        what: the mapping in the words of errors.
        file: scene file, for errors.
    """
    names = list(known)
    for name in raw:
        if name not in names:
            hint = did_you_mean(str(name), names)
            raise SceneError(dotted(key, name), name, f"a known key of {what}{hint}: {', '.join(names)}", file)


def scene_error(error: Refused, key: str, value: Any, file: str | None) -> SceneError:
    """Return the scene error for a refused value at ``key``."""
    shown = value if error.value is ... else error.value
    return SceneError(dotted(key, *error.at), shown, error.expected, file)


# ---- Reading of blocks: the kind that ``type`` names, and the values of its parameters


@dataclass(frozen=True)
class ParsedParams:
    """A block of a scene file after reading: its kind, and the values of the kind's parameters.

    Attributes:
        kind: the class (or instance) that declares ``parameters``.
        values: values of all parameters by name, defaults filled in.
        given: names of the parameters that the file sets.
    """

    kind: Any
    values: dict[str, Any]
    # Not part of the fingerprint: a default that the file sets renders the same picture.
    given: frozenset[str] = field(default=frozenset(), repr=False, metadata=NOT_FINGERPRINTED)

    @property
    def name(self) -> str:
        """Return its ``type``."""
        return self.kind.name

    def __getitem__(self, parameter: str) -> Any:
        return self.values[parameter]


#: Reads the texture that stands in place of a number or a colour: from the mapping as written, and the parameter's spec.
ReadTexture = Callable[[Mapping[str, Any], Spec], Any]


def read_typed(
    what: str,
    table: Mapping[str, Any],
    raw: Any,
    key: str,
    file: str | None,
    default: str = "",
    texture: ReadTexture | None = None,
) -> ParsedParams:
    """Read a mapping whose ``type`` names a kind of a table.

    Args:
        what: name of the table for errors, e.g. ``light``.
        table: the kinds.
        raw: the mapping as written.
        key: its dotted key.
        file: scene file, for errors.
        default: the type where ``type`` is missing; "": ``type`` is required.
        texture: reads textures in place of numbers and colours; None: none are accepted.

    Raises:
        SceneError: no mapping, an unknown type, an unknown key, a bad value.
    """
    types = ", ".join(table)
    if not isinstance(raw, Mapping):
        raise SceneError(key, raw, f"a mapping with a type of {types}", file)
    name = raw.get("type", default or None)
    if not isinstance(name, str) or name not in table:
        hint = did_you_mean(name, [*table])
        raise SceneError(dotted(key, "type"), name, f"a known {what} type{hint}: {types}", file)
    kind = table[name]

    def read() -> ParsedParams:
        return _read_kind(what, kind, name, raw, key, file, texture)

    if not isinstance(kind, type):  # an instance may change between calls
        return read()
    found = _parsed_blocks.get((what, kind, texture), raw, read)
    return ParsedParams(kind, dict(found.values), found.given)


#: Blocks that were read, by the mapping as written.
_parsed_blocks: ResultCache[ParsedParams] = ResultCache(most=4096)


def _read_kind(
    what: str, kind: Any, name: str, raw: Mapping[str, Any], key: str, file: str | None, texture: ReadTexture | None
) -> ParsedParams:
    """Read a mapping whose kind is known; arguments as of :func:`read_typed`, ``name``: the ``type``."""
    words = f"{what} type {name}"
    names = list(parameters_of(kind))
    check_keys(raw, ("type", *names), key=key, what=words, file=file)
    values = {name: value for name, value in raw.items() if name != "type"}
    return read_params(kind, values, key=key, file=file, words=words, texture=texture)


def read_params(
    kind: Any,
    raw: Mapping[str, Any],
    key: str,
    file: str | None,
    words: str | None = None,
    texture: ReadTexture | None = None,
) -> ParsedParams:
    """Read the values of a kind's parameters from a mapping without ``type``; null means unset.

    The kind's ``check(values, given)``, if any, may fill in values that follow from others, as a camera does with its pose.

    Args:
        kind: the class or instance that declares ``parameters``.
        raw: the mapping as written.
        key: its dotted key.
        file: scene file, for errors.
        words: the mapping in the words of errors; None: the name of the kind.
        texture: reads textures in place of numbers and colours; None: none are accepted.

    Raises:
        SceneError: an unknown key, a bad value, or values that ``check`` refuses.
    """
    specs = parameters_of(kind)
    given = {name: value for name, value in raw.items() if value is not None}
    check_keys(given, specs, key=key, what=words or getattr(kind, "name", "") or kind.__name__, file=file)
    values: dict[str, Any] = {}
    for name, spec in specs.items():
        if name in given:
            try:
                values[name] = _read_value(spec, given[name], texture)
            except Refused as error:
                raise scene_error(error, key=dotted(key, name), value=given[name], file=file) from None
        elif spec.default is REQUIRED:
            raise SceneError(dotted(key, name), None, "a value (this key is required)", file)
        else:
            values[name] = None if callable(spec.default) else spec.default
    # Defaults that are functions follow from the values of the others.
    for name, spec in specs.items():
        if name not in given and callable(spec.default):
            values[name] = spec.default(values)
    check = getattr(kind, "check", None)
    if check is not None:
        try:
            check(values, frozenset(given))
        except Refused as error:
            raise scene_error(error, key=key, value=None, file=file) from None
    return ParsedParams(kind, values, frozenset(given))


def refuse_unused_keys(what: str, table: Mapping[str, Any], raw: Any, default: str, file: str | None) -> None:
    """Raise for a key that only other types of the table read, since it would have no effect.

    Args:
        what: name of the table, and key of the block.
        table: the kinds.
        raw: the block as written.
        default: the type where ``type`` is missing.
        file: scene file, for the error.
    """
    name = raw.get("type", default) if isinstance(raw, Mapping) else None
    if not isinstance(name, str) or name not in table:
        return
    own = parameters_of(table[name])
    for key, value in raw.items():
        if key in own or key == "type":
            continue
        owners = [other for other in table if key in parameters_of(table[other])]
        if owners:
            keys, others = ", ".join(["type", *own]), ", ".join(owners)
            expected = f"only keys that the {name} {what} reads ({keys}); {key} belongs to {others}"
            raise SceneError(dotted(what, key), value, expected, file)


def _read_value(spec: Spec, value: Any, texture: ReadTexture | None) -> Any:
    """Return the value of a parameter, or the texture in its place.

    Raises:
        Refused: the value is not accepted.
    """
    if isinstance(spec, Block):
        return _read_block(spec, texture, value)
    if spec.texture and texture is not None:
        if isinstance(value, str) and isinstance(spec, Map):
            value = {"texture": value}
        elif isinstance(value, np.ndarray) and value.ndim > 1:
            value = {"type": "image", "data": value}
        if isinstance(value, Mapping):
            return texture(value, spec)
    return spec.read(value)


def _read_block(spec: Block, texture: ReadTexture | None, value: Any) -> ParsedParams | None:
    """Return a nested mapping, or None for null; errors have keys relative to it."""
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise Refused(spec.expected)
    try:
        return read_params(spec.kind, value, key="", file=None, words=spec.kind.__name__.lower(), texture=texture)
    except SceneError as error:
        raise as_refused(error) from None
