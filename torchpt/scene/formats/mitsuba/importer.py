"""Put a scene of Mitsuba together: references, files, materials, shapes, lights and settings, as a YAML scene has them."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchpt.core.errors import AssetError, SceneError, did_you_mean
from torchpt.core.files import is_regular
from torchpt.images.texels import read_texels
from torchpt.math.transforms import is_usable
from torchpt.scene.formats.mitsuba.bsdfs import BSDFS, UNKNOWN, opacity_of
from torchpt.scene.formats.mitsuba.elements import Element, parse_scene, walk
from torchpt.scene.formats.mitsuba.emitters import EMITTERS, join_skies
from torchpt.scene.formats.mitsuba.notes import Notes
from torchpt.scene.formats.mitsuba.plugins import Plugin, Twin, left_out, nearest
from torchpt.scene.formats.mitsuba.properties import OBJECTS, VALUES, Properties, note_unknown_parts
from torchpt.scene.formats.mitsuba.sensors import (
    FILMS,
    FILTERS,
    INTEGRATORS,
    SAMPLERS,
    SENSORS,
    UNKNOWN_FILM,
    UNKNOWN_INTEGRATOR,
    UNKNOWN_SAMPLER,
)
from torchpt.scene.formats.mitsuba.shapes import SHAPES, bounds, posed, with_attribute
from torchpt.scene.formats.mitsuba.textures import TEXTURES, attributes_of, scaled
from torchpt.scene.formats.mitsuba.versions import plugin_name, property_name

__all__ = ["PLUGINS", "ImportOptions", "Importer", "import_mitsuba", "read_mitsuba", "split_import_keys"]

#: The tables of plugins by tag.
PLUGINS: dict[str, Mapping[str, Plugin]] = {
    "bsdf": BSDFS,
    "texture": TEXTURES,
    "shape": SHAPES,
    "emitter": EMITTERS,
    "sensor": SENSORS,
    "film": FILMS,
    "rfilter": FILTERS,
    "sampler": SAMPLERS,
    "integrator": INTEGRATORS,
}

#: Greatest depth of objects inside objects, references followed.
MAX_NESTING = 32
_UNKNOWN_TEXTURE = nearest("a colour", lambda p, importer: [0.5, 0.5, 0.5], "it is unknown; grey takes its place")
_UNKNOWN_SENSOR = nearest("perspective", SENSORS["perspective"].build, "it is unknown")
_UNKNOWN = left_out("it is unknown")


@dataclass(frozen=True)
class ImportOptions:
    """Values of the keys ``import`` and ``scene_params``.

    Attributes:
        strict: an error in place of every warning.
        missing: a missing file is a warning; else an error.
        parameters: values of the scene's parameters as text, by name.
    """

    strict: bool = False
    missing: bool = False
    parameters: Mapping[str, str] = field(default_factory=dict)


def split_import_keys(overrides: Mapping[str, Any] | None) -> tuple[ImportOptions, dict[str, Any]]:
    """Take ``import`` and ``scene_params`` out of the overrides of a scene.

    Args:
        overrides: values by dotted key, such as ``import.strict`` or ``scene_params.spp``, or by block.

    Returns:
        The options, and the other overrides.

    Raises:
        SceneError: an unknown key, or a wrong value.
    """
    rest: dict[str, Any] = {}
    keys: dict[str, Any] = {}
    parameters: dict[str, str] = {}
    for name, value in (overrides or {}).items():
        block, _, key = str(name).lstrip("+").partition(".")
        if block not in ("import", "scene_params"):
            rest[name] = value
            continue
        if not key and not isinstance(value, Mapping):
            raise SceneError(block, value, "a mapping, such as {strict: true} or {spp: 16}")
        for inner, item in {key: value}.items() if key else value.items():
            if block == "scene_params":
                parameters[str(inner)] = _as_text(f"scene_params.{inner}", item)
            else:
                keys[str(inner)] = item
    for key, accepted in (("strict", (True, False)), ("missing", ("error", "warn"))):
        if key in keys and not any(keys[key] is value or keys[key] == value != 1 for value in accepted):
            words = "true or false" if key == "strict" else "error or warn"
            raise SceneError(f"import.{key}", keys[key], words)
    for key in keys:
        if key not in ("strict", "missing"):
            raise SceneError(f"import.{key}", keys[key], "one of the keys import.strict, import.missing")
    return ImportOptions(bool(keys.get("strict", False)), keys.get("missing") == "warn", parameters), rest


def _as_text(key: str, value: Any) -> str:
    """Return the value of a parameter as it stands in XML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return value
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple) and all(isinstance(item, int | float) for item in value):
        return " ".join(map(repr, value))
    raise SceneError(key, value, "a number, a word, true or false")


