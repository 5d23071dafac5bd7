"""Scenes of several layers: files that a scene names in ``defaults``, its own keys, and overrides by dotted key.

Layers are merged as they are written, before anything of them is read:

- Mappings are merged key by key; lists, numbers and text of a later layer replace those of an earlier one.
- A mapping that names another ``type`` than the one below it replaces it as a whole. The camera, ``integrator``, ``sampler``
  and ``film.filter`` keep the keys that their new type reads too.
- A null unsets: a texture, material, shape or light is removed by it, which has to be there.
- Relative paths start at the folder of the file that they stand in; those of overrides at the current one.
"""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError
from torchpt.core.files import configs, is_regular
from torchpt.physics.bsdfs import KINDS as MATERIALS
from torchpt.physics.cameras import KINDS as CAMERAS
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.shapes import KINDS as SHAPES
from torchpt.physics.textures import KINDS as TEXTURES
from torchpt.scene.formats.yaml import MAX_DEPTH, plain, read_yaml
from torchpt.scene.settings import BLOCKS, TYPED, shaped
from torchpt.spec.schema import dotted, parameters_of

__all__ = ["KEYS", "MAX_FILES", "NAMED", "PATHS", "Layers", "compose", "overridden_by", "told", "words_of"]

#: Blocks that hold things by name.
NAMED = {"textures": "texture", "materials": "material", "shapes": "shape", "lights": "light"}
#: Keys of a scene.
KEYS = ("version", "defaults", "camera", *BLOCKS, *NAMED)
#: Keys whose values are paths.
PATHS = ("path",)
#: Files that a scene may consist of, and how deep they may name each other.
MAX_FILES, MAX_LEVELS = 64, 8
#: What has a type and keeps what another type reads too: its kinds, and its type where none is said.
_KEEPING: dict[tuple[str, ...], tuple[Mapping[str, Any], str]] = {
    ("camera",): (CAMERAS, CAMERAS.names[0]),
    ("integrator",): TYPED["integrator"],
    ("sampler",): TYPED["sampler"],
    ("film", "filter"): TYPED["filter"],
}
_TABLES: dict[str, Mapping[str, Any]] = {
    "textures": TEXTURES, "materials": MATERIALS, "shapes": SHAPES, "lights": LIGHTS,
}  # fmt: skip

Parts = tuple[str, ...]


@dataclass(frozen=True)
class Layers:
    """Which file of a scene each of its keys comes from.

    Attributes:
        layers: file, and its keys without values, the lowest first; the file of overrides is None.
    """

    layers: tuple[tuple[str | None, Any], ...] = field(default=())

    def file_of(self, key: str, otherwise: str | None) -> str | None:
        """Return the file that a key comes from: of those that know most of its parts the last one.

        Args:
            key: dotted.
            otherwise: the file of a scene that has one layer only.
        """
        found, best = otherwise, -1
        for file, tree in self.layers:
            known = _known_parts(tree, key)
            if known >= best:
                found, best = file, known
        return found

    def blame(self, error: SceneError) -> SceneError:
        """Return the error with the file that its key comes from."""
        if not self.layers:
            return error
        return type(error)(error.key, error.value, error.expected, self.file_of(error.key, error.file))


def _known_parts(tree: Any, key: str) -> int:
    """Return how many letters of a dotted key a tree of keys has."""
    known = 0
    while isinstance(tree, dict) and key:
        name = next((name for name in _prefixes(key) if name in tree), None)
        if name is None:
            break
        known, key, tree = known + len(name) + 1, key[len(name) + 1 :], tree[name]
    return known


def _prefixes(key: str) -> Iterator[str]:
    """Yield the beginnings of a dotted key that may be a name, the longest first: names may hold dots."""
    parts = key.split(".")
    for count in range(len(parts), 0, -1):
        yield ".".join(parts[:count])


def _skeleton(raw: Any) -> Any:
    """Return the keys of nested mappings, without values."""
    return {key: _skeleton(value) for key, value in raw.items()} if isinstance(raw, dict) else None


# ---- Files that a scene names in `defaults`


def compose(
    raw: dict[str, Any], file: str | None, base: Path, places: Sequence[Path] = ()
) -> tuple[dict[str, Any], Layers]:
    """Return a scene merged with the files that its ``defaults`` name, and where its keys come from.

    Args:
        raw: the scene as written, bounded by :func:`torchpt.scene.formats.yaml.plain`.
        file: the scene file, for errors.
        base: the folder that its relative paths start from.
        places: folders where names are looked for too, before those that ship.

    Raises:
        SceneError: a file that is not there, that names itself, too many of them; a removal of what is not there.
    """
    if "defaults" not in raw:
        return raw, Layers()
    reader = _Reader(base, (*places, configs() / "scene"))
    merged = reader.merge(raw, file, base, () if file is None else (Path(file).resolve(),))
    return merged, Layers(tuple(reader.layers))


