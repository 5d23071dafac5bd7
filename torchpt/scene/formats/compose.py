"""Merge the layers of a scene: the files in its ``defaults``, then its own keys; :mod:`.overrides` come last.

:func:`torchpt.scene.formats.description.read_description` calls :func:`compose`. Layers are merged as written, before
validation:

- Mappings are merged key by key; lists, numbers and text of a later layer replace those of an earlier one.
- A mapping that names another ``type`` than the one below it replaces it as a whole. The camera, ``integrator``, ``sampler``
  and ``film.filter`` keep the keys that their new type reads too.
- A null unsets a key; it removes a texture, material, shape or light, which must exist.
- Relative paths start at the folder of the file that they stand in; those of overrides at the current one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError, did_you_mean
from torchpt.core.files import configs, is_regular
from torchpt.physics.bsdfs import KINDS as MATERIALS
from torchpt.physics.cameras import KINDS as CAMERAS
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.shapes import KINDS as SHAPES
from torchpt.physics.textures import KINDS as TEXTURES
from torchpt.scene.formats.yaml import plain, read_yaml
from torchpt.scene.settings import BLOCKS, TYPED_BLOCKS, keep_aspect
from torchpt.spec.schema import parameters_of

__all__ = [
    "KEEPING",
    "KEYS",
    "MAX_FILES",
    "MAX_LEVELS",
    "NAMED",
    "PATHS",
    "TABLES",
    "Layers",
    "Parts",
    "compose",
    "expected_name",
    "merge_named",
    "merge_values",
    "prefixes",
    "resolve_path",
    "resolve_paths",
    "shared_keys",
    "skeleton",
    "with_size",
]  # fmt: skip

#: Blocks that map names to blocks, and what errors call one of those.
NAMED = {"textures": "texture", "materials": "material", "shapes": "shape", "lights": "light"}
#: Keys of a scene.
KEYS = ("version", "defaults", "camera", *BLOCKS, *NAMED)
#: Keys whose values are paths.
PATHS = ("path",)
#: Most files of a scene, and the greatest depth of their ``defaults``.
MAX_FILES, MAX_LEVELS = 64, 8
#: Most names that an error lists, which is one line.
MOST_NAMES_SHOWN = 20
#: Blocks that keep the keys shared by both types when the type changes, by their key in the scene: table of kinds, default
#: type.
KEEPING: dict[tuple[str, ...], tuple[Mapping[str, Any], str]] = {
    ("camera",): (CAMERAS, CAMERAS.names[0]),
    ("integrator",): TYPED_BLOCKS["integrator"],
    ("sampler",): TYPED_BLOCKS["sampler"],
    ("film", "filter"): TYPED_BLOCKS["filter"],
}
#: Table of the kinds of each block of named blocks.
TABLES: dict[str, Mapping[str, Any]] = {
    "textures": TEXTURES, "materials": MATERIALS, "shapes": SHAPES, "lights": LIGHTS,
}  # fmt: skip

#: A dotted key as its names in the scene.
Parts = tuple[str, ...]


@dataclass(frozen=True)
class Layers:
    """The files of a scene, with the keys that come from each.

    Attributes:
        layers: file and tree of its keys (nested mappings without values), the lowest layer first; the file of overrides is
            None.
        places: file, line and element of an imported scene that a key and those below it come from, by dotted key.
    """

    layers: tuple[tuple[str | None, Any], ...] = field(default=())
    places: Mapping[str, str] = field(default_factory=dict)

    def file_of(self, key: str, otherwise: str | None) -> str | None:
        """Return the file that a key comes from: the last of those that have the longest prefix of it.

        Of an imported scene the place within it is returned.

        Args:
            key: dotted key.
            otherwise: the file of a scene that has one layer only.
        """
        found, longest = otherwise, -1
        for file, tree in self.layers:
            length = _known_length(tree, key)
            if length >= longest:
                found, longest = file, length
        if self.layers and found is None:
            return None
        return next((self.places[name] for name in prefixes(key) if name in self.places), found)

    def blame(self, error: SceneError) -> SceneError:
        """Return the error with the file that its key comes from."""
        if not self.layers and not self.places:
            return error
        return type(error)(error.key, error.value, error.expected, self.file_of(error.key, error.file))


def _known_length(tree: Any, key: str) -> int:
    """Return the number of characters, dots included, of the longest prefix of a dotted key that a tree of keys has."""
    known = 0
    while isinstance(tree, dict) and key:
        name = next((name for name in prefixes(key) if name in tree), None)
        if name is None:
            break
        known, key, tree = known + len(name) + 1, key[len(name) + 1 :], tree[name]
    return known


def prefixes(key: str) -> Iterator[str]:
    """Yield the prefixes of a dotted key that may be a name, the longest first: names may hold dots."""
    parts = key.split(".")
    for count in range(len(parts), 0, -1):
        yield ".".join(parts[:count])


def skeleton(raw: Any) -> Any:
    """Return the keys of nested mappings, without values."""
    return {key: skeleton(value) for key, value in raw.items()} if isinstance(raw, dict) else None


# ---- Files that a scene names in `defaults`


def compose(
    raw: dict[str, Any], file: str | None, base: Path, places: Sequence[Path] = ()
) -> tuple[dict[str, Any], Layers]:
    """Merge a scene with the files in its ``defaults``; return it with the files of its keys.

    Args:
        raw: the scene as written, copied and checked by :func:`torchpt.scene.formats.yaml.plain`.
        file: the scene file, for errors.
        base: the folder that its relative paths start from.
        places: further folders to look up names in, before the scenes that ship.

    Raises:
        SceneError: a missing file, a cycle, too many files, or a removal of a name that does not exist.
    """
    if "defaults" not in raw:
        return raw, Layers()
    reader = _Reader(base, (*places, configs() / "scene"))
    merged = reader.merge(raw, file, base, trail=() if file is None else (Path(file).resolve(),))
    return merged, Layers(tuple(reader.layers))


class _Reader:
    """Reader of the files of one scene; ``layers`` collects them with their keys, the lowest first.

    Args:
        base: the folder that relative paths start from once all are merged.
        places: folders to look up names in that are not beside the file with the ``defaults``.
    """

    def __init__(self, base: Path, places: Sequence[Path]) -> None:
        self.base, self.places = base.resolve(), places
        self.layers: list[tuple[str | None, Any]] = []

    def merge(self, raw: dict[str, Any], file: str | None, folder: Path, trail: tuple[Path, ...]) -> dict[str, Any]:
        """Merge a file with those in its ``defaults``.

        Args:
            raw: the file as written.
            file: its name for errors.
            folder: the folder that it lies in.
            trail: this file after those that lead to it, the scene first; empty for a scene that is no file.

        Raises:
            SceneError: see :func:`compose`.
        """
        own = {key: value for key, value in raw.items() if key != "defaults"}
        below: dict[str, Any] = {}
        for index, name in enumerate(_names(raw.get("defaults"), file)):
            key = f"defaults.{index}" if isinstance(raw["defaults"], list) else "defaults"
            path = self.find_file(name, folder, key, file, trail)
            if path in trail:
                circle = " -> ".join(_shown(step) for step in (*trail[trail.index(path) :], path))
                raise SceneError(key, name, f"files that do not name themselves ({circle})", file)
            if len(trail) > MAX_LEVELS:
                raise SceneError(key, name, f"files that name each other at most {MAX_LEVELS} levels deep", file)
            if len(self.layers) >= MAX_FILES:
                raise SceneError(key, name, f"a scene of at most {MAX_FILES} files", file)
            shown = _shown(path)
            part = self.merge(plain(read_yaml(path, shown), shown), shown, path.parent, (*trail, path))
            below = _merge_layers(below, part, shown, strict=False) if below else part
        # Paths of files in other folders are made absolute; those of the scene start at its own folder.
        if trail and folder.resolve() != self.base:
            own = resolve_paths(own, folder.resolve())
        self.layers.append((file, skeleton(own)))
        return _merge_layers(below, own, file, strict="defaults" in raw)

    def find_file(self, name: str, folder: Path, key: str, file: str | None, trail: tuple[Path, ...]) -> Path:
        """Return the file of an entry of ``defaults``: beside the file that has it, or in one of the places."""
        is_path = name.endswith((".yaml", ".yml"))
        places = [folder / name] if is_path else [place / f"{name}.yaml" for place in (folder, *self.places)]
        for place in places:
            path = place.resolve()
            # A file that names itself extends a namesake in a later place.
            is_itself = bool(trail) and path == trail[-1] and place is not places[-1]
            if is_regular(path) and not is_itself:
                return path
        known = sorted({path.stem for place in (folder, *self.places) for path in place.glob("*.yaml")})
        hint = did_you_mean(name, known)
        where = str(places[0]) if is_path else f"{places[0]} or a scene that ships"
        raise SceneError(key, name, f"a file that is there: {where}{hint}", file)


def _names(value: Any, file: str | None) -> list[str]:
    """Return the entries of ``defaults``; a single name stands for a list of one."""
    names = [value] if isinstance(value, str) else [] if value is None else value
    expected = "a list of names of scenes or of files ending in .yaml, merged in this order under the scene's own keys"
    if not isinstance(names, list):
        raise SceneError("defaults", value, expected, file)
    for index, name in enumerate(names):
        if not isinstance(name, str) or not name.strip() or not name.isprintable() or name == "_self_":
            raise SceneError(f"defaults.{index}", name, expected, file)
    return names


def _shown(path: Path) -> str:
    """Return a path for errors: relative to the current folder if below it."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def resolve_paths(value: Any, folder: Path) -> Any:
    """Return nested mappings with relative paths joined to a folder."""
    if isinstance(value, dict):
        return {
            key: resolve_path(item, folder) if key in PATHS else resolve_paths(item, folder)
            for key, item in value.items()
        }
    if isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        return [resolve_paths(item, folder) for item in value]
    return value


