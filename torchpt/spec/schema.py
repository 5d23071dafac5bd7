"""Kinds and their values: tables of kinds, declarations read by name, and checks of whole blocks."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from torchpt.core.errors import NotBuiltError, SceneError
from torchpt.core.tree import NOT_FINGERPRINTED
from torchpt.spec import Map, Refused, unsupported
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
    "refuse_not_built",
    "refuse_unused_keys",
    "scene_error",
]


# ---- Tables of kinds: the files of a folder, each imported when its kind is asked for


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


# ---- Kinds whose instances are the values of their parameters


class FrozenConfig:
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
        return type(other) is type(self) and isinstance(other, FrozenConfig) and other.values == self.values

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


# ---- What plain values were read as, kept by what they say: the same surfaces and settings are read again and again


T = TypeVar("T")
#: Longer lists are data of their own: not worth a key.
LONGEST = 64
#: Values that are their own keys, beside their type: 1, 1.0 and true are not the same.
_PLAIN = frozenset((int, bool, str, type(None)))


def frozen(value: Any) -> Hashable:
    """A key that only values of the same types and numbers share, to the bit.

    Raises:
        TypeError: something else than plain values in lists and dicts, or a long list.
    """
    kind = type(value)
    if kind in _PLAIN:
        return kind, value
    if kind is float:
        return repr(value)
    if kind is list or kind is tuple:
        if len(value) <= LONGEST:
            return kind, tuple([frozen(item) for item in value])
    elif kind is dict:
        return kind, tuple([(key, frozen(item)) for key, item in value.items()])
    raise TypeError(kind.__name__)


class ResultCache(Generic[T]):
    """Results by what they were made of; the oldest ones go.

    Args:
        most: how many are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._known: dict[Hashable, T] = {}

    def get(self, names: Hashable, values: Any, make: Callable[[], T]) -> T:
        """What ``make`` makes of ``values``, which it is not to keep or change; errors are not kept.

        Args:
            names: what else it depends on, by identity or value.
            values: plain ones; for others nothing is kept.
            make: called where the result is not known.
        """
        try:
            key = names, frozen(values)
            found = self._known.get(key)
        except TypeError:
            return make()
        if found is None:
            found = self._known[key] = make()
            if len(self._known) > self._most:
                self._known.pop(next(iter(self._known)), None)
        return found


# ---- Checks of mappings, and refusals as :class:`SceneError` with the key that is wrong


def dotted(*parts: str | int) -> str:
    """A dotted key; empty parts vanish."""
    return ".".join(str(part) for part in parts if part != "")


