"""Read the properties of one plugin by their present names, and warn of those that nobody asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import did_you_mean
from torchpt.scene.formats.mitsuba import values
from torchpt.scene.formats.mitsuba.elements import Element, walk
from torchpt.scene.formats.mitsuba.notes import Notes
from torchpt.scene.formats.mitsuba.versions import property_name

if TYPE_CHECKING:
    from torchpt.scene.formats.mitsuba.importer import Importer

__all__ = ["OBJECTS", "VALUES", "Properties", "note_unknown_parts"]

#: Tags of objects, which have a plugin; all other tags are values.
OBJECTS = (
    "bsdf", "texture", "shape", "emitter", "sensor", "film", "sampler", "rfilter", "integrator", "medium", "phase", "volume",
    "subsurface",
)  # fmt: skip
_COLOURS = ("rgb", "srgb", "spectrum", "blackbody", "color", "float", "integer")
VALUES = (*_COLOURS, "boolean", "string", "point", "vector", "transform", "animation")

_POINT = ("x", "y", "z", "value")
_SPECTRUM = (
    "type",
    "value",
    "values",
    "wavelengths",
    "wavelength_min",
    "wavelength_max",
    "filename",
    "color",
    "scale",
    "intent",
)
#: Attributes by tag, without ``name``, which every value may have.
_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(OBJECTS, ("type", "id")),
    **dict.fromkeys((*_COLOURS, "boolean", "string"), ("value", "intent")),
    **dict.fromkeys(("point", "vector"), _POINT),
    "spectrum": (*_SPECTRUM, "temperature", "multiplier"),
    "blackbody": ("temperature", "scale", "multiplier"),
    "transform": ("time",),
    "animation": (),
    "ref": ("id",),
}
_OPERATIONS: dict[str, tuple[str, ...]] = {
    "translate": _POINT,
    "scale": _POINT,
    "rotate": (*_POINT, "angle"),
    "matrix": ("value",),
    "lookat": ("origin", "target", "up", *(letter + axis for letter in "otu" for axis in "xyz")),
}
#: Values with elements inside.
_CONTAINERS = ("transform", "animation", "spectrum", "blackbody")


def note_unknown_parts(root: Element, notes: Notes) -> None:
    """Warn of attributes that nobody reads and of elements inside plain values, which have none."""
    for element in walk(root):
        if element.tag in _OPERATIONS:
            known = _OPERATIONS[element.tag]
        elif element.tag in _ATTRIBUTES:
            known = (*_ATTRIBUTES[element.tag], "name")
        else:
            continue
        name = element.attributes.get("name", "") if element.tag in VALUES else ""
        place = f"{element.label} {name}".rstrip()
        for key in element.attributes:
            if key not in known:
                notes.add(
                    element, f"{place}: the attribute {key} is unknown here and left out{did_you_mean(key, known)}"
                )
        if element.tag not in OBJECTS and element.tag not in _CONTAINERS:
            for child in element.children:
                notes.add(child, f"{place}: the {child.label} inside is left out")


class Properties:
    """Properties of an element.

    Attributes:
        element: the element.
        plugin: present name of its plugin.
    """

    def __init__(self, element: Element, plugin: str, importer: Importer) -> None:
        self.element, self.plugin, self.importer = element, plugin, importer
        self._values: dict[str, Element] = {}
        self._objects: list[tuple[str, Element]] = []  # name, or "", and the object
        self._used: set[str] = set()
        self._taken: set[int] = set()
        for child in element.children:
            name = property_name(element.tag, plugin, child.attributes.get("name", ""))
            target = importer.target(child) if child.tag == "ref" else child
            if target.tag in OBJECTS:
                self._objects.append((name, target))
            elif target.tag not in VALUES:
                known = ", ".join((*VALUES, *OBJECTS, "ref"))
                raise child.error(f"<{child.written}>", f"one of the elements {known}")
            elif not name:
                raise child.error(f"<{child.written}>", "an attribute name")
            elif name in self._values and self.modern:
                raise child.error(name, f"a property only once (line {self._values[name].line} has it too)")
            else:
                if name in self._values:
                    self.note(f"the property {name} stands there several times: the last one is taken")
                self._values[name] = target

    @property
    def modern(self) -> bool:
        """Return True for a file of Mitsuba 2 or 3, whose defaults differ from those before."""
        return self.element.version >= (2,)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the values that are given."""
        return tuple(self._values)

    def has(self, *names: str) -> bool:
        """Return True where any of the properties is given."""
        return any(name in self._values or any(name == other for other, _ in self._objects) for name in names)

    def note(self, text: str) -> None:
        """Note what was done in place of what a property asks for; ``text`` follows the element's name."""
        self.importer.notes.add(self.element, f"{self.element.label}: {text}")

    def ignore(self, *names: str) -> None:
        """Mark properties as read that change no picture."""
        self._used.update(names)

    def number(self, name: str, default: float) -> float:
        """Return a number."""
        found = self._text(name)
        return default if found is None else values.number(self._values[name], found)

    def integer(self, name: str, default: int) -> int:
        """Return a whole number."""
        found = self._text(name)
        return default if found is None else values.integer(self._values[name], found)

    def flag(self, name: str, default: bool = False) -> bool:
        """Return a boolean."""
        found = self._text(name)
        return default if found is None else values.boolean(self._values[name], found)

    def text(self, name: str, default: str = "") -> str:
        """Return a string, without blanks around it."""
        found = self._text(name)
        return default if found is None else found.strip()

    def point(self, name: str) -> list[float] | None:
        """Return a point or a vector, or None."""
        element = self._value(name)
        return None if element is None else values.vector(element)

    def transform(self, name: str = "to_world") -> NDArray[np.float64]:
        """Return a transform ``(4, 4)``, by default the identity; of an ``<animation>`` the first one."""
        element = self._value(name)
        if element is None:
            return np.eye(4)
        if element.tag == "animation":
            self.note("the animation is left out: its first transform is taken")
            inner = [child for child in element.children if child.tag == "transform"]
            return values.transform(inner[0]) if inner else np.eye(4)
        if element.tag != "transform":
            raise element.error(f"<{element.written}>", f"a transform as {name}")
        found = values.transform(element)
        if values.is_projective(element):
            self.note("a matrix with perspective becomes affine: its last row is left out")
        return found

    def colour(self, name: str, default: Any = None, *, light: bool = False) -> Any:
        """Return a colour ``[r, g, b]``, or ``default``; a texture's place is taken by grey."""
        found = self.slot(name, default, light=light, bounded=False)
        if isinstance(found, dict):
            self.note(f"the texture of {name} becomes grey")
            return [0.5] * 3
        return found

    def slot(self, name: str, default: Any = None, *, light: bool = False, bounded: bool = True) -> Any:
        """Return a colour ``[r, g, b]`` or a texture as a scene file has it, or ``default``.

        Args:
            name: name of the property.
            default: returned where it is not given.
            light: True for the colour of a light.
            bounded: True where the colour is a fraction; more than 1 becomes 1, with a warning.
        """
        texture = self._texture(name)
        if texture is not None:
            found = self.importer.texture(texture)
            return self.fraction(found, name) if bounded and not light else found
        element = self._value(name)
        if element is None:
            return default
        if element.tag not in _COLOURS:
            raise element.error(f"<{element.written}>", f"a colour or a texture as {name}")
        found = values.colour(element, light=light, find=self.importer.find)
        high = 1.0 if bounded and not light else values.LARGEST
        if min(found) < 0.0 or max(found) > high:
            self.note(f"{name} outside of 0..1 is clamped" if high == 1.0 else f"{name} below 0 becomes 0")
            found = tuple(min(max(value, 0.0), high) for value in found)
        return list(found)

    def scalar(self, name: str, default: Any = None, *, high: float = 1.0) -> Any:
        """Return a number in 0..``high`` or a texture, or ``default``; numbers outside are clamped, with a warning.

        Of a colour the mean is taken, as in Mitsuba.
        """
        found = self.slot(name, None, bounded=False)
        if found is None or isinstance(found, dict):
            return default if found is None else self.fraction(found, name) if high == 1.0 else found
        value = found[0] if len(set(found)) == 1 else sum(found) / 3.0
        if value > high:
            self.note(f"{name} above {high:g} becomes {high:g}")
        return min(value, high)

    def fraction(self, value: Any, name: str) -> Any:
        """Return a texture, or a colour in place of one, as one of values in 0..1; note where it has others."""
        texture = self.importer.textures[value["texture"]] if isinstance(value, dict) and "texture" in value else value
        if not (max(value) > 1.0 if isinstance(value, list) else self.importer.exceeds_one(texture)):
            return value
        self.note(f"values of the texture of {name} outside of 0..1 are clamped")
        if isinstance(value, list):
            return [min(x, 1.0) for x in value]
        if texture["type"] == "image":
            return texture | {"clamp": True}
        return texture | {key: [min(x, 1.0) for x in texture[key]] for key in ("color0", "color1") if key in texture}

    def objects(self, *tags: str) -> list[Element]:
        """Return the objects of some tags, in the order of the file."""
        found = [element for _, element in self._objects if element.tag in tags]
        self._taken.update(map(id, found))
        return found

    def only(self, tag: str) -> Element:
        """Return the one object of a tag.

        Raises:
            SceneError: there is none, or there are several.
        """
        found = self.objects(tag)
        if len(found) != 1:
            raise self.element.error(self.element.label, f"one {tag} inside it, not {len(found)}")
        return found[0]

    def file(self, name: str = "filename") -> Any:
        """Return the file that a property names, None where it is missing and that is a warning.

        Raises:
            SceneError: the property or the file is missing.
        """
        element = self._value(name)
        if element is None:
            raise self.element.error(self.element.label, f"a string {name}")
        return self.importer.find(element, element.attributes.get("value", "").strip())

    def left_over(self) -> None:
        """Warn of properties and objects that were not read."""
        for name in self._values:
            if name not in self._used:
                self.note(f"the property {name} is unknown here and left out")
        for _, element in self._objects:
            if id(element) not in self._taken:
                self.note(f"the {element.label} inside is left out")

    def _value(self, name: str) -> Element | None:
        self._used.add(name)
        return self._values.get(name)

    def _text(self, name: str) -> str | None:
        element = self._value(name)
        if element is None:
            return None
        if "value" not in element.attributes:
            raise element.error(f"<{element.written}>", f"an attribute value for {name}")
        return element.attributes["value"]

    def _texture(self, name: str) -> Element | None:
        for other, element in self._objects:
            if other == name and element.tag == "texture":
                self._taken.add(id(element))
                return element
        return None
