"""Checks of mappings, and refusals as :class:`SceneError` with the key that is wrong."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from torchpt.errors import NotBuiltError, SceneError
from torchpt.spec import Refused

__all__ = ["check_keys", "dotted", "refuse_not_built", "refused"]


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