def check_keys(raw: Mapping[str, Any], known: Iterable[str], key: str, what: str, file: str | None) -> None:
    """Raises a SceneError for the first key that is not known, with the known ones and the closest of them."""
    names = list(known)
    for name in raw:
        if name not in names:
            close = difflib.get_close_matches(str(name), names, 1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise SceneError(dotted(key, name), name, f"a known key of {what}{hint}: {', '.join(names)}", file)


def scene_error(error: Refused, key: str, value: Any, file: str | None) -> SceneError:
    """The refusal of a value as the error that names its key."""
    shown = value if error.value is ... else error.value
    kind = NotBuiltError if error.not_built else SceneError
    return kind(dotted(key, *error.at), shown, error.expected, file)


def refuse_not_built(
    raw: Mapping[str, Any], later: Mapping[str, object], key: str, available: str, file: str | None
) -> dict[str, Any]:
    """The mapping without its planned keys, once none of them asks for anything.

    Raises:
        NotBuiltError: a planned key whose value is neither null nor the one that asks for nothing.
    """
    for name, nothing in later.items():
        value = raw.get(name)
        same = type(value) in (int, float, bool) and isinstance(value, bool) == isinstance(nothing, bool)
        if value is not None and not (same and value == nothing):
            raise NotBuiltError(dotted(key, name), value, available, file)
    return {name: value for name, value in raw.items() if name not in later}


# ---- Mappings of a scene file as kinds and the values of their parameters: schema and errors made of what kinds declare


@dataclass(frozen=True)
class ParsedParams:
    """A thing of a scene file.

    Attributes:
        kind: what it is: a class that declares ``parameters``.
        values: of all its parameters by name, defaults filled in.
        given: names of those that the file states.
    """

    kind: Any
    values: dict[str, Any]
    given: frozenset[str] = field(
        default=frozenset(), repr=False, metadata=NOT_FINGERPRINTED
    )  # a default that is stated is no other one

    @property
    def name(self) -> str:
        """Its ``type``."""
        return self.kind.name

    def __getitem__(self, parameter: str) -> Any:
        return self.values[parameter]


#: Reads what stands in place of a number or a colour, where a texture may: from the mapping as written and the spec.
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
    """The thing of a mapping whose ``type`` picks its kind from a table.

    Args:
        what: what the table holds, e.g. ``light``; a key of :data:`torchpt.spec.unsupported.TYPES` where some are not built.
        table: the kinds.
        raw: the mapping as written.
        key: its dotted key.
        file: scene file for errors.
        default: the type where none is given; without one ``type`` is required.
        texture: reads textures that stand in place of numbers and colours.

    Raises:
        SceneError: no mapping, an unknown type, an unknown key, a bad value.
        NotBuiltError: a type or key that the format knows and this version does not build.
    """
    planned = unsupported.TYPES.get(what, {})
    types = ", ".join([*table, *planned])
    if not isinstance(raw, Mapping):
        raise SceneError(key, raw, f"a mapping with a type of {types}", file)
    name = raw.get("type", default or None)
    if not isinstance(name, str) or (name not in table and name not in planned):
        close = difflib.get_close_matches(name, [*table, *planned], 1) if isinstance(name, str) else []
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise SceneError(dotted(key, "type"), name, f"a known {what} type{hint}: {types}", file)
    words = f"{what} type {name}"
    if name in planned:
        check_keys(raw, ("type", *planned[name]), key, words, file)
        raise NotBuiltError(dotted(key, "type"), name, ", ".join(table), file)
    kind = table[name]

    def read() -> ParsedParams:
        return _read(what, kind, name, raw, key, file, texture)

    if not isinstance(kind, type):  # an instance of the caller's own, which may change
        return read()
    found = _known.get((what, kind, texture), raw, read)
    return ParsedParams(kind, dict(found.values), found.given)


#: Things by what was written of them.
_known: ResultCache[ParsedParams] = ResultCache(4096)


def _read(
    what: str, kind: Any, name: str, raw: Mapping[str, Any], key: str, file: str | None, texture: ReadTexture | None
) -> ParsedParams:
    """A thing of a kind that is known."""
    words = f"{what} type {name}"
    names = list(parameters_of(kind))
    later = {**unsupported.KEYS.get(what, {}), **unsupported.KEYS.get(name, {})}
    check_keys({k: v for k, v in raw.items() if k not in later}, ("type", *names), key, words, file)
    rest = refuse_not_built(raw, later, key, ", ".join(names), file)
    values = {k: value for k, value in rest.items() if k != "type"}
    return read_params(kind, values, key, file, words, texture)


def read_params(
    kind: Any,
    raw: Mapping[str, Any],
    key: str,
    file: str | None,
    words: str | None = None,
    texture: ReadTexture | None = None,
) -> ParsedParams:
    """The values of a kind's parameters, from a mapping that holds nothing else; null means unset.

    A kind's own ``check(values, given)`` may fill in values that follow from others, as a camera does with its pose.

    Raises:
        SceneError: an unknown key, a bad value, or values that the kind's own ``check(values, given)`` refuses.
    """
    specs = parameters_of(kind)
    given = {name: value for name, value in raw.items() if value is not None}
    check_keys(given, specs, key, words or getattr(kind, "name", "") or kind.__name__, file)
    values: dict[str, Any] = {}
    for name, spec in specs.items():
        if name in given:
            try:
                values[name] = _read_value(spec, given[name], texture)
            except Refused as error:
                raise scene_error(error, dotted(key, name), given[name], file) from None
        elif spec.default is REQUIRED:
            raise SceneError(dotted(key, name), None, "a value (this key is required)", file)
        else:
            values[name] = None if callable(spec.default) else spec.default
    for name, spec in specs.items():
        if name not in given and callable(spec.default):
            values[name] = spec.default(values)
    check = getattr(kind, "check", None)
    if check is not None:
        try:
            check(values, frozenset(given))
        except Refused as error:
            raise scene_error(error, key, None, file) from None
    return ParsedParams(kind, values, frozenset(given))


def refuse_unused_keys(what: str, table: Mapping[str, Any], raw: Any, default: str, file: str | None) -> None:
    """Raises for a key of a block that another type of the table reads: it could be accepted only to do nothing.

    Args:
        what: what the table holds, which is the block's key too.
        table: the kinds.
        raw: the block as written.
        default: the type where none is given.
        file: scene file for the error.
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
    """Return the value of a parameter, or the texture that stands in its place.

    Raises:
        Refused: it is not accepted.
    """
    if isinstance(spec, Block):
        return _block(spec, texture, value)
    if spec.texture and texture is not None:
        if isinstance(value, str) and isinstance(spec, Map):
            value = {"texture": value}
        elif isinstance(value, np.ndarray) and value.ndim > 1:
            value = {"type": "image", "data": value}
        if isinstance(value, Mapping):
            return texture(value, spec)
    return spec.read(value)


def _block(spec: Block, texture: ReadTexture | None, value: Any) -> ParsedParams | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise Refused(spec.expected)
    try:
        return read_params(spec.kind, value, "", None, spec.kind.__name__.lower(), texture)
    except SceneError as error:
        raise as_refused(error) from None
