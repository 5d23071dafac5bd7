"""Mappings of a scene file as kinds and the values of their parameters: schema and errors made of what kinds declare."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchpt.core.tree import UNPRINTED
from torchpt.errors import NotBuiltError, SceneError
from torchpt.spec import REQUIRED, Block, Map, Refused, Spec, not_built, parameters_of
from torchpt.spec.memo import Memo
from torchpt.spec.reading import within
from torchpt.spec.validate import check_keys, dotted, refuse_not_built, refused

__all__ = ["Described", "described", "refuse_foreign", "values_of"]


@dataclass(frozen=True)
class Described:
    """A thing of a scene file.

    Attributes:
        kind: what it is: a class that declares ``parameters``.
        values: of all its parameters by name, defaults filled in.
        given: names of those that the file states.
    """

    kind: Any
    values: dict[str, Any]
    given: frozenset[str] = field(
        default=frozenset(), repr=False, metadata=UNPRINTED
    )  # a default that is stated is no other one

    @property
    def name(self) -> str:
        """Its ``type``."""
        return self.kind.name

    def __getitem__(self, parameter: str) -> Any:
        return self.values[parameter]


#: Reads what stands in place of a number or a colour, where a texture may: from the mapping as written and the spec.
ReadTexture = Callable[[Mapping[str, Any], Spec], Any]


def described(
    what: str,
    table: Mapping[str, Any],
    raw: Any,
    key: str,
    file: str | None,
    default: str = "",
    texture: ReadTexture | None = None,
) -> Described:
    """The thing of a mapping whose ``type`` picks its kind from a table.

    Args:
        what: what the table holds, e.g. ``light``; a key of :data:`torchpt.spec.not_built.TYPES` where some are not built.
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
    planned = not_built.TYPES.get(what, {})
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

    def read() -> Described:
        return _read(what, kind, name, raw, key, file, texture)

    if not isinstance(kind, type):  # an instance of the caller's own, which may change
        return read()
    found = _known.get((what, kind, texture), raw, read)
    return Described(kind, dict(found.values), found.given)


#: Things by what was written of them.
_known: Memo[Described] = Memo(4096)


def _read(
    what: str, kind: Any, name: str, raw: Mapping[str, Any], key: str, file: str | None, texture: ReadTexture | None
) -> Described:
    """A thing of a kind that is known."""
    words = f"{what} type {name}"
    names = list(parameters_of(kind))
    later = {**not_built.KEYS.get(what, {}), **not_built.KEYS.get(name, {})}
    check_keys({k: v for k, v in raw.items() if k not in later}, ("type", *names), key, words, file)
    rest = refuse_not_built(raw, later, key, ", ".join(names), file)
    values = {k: value for k, value in rest.items() if k != "type"}
    return values_of(kind, values, key, file, words, texture)


def values_of(
    kind: Any,
    raw: Mapping[str, Any],
    key: str,
    file: str | None,
    words: str | None = None,
    texture: ReadTexture | None = None,
) -> Described:
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
                raise refused(error, dotted(key, name), given[name], file) from None
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
            raise refused(error, key, None, file) from None
    return Described(kind, values, frozenset(given))


def refuse_foreign(what: str, table: Mapping[str, Any], raw: Any, default: str, file: str | None) -> None:
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


def _block(spec: Block, texture: ReadTexture | None, value: Any) -> Described | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise Refused(spec.expected)
    try:
        return values_of(spec.kind, value, "", None, spec.kind.__name__.lower(), texture)
    except SceneError as error:
        raise within(error) from None