class _Reader:
    """Reads the files of one scene.

    Args:
        base: the folder that relative paths start from once all are merged.
        places: folders where names are looked for that are not beside the file that names them.
    """

    def __init__(self, base: Path, places: Sequence[Path]) -> None:
        self.base, self.places = base.resolve(), places
        self.layers: list[tuple[str | None, Any]] = []

    def merge(self, raw: dict[str, Any], file: str | None, folder: Path, trail: tuple[Path, ...]) -> dict[str, Any]:
        own = {key: value for key, value in raw.items() if key != "defaults"}
        below: dict[str, Any] = {}
        for index, name in enumerate(_names(raw.get("defaults"), file)):
            key = f"defaults.{index}" if isinstance(raw["defaults"], list) else "defaults"
            path = self.found(name, folder, key, file, trail)
            if path in trail:
                circle = " -> ".join(_shown(step) for step in (*trail[trail.index(path) :], path))
                raise SceneError(key, name, f"files that do not name themselves ({circle})", file)
            if len(trail) > MAX_LEVELS:
                raise SceneError(key, name, f"files that name each other at most {MAX_LEVELS} levels deep", file)
            if len(self.layers) >= MAX_FILES:
                raise SceneError(key, name, f"a scene of at most {MAX_FILES} files", file)
            shown = _shown(path)
            part = self.merge(plain(read_yaml(path, shown), shown), shown, path.parent, (*trail, path))
            below = merged(below, part, shown, strict=False) if below else part
        if trail and folder.resolve() != self.base:
            own = _placed(own, folder.resolve())
        self.layers.append((file, _skeleton(own)))
        return merged(below, own, file, strict="defaults" in raw)

    def found(self, name: str, folder: Path, key: str, file: str | None, trail: tuple[Path, ...]) -> Path:
        """Return the file that a default names: beside the file that names it, or in one of the places."""
        exact = name.endswith((".yaml", ".yml"))
        places = [folder / name] if exact else [place / f"{name}.yaml" for place in (folder, *self.places)]
        for place in places:
            path = place.resolve()
            own = bool(trail) and path == trail[-1] and place is not places[-1]  # a file that extends its namesake
            if is_regular(path) and not own:
                return path
        known = sorted({path.stem for place in (folder, *self.places) for path in place.glob("*.yaml")})
        close = difflib.get_close_matches(name, known, 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        where = str(places[0]) if exact else f"{places[0]} or a scene that ships"
        raise SceneError(key, name, f"a file that is there: {where}{hint}", file)


def _names(value: Any, file: str | None) -> list[str]:
    names = [value] if isinstance(value, str) else [] if value is None else value
    expected = "a list of names of scenes or of files ending in .yaml, merged in this order under the scene's own keys"
    if not isinstance(names, list):
        raise SceneError("defaults", value, expected, file)
    for index, name in enumerate(names):
        if not isinstance(name, str) or not name.strip() or not name.isprintable() or name == "_self_":
            raise SceneError(f"defaults.{index}", name, expected, file)
    return names


def _shown(path: Path) -> str:
    """Return a path as errors show it: from the current folder where it lies below that."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def _placed(value: Any, folder: Path) -> Any:
    """Return nested mappings whose relative paths start at a folder."""
    if isinstance(value, dict):
        return {key: _path_in(item, folder) if key in PATHS else _placed(item, folder) for key, item in value.items()}
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return [_placed(item, folder) for item in value]
    return value


def _path_in(value: Any, folder: Path) -> Any:
    if isinstance(value, list):
        return [_path_in(item, folder) for item in value]
    if not isinstance(value, str) or value.startswith("$") or not value.strip():
        return value
    return os.path.normpath(folder / value)


# ---- One layer over another


def merged(below: Mapping[str, Any], above: Mapping[str, Any], file: str | None, *, strict: bool) -> dict[str, Any]:
    """Return a layer over another; neither is changed.

    Args:
        below: the earlier layer, by block.
        above: the later one.
        file: of the later one, for errors.
        strict: whether what a null removes has to be there; else the null stays, for a layer below.

    Raises:
        SceneError: a thing to remove that is not there.
    """
    below = _with_size(below, above)
    result = dict(below)
    for block, value in above.items():
        if block in NAMED and isinstance(value, Mapping):
            result[block] = _things(block, below.get(block), value, file, strict)
        else:
            result[block] = _over(below.get(block), value, (block,))
    return result


def _things(block: str, below: Any, above: Mapping[str, Any], file: str | None, strict: bool) -> dict[str, Any]:
    result = dict(below) if isinstance(below, Mapping) else {}
    for name, value in above.items():
        if value is not None:
            result[name] = _over(result.get(name), value, (block, name))
        elif result.pop(name, None) is None:
            if strict:
                raise SceneError(f"{block}.{name}", None, _one_of(block, name, list(result)), file)
            result[name] = None
    return result


def _over(below: Any, above: Any, where: Parts) -> Any:
    """Return a value of a later layer over that of an earlier one, ``where`` they stand."""
    if where in _KEEPING:
        below, above = (({"type": item} if isinstance(item, str) else item) for item in (below, above))
    if not isinstance(above, Mapping) or not isinstance(below, Mapping):
        return above
    if where == ("film",):
        above = shaped(below, above)
    if where in _KEEPING:
        table, default = _KEEPING[where]
        below = _kept(below, above.get("type") or below.get("type") or default, table, default)
    elif _identity(above) not in (None, _identity(below)):
        return above
    result = dict(below)
    for key, value in above.items():
        result[key] = _over(below.get(key), value, (*where, key))
    return result


def _identity(thing: Mapping[str, Any]) -> Any:
    """Return what says of a mapping what it is: its type, or that it names a texture."""
    return thing.get("type") or ("texture" if "texture" in thing else None)


def _kept(below: Mapping[str, Any], name: Any, table: Mapping[str, Any], default: str) -> dict[str, Any]:
    """Return the keys of a mapping that another type reads too."""
    if name == below.get("type", default) or not isinstance(name, str) or name not in table:
        return dict(below)
    own = parameters_of(table[name])
    return {key: value for key, value in below.items() if key in own or key not in _all_keys(table)}


def _all_keys(table: Mapping[str, Any]) -> set[str]:
    return {key for kind in table for key in parameters_of(table[kind])}


def _with_size(below: Mapping[str, Any], above: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a layer whose camera says the size that its ``K`` in pixels is of, where a later layer has another film."""
    camera, film = below.get("camera"), below.get("film")
    if not isinstance(camera, Mapping) or camera.get("K") is None or camera.get("size") is not None:
        return below
    size = [film.get("width"), film.get("height")] if isinstance(film, Mapping) else [None]
    if None in size or "film" not in above or "K" in (above.get("camera") or ()):
        return below
    return {**below, "camera": {**camera, "size": size}}


def _one_of(block: str, name: str, known: Sequence[str]) -> str:
    """Return what is accepted in place of a name that is not there."""
    close = difflib.get_close_matches(name, known, 1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    shown = [*known[:20], "..."] if len(known) > 20 else known
    return f"the name of a {NAMED[block]} that is there{hint}: {', '.join(shown) or 'there is none'}"


# ---- Overrides: values by dotted key, of the command line or of `torchpt.load(overrides=...)`


def overridden_by(
    raw: dict[str, Any], overrides: Mapping[str, Any], layers: Layers, file: str | None, base: Path
) -> tuple[dict[str, Any], Layers]:
    """Return a scene with some of its values replaced, and where its keys come from then.

    Things are added and removed first, then types change, then all other values: in which order they are given makes
    no difference otherwise.

    Args:
        raw: the scene, as :func:`compose` returns it; it is not changed.
        overrides: values by dotted key. ``KEY`` sets what is there or may be there, ``+KEY`` adds what is not, ``++KEY`` does
            either, ``~KEY`` removes what is there (whose value must be the one given, unless that is None).
        layers: where the scene's keys come from.
        file: the scene file.
        base: the folder that its relative paths start from.

    Raises:
        SceneError: a key that leads nowhere, with a suggestion where there is one.
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
            change.value = _path_in(change.value, here) if inside else _placed(change.value, here)
    result = _copied(_with_size(raw, {"film": None}))
    for change in sorted(changes, key=lambda change: change.turn):
        _apply(result, change)
    sides = {
        change.parts[1]: change.value for change in changes if change.parts in (("film", "width"), ("film", "height"))
    }
    if sides:
        result["film"] |= shaped(raw.get("film") or {}, sides)
    tree: dict[str, Any] = {}
    for change in changes:
        _note(tree, change.parts, change.value)
    below = layers.layers or ((file, _skeleton(raw)),)
    return result, Layers((*below, (None, tree)))


@dataclass
class _Change:
    """An override, taken apart.

    Attributes:
        sign: "", "+", "++" or "~".
        key: dotted, without it.
        value: what it sets.
        parts: where in the scene that is, once it is applied.
    """

    sign: str
    key: str
    value: Any
    parts: Parts = ()

    @property
    def turn(self) -> int:
        """Return when it is applied: things first, then types, then all else."""
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
    close = difflib.get_close_matches(parts[0], known, 1)
    return f" (did you mean {'.'.join([close[0], *parts[1:]])}?)" if close else ""


def _copied(value: Any) -> Any:
    """Return nested mappings and lists that may be changed; rows of numbers are shared."""
    if isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return [_copied(item) for item in value]
    return list(value) if isinstance(value, list) else value


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
        place = _entered(place, name, tuple(parts), change)
    change.parts = tuple(parts)
    if isinstance(place, list):
        _put_in_list(place, name, change)
        return
    there = place.get(name) is not None
    if change.sign == "~":
        if not there:
            raise SceneError(change.key, None, _absent(place, change.parts, "to be there, as it is removed"))
        _check_removed(place[name], change)
        del place[name]
        return
    thing = len(parts) == 2 and parts[0] in NAMED
    if change.sign == "+" and there:
        raise SceneError(
            change.key, change.value, f"a key that is not there yet (it is; {change.key}= without + changes it)"
        )
    if change.sign == "" and thing and not there:
        raise SceneError(change.key, change.value, f"{_one_of(parts[0], name, list(place))}; +{change.key}= adds one")
    if thing and change.value is None:
        place.pop(name, None)
    elif name == "type":
        _retype(place, change)
    elif change.key in NAMED and isinstance(change.value, Mapping):
        place[name] = _things(name, place.get(name), change.value, None, strict=True)
    else:
        place[name] = _over(place.get(name), change.value, change.parts)


def _next_part(place: Any, rest: str) -> str:
    """Return the next part of what is left of a key: names that are there may hold dots."""
    if isinstance(place, dict):
        for name in _prefixes(rest):
            if name in place:
                return name
    return rest.partition(".")[0]


def _entered(place: Any, name: str, parts: Parts, change: _Change) -> Any:
    """Return what lies under a part of a key that is not its last."""
    if isinstance(place, list):
        return _checked(place[_index(place, name, change)], parts, change)
    value = place.get(name)
    if value is None:
        if len(parts) == 2 and parts[0] in NAMED:
            known = [key for key, item in place.items() if item is not None]
            raise SceneError(".".join(parts), name, f"{_one_of(parts[0], name, known)}; +{'.'.join(parts)}= adds one")
        if change.sign == "~":
            raise SceneError(change.key, None, _absent(place, parts, "to be there, as it is removed"))
        value = place[name] = {}
    elif isinstance(value, str) and parts in _KEEPING:
        value = place[name] = {"type": value}
    return _checked(value, parts, change)


def _checked(value: Any, parts: Parts, change: _Change) -> Any:
    if isinstance(value, dict | list):
        return value
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
        place[index] = _over(place[index], change.value, change.parts)


def _check_removed(value: Any, change: _Change) -> None:
    if change.value is not None and change.value != value:
        raise SceneError(change.key, value, f"{words_of(change.value)}, which is to be removed")


def _absent(place: Mapping[str, Any], parts: Parts, expected: str) -> str:
    known = [name for name, value in place.items() if value is not None]
    if len(parts) == 2 and parts[0] in NAMED:
        return _one_of(parts[0], parts[1], known)
    close = difflib.get_close_matches(parts[-1], known, 1)
    hint = f" (did you mean {dotted(*parts[:-1], close[0])}?)" if close else ""
    return f"{dotted(*parts)} {expected}{hint}"


def _retype(place: dict[str, Any], change: _Change) -> None:
    """Change a type; keys that the new type does not read go."""
    above = change.parts[:-1]
    table, default = _KEEPING.get(above) or (_table_of(above[0], place.get("type"), change.value), "")
    if table is not None:
        kept = _kept(place, change.value, table, default)
        place.clear()
        place.update(kept)
    place["type"] = change.value


def _table_of(block: str, before: Any, after: Any) -> Mapping[str, Any] | None:
    """Return the kinds that two types belong to, those of the block first."""
    tables = [_TABLES[block]] if block in _TABLES else []
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
    tree[parts[-1]] = _skeleton(value)


_WORD = re.compile(r"[A-Za-z_$./][\w$./\-]*\Z", re.ASCII)
_SPECIAL = ("true", "false", "null", "inf", "nan")


def words_of(value: Any) -> str:
    """Return a value as the command line writes it; of tensors and arrays their shape."""
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


def told(overrides: Mapping[str, Any]) -> tuple[str, ...]:
    """Return overrides as words of the command line."""
    return tuple(
        key if key.startswith("~") and value is None else f"{key}={words_of(value)}" for key, value in overrides.items()
    )
