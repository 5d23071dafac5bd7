"""Read and validate scene files: names, paths and numbers; nothing is built yet.

:func:`read_description` is the entry: text or dict -> layers merged (:mod:`.compose`, :mod:`.overrides`) -> blocks read and
checked -> :class:`Description`. A *layer* is one of the files that a scene is merged from. A block that has a ``type`` becomes
:class:`~torchpt.spec.schema.ParsedParams`: the class of that type (``kind``) and the values of its parameters (``values``, or
``[name]``).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any, TypeVar

from torchpt.core.errors import AssetError, SceneError, did_you_mean
from torchpt.core.files import MAX_BYTES, check_regular, configs, is_regular
from torchpt.physics.bsdfs import Bsdf
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.shapes import KINDS as SHAPES
from torchpt.physics.textures import KINDS as TEXTURES
from torchpt.scene import settings as run_settings
from torchpt.scene.formats.cameras import read_camera
from torchpt.scene.formats.compose import KEYS, Layers, compose
from torchpt.scene.formats.materials import Kind, check_material, material_types, read_material
from torchpt.scene.formats.overrides import overridden_by, override_words
from torchpt.scene.formats.textures import check_texture, texture_of
from torchpt.scene.formats.yaml import parse_yaml, plain, read_open, read_yaml
from torchpt.scene.settings import BLOCKS, Settings, settings_with
from torchpt.spec import Role
from torchpt.spec.schema import ParsedParams, check_keys, read_typed

__all__ = [
    "ASSETS",
    "MAX_ENTRIES",
    "Description",
    "Source",
    "overridden",
    "read_description",
    "scene_names",
    "settings",
]

#: The environment variable that paths may begin with.
ASSETS = "$TORCHPT_ASSETS"
#: Most textures, materials, shapes (instances included) and lights of a scene, of each.
MAX_ENTRIES = 100_000

T = TypeVar("T")
#: Types of the first argument of `load`.
Source = str | os.PathLike[str] | IO[str] | IO[bytes] | Mapping[str, Any]
#: What errors say is accepted there.
SOURCES = "a scene's name, a path ending in .yaml or .xml, YAML text, an open file, or a mapping"


@dataclass(frozen=True)
class Description:
    """A validated scene file.

    Attributes:
        file: the scene file, or None for a scene given as a dict.
        base: the folder that relative paths start from.
        camera: the camera.
        version: 1 where the file has it, else None.
        film: keys of the film block that are not null, as written.
        integrator: keys of the integrator block.
        sampler: keys of the sampler block.
        render: keys of the render block.
        textures: textures by name.
        materials: materials by name.
        shapes: shapes by name, in the order of the file.
        lights: lights by name.
        overrides: overrides of the scene's keys, in the form of the command line.
        layers: the file that each key comes from, for errors.
        allows_empty_meshes: True where a mesh without a face that has area is a warning, as in imported scenes.
    """

    file: str | None
    base: Path
    camera: ParsedParams
    version: int | None = None
    film: dict[str, Any] = field(default_factory=dict)
    integrator: dict[str, Any] = field(default_factory=dict)
    sampler: dict[str, Any] = field(default_factory=dict)
    render: dict[str, Any] = field(default_factory=dict)
    textures: dict[str, ParsedParams] = field(default_factory=dict)
    materials: dict[str, ParsedParams] = field(default_factory=dict)
    shapes: dict[str, ParsedParams] = field(default_factory=dict)
    lights: dict[str, ParsedParams] = field(default_factory=dict)
    overrides: tuple[str, ...] = ()
    layers: Layers = field(default=Layers(), repr=False, compare=False)
    allows_empty_meshes: bool = False

    def blame(self, error: SceneError) -> SceneError:
        """Return an error with the file that its key comes from."""
        return error if error.file is None else self.layers.blame(error)

    def resolve(self, path: str | tuple[str, ...], key: str) -> Path:
        """Return the file that a path of the scene refers to, or the first that exists of several.

        A relative path starts at the scene file's folder; only a leading ``$TORCHPT_ASSETS`` is expanded.

        Args:
            path: as written in the scene.
            key: dotted key for the error.

        Raises:
            SceneError: ``$TORCHPT_ASSETS`` is used and not set.
            AssetError: no such file.
        """
        candidates = (path,) if isinstance(path, str) else path
        problems: list[SceneError | AssetError] = []
        for candidate in candidates:
            try:
                return self._existing(candidate, key)
            except (SceneError, AssetError) as error:
                problems.append(error)
        raise problems[-1]

    def _existing(self, path: str, key: str) -> Path:
        """Return the file of a single path; arguments and errors as of :meth:`resolve`."""
        file = self.layers.file_of(key, self.file)
        head, _, rest = path.partition("/")
        if head == ASSETS:
            folder = os.environ.get(ASSETS[1:], "")
            if not folder:
                expected = f"a file that can be found (the environment variable {ASSETS[1:]} is not set)"
                raise SceneError(key, path, expected, file)
            found = Path(folder) / rest
        else:
            found = self.base / path
        try:
            check_regular(found, MAX_BYTES)
        except OSError as error:
            problem = (
                "no such file" if isinstance(error, FileNotFoundError | NotADirectoryError) else str(error.strerror)
            )
            # Other variables and ~ are taken as they stand.
            hint = f"; only {ASSETS} is expanded" if path.startswith(("$", "~")) and head != ASSETS else ""
            raise AssetError(found, f"{problem}, {self._named_by(key)}{hint}") from None
        return found

    @contextmanager
    def reading_files(self) -> Iterator[Callable[[str | tuple[str, ...], str], Path]]:
        """Yield :meth:`resolve`; errors in the context about a file that it returned get the dotted key of the file.

        Raises:
            AssetError: the error with the key.
        """
        key_of_file: dict[str, str] = {}

        def resolve(path: str | tuple[str, ...], key: str) -> Path:
            found = self.resolve(path, key)
            key_of_file[str(found)] = key
            return found

        try:
            yield resolve
        except AssetError as error:
            if error.file not in key_of_file:  # a missing file, whose error has the key; or an image of a mesh file
                raise
            raise AssetError(error.file, f"{error.problem}, {self._named_by(key_of_file[error.file])}") from None

    def _named_by(self, key: str) -> str:
        """Return the end of an error message about a file: the dotted key that holds the path, and the scene file."""
        file = self.layers.file_of(key, self.file)
        return f"named by {key} of {file}" if file else f"named by {key}"


def scene_names() -> list[str]:
    """Return the names of the scenes that ship."""
    return sorted(path.stem for path in (configs() / "scene").glob("*.yaml"))


def read_description(
    source: Source,
    bsdfs: Mapping[str, Bsdf] | None = None,
    change: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
    overrides: Mapping[str, Any] | None = None,
    places: Sequence[Path] = (),
) -> Description:
    """Read and validate a scene.

    Args:
        source: the name of a scene in ``configs/scene/``, a path ending in ``.yaml``, or ``.xml`` for scenes of Mitsuba, an
            open file, YAML text of more than one line, or a mapping of the same schema. Relative paths start at the file's
            folder; where there is no file, at the current one.
        bsdfs: material types of the caller's own: type name to model instance.
        change: called with the raw scene after ``defaults`` and overrides are merged; returns the one to validate.
        overrides: values by dotted key, see :func:`torchpt.scene.formats.overrides.overridden_by`; for scenes of Mitsuba also
            ``import.strict``, ``import.missing`` and ``scene_params``.
        places: folders where scenes are looked up by name, also those in ``defaults``, before those that ship.

    Raises:
        SceneError: the first wrong key or value, with file, dotted key, value and what is accepted.
        NotBuiltError: a key or type that the format knows and this version does not support.

    Warns:
        EnergyWarning: a material may reflect more light than it receives.
        ImportedSceneWarning: a scene of Mitsuba has what this program lacks.
    """
    types = material_types(bsdfs)

    def describe(raw: Any, file: str | None, base: Path, origins: Mapping[str, str] | None = None) -> Description:
        """Merge the layers of a scene and validate the result.

        Args:
            raw: the scene.
            file: its file.
            base: the folder that relative paths start from.
            origins: see :attr:`Layers.places`.
        """
        merged, layers = compose(plain(raw, file), file, base, places)
        layers = replace(layers, places=origins or {})
        if overrides:
            merged, layers = overridden_by(merged, overrides, layers, file, base)
        merged = change(merged) if change is not None else merged
        try:
            found = _describe(merged, types, file, base, layers)
        except SceneError as error:
            raise layers.blame(error) from None
        return replace(found, overrides=override_words(overrides)) if overrides else found

    if isinstance(source, Mapping):
        return describe(source, file=None, base=Path.cwd())
    if not isinstance(source, str | os.PathLike) and hasattr(source, "read"):
        name = getattr(source, "name", None)
        file = name if isinstance(name, str) and is_regular(name) else None
        base = Path.cwd() if file is None else Path(file).resolve().parent
        return describe(read_open(source, file), file=file, base=base)
    if not isinstance(source, str | os.PathLike):
        raise SceneError("scene", source, SOURCES)
    file = os.fspath(source)
    if isinstance(source, str) and "\n" in source:
        return describe(parse_yaml(source), file=None, base=Path.cwd())
    if file.endswith(".xml"):
        from torchpt.scene.formats.mitsuba import import_mitsuba, split_import_keys  # few scenes need it

        path, given = Path(file), overrides
        _check_exists(path, file, places)
        options, overrides = split_import_keys(overrides)
        raw, origins = import_mitsuba(path, file, options)
        found = describe(raw, file, path.resolve().parent, origins)
        return replace(found, overrides=override_words(given or {}), allows_empty_meshes=not options.strict)
    if file.endswith((".yaml", ".yml")):
        path = Path(file)
        _check_exists(path, file, places)
    else:
        path = _named_scene(file, places)
        file = str(path)
    return describe(read_yaml(path, file), file=file, base=path.resolve().parent)


def _named_scene(name: str, places: Sequence[Path]) -> Path:
    """Return the file of a scene in one of the places, or of one that ships.

    Raises:
        SceneError: no scene has this name.
    """
    files = _files_by_name(places)
    if name not in files:
        local = f"{name}.yaml"
        hint = f" (did you mean {local}?)" if is_regular(local) else did_you_mean(name, files)
        raise SceneError("scene", name, f"one of {', '.join(sorted(files))}{hint}, or a path ending in .yaml or .xml")
    return files[name]


def _files_by_name(places: Sequence[Path]) -> dict[str, Path]:
    """Return scene files by name: those in the folders ``places``, of which earlier ones win, then those that ship."""
    return {
        path.stem: path for place in (configs() / "scene", *reversed(places)) for path in sorted(place.glob("*.yaml"))
    }


def _check_exists(path: Path, file: str, places: Sequence[Path]) -> None:
    """Check that a scene file exists.

    Args:
        path: the file.
        file: the same as the caller wrote it, for the error.
        places: folders where scenes are looked up by name.

    Raises:
        SceneError: it is missing; suggests the closest name among the files beside it and the scenes found by name.
    """
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        reason = error.strerror
    except (OSError, ValueError):  # reported when the file is read
        return
    else:
        return
    beside: set[str] = set()
    if path.parent.is_dir():
        beside = {other.name for ending in ("*.yaml", "*.yml", "*.xml") for other in path.parent.glob(ending)}
    hint = did_you_mean(
        path.name,
        [*sorted(beside), *_files_by_name(places)],
        lambda name: str(path.with_name(name)) if name in beside else name,
    )
    raise SceneError("scene", file, f"a scene file that can be read ({reason}){hint}")


def settings(description: Description, overrides: Mapping[str, Any] | None = None) -> Settings:
    """Return the complete settings: built-in default < scene file < override.

    Args:
        description: has the scene's blocks film, integrator, sampler and render.
        overrides: keys by block, e.g. ``{"render": {"spp": 16}}``; None means unset.

    Raises:
        SceneError: key such as ``render.spp``.
    """
    blocks = {name: getattr(description, name) for name in BLOCKS}
    try:
        return run_settings.merge(blocks, overrides or {}, description.file)
    except SceneError as error:
        raise description.blame(error) from None


def overridden(description: Description, overrides: Mapping[str, Mapping[str, Any]]) -> tuple[Description, Settings]:
    """Return the complete settings where a null among the overrides removes the scene's own key.

    Args:
        description: the scene's.
        overrides: keys by block, as `settings` takes them.

    Returns:
        The description without the removed keys, and the settings.

    Raises:
        SceneError: key such as ``render.spp``.
    """
    for block, changes in overrides.items():
        description = replace(description, **{block: _without_removed(getattr(description, block), changes)})
    return description, settings(description, overrides)


def _without_removed(block: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return a block without the keys that are null among the changes, also in blocks within."""
    kept: dict[str, Any] = {}
    for key, value in block.items():
        change = changes.get(key)
        if isinstance(value, Mapping) and isinstance(change, Mapping):
            kept[key] = _without_removed(value, change)
        elif key not in changes or change is not None:
            kept[key] = value
    return kept


