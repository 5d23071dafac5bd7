"""Apply overrides of a scene's keys by dotted key, from the command line or ``torchpt.load(overrides=...)``.

They are the top layer of a scene, merged by the rules of :mod:`torchpt.scene.formats.compose`. A *named block* is an entry of
textures, materials, shapes or lights. The *parts* of a dotted key are its names in the scene, which may hold dots themselves;
so a key is split while the scene is walked.
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
    changes = [_parsed_change(name, value) for name, value in overrides.items()]
    seen: dict[tuple[str, bool], str] = {}  # as given, by key and whether it removes: a key may be removed and set anew
    for change in changes:
        identity = change.key, change.sign == "~"
        if identity in seen:
            raise SceneError(change.key, change.value, f"to be given once (it is given as {seen[identity]} too)")
        seen[identity] = change.sign + change.key
    # Relative paths of overrides start at the current folder, those of the scene at `base`.
    if base.resolve() != (here := Path.cwd()):
        for change in changes:
            is_path = any(part in PATHS for part in change.key.split(".")[2:])
            change.value = resolve_path(change.value, here) if is_path else resolve_paths(change.value, here)
    # Keys that change, by block: `with_size` asks only which they are.
    blocks: dict[str, dict[str, Any]] = {}
    for change in changes:
        block, _, inner = change.key.partition(".")
        blocks.setdefault(block, {})[inner] = None
    result = dict(with_size(raw, blocks))
    for change in sorted(changes, key=lambda change: change.order):
        _apply(result, change)
    sides = {
        change.parts[1]: change.value for change in changes if change.parts in (("film", "width"), ("film", "height"))
    }
    if sides:
        result["film"] |= keep_aspect(raw.get("film") or {}, sides)
    tree: dict[str, Any] = {}  # the keys that overrides give, as a layer of its own
    for change in changes:
        _add_keys(tree, change.parts, change.value)
    below = layers.layers or ((file, skeleton(raw)),)
    return result, Layers((*below, (None, tree)), layers.places)


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
    def order(self) -> int:
        """Return 0 for named blocks and whole blocks, 1 for types, 2 for all others: the order in which changes are applied."""
        block, *inner = self.key.split(".")
        if not inner or (block in NAMED and len(inner) == 1):
            return 0
        return 1 if inner[-1] == "type" else 2


def _parsed_change(name: Any, value: Any) -> _Change:
    """Split the sign from a key, and check that its first part is a key of scenes."""
    if not isinstance(name, str):
        raise SceneError("overrides", name, "dotted keys such as camera.fov")
    match = re.match(r"(\+\+|\+|~|)(.*)\Z", name, re.DOTALL)  # a sign or none, then the key
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
    """Return a hint with the closest known key, or ""."""
    known = [key for key in KEYS if key != "defaults"]
    return did_you_mean(parts[0], known, lambda name: ".".join([name, *parts[1:]]))


def _apply(raw: dict[str, Any], change: _Change) -> None:
    """Carry an override out.

    Raises:
        SceneError: a key that leads nowhere.
    """
    container: Any = raw  # the mapping or list that `remaining_key` starts in
    parts: list[str] = []
    remaining_key = change.key
    while True:
        name = _next_part(container, remaining_key)
        parts.append(name)
        if name == remaining_key:
            break
        remaining_key = remaining_key[len(name) + 1 :]
        container = _descend(container, name, tuple(parts), change)
    change.parts = tuple(parts)
    if isinstance(container, list):
        _put_in_list(container, name, change)
        return
    exists = container.get(name) is not None
    if change.sign == "~":
        if not exists:
            raise SceneError(change.key, name, _absent(container, change.parts, "to be there, as it is removed"))
        _check_removed(container[name], change)
        del container[name]
        return
    is_named_block = len(parts) == 2 and parts[0] in NAMED
    if change.sign == "+" and exists:
        raise SceneError(
            change.key, change.value, f"a key that is not there yet (it is; {change.key}= without + changes it)"
        )
    if change.sign == "" and is_named_block and not exists:
        raise SceneError(
            change.key, change.value, f"{expected_name(parts[0], name, list(container))}; +{change.key}= adds one"
        )
    if is_named_block and change.value is None:
        container.pop(name, None)
    elif name == "type":
        _retype(container, change)
    elif change.key in NAMED and isinstance(change.value, Mapping):
        container[name] = merge_named(name, container.get(name), change.value, file=None, strict=True)
    else:
        container[name] = merge_values(container.get(name), change.value, change.parts)


def _next_part(container: Any, remaining_key: str) -> str:
    """Return the next name of a dotted key: the longest one that exists, as names may hold dots, else up to the next dot."""
    if isinstance(container, dict):
        for name in prefixes(remaining_key):
            if name in container:
                return name
    return remaining_key.partition(".")[0]


def _descend(container: Any, name: str, parts: Parts, change: _Change) -> Any:
    """Replace the mapping or list ``name`` in ``container`` by a copy, which may be changed, and return the copy."""
    if isinstance(container, list):
        index = _index(container, name, change)
        container[index] = _copy_of(container[index], parts, change)
        return container[index]
    value = container.get(name)
    if value is None:
        if len(parts) == 2 and parts[0] in NAMED:
            known = [key for key, item in container.items() if item is not None]
            raise SceneError(
                ".".join(parts), name, f"{expected_name(parts[0], name, known)}; +{'.'.join(parts)}= adds one"
            )
        if change.sign == "~":
            raise SceneError(change.key, None, _absent(container, parts, "to be there, as it is removed"))
        value = {}
    elif isinstance(value, str) and parts in KEEPING:
        value = {"type": value}
    container[name] = _copy_of(value, parts, change)
    return container[name]


def _copy_of(value: Any, parts: Parts, change: _Change) -> Any:
    """Return a shallow copy of a mapping or list; raise for any other value, in which no key can be."""
    if isinstance(value, dict | list):
        return value.copy()
    inner = change.key[len(".".join(parts)) + 1 :]
    raise SceneError(change.key, value, f"{'.'.join(parts)} to be a mapping or a list, in which {inner} could be")


def _index(container: list[Any], name: str, change: _Change) -> int:
    """Return a part of a key as an index of a list; raise where it is none."""
    if re.fullmatch(r"[0-9]{1,9}", name) and int(name) < len(container):
        return int(name)
    expected = f"an index 0..{len(container) - 1} of this list" if container else "a list that is not empty"
    raise SceneError(change.key, name, expected)


def _put_in_list(container: list[Any], name: str, change: _Change) -> None:
    """Carry out an override of an item of a list."""
    if change.sign in ("+", "++") and name == str(len(container)):
        container.append(change.value)
        return
    index = _index(container, name, change)
    if change.sign == "+":
        raise SceneError(change.key, change.value, f"the index {len(container)}, which adds to the end of this list")
    if change.sign == "~":
        _check_removed(container[index], change)
        del container[index]
    else:
        container[index] = merge_values(container[index], change.value, change.parts)


def _check_removed(value: Any, change: _Change) -> None:
    """Raise where the value that is removed is not the one that the override names."""
    is_same = change.value is None or change.value == value
    if not isinstance(is_same, bool) or not is_same:  # a comparison of arrays is no bool
        raise SceneError(change.key, value, f"{words_of(change.value)}, which is to be removed")


def _absent(container: Mapping[str, Any], parts: Parts, expected: str) -> str:
    """Return the phrase for a key that does not exist, with a suggestion."""
    known = [name for name, value in container.items() if value is not None]
    if len(parts) == 2 and parts[0] in NAMED:
        return expected_name(parts[0], parts[1], known)
    return f"{dotted(*parts)} {expected}{did_you_mean(parts[-1], known, lambda name: dotted(*parts[:-1], name))}"


def _retype(container: dict[str, Any], change: _Change) -> None:
    """Change a type, and drop keys that the new type does not read."""
    block_key = change.parts[:-1]
    if change.value is None and block_key[0] == "materials":
        change.value = "null"  # a material that YAML reads as nothing
    table, default = KEEPING.get(block_key) or (_table_of(block_key[0], container.get("type"), change.value), "")
    if table is not None:  # else the old keys stay, and those that do not fit are reported
        keys = shared_keys(container, change.value, table, default)
        container.clear()
        container.update(keys)
    container["type"] = change.value


def _table_of(block: str, before: Any, after: Any) -> Mapping[str, Any] | None:
    """Return the table of kinds that has both types; that of the block is tried first."""
    tables = [TABLES[block]] if block in TABLES else []
    for table in (*tables, TEXTURES, MATERIALS):
        if isinstance(after, str) and isinstance(before, str) and before in table and after in table:
            return table
    return None


def _add_keys(tree: dict[str, Any], parts: Parts, value: Any) -> None:
    """Add a key, and the keys of its value, to a tree of keys."""
    for part in parts[:-1]:
        inner = tree.get(part)
        if not isinstance(inner, dict):
            inner = tree[part] = {}
        tree = inner
    tree[parts[-1]] = skeleton(value)


#: Text that the command line reads as text without quotes: a letter, _ $ . or /, then also digits and -.
_WORD = re.compile(r"[A-Za-z_$./][\w$./\-]*\Z", re.ASCII)
#: Words that would be read as other values.
_SPECIAL = ("true", "false", "null", "inf", "nan")


def words_of(value: Any) -> str:
    """Return a value in the form of the command line; for tensors and arrays their shape."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        if _WORD.match(value) and value.lower() not in _SPECIAL:
            return value
        # Hydra's grammar: backslashes count as escapes only before a quote, where they are doubled, as at the end.
        escaped = re.sub(r"(\\*)(')", r"\1\1\\'", value)
        return "'" + re.sub(r"(\\+)\Z", r"\1\1", escaped) + "'"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{words_of(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(words_of(item) for item in value) + "]"
    if not getattr(value, "shape", True):  # a tensor or array of shape (): a number
        return repr(value.item())
    return f"<{type(value).__name__} {'x'.join(map(str, getattr(value, 'shape', ())))}>"


def override_words(overrides: Mapping[str, Any]) -> tuple[str, ...]:
    """Return overrides in the form of the command line."""
    return tuple(
        key if key.startswith("~") and value is None else f"{key}={words_of(value)}" for key, value in overrides.items()
    )