def read_mitsuba(path: Path, file: str, options: ImportOptions) -> dict[str, Any]:
    """Read a scene of Mitsuba; see :func:`import_mitsuba`."""
    return import_mitsuba(path, file, options)[0]


def import_mitsuba(path: Path, file: str, options: ImportOptions) -> tuple[dict[str, Any], dict[str, str]]:
    """Read a scene of Mitsuba.

    Args:
        path: the file.
        file: the same as errors show it.
        options: see :class:`ImportOptions`.

    Returns:
        The scene in the form of a YAML file; relative paths start at the file's folder. Shapes may have ``mesh`` in place of
        ``path``: parts that are not as the file has them. And where its keys come from, by dotted key: file, line and element.

    Raises:
        SceneError: a scene that cannot be read, with its line; a missing file; any warning where the import is strict.

    Warns:
        ImportedSceneWarning: what has no exact twin, one warning for each kind.
    """
    root, left_out = parse_scene(path, file, options.parameters, missing=options.missing)
    importer = Importer(root, path.resolve().parent, options, left_out)
    scene = importer.scene()
    importer.notes.warn()
    return scene, importer.places


class Importer:
    """Importer of one scene.

    Attributes:
        notes: the warnings so far.
        materials: named materials that something uses, by name.
        textures: named textures that something uses, by name.
        shapes: shapes by name.
        lights: lights by name.
        places: file, line and element that keys of the scene come from, by dotted key.
    """

    def __init__(self, root: Element, base: Path, options: ImportOptions, left_out: Sequence[Element]) -> None:
        self.root, self.base, self.options = root, base, options
        self.notes = Notes(strict=options.strict)
        self.materials: dict[str, Any] = {}
        self.textures: dict[str, Any] = {}
        self.shapes: dict[str, Any] = {}
        self.lights: dict[str, Any] = {}
        self.places: dict[str, str] = {}
        self._meshes_of_groups: dict[int, dict[int, str]] = {}  # by id of a group: shape drawn, by id of its element
        self._depth = 0
        self._folders = [base]
        self._ids: dict[str, Element] = {}
        self._keys: dict[str, str] = {}  # key of a material or a texture, by its id
        self._find_ids()
        note_unknown_parts(root, self.notes)
        if left_out:
            self._leave_out(left_out)

    def _leave_out(self, includes: Sequence[Element]) -> None:
        """Warn of files that are not included, and take away each ``<ref>`` to what may be in them."""
        for element in includes:
            self.notes.add(element, f"the file {element.attributes['filename']} is not there, and left out")
        for element in walk(self.root):
            for child in element.children:
                if child.tag == "ref" and child.attributes.get("id", "") not in self._ids:
                    self.notes.add(child, f"{child.attributes.get('id', '')} is not there, and left out")
            element.children = [
                child for child in element.children if child.tag != "ref" or child.attributes.get("id", "") in self._ids
            ]

    def _find_ids(self) -> None:
        """Collect ids, ``<alias>`` and ``<path>``."""
        aliases: list[Element] = []
        for element in walk(self.root):
            if element.tag == "alias":
                aliases.append(element)
            elif element.tag == "path":
                value = element.attributes.get("value", "")
                self._folders.append(element.folder / value.replace("\\", "/"))
            elif element.tag in OBJECTS and element.id:
                if element.id in self._ids:
                    first = self._ids[element.id]
                    raise element.error(element.id, f"an id of its own ({first.file}:{first.line} has it too)")
                self._ids[element.id] = element
        for alias in aliases:
            source, name = alias.attributes.get("id", ""), alias.attributes.get("as", "")
            if not name or name in self._ids:
                raise alias.error(name, "a new name as the attribute `as`")
            self._ids[name] = self._with_id(source, alias)

    def _with_id(self, name: str, element: Element) -> Element:
        if name not in self._ids:
            raise element.error(name, f"the id of an element{did_you_mean(name, self._ids)}")
        return self._ids[name]

    def target(self, reference: Element) -> Element:
        """Return the element that a ``<ref>`` names.

        Raises:
            SceneError: nothing has this id.
        """
        return self._with_id(reference.attributes.get("id", ""), reference)

    def locate(self, key: str, element: Element) -> None:
        """Keep where a key of the scene comes from, and those below it that the element's properties give."""
        self.places[key] = element.place
        for child in element.children:
            name = property_name(element.tag, plugin_name(element.tag, element.type), child.attributes.get("name", ""))
            if name and child.tag in VALUES:
                self.places[f"{key}.{name}"] = f"{child.file}: line {child.line}, {element.label} {name}"

    # ---- Files

    def find(self, element: Element, name: str) -> Path | None:
        """Return the file that an element names, or None where it is missing and that is a warning.

        Raises:
            SceneError: no such file.
        """
        if name and name.isprintable():
            for folder in (element.folder, *self._folders):
                for candidate in dict.fromkeys((name, name.replace("\\", "/"))):
                    try:
                        if is_regular(folder / candidate):
                            return folder / candidate
                    except (OSError, ValueError):
                        continue
        if self.options.missing:
            self.notes.add(element, f"the file {name} is not there: grey takes its place, or nothing that of a mesh")
            return None
        raise element.error(name, "a file that is there (import.missing=warn goes on without it)")

    def path(self, path: Path) -> str:
        """Return a file as a scene file names it: relative to the scene's folder if below it."""
        try:
            text = os.path.relpath(path, self.base) if path.resolve().is_relative_to(self.base) else str(path.resolve())
        except (OSError, ValueError):
            text = str(path)
        return f"./{text}" if text.startswith("$") else text

    # ---- Plugins

    def build(self, table: Mapping[str, Plugin], element: Element, unknown: Plugin) -> Any:
        """Return what becomes of an element by the table of its plugins; warn where that is not exact.

        Raises:
            SceneError: a wrong value.
        """
        if not element.type:
            raise element.error(f"<{element.written}>", "an attribute type")
        name = plugin_name(element.tag, element.type)
        plugin = table.get(name, unknown)
        if plugin.twin is Twin.LEFT_OUT:
            self.notes.add(element, f"{element.label} is left out: {plugin.note}")
            return None
        if plugin.twin is Twin.NEAREST:
            self.notes.add(element, f"{element.label} becomes {plugin.becomes}: {plugin.note}")
        if self._depth >= MAX_NESTING:
            raise element.error(
                element.label, f"objects at most {MAX_NESTING} deep inside each other, references followed"
            )
        self._depth += 1
        properties = Properties(element, name, self)
        result = plugin.build(properties, self)
        if plugin is not unknown:
            properties.left_over()
        self._depth -= 1
        return result

    def material(self, element: Element) -> dict[str, Any]:
        """Return the material of a ``<bsdf>``."""
        if element.tag != "bsdf":
            raise element.error(f"<{element.written}>", "a bsdf")
        if self._keys.get(element.id) in self.materials:
            return self.materials[self._keys[element.id]]
        return self.build(BSDFS, element, UNKNOWN)

    def texture(self, element: Element) -> Any:
        """Return a texture for a parameter: a reference to a named one, one in place, or a colour."""
        if self._keys.get(element.id) in self.textures:
            return {"texture": self._keys[element.id]}
        value = self.build(TEXTURES, element, _UNKNOWN_TEXTURE)
        if not element.id or not isinstance(value, dict) or "texture" in value:
            return value
        name = self._key(self.textures, element)
        self.textures[name] = value
        self.locate(f"textures.{name}", element)
        return {"texture": name}

    def exceeds_one(self, texture: Mapping[str, Any]) -> bool:
        """Return True for a texture with values outside of 0..1: images of floats are read to see."""
        if texture["type"] != "image":
            return max((*texture.get("color0", ()), *texture.get("color1", ()), 0.0)) > 1.0
        scale = max(map(abs, texture.get("scale", (1.0,))))
        path = self.base / texture["path"]
        if scale <= 1.0 and path.suffix.lower() in _WHOLE:
            return False
        try:
            picture = read_texels(path)
        except AssetError:
            return False  # refused when the scene is built, with more words
        values = picture.decoded if picture.is_encoded(texture["colorspace"]) else picture.values
        return bool(values.min() < 0.0 or values.max() * scale > 1.0 + 1e-6)

    def _key(self, taken: Mapping[str, Any], element: Element) -> str:
        """Return the key of a material or a texture that has an id; ids that make the same key get one each."""
        if element.id not in self._keys:
            self._keys[element.id] = self._free(taken, element)
        return self._keys[element.id]

    # ---- The scene

    def scene(self) -> dict[str, Any]:
        """Return the scene in the form of a YAML file."""
        found: dict[str, list[Element]] = {tag: [] for tag in OBJECTS}
        for child in self.root.children:
            target = self.target(child) if child.tag == "ref" else child
            if target.tag in found:
                found[target.tag].append(target)
            elif target.tag in VALUES:
                self.notes.add(child, f"the property {child.attributes.get('name', '')} of the scene is left out")
            elif target.tag not in ("alias", "path"):
                known = ", ".join((*OBJECTS, "default", "include", "alias", "ref", "path"))
                raise child.error(f"<{child.written}>", f"one of the elements {known}")
        settings = self._settings(found["sensor"], found["integrator"])
        for element in found["shape"]:
            self._shape(element)
        if not found["sensor"]:
            settings["camera"] = self._camera_of_all()
        for element in found["emitter"]:
            self._emitter(element)
        for tag in ("medium", "phase", "volume", "subsurface"):
            for element in found[tag]:
                self.notes.add(element, f"{element.label} is left out: there are no media")
        blocks = {name: getattr(self, name) for name in ("textures", "materials", "shapes", "lights")}
        return {"version": 1, **settings, **{name: block for name, block in blocks.items() if block}}

    def _settings(self, sensors: list[Element], integrators: list[Element]) -> dict[str, Any]:
        """Return camera, film, sampler, integrator and ``render.spp``."""
        if len(sensors) > 1:
            self.notes.add(sensors[1], "all sensors but the first are left out")
        sensor = sensors[0] if sensors else replace(self.root, tag="sensor", attributes={}, children=[])
        inner: dict[str, Element] = {}
        rest: list[Element] = []
        for child in sensor.children:
            target = self.target(child) if child.tag == "ref" else child
            if target.tag in ("film", "sampler"):
                if target.tag in inner:
                    self.notes.add(target, f"{sensor.label}: only the last {target.tag} of several is taken")
                inner[target.tag] = target
            else:
                rest.append(child)
        bare = replace(sensor, children=rest)
        camera = self.build(SENSORS, bare, _UNKNOWN_SENSOR) if sensors else {}
        film = {"width": 768, "height": 576, "filter": {"type": "gaussian"}}
        self.locate("camera", sensor)
        for key, tag in (("film", "film"), ("sampler", "sampler"), ("render.spp", "sampler")):
            if tag in inner:
                self.locate(key, inner[tag])
        for child in inner["film"].children if "film" in inner else ():
            if child.tag == "rfilter":
                self.locate("film.filter", child)
        if "film" in inner:
            film = self.build(FILMS, inner["film"], UNKNOWN_FILM)
        sampler, count = "independent", 4
        if "sampler" in inner:
            sampler, count = self.build(SAMPLERS, inner["sampler"], UNKNOWN_SAMPLER)
        integrator: dict[str, Any] = {"type": "path", "max_depth": -1}
        if self.root.version < (2,):  # without one, Mitsuba took direct light
            integrator = {"type": "direct"}
        if len(integrators) > 1:
            self.notes.add(integrators[-1], "all integrators but the last are left out")
        if integrators:
            integrator = self.build(INTEGRATORS, integrators[-1], UNKNOWN_INTEGRATOR)
            self.locate("integrator", integrators[-1])
        layers = integrator.pop("aovs", [])
        if integrator["type"] != "aov":
            integrator = integrator | {"dark_rims": True}
        if layers:
            film = film | {"aovs": layers}
        return {
            "camera": camera,
            "film": film,
            "integrator": integrator,
            "sampler": {"type": sampler},
            "render": {"spp": count},
        }

    def _camera_of_all(self) -> dict[str, Any]:
        """Return the camera of a scene without one: along z, with all shapes before it, as Mitsuba before version 2 had."""
        try:
            box = bounds(self.shapes, self.base)
        except AssetError as error:
            raise self.root.error("no sensor", f"a sensor (a camera), or readable meshes: {error.problem}") from None
        if box is None:
            raise self.root.error("no sensor", "a sensor (a camera)")
        self.notes.add(self.root, "there is no sensor: a camera along z sees all shapes")
        middle, sizes = box.mean(0), box[1] - box[0]
        distance = (float(max(sizes[:2])) or float(sizes[2]) or 1.0) / (2.0 * math.tan(math.radians(22.5)))
        origin = [float(middle[0]), float(middle[1]), float(box[0, 2]) - distance]
        pose = np.eye(4)
        pose[:3, 3] = origin
        return {"type": "perspective", "to_world": pose.tolist(), "fov": 45.0}

    def _shape(self, element: Element) -> None:
        """Add a shape of the scene."""
        name = plugin_name(element.tag, element.type)
        if name == "shapegroup":
            return  # its instances are drawn
        if name == "instance":
            self._instance(element)
            return
        if name == "merge":
            self._merge(element)
            return
        shape = self._plain_shape(element)
        if shape is not None:
            self._add_shape(element, shape)

    def _add_shape(self, element: Element, shape: dict[str, Any]) -> str:
        """Add a shape to the scene; return its name."""
        name = self._free(self.shapes, element)
        self.shapes[name] = shape
        self.locate(f"shapes.{name}", element)
        for child in element.children:
            if child.tag == "bsdf":
                self.locate(f"shapes.{name}.material", child)
        return name

    def _merge(self, element: Element) -> None:
        """Add the shapes of a ``merge``, which keep their own materials."""
        properties = Properties(element, "merge", self)
        for child in properties.objects("shape"):
            if plugin_name(child.tag, child.type) in ("merge", "shapegroup"):  # a merge could hold itself
                self.notes.add(child, f"{child.label} inside a merge is left out")
            else:
                self._shape(child)
        properties.left_over()

    def _plain_shape(self, element: Element) -> dict[str, Any] | None:
        """Return a shape with its material and emission; None where it is left out."""
        inner, rest, has_medium = self._taken_apart(element)
        bare = replace(element, children=rest)
        shape = self.build(SHAPES, bare, _UNKNOWN)
        if shape is None:
            return None
        names = attributes_of(inner.values(), self)
        if names:
            shape = with_attribute(shape, names, element, self)
        emitter = inner.get("emitter")
        border = has_medium and emitter is None and element.version < (2,)
        material, name = self._material_of(inner.get("bsdf"), lit=emitter is not None, border=border)
        if emitter is not None:
            radiance = self._radiance(emitter, opacity_of(material))
            if isinstance(radiance, dict):
                material, name = {**material, "emission": radiance}, None
            elif radiance is not None:
                shape["emission"] = radiance
        return shape | {"material": material if name is None else name}

    def _taken_apart(self, element: Element) -> tuple[dict[str, Element], list[Element], bool]:
        """Return BSDF and emitter of a shape, its other children, and whether it has a medium."""
        inner: dict[str, Element] = {}
        rest: list[Element] = []
        has_medium = False
        for child in element.children:
            target = self.target(child) if child.tag == "ref" else child
            if target.tag in ("bsdf", "emitter"):
                if target.tag in inner:
                    self.notes.add(element, f"{element.label}: only the last {target.tag} of several is taken")
                inner[target.tag] = target
            elif target.tag in ("medium", "subsurface"):
                has_medium |= target.tag == "medium"
                self.notes.add(target, f"{target.label} is left out: there are no media")
            else:
                rest.append(child)
        return inner, rest, has_medium

    def _material_of(self, element: Element | None, *, lit: bool, border: bool) -> tuple[dict[str, Any], str | None]:
        """Return the material of a shape, and its name where it has one.

        Args:
            element: the BSDF; None: that of Mitsuba.
            lit: True for a shape that emits, which is black without a BSDF.
            border: True for a shape that only bounds a medium where it has no BSDF.
        """
        if element is None:
            if border:
                return {"type": "null"}, None
            return {"type": "diffuse", "two_sided": False} | ({"reflectance": [0.0] * 3} if lit else {}), None
        material = self.material(element)
        if not element.id:
            return material, None
        name = self._key(self.materials, element)
        self.materials[name] = material
        self.locate(f"materials.{name}", element)
        return material, name

    def _radiance(self, element: Element, opacity: float | None) -> Any:
        """Return the radiance of an area emitter: a colour or a texture; None where the emitter is left out.

        Args:
            element: the emitter.
            opacity: that of its shape, which Mitsuba's emission does not depend on and ours is multiplied by; None: a texture.
        """
        name = plugin_name(element.tag, element.type)
        if name != "area":
            self.notes.add(element, f"{element.label} on a shape is left out: only area emitters are on shapes")
            return None
        properties = Properties(element, name, self)
        properties.ignore("sampling_weight")
        found = properties.slot("radiance", [1.0] * 3, light=True)
        properties.left_over()
        if opacity is None:
            properties.note("emission is multiplied by the opacity of the shape, a texture, where Mitsuba's is not")
        elif not opacity > 0.0:
            properties.note("it is left out: its shape is not there (null, or an opacity of 0), where Mitsuba's shines")
        elif opacity != 1.0:
            found = scaled(found, [1.0 / opacity] * 3, properties)
        return found

    def _instance(self, element: Element) -> None:
        """Draw the shapes of a group: the first time as they are, then as instances where they are meshes."""
        groups: list[Element] = []
        rest: list[Element] = []
        for child in element.children:
            target = self.target(child) if child.tag == "ref" else child
            (groups if target.tag == "shape" else rest).append(target if target.tag == "shape" else child)
        if len(groups) != 1 or plugin_name("shape", groups[0].type) != "shapegroup":
            raise element.error(element.label, "one reference to a shapegroup inside it")
        properties = Properties(replace(element, children=rest), "instance", self)
        pose = properties.transform()
        properties.left_over()
        if not is_usable(pose):
            properties.note("it is left out: its to_world cannot be inverted")
            return
        drawn = self._meshes_of_groups.setdefault(id(groups[0]), {})
        for child in groups[0].children:
            target = self.target(child) if child.tag == "ref" else child
            if target.tag != "shape" or plugin_name("shape", target.type) in ("shapegroup", "instance"):
                self.notes.add(target, f"{target.label} inside a shapegroup is left out")
                continue
            before = self.shapes.get(drawn.get(id(target), ""))
            shape = self._plain_shape(target) if before is None or before["type"] != "mesh" else None
            if shape is not None:
                drawn[id(target)] = self._add_shape(target, posed(shape, pose))
            elif before is not None:
                total = pose @ self._own_pose(target)
                if not is_usable(total):
                    self.notes.add(target, f"{target.label}: a flattened copy is left out")
                    continue
                sides = {"flip_normals": True} if before.get("flip_normals") else {}  # a copy has its own
                copy = posed({"type": "instance", "of": drawn[id(target)], **sides}, total)
                self._add_shape(target, copy)

    def _own_pose(self, element: Element) -> Any:
        """Return the transform of a shape of a group."""
        _, rest, _ = self._taken_apart(element)
        plugin = plugin_name(element.tag, element.type)
        return Properties(replace(element, children=rest), plugin, self).transform()

    def _emitter(self, element: Element) -> None:
        """Add a light that is on no shape."""
        if plugin_name(element.tag, element.type) == "area":
            if self._is_on_a_shape(element):
                return
            self.notes.add(element, f"{element.label} is left out: it is on no shape")
            return
        for light in self.build(EMITTERS, element, _UNKNOWN) or ():
            before = next((other for other in self.lights.values() if other["type"] in _ENVIRONMENTS), None)
            if light["type"] in _ENVIRONMENTS and before is not None:
                if before["type"] == light["type"] == "sky" and join_skies(before, light):
                    continue
                self.notes.add(element, f"{element.label} is left out: there is an environment before it")
                continue
            name = self._free(self.lights, element, light["type"])
            self.lights[name] = light
            self.locate(f"lights.{name}", element)

    def _is_on_a_shape(self, emitter: Element) -> bool:
        """Return True for an emitter to which a ``<ref>`` in a shape leads."""
        references = (child for shape in walk(self.root) if shape.tag == "shape" for child in shape.children)
        return any(child.tag == "ref" and self.target(child) is emitter for child in references)

    def _free(self, taken: Mapping[str, Any], element: Element, kind: str = "") -> str:
        """Return a name that is not taken: the id of an element, else its type and a number."""
        stem = _as_key(element.id) if element.id else kind or element.type
        if element.id and stem not in taken:
            return stem
        number = len(taken) + 1
        while f"{stem}_{number}" in taken:
            number += 1
        return f"{stem}_{number}"


_WHOLE = (".png", ".jpg", ".jpeg", ".bmp", ".tga", ".ppm", ".pgm")  # images of whole numbers, which are at most 1
_ENVIRONMENTS = ("envmap", "constant", "sky")


def _as_key(name: str) -> str:
    """Return an id as a key of a scene file."""
    found = "".join(letter if letter.isprintable() else "_" for letter in name).strip()[:200]
    return found or "_"
