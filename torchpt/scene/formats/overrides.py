"""Apply overrides of a scene's keys by dotted key, from the command line or ``torchpt.load(overrides=...)``.

They are the top layer of a scene, merged by the rules of :mod:`torchpt.scene.formats.compose`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError, did_you_mean
from torchpt.physics.bsdfs import KINDS as MATERIALS
from torchpt.physics.textures import KINDS as TEXTURES
from torchpt.scene.formats.compose import (
    KEEPING,
    KEYS,
    NAMED,
    PATHS,
    TABLES,
    Layers,
    Parts,
    expected_name,
    merge_named,
    merge_values,
    prefixes,
    resolve_path,
    resolve_paths,
    shared_keys,
    skeleton,
    with_size,
)  # fmt: skip
from torchpt.scene.formats.yaml import MAX_DEPTH, plain
from torchpt.scene.settings import keep_aspect
from torchpt.spec.schema import dotted

__all__ = ["overridden_by", "override_words", "words_of"]


def overridden_by(
    raw: dict[str, Any], overrides: Mapping[str, Any], layers: Layers, file: str | None, base: Path
) -> tuple[dict[str, Any], Layers]:
    """Apply overrides to a scene; return it with the files of its keys.

    Named blocks are added and removed first, then types change, then all other values; apart from that the order of
    overrides has no effect.

    Args:
        raw: the scene, as :func:`compose` returns it; it is not changed.
        overrides: values by dotted key. ``KEY`` sets a key of the scene or of its kinds, ``+KEY`` adds a new one, ``++KEY``
            does either, ``~KEY`` removes one (whose value must equal the given one, unless that is None).
        layers: the files of the scene's keys.
        file: the scene file.
        base: the folder that its relative paths start from.

    Raises:
        SceneError: an unknown key, with the closest known one.
    """
    if not isinstance(overrides, Mapping):
        raise SceneError("overrides", overrides, "a mapping from dotted keys such as camera.fov to values")
    changes = [_change(name, value) for name, value in overrides.items()]
    seen: dict[tuple[str, bool], str] = {}
    for change in changes:
        name = change.key, change.sign == "~"
        if name in seen:
            raise SceneError(change.key, change.value, f"to be given once (it is given as {seen[name]} too)")
        seen[name] = change.sign + change.key
    if base.resolve() != (here := Path.cwd()):
        for change in changes:
            inside = any(part in PATHS for part in change.key.split(".")[2:])
            change.value = resolve_path(change.value, here) if inside else resolve_paths(change.value, here)
    blocks: dict[str, dict[str, Any]] = {}
    for change in changes:
        block, _, inner = change.key.partition(".")
        blocks.setdefault(block, {})[inner] = None
    result = dict(with_size(raw, blocks))
    for change in sorted(changes, key=lambda change: change.turn):
        _apply(result, change)
    sides = {
        change.parts[1]: change.value for change in changes if change.parts in (("film", "width"), ("film", "height"))
    }
    if sides:
        result["film"] |= keep_aspect(raw.get("film") or {}, sides)
    tree: dict[str, Any] = {}
    for change in changes:
        _note(tree, change.parts, change.value)
    below = layers.layers or ((file, skeleton(raw)),)
    return result, Layers((*below, (None, tree)))


@dataclass
class _Change:
    """A parsed override.

    Attributes:
        sign: "", "+", "++" or "~".
        key: dotted key without the sign.
        value: the new value.
        parts: the key's names in the scene; set when it is applied.
    """

    sign: str
    key: str
    value: Any
    parts: Parts = ()

    @property
    def turn(self) -> int:
        """Return its place in the order of application: named blocks first, then types, then all others."""
        block, *inner = self.key.split(".")
        if not inner or (block in NAMED and len(inner) == 1):
            return 0
        return 1 if inner[-1] == "type" else 2


def _change(name: Any, value: Any) -> _Change:
    if not isinstance(name, str):
        raise SceneError("overrides", name, "dotted keys such as camera.fov")
    match = re.match(r"(\+\+|\+|~|)(.*)\Z", name, re.DOTALL)
    assert match is not None
    sign, key = match.groups()
    parts = key.split(".")
    if not all(part.strip() for part in parts) or len(parts) > MAX_DEPTH:
        raise SceneError(key or name, value, "a dotted key such as camera.fov or materials.NAME.roughness")
    if parts[0] not in KEYS or parts[0] == "defaults":
        raise SceneError(
            key, value, f"a key of a scene{_near_key(parts)}: {', '.join(k for k in KEYS if k != 'defaults')}"
        )
    if "_target_" in parts:
        raise SceneError(key, value, "no `_target_`: a scene never names Python objects")
    return _Change(sign, key, plain({key: value})[key])


def _near_key(parts: list[str]) -> str:
    known = [key for key in KEYS if key != "defaults"]
    return did_you_mean(parts[0], known, lambda name: ".".join([name, *parts[1:]]))


def _apply(raw: dict[str, Any], change: _Change) -> None:
    """Carry an override out.

    Raises:
        SceneError: a key that leads nowhere.
    """
    place: Any = raw
    parts: list[str] = []
    rest = change.key
    while True:
        name = _next_part(place, rest)
        parts.append(name)
        if name == rest:
            break
        rest = rest[len(name) + 1 :]
        place = _descend(place, name, tuple(parts), change)
    change.parts = tuple(parts)
    if isinstance(place, list):
        _put_in_list(place, name, change)
        return
    there = place.get(name) is not None
    if change.sign == "~":
        if not there:
            raise SceneError(change.key, name, _absent(place, change.parts, "to be there, as it is removed"))
        _check_removed(place[name], change)
        del place[name]
        return
    thing = len(parts) == 2 and parts[0] in NAMED
    if change.sign == "+" and there:
        raise SceneError(
            change.key, change.value, f"a key that is not there yet (it is; {change.key}= without + changes it)"
        )
    if change.sign == "" and thing and not there:
        raise SceneError(
            change.key, change.value, f"{expected_name(parts[0], name, list(place))}; +{change.key}= adds one"
        )
    if thing and change.value is None:
        place.pop(name, None)
    elif name == "type":
        _retype(place, change)
    elif change.key in NAMED and isinstance(change.value, Mapping):
        place[name] = merge_named(name, place.get(name), change.value, None, strict=True)
    else:
        place[name] = merge_values(place.get(name), change.value, change.parts)


def _next_part(place: Any, rest: str) -> str:
    """Return the next name of the rest of a dotted key: existing names may hold dots."""
    if isinstance(place, dict):
        for name in prefixes(rest):
            if name in place:
                return name
    return rest.partition(".")[0]


def _descend(place: Any, name: str, parts: Parts, change: _Change) -> Any:
    """Replace an inner mapping or list of the scene by a copy, which may be changed, and return it."""
    if isinstance(place, list):
        index = _index(place, name, change)
        place[index] = _checked(place[index], parts, change)
        return place[index]
    value = place.get(name)
    if value is None:
        if len(parts) == 2 and parts[0] in NAMED:
            known = [key for key, item in place.items() if item is not None]
            raise SceneError(
                ".".join(parts), name, f"{expected_name(parts[0], name, known)}; +{'.'.join(parts)}= adds one"
            )
        if change.sign == "~":
            raise SceneError(change.key, None, _absent(place, parts, "to be there, as it is removed"))
        value = {}
    elif isinstance(value, str) and parts in KEEPING:
        value = {"type": value}
    place[name] = _checked(value, parts, change)
    return place[name]


def _checked(value: Any, parts: Parts, change: _Change) -> Any:
    if isinstance(value, dict | list):
        return value.copy()
    inner = change.key[len(".".join(parts)) + 1 :]
    raise SceneError(change.key, value, f"{'.'.join(parts)} to be a mapping or a list, in which {inner} could be")


def _index(place: list[Any], name: str, change: _Change) -> int:
    if re.fullmatch(r"[0-9]{1,9}", name) and int(name) < len(place):
        return int(name)
    expected = f"an index 0..{len(place) - 1} of this list" if place else "a list that is not empty"
    raise SceneError(change.key, name, expected)


def _put_in_list(place: list[Any], name: str, change: _Change) -> None:
    if change.sign in ("+", "++") and name == str(len(place)):
        place.append(change.value)
        return
    index = _index(place, name, change)
    if change.sign == "+":
        raise SceneError(change.key, change.value, f"the index {len(place)}, which adds to the end of this list")
    if change.sign == "~":
        _check_removed(place[index], change)
        del place[index]
    else:
        place[index] = merge_values(place[index], change.value, change.parts)


def _check_removed(value: Any, change: _Change) -> None:
    same = change.value is None or change.value == value
    if not isinstance(same, bool) or not same:  # nor can arrays be compared
        raise SceneError(change.key, value, f"{words_of(change.value)}, which is to be removed")


def _absent(place: Mapping[str, Any], parts: Parts, expected: str) -> str:
    known = [name for name, value in place.items() if value is not None]
    if len(parts) == 2 and parts[0] in NAMED:
        return expected_name(parts[0], parts[1], known)
    return f"{dotted(*parts)} {expected}{did_you_mean(parts[-1], known, lambda name: dotted(*parts[:-1], name))}"


def _retype(place: dict[str, Any], change: _Change) -> None:
    """Change a type, and drop keys that the new type does not read."""
    above = change.parts[:-1]
    if change.value is None and above[0] == "materials":
        change.value = "null"  # a material that YAML reads as nothing
    table, default = KEEPING.get(above) or (_table_of(above[0], place.get("type"), change.value), "")
    if table is not None:
        keys = shared_keys(place, change.value, table, default)
        place.clear()
        place.update(keys)
    place["type"] = change.value


def _table_of(block: str, before: Any, after: Any) -> Mapping[str, Any] | None:
    """Return the table of kinds that has both types; that of the block is tried first."""
    tables = [TABLES[block]] if block in TABLES else []
    for table in (*tables, TEXTURES, MATERIALS):
        if isinstance(after, str) and isinstance(before, str) and before in table and after in table:
            return table
    return None


def _note(tree: dict[str, Any], parts: Parts, value: Any) -> None:
    for part in parts[:-1]:
        inner = tree.get(part)
        if not isinstance(inner, dict):
            inner = tree[part] = {}
        tree = inner
    tree[parts[-1]] = skeleton(value)


_WORD = re.compile(r"[A-Za-z_$./][\w$./\-]*\Z", re.ASCII)
_SPECIAL = ("true", "false", "null", "inf", "nan")


def words_of(value: Any) -> str:
    """Return a value in the form of the command line; for tensors and arrays their shape."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        if _WORD.match(value) and value.lower() not in _SPECIAL:
            return value
        escaped = re.sub(r"(\\*)(')", r"\1\1\\'", value)
        return "'" + re.sub(r"(\\+)\Z", r"\1\1", escaped) + "'"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{words_of(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(words_of(item) for item in value) + "]"
    if not getattr(value, "shape", True):
        return repr(value.item())
    return f"<{type(value).__name__} {'x'.join(map(str, getattr(value, 'shape', ())))}>"


def override_words(overrides: Mapping[str, Any]) -> tuple[str, ...]:
    """Return overrides in the form of the command line."""
    return tuple(
        key if key.startswith("~") and value is None else f"{key}={words_of(value)}" for key, value in overrides.items()
    )
