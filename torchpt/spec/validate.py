"""Plain mappings to models: the `type:` table look-up, and pydantic's errors as one :class:`SceneError`."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_plain_validator_function

from torchpt.errors import NotBuiltError, SceneError
from torchpt.spec import Refused, not_built

__all__ = [
    "Check", "Model", "check_keys", "construct", "dotted", "refuse_foreign", "refuse_not_built", "refused", "select",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Check:
    """Beside a field's type: the function that takes a raw value to it.

    Pydantic's ``PlainValidator``, which in addition works out how a value of the type would be written. Nothing asks for
    that, and it takes more time than all the rest of a model.
    """

    function: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> CoreSchema:
        """What pydantic calls the function through."""
        return no_info_plain_validator_function(self.function)


class Model(BaseModel):
    """Base of the scene's models: immutable, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", defer_build=True, frozen=True, arbitrary_types_allowed=True)


M = TypeVar("M", bound=Model)


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


def construct(model: type[M], raw: Any, key: str, file: str | None, what: str | None = None) -> M:
    """The model of a mapping.

    Args:
        model: the pydantic model.
        raw: the mapping as written.
        key: dotted key of the mapping.
        file: scene file for the error.
        what: how an error names the thing, e.g. ``a mesh``.

    Raises:
        SceneError: the first thing wrong with it.
    """
    what = what or model.__name__.lower()
    if not isinstance(raw, Mapping):
        raise SceneError(key, raw, f"a mapping with the keys {', '.join(model.model_fields)}", file)
    check_keys(raw, model.model_fields, key, what, file)
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        _raise(error, key, file)


def _raise(error: ValidationError, key: str, file: str | None) -> NoReturn:
    first = error.errors(include_url=False)[0]
    context = first.get("ctx", {})
    value = first["input"]
    if isinstance(context.get("error"), Refused):
        raise refused(context["error"], dotted(key, *first["loc"]), value, file) from None
    if first["type"] == "missing":
        raise SceneError(dotted(key, *first["loc"]), None, "a value (this key is required)", file) from None
    if first["type"] != "scene":
        raise SceneError(dotted(key, *first["loc"]), value, first["msg"].lower(), file) from None
    if context["value"] is not ...:
        value = context["value"]
    at = dotted(key, *first["loc"], *context["at"])
    if context["not_built"]:
        raise NotBuiltError(at, value, context["expected"], file) from None
    raise SceneError(at, value, context["expected"], file) from None


def refused(error: Refused, key: str, value: Any, file: str | None) -> SceneError:
    """The refusal of a value as the error that names its key."""
    shown = value if error.value is ... else error.value
    kind = NotBuiltError if error.not_built else SceneError
    return kind(dotted(key, *error.at), shown, error.expected, file)


def select(kind: str, table: Mapping[str, type[M]], raw: Any, key: str, file: str | None, default: str = "") -> M:
    """The model of a mapping whose ``type`` picks it from a table.

    Args:
        kind: what the table holds, a key of :data:`not_built.TYPES`, e.g. ``material``.
        table: the built types.
        raw: the mapping as written.
        key: dotted key of the mapping.
        file: scene file for the error.
        default: the type where none is given; without one ``type`` is required.

    Raises:
        SceneError: no mapping, an unknown type, an unknown key, a bad value.
        NotBuiltError: a type or key that the format knows and this version does not build.
    """
    planned = not_built.TYPES.get(kind, {})
    types = ", ".join([*table, *planned])
    if not isinstance(raw, Mapping):
        raise SceneError(key, raw, f"a mapping with a type of {types}", file)
    name = raw.get("type", default or None)
    if not isinstance(name, str) or (name not in table and name not in planned):
        close = difflib.get_close_matches(name, [*table, *planned], 1) if isinstance(name, str) else []
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise SceneError(dotted(key, "type"), name, f"a known {kind} type{hint}: {types}", file)
    what = f"{kind} type {name}"
    if name in planned:
        check_keys(raw, ("type", *planned[name]), key, what, file)
        raise NotBuiltError(dotted(key, "type"), name, ", ".join(table), file)
    model = table[name]
    later = {**not_built.KEYS.get(kind, {}), **not_built.KEYS.get(name, {})}
    check_keys({k: v for k, v in raw.items() if k not in later}, ("type", *_fields(model)), key, what, file)
    rest = refuse_not_built(raw, later, key, ", ".join(_fields(model)), file)
    given = {k: value for k, value in rest.items() if value is not None}  # null means unset
    return construct(model, {**given, "type": name}, key, file, what)


def refuse_foreign(kind: str, table: Mapping[str, type[Model]], raw: Any, default: str, file: str | None) -> None:
    """Raises for a key of a block that another type of the table reads: it could be accepted only to do nothing.

    Args:
        kind: what the table holds, which is the block's key too.
        table: the built types.
        raw: the block as written.
        default: the type where none is given.
        file: scene file for the error.
    """
    name = raw.get("type", default) if isinstance(raw, Mapping) else None
    if not isinstance(name, str) or name not in table:
        return
    own = table[name].model_fields
    for key, value in raw.items():
        owners = [other for other, model in table.items() if key in model.model_fields]
        if key not in own and owners:
            keys, others = ", ".join(own), ", ".join(owners)
            expected = f"only keys that the {name} {kind} reads ({keys}); {key} belongs to {others}"
            raise SceneError(dotted(kind, key), value, expected, file)


def _fields(model: type[Model]) -> list[str]:
    return [name for name in model.model_fields if name != "type"]


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