def resolve_path(value: Any, folder: Path) -> Any:
    """Return a path, or a list of them, joined to a folder; one that begins with a variable is unchanged."""
    if isinstance(value, list):
        return [resolve_path(item, folder) for item in value]
    if not isinstance(value, str) or value.startswith("$") or not value.strip():
        return value
    return os.path.normpath(folder / value)


# ---- Merging of two layers


def _merge_layers(
    below: Mapping[str, Any], above: Mapping[str, Any], file: str | None, *, strict: bool
) -> dict[str, Any]:
    """Return two layers merged; neither is changed.

    Args:
        below: the earlier layer, by block.
        above: the later one.
        file: file of the later one, for errors.
        strict: True where a name that a null removes must exist; else the null is kept for a lower layer.

    Raises:
        SceneError: a removal of a name that does not exist.
    """
    below = with_size(below, above)
    result = dict(below)
    for block, value in above.items():
        if block in NAMED and isinstance(value, Mapping):
            result[block] = merge_named(block, below.get(block), value, file=file, strict=strict)
        else:
            result[block] = merge_values(below.get(block), value, (block,))
    return result


def merge_named(block: str, below: Any, above: Mapping[str, Any], file: str | None, *, strict: bool) -> dict[str, Any]:
    """Merge two layers of a block of :data:`NAMED`, e.g. ``materials``; arguments and errors as of :func:`_merge_layers`."""
    result = dict(below) if isinstance(below, Mapping) else {}
    for name, value in above.items():
        if value is not None:
            result[name] = merge_values(result.get(name), value, (block, name))
        elif result.pop(name, None) is None:
            if strict:
                raise SceneError(f"{block}.{name}", None, expected_name(block, name, list(result)), file)
            result[name] = None
    return result


