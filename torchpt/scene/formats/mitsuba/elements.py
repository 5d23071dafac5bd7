"""Parse Mitsuba's XML to elements, with parameters substituted and included files in place.

Entities and external references are refused; files are read from disk only, within the limits below.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from torchpt.core.errors import SceneError, did_you_mean
from torchpt.core.files import check_regular, read_regular

__all__ = ["Element", "parse_scene", "walk"]

# Limits, far above any scene, within which no file exhausts memory or the stack.
MAX_BYTES = 256 * 2**20
MAX_DEPTH = 64  # levels of nesting
MAX_ELEMENTS = 2_000_000
MAX_FILES, MAX_INCLUDES = 256, 15  # files of a scene, and levels of <include>
MAX_TEXT = 2**20  # characters of an attribute once parameters are substituted; 256 times as many in all

#: Old names of tags, and those of today (Mitsuba 0.4 renamed cameras and luminaires).
TAGS = {"camera": "sensor", "luminaire": "emitter", "lookAt": "lookat"}
_PARAMETER = re.compile(r"\$(\w+)")


@dataclass
class Element:
    """An element of a scene.

    Attributes:
        tag: its name, such as ``bsdf`` or ``float``; old names are replaced, see :data:`TAGS`.
        attributes: its attributes, with parameters substituted.
        file: the file that it stands in, as errors show it.
        line: its line.
        folder: the folder of that file, from which relative paths start.
        version: of Mitsuba, that the file was written for.
        children: the elements inside.
        written: the tag as written.
    """

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    folder: Path
    version: tuple[int, ...]
    children: list[Element] = field(default_factory=list)
    written: str = ""

    @property
    def type(self) -> str:
        """Return the name of the plugin, or ""."""
        return self.attributes.get("type", "")

    @property
    def id(self) -> str:
        """Return the id, or ""."""
        return self.attributes.get("id", "")

    @property
    def label(self) -> str:
        """Return the element as warnings name it: ``bsdf "coating"``."""
        return f'{self.tag} "{self.type}"' if self.type else self.tag

    @property
    def place(self) -> str:
        """Return file, line and element as errors name them."""
        return f"{self.file}: {self._line}"

    @property
    def _line(self) -> str:
        return f"line {self.line}, {self.label} {self.attributes.get('name', '')}".rstrip()

    def error(self, value: object, expected: str) -> SceneError:
        """Return the error of a wrong value in this element."""
        return SceneError(self._line, value, expected, self.file)


def parse_scene(
    path: Path, file: str, given: Mapping[str, str], *, missing: bool = False
) -> tuple[Element, list[Element]]:
    """Parse a scene file.

    Args:
        path: the file.
        file: the same as errors show it.
        given: values of the scene's parameters, in place of its ``<default>``.
        missing: whether included files may be missing.

    Returns:
        The element ``<scene>``, with the children of included files in the place of each ``<include>``; and each
        ``<include>`` whose file is missing.

    Raises:
        SceneError: no well-formed XML, no scene, a parameter without a value, limits exceeded, a missing file.
    """
    reader = _Reader(dict(given), missing)
    root = reader.read(path, file, trail=())
    unknown = [name for name in given if name not in reader.used | reader.declared]
    if unknown:
        known = sorted(reader.used | reader.declared)
        names = f"one of {', '.join(known)}" if known else "none, as the scene has no parameters"
        hint = did_you_mean(unknown[0], known)
        raise SceneError(
            f"scene_params.{unknown[0]}", given[unknown[0]], f"a parameter of the scene: {names}{hint}", file
        )
    return root, reader.left_out


class _Reader:
    """Reader of the files of one scene; ``parameters`` are the values by name, ``used`` those that stand somewhere."""

    def __init__(self, parameters: dict[str, str], missing: bool) -> None:
        self.parameters, self.missing = parameters, missing
        self.left_out: list[Element] = []
        self.used: set[str] = set()
        self.declared: set[str] = set()
        self.files = self.elements = self.substituted = 0

    def read(self, path: Path, file: str, trail: tuple[Path, ...]) -> Element:
        """Parse a file and the files that it includes; ``trail``: the files that include it."""
        self.files += 1
        if self.files > MAX_FILES or len(trail) > MAX_INCLUDES:
            raise SceneError("include", file, f"at most {MAX_FILES} files, included {MAX_INCLUDES} levels deep", file)
        root = self._parse(_bytes_of(path, file), path, file)
        if root.tag != "scene":
            raise SceneError(f"line {root.line}", f"<{root.written}>", "<scene> as the outermost element", file)
        version = _version(root)
        self._finish(root, version, (*trail, path.resolve()))
        return root

    def _parse(self, data: bytes, path: Path, file: str) -> Element:
        parser = expat.ParserCreate()
        stack: list[Element] = []
        roots: list[Element] = []
        folder = path.resolve().parent

        def refuse(what: str) -> SceneError:
            return SceneError(f"line {parser.CurrentLineNumber}", what, "XML without entities", file)

        def start(tag: str, attributes: dict[str, str]) -> None:
            self.elements += 1
            if self.elements > MAX_ELEMENTS or len(stack) >= MAX_DEPTH:
                expected = f"at most {MAX_ELEMENTS} elements, nested at most {MAX_DEPTH} deep"
                raise SceneError(f"line {parser.CurrentLineNumber}", f"<{tag}>", expected, file)
            element = Element(TAGS.get(tag, tag), attributes, file, parser.CurrentLineNumber, folder, (), written=tag)
            (stack[-1].children if stack else roots).append(element)
            stack.append(element)

        def entity(*_: object) -> None:
            raise refuse("an entity")

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda _: stack.pop() and None
        parser.EntityDeclHandler = entity
        parser.ExternalEntityRefHandler = entity  # type: ignore[assignment]
        parser.SkippedEntityHandler = entity  # type: ignore[assignment]
        start_of = re.match(rb"\s+(<\?xml[^>]*\?>)", data)
        if start_of:  # blanks before the declaration, which some XML readers allow: it is taken out, lines stay
            data = data.replace(start_of[1], b"", 1)
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            text = data.splitlines()
            line = text[error.lineno - 1].decode("utf-8", "replace").strip() if error.lineno <= len(text) else ""
            problem = f"well-formed XML ({expat.ErrorString(error.code)})"
            raise SceneError(f"line {error.lineno}", line, problem, file) from None
        except (ValueError, LookupError) as error:  # an encoding that Python does not know
            raise SceneError("line 1", str(error), "XML in an encoding that is known, such as utf-8", file) from None
        return roots[0]

    def _finish(self, parent: Element, version: tuple[int, ...], trail: tuple[Path, ...]) -> None:
        """Substitute parameters, take ``<default>`` and ``<include>`` in the order of the file; set the version."""
        parent.version = version
        self._substitute(parent)
        children: list[Element] = []
        for child in parent.children:
            if child.tag == "default":
                child.version = version
                self._substitute(child)
                name = _required(child, "name")
                self.declared.add(name)
                self.parameters.setdefault(name, _required(child, "value"))
            elif child.tag == "include":
                child.version = version
                self._substitute(child)
                children += self._included(child, trail)
            else:
                self._finish(child, version, trail)
                children.append(child)
        parent.children = children

    def _included(self, element: Element, trail: tuple[Path, ...]) -> list[Element]:
        """Return the children of the file that an ``<include>`` names."""
        name = _required(element, "filename")
        folders = (element.folder, trail[0].parent)
        for folder in folders:
            for candidate in (name, name.replace("\\", "/")):
                path = folder / candidate
                if path.is_file():
                    if path.resolve() in trail:
                        raise element.error(name, "a file that does not include itself")
                    return self.read(path, _shown(path), trail).children
        if not self.missing:
            raise element.error(name, "the name of a file that is there (import.missing=warn goes on without it)")
        self.left_out.append(element)
        return []

    def _substitute(self, element: Element) -> None:
        """Put the values of parameters in place of ``$name`` in the attributes of an element."""
        for key, text in element.attributes.items():
            if "$" not in text:
                continue
            found = _PARAMETER.sub(lambda match: self._value(match[1], element), text)
            self.substituted += len(found)
            if len(found) > MAX_TEXT or self.substituted > 256 * MAX_TEXT:
                raise element.error(found[:40], f"at most {MAX_TEXT} characters in an attribute, 256 times that in all")
            element.attributes[key] = found

    def _value(self, name: str, element: Element) -> str:
        """Return the value of the parameter ``name``, or of the longest one that its letters begin with and the rest."""
        for length in range(min(len(name), max(map(len, self.parameters), default=0)), 0, -1):
            if name[:length] in self.parameters:
                self.used.add(name[:length])
                return self.parameters[name[:length]] + name[length:]
        known = sorted(self.parameters)
        there = f" ({', '.join(known)})" if known else ""
        hint = did_you_mean(name, known)
        raise element.error(f"${name}", f"a parameter with a <default>{there}{hint}, or scene_params={{{name}: ...}}")


def _bytes_of(path: Path, file: str) -> bytes:
    """Return what a file holds, within limits."""
    try:
        if check_regular(path) > MAX_BYTES:
            raise SceneError("scene", file, f"a file of at most {MAX_BYTES // 2**20} MiB")
        return read_regular(path, MAX_BYTES)
    except OSError as error:
        raise SceneError("scene", file, f"a scene file that can be read ({error.strerror})") from None


def _version(root: Element) -> tuple[int, ...]:
    """Return the version of Mitsuba that a file was written for; 3.0.0 where it does not say."""
    text = root.attributes.get("version", "3.0.0").strip()
    found = re.match(r"[0-9]{1,6}(\.[0-9]{1,6}){0,3}", text)  # before a suffix such as "-alpha"
    if found is None:
        raise root.error(text, "a version such as 0.6.0 or 3.0.0")
    return tuple(int(part) for part in found[0].split("."))


def _required(element: Element, name: str) -> str:
    if name not in element.attributes:
        raise element.error(f"<{element.written}>", f"an attribute {name}")
    return element.attributes[name]


def _shown(path: Path) -> str:
    """Return a path for errors: relative to the current folder if below it."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def walk(element: Element) -> Iterator[Element]:
    """Yield an element and all inside it, in the order of the file."""
    stack = [element]
    while stack:
        found = stack.pop()
        yield found
        stack.extend(reversed(found.children))