def _describe(
    raw: dict[str, Any], types: Mapping[str, Kind], file: str | None, base: Path, layers: Layers
) -> Description:
    """Validate a merged scene.

    Args:
        raw: the scene as plain values.
        types: the table of material types.
        file: the scene file, or None.
        base: the folder that relative paths start from.
        layers: the files of the scene's keys.

    Raises:
        SceneError: the first wrong key or value.
    """
    check_keys(raw, KEYS, key="", what="a scene", file=file)
    version = raw.get("version")
    if version is not None and (isinstance(version, bool) or version != 1):
        raise SceneError("version", version, "1", file)
    if raw.get("camera") is None:
        raise SceneError("camera", None, "a camera (every scene needs one)", file)
    blocks = {name: _settings_block(raw, name, file) for name in BLOCKS}
    camera = read_camera(raw["camera"], film=blocks["film"], file=file)
    run_settings.merge(blocks, {}, file)  # only checks them; each render merges them with its own overrides
    textures = _named_items(
        raw, "textures", file, lambda item, key: read_typed("texture", TEXTURES, item, key=key, file=file)
    )
    materials = _named_items(
        raw, "materials", file, lambda item, key: read_material(item, key=key, types=types, file=file)
    )
    for name, material in materials.items():
        key = f"materials.{name}"
        check_material(material, key=key, materials=materials, textures=textures, file=layers.file_of(key, file))
    shapes = _named_items(
        raw,
        "shapes",
        file,
        lambda item, key: _shape(item, key=key, materials=materials, textures=textures, types=types, file=file),
    )
    lights = _named_items(raw, "lights", file, lambda item, key: read_typed("light", LIGHTS, item, key=key, file=file))
    film, integrator, sampler, render = (blocks[name] for name in BLOCKS)
    return Description(
        file=file,
        base=base,
        camera=camera,
        version=version,
        film=film,
        integrator=integrator,
        sampler=sampler,
        render=render,
        textures=textures,
        materials=materials,
        shapes=shapes,
        lights=lights,
        layers=layers,
    )