def merge_values(below: Any, above: Any, where: Parts) -> Any:
    """Merge the values of two layers at the key ``where``; neither is changed."""
    if where in KEEPING:  # a bare name stands for a block of that type
        below, above = (({"type": item} if isinstance(item, str) else item) for item in (below, above))
    if not isinstance(above, Mapping) or not isinstance(below, Mapping):
        return above
    if where == ("film",):
        above = keep_aspect(below, above)
    if where in KEEPING:
        table, default = KEEPING[where]
        below = shared_keys(below, above.get("type") or below.get("type") or default, table, default)
    elif _type_of(above) not in (None, _type_of(below)):
        return above
    result = dict(below)
    for key, value in above.items():
        result[key] = merge_values(below.get(key), value, (*where, key))
    return result


def _type_of(block: Mapping[str, Any]) -> Any:
    """Return the type of a mapping, ``texture`` for a reference to a texture, or None."""
    if "type" in block:
        return block["type"] or "null"  # a material that YAML reads as nothing
    return "texture" if "texture" in block else None


def shared_keys(below: Mapping[str, Any], name: Any, table: Mapping[str, Any], default: str) -> dict[str, Any]:
    """Return the keys of a block that stay when its type changes: those that both types read, and those that no type knows.

    Args:
        below: the block.
        name: the new type.
        table: the kinds of the block.
        default: the type of a block without one.
    """
    if name == below.get("type", default) or not isinstance(name, str) or name not in table:
        return dict(below)
    own = parameters_of(table[name])
    return {key: value for key, value in below.items() if key in own or key not in _all_keys(table)}


def _all_keys(table: Mapping[str, Any]) -> set[str]:
    return {key for kind in table for key in parameters_of(table[kind])}


def with_size(below: Mapping[str, Any], above: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a layer whose camera has the film's size beside ``K``, where a later layer changes the film.

    ``K`` is in pixels of the film that it was written for.

    Args:
        below: the layer.
        above: the later layer, by block; only its keys are read.
    """
    camera, film = below.get("camera"), below.get("film")
    if not isinstance(camera, Mapping) or camera.get("K") is None or camera.get("size") is not None:
        return below
    size = [film.get("width"), film.get("height")] if isinstance(film, Mapping) else [None]
    if None in size or "film" not in above or "K" in (above.get("camera") or ()):
        return below
    return {**below, "camera": {**camera, "size": size}}


def expected_name(block: str, name: str, known: Sequence[str]) -> str:
    """Return the phrase of what is accepted in place of an unknown name."""
    hint = did_you_mean(name, known)
    shown = [*known[:MOST_NAMES_SHOWN], "..."] if len(known) > MOST_NAMES_SHOWN else known
    return f"the name of a {NAMED[block]} that is there{hint}: {', '.join(shown) or 'there is none'}"
