"""Plain mappings to models, and pydantic's errors as one :class:`SceneError`."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import CoreSchema
from pydantic_core.core_schema import no_info_plain_validator_function

from torchpt.errors import NotBuiltError, SceneError
from torchpt.spec import Refused

__all__ = ["Check", "Model", "check_keys", "construct", "dotted", "refuse_not_built", "refused"]


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