def _settings_block(raw: Mapping[str, Any], name: str, file: str | None) -> dict[str, Any]:
    """Return the keys of a block of settings that are not null; refuse those that write files."""
    block = raw.get(name)
    if block is None:
        return {}
    if not isinstance(block, dict):
        raise SceneError(name, block, "a mapping of settings", file)
    for key in settings_with(Role.FILES).get(name, ()):
        if block.get(key) not in (None, False):
            expected = "null: which files are written is said on the command line or in Python, never by a scene"
            raise SceneError(f"{name}.{key}", block[key], expected, file)
    return {key: value for key, value in block.items() if value is not None}


def _named_items(raw: Mapping[str, Any], block: str, file: str | None, read: Callable[[Any, str], T]) -> dict[str, T]:
    """Return the items of a block by name, each read by ``read(item, dotted key)``."""
    items = raw.get(block)
    if items is None:
        return {}
    if not isinstance(items, dict):
        raise SceneError(block, items, f"a mapping from names to {block}", file)
    if len(items) > MAX_ENTRIES:
        raise SceneError(block, len(items), f"at most {MAX_ENTRIES} of them (what is larger is a mesh)", file)
    return {name: read(item, f"{block}.{name}") for name, item in items.items()}


def _shape(
    item: Any,
    key: str,
    materials: Mapping[str, ParsedParams],
    textures: Mapping[str, ParsedParams],
    types: Mapping[str, Kind],
    file: str | None,
) -> ParsedParams:
    """Read a shape, with its material where that is written in place, and check its references.

    Args:
        item: the shape as written.
        key: its dotted key.
        materials: all materials by name.
        textures: all textures by name.
        types: the table of material types.
        file: scene file, for errors.

    Raises:
        SceneError: a wrong key or value, an unknown material or texture, emission of both shape and material.
    """
    if isinstance(item, dict) and isinstance(item.get("material"), dict):
        inline = read_material(item["material"], key=f"{key}.material", types=types, file=file)
        check_material(inline, key=f"{key}.material", materials=materials, textures=textures, file=file)
        item = {**item, "material": inline}
    shape = read_typed("shape", SHAPES, item, key=key, file=file, texture=texture_of)
    displacement = shape.values.get("displacement")
    if displacement is not None:
        where = f"{key}.displacement.texture"
        check_texture(displacement["texture"], key=where, textures=textures, file=file, coordinates=True, points=True)
    material, emission, where = shape["material"], shape["emission"], f"{key}.material"
    if isinstance(material, str):
        if material not in materials:
            known = ", ".join(materials) or "none is defined"
            hint = did_you_mean(material, materials)
            raise SceneError(where, material, f"the name of a material ({known}){hint} or a material", file)
        material, where = materials[material], f"materials.{material}"
    if emission is not None and material is not None and material["emission"] is not None:
        expected = f"no emission where the material emits as well ({where}.emission)"
        raise SceneError(f"{key}.emission", emission, expected, file)
    return shape
