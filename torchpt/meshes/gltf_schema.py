"""What each part of a glTF document must be for the reader to follow it: objects, lists, texts, numbers, by key.

Khronos glTF 2.0 specification, 5 (properties reference). Ranges of numbers are their readers' matter; only what is read is
checked, when it is first asked for. Errors name the element, as ``meshes[0].primitives[1].attributes.POSITION``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = ["BLOCKS", "ROOT", "Wrong", "check"]


class Wrong(ValueError):
    """An element that is not what it must be; its text names it and says what is accepted."""


@dataclass(frozen=True)
class _Object:
    """An object: what its keys hold, those that must be there, and what all others hold."""

    keys: Mapping[str, Any] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    others: Any = None


@dataclass(frozen=True)
class _List:
    """A list: what its items are, and how many there are where that is fixed."""

    items: Any
    length: int | None = None


# Leaves: what a value must be, in words, and its types.
_NUMBER, _WHOLE, _TEXT, _ANY = "a number", "a whole number", "text", "anything"
_TYPES: dict[str, tuple[type, ...]] = {_NUMBER: (int, float), _WHOLE: (int,), _TEXT: (str,)}
_LARGEST = 1e300  # of numbers that are only converted; those that count are held to narrower ranges where they are read

_OBJECT = _Object()
_INFO = _Object(
    {"extensions": _Object({"KHR_texture_transform": _OBJECT}), "texCoord": _ANY, "index": _WHOLE}, ("index",)
)
_LOOK = _Object(  # textures of the core material and of its extensions, whatever extension they stand in
    {
        name: _INFO
        for name in (
            "baseColorTexture", "metallicRoughnessTexture", "specularTexture", "transmissionTexture", "clearcoatTexture",
        )
    }
)  # fmt: skip
_SPARSE = _Object(
    {
        "count": _WHOLE,
        "indices": _Object({"bufferView": _WHOLE, "componentType": _WHOLE}, ("bufferView", "componentType")),
        "values": _Object({"bufferView": _WHOLE}, ("bufferView",)),
    },
    ("count", "indices", "values"),
)

#: Items of the document's lists, by the key of the list.
BLOCKS: dict[str, _Object] = {
    "scenes": _Object({"nodes": _List(_WHOLE)}),
    "nodes": _Object(
        {
            "children": _List(_WHOLE),
            "mesh": _WHOLE,
            "matrix": _List(_NUMBER, 16),
            "rotation": _List(_NUMBER, 4),
            "scale": _List(_NUMBER, 3),
            "translation": _List(_NUMBER, 3),
            "extensions": _Object({"KHR_lights_punctual": _OBJECT}),
        }
    ),
    "meshes": _Object(
        {
            "primitives": _List(
                _Object(
                    {
                        "attributes": _Object({"POSITION": _WHOLE}, ("POSITION",), _WHOLE),
                        "indices": _WHOLE,
                        "material": _WHOLE,
                        "mode": _WHOLE,
                        "extensions": _OBJECT,
                    },
                    ("attributes",),
                )
            )
        },
        ("primitives",),
    ),
    "materials": _Object(
        {
            "pbrMetallicRoughness": _LOOK,
            "normalTexture": _INFO,
            "emissiveTexture": _INFO,
            "extensions": _Object(others=_LOOK),
        }
    ),
    "accessors": _Object({"type": _TEXT, "componentType": _WHOLE, "count": _WHOLE, "sparse": _SPARSE}),
    "bufferViews": _OBJECT,
    "buffers": _OBJECT,
    "images": _OBJECT,
    "textures": _Object({"extensions": _OBJECT}),
    "samplers": _Object({"wrapS": _WHOLE, "wrapT": _WHOLE}),
}
#: The document itself; the items of its lists are checked one by one.
ROOT = _Object(
    {
        "extensionsRequired": _List(_TEXT),
        "extensionsUsed": _List(_TEXT),
        "extensions": _Object({"KHR_lights_punctual": _Object({"lights": _List(_Object({"spot": _OBJECT}))})}),
        **{name: _List(_ANY) for name in BLOCKS},
    }
)


def check(value: Any, kind: Any, where: str) -> None:
    """Hold a value against what it must be.

    Args:
        value: as JSON has it.
        kind: one of :data:`BLOCKS`, or :data:`ROOT`.
        where: the element's name; empty for the document itself.

    Raises:
        Wrong: the first thing in it that is something else, or missing.
    """
    if isinstance(kind, _Object):
        if not isinstance(value, dict):
            raise Wrong(f"{where}: expected an object, got {_brief(value)}")
        for key in kind.required:
            if key not in value:
                raise Wrong(f"{where}: {key} is missing")
        for key, item in value.items():
            inner = kind.keys.get(key, kind.others)
            if inner is not None:
                check(item, inner, f"{where}.{key[:80]}" if where else key)
    elif isinstance(kind, _List):
        if not isinstance(value, list) or (kind.length is not None and len(value) != kind.length):
            expected = "a list" if kind.length is None else f"a list of {kind.length} numbers"
            raise Wrong(f"{where}: expected {expected}, got {_brief(value)}")
        if kind.items is not _ANY:
            for number, item in enumerate(value):
                check(item, kind.items, f"{where}[{number}]")
    elif kind is not _ANY:
        fits = isinstance(value, _TYPES[kind]) and not isinstance(value, bool)
        if not fits or (kind is _NUMBER and not -_LARGEST <= value <= _LARGEST):
            raise Wrong(f"{where}: expected {kind}, got {_brief(value)}")


def _brief(value: Any) -> str:
    """A value of JSON in a few words."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**40:
        return "a number of very many digits"
    return repr(value)[:60] if value is not None else "null"
