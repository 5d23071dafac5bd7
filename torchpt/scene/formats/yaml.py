"""Parse YAML to plain dicts and lists: iterative, bounded, and strict about duplicate keys.

Scene files and dicts pass through :func:`plain` before anything reads them.

The parser is libyaml's (``CSafeLoader``), read event by event: nesting cannot exhaust the stack, keys stay text as
written, ``1e-3`` is a number (YAML 1.2), and every error knows its line. Anchors, aliases and ``<<`` merges work;
:func:`plain` bounds what they may expand to.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError
from torchpt.core.files import check_regular, read_regular

__all__ = ["MAX_BYTES", "MAX_DEPTH", "MAX_KEY", "MAX_VALUES", "parse_yaml", "plain", "read_open", "read_yaml"]

# Limits, far above any scene, within which no file exhausts memory or the stack.
MAX_BYTES = 256 * 2**20
MAX_DEPTH = 100  # levels of nesting
MAX_KEY = 256  # characters of a key
MAX_VALUES = 5_000_000  # after aliases are expanded
MAX_MERGED = 1_000_000  # keys that `<<` may copy

# Numbers as in YAML 1.2, underscores between digits allowed: decimal, 0x and 0o integers; floats with or without point and
# exponent; .inf and .nan.
_INT = re.compile(r"[-+]?(?:[0-9][0-9_]*|0x[0-9a-fA-F_]+|0o[0-7_]+)\Z")
_FLOAT = re.compile(r"[-+]?(?:[0-9][0-9_]*\.?[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?\Z")
_NON_FINITE = re.compile(r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z")
#: Words that are no text: null, and YAML 1.1's booleans, each as written, capitalized and in capitals.
_WORDS: dict[str, Any] = {"": None, "~": None}
for _meaning, _words in ((None, ("null",)), (True, ("true", "yes", "on")), (False, ("false", "no", "off"))):
    for _word in _words:
        _WORDS.update(dict.fromkeys((_word, _word.capitalize(), _word.upper()), _meaning))
_SCALARS = frozenset({int, float, str, bool, type(None)})
_CONTAINERS = (dict, list, tuple, Mapping)
#: Tags of plain values. All others name objects, which a scene must not create.
_CORE_TAGS = {f"tag:yaml.org,2002:{name}" for name in ("str", "int", "float", "bool", "null", "seq", "map")} | {"!"}


def read_yaml(path: Path, file: str) -> Any:
    """Parse a YAML file.

    Raises:
        SceneError: the file is missing, too large, or no valid YAML.
    """
    try:
        if check_regular(path) > MAX_BYTES:
            raise SceneError(
                "scene", file, f"a file of at most {MAX_BYTES // 2**20} MiB (large meshes belong in PLY files)"
            )
        data = read_regular(path, MAX_BYTES)
    except OSError as error:
        raise SceneError("scene", file, f"a scene file that can be read ({error.strerror})") from None
    return parse_yaml(data, file)


def read_open(source: Any, file: str | None) -> Any:
    """Parse the rest of an open file, or of any object with ``read``.

    Raises:
        SceneError: it cannot be read, is too large, or is no valid YAML.
    """
    name = file or "an open file"
    try:
        data = source.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # closed, or not text
        reason = getattr(error, "strerror", None) or str(error)
        raise SceneError("scene", name, f"an open file that can be read ({reason})") from None
    if not isinstance(data, str | bytes):
        raise SceneError("scene", name, "an open file of text or bytes")
    if len(data) > MAX_BYTES:
        raise SceneError("scene", name, f"at most {MAX_BYTES // 2**20} MiB (large meshes belong in PLY files)")
    return parse_yaml(data, file)


def parse_yaml(data: bytes | str, file: str | None = None) -> Any:
    """Parse YAML text of a single document to dicts, lists, text, numbers, booleans and None.

    Raises:
        SceneError: invalid YAML, a duplicate key, a tag that names an object, or nesting beyond ``MAX_DEPTH``.
    """
    import yaml

    try:
        return _Builder(file).build(yaml.parse(data, Loader=yaml.CSafeLoader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "unreadable text"
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark is not None else "text"
        raise SceneError(where, _line_of(data, mark), f"valid YAML ({' '.join(str(problem).split())})", file) from None


def _line_of(data: bytes | str, mark: Any) -> str:
    if mark is None:
        return ""
    text = data.decode("utf-8", "replace") if isinstance(data, bytes) else data
    lines = text.splitlines()
    return lines[mark.line].strip() if mark.line < len(lines) else "the end of the file"


class _Frame:
    """A list or mapping under construction.

    Attributes:
        value: what has been read of it.
        anchor: the anchor that names it, or None.
        key: of a mapping, the key whose value comes next; None where a key comes next.
        lines: of a mapping, the line of each key, to report duplicates.
        merges: of a mapping, the mappings that ``<<`` merges into it, the first with the highest precedence; None without.
    """

    __slots__ = ("anchor", "key", "lines", "merges", "value")

    def __init__(self, value: list[Any] | dict[str, Any], anchor: str | None) -> None:
        self.value = value
        self.anchor = anchor
        self.key: str | None = None
        self.lines: dict[str, int] = {}
        self.merges: list[Any] | None = None


class _Builder:
    """Builder of plain objects from libyaml's parser events; ``stack`` holds what is open, the innermost last."""

    def __init__(self, file: str | None) -> None:
        self.file = file
        self.stack: list[_Frame] = []
        self.anchors: dict[str, Any] = {}
        self.root: Any = None
        self.documents = 0
        self.merged = self.values = 0  # keys copied by `<<`, and values, so far

    def build(self, events: Iterator[Any]) -> Any:
        """Return the root of the document that the events describe."""
        for event in events:
            name = event.__class__.__name__
            if (
                name == "ScalarEvent"
                and self.stack
                and event.tag is None
                and event.anchor is None
                and event.implicit[0]  # without quotes
            ):
                values = self.stack[-1].value
                if isinstance(values, list):  # a short cut for numbers by the thousand
                    values.append(_resolve(event.value))
                    self.count_value(event)
                    continue
            if name == "ScalarEvent":
                self.scalar(event)
            elif name in ("SequenceStartEvent", "MappingStartEvent"):
                self.open(event, [] if name == "SequenceStartEvent" else {})
            elif name in ("SequenceEndEvent", "MappingEndEvent"):
                self.close(event)
            elif name == "AliasEvent":
                if event.anchor not in self.anchors:
                    raise self.error(event, f"*{event.anchor}", "an anchor that is complete before it is used")
                self.add(event, self.anchors[event.anchor])
            elif name == "DocumentStartEvent":
                self.documents += 1
                if self.documents > 1:
                    raise self.error(event, "---", "one YAML document in a scene file")
        return self.root

    def error(self, event: Any, value: object, expected: str) -> SceneError:
        return SceneError(f"line {event.start_mark.line + 1}", value, expected, self.file)

    def path(self, name: str = "") -> str:
        """Return the dotted key of the present event."""
        parts = [str(len(f.value)) if isinstance(f.value, list) else f.key for f in self.stack]
        return ".".join([part for part in parts if part is not None] + [name] * bool(name))

    def scalar(self, event: Any) -> None:
        """Take a scalar: a key where the innermost mapping expects one, else a value."""
        frame = self.stack[-1] if self.stack else None
        if frame is not None and isinstance(frame.value, dict) and frame.key is None:
            self.begin_key(frame, event)
            return
        if event.tag is not None and event.tag not in _CORE_TAGS:
            raise SceneError(self.path(), event.tag, "plain YAML without tags that name objects", self.file)
        is_unquoted = event.implicit[0] and event.tag is None
        value = _resolve(event.value) if is_unquoted else event.value
        if event.anchor:
            self.anchors[event.anchor] = value
        self.add(event, value)

    def begin_key(self, frame: _Frame, event: Any) -> None:
        """Set the key whose value comes next."""
        key, line = event.value, event.start_mark.line + 1
        if key in frame.lines and key != "<<":
            expected = f"a key only once in its block (lines {frame.lines[key]} and {line})"
            raise SceneError(self.path(key), key, expected, self.file)
        frame.lines[key] = line
        frame.key = key
        if event.anchor:
            self.anchors[event.anchor] = key

    def open(self, event: Any, value: list[Any] | dict[str, Any]) -> None:
        """Begin a list or mapping; an alias of it inside itself finds no anchor."""
        if event.tag is not None and event.tag not in _CORE_TAGS:
            raise SceneError(self.path(), event.tag, "plain YAML without tags that name objects", self.file)
        if len(self.stack) >= MAX_DEPTH:
            raise self.error(event, "deeper nesting", f"at most {MAX_DEPTH} levels of nesting")
        frame = self.stack[-1] if self.stack else None
        if frame is not None and isinstance(frame.value, dict) and frame.key is None:
            raise self.error(event, "a list or mapping", "text as a key")
        if event.anchor:
            self.anchors.pop(event.anchor, None)
        self.stack.append(_Frame(value, event.anchor))

    def close(self, event: Any) -> None:
        """End the innermost list or mapping: merge what ``<<`` names, and add it to the one around it."""
        frame = self.stack.pop()
        if frame.merges is not None and isinstance(frame.value, dict):
            # Each merge copies the keys of its source and those that are there.
            self.merged += sum(len(source) for source in frame.merges) + len(frame.value) * len(frame.merges)
            if self.merged > MAX_MERGED:
                raise self.error(event, "<<", f"merges that copy at most {MAX_MERGED} keys in all")
            for source in frame.merges:  # the first one listed wins, own keys win over all
                frame.value = dict(source) | frame.value
        if frame.anchor:
            self.anchors[frame.anchor] = frame.value
        self.add(event, frame.value)

    def count_value(self, event: Any) -> None:
        """Count a value, and raise where there are too many."""
        self.values += 1
        if self.values > MAX_VALUES:
            raise self.error(event, self.values, f"at most {MAX_VALUES} values")

    def add(self, event: Any, value: Any) -> None:
        """Add a complete value to the innermost list or mapping, or make it the root."""
        self.count_value(event)
        if not self.stack:
            self.root = value
            return
        frame = self.stack[-1]
        if isinstance(frame.value, list):
            frame.value.append(value)
        elif frame.key is None:
            raise self.error(event, value, "text as a key")
        elif frame.key == "<<":
            sources = value if isinstance(value, list) else [value]
            if not all(isinstance(source, dict) for source in sources):
                raise self.error(event, value, "a mapping, or a list of mappings, to merge")
            frame.merges = (frame.merges or []) + sources
            frame.key = None
        else:
            frame.value[frame.key] = value
            frame.key = None


def _resolve(text: str) -> Any:
    """Return the value of a plain scalar: a number (YAML 1.2), a boolean (YAML 1.1), else text."""
    if text in _WORDS:
        return _WORDS[text]
    if text[0] not in "+-.0123456789":
        return text
    if _INT.match(text):
        digits = text.replace("_", "")
        base = 16 if "0x" in digits else 8 if "0o" in digits else 10
        return int(digits, base) if len(digits) < 400 else text  # beyond any float; Python refuses thousands of digits
    if _FLOAT.match(text):
        return float(text.replace("_", ""))
    if _NON_FINITE.match(text):
        return float(text.lower().replace(".", ""))
    return text


#: Keys that were found to be printable text, and the most of them: scenes repeat theirs.
_good_keys: set[str] = set()
MAX_GOOD_KEYS = 4096


def plain(source: Any, file: str | None = None) -> Any:
    """Copy nested mappings and sequences to dicts and lists, bounded and safe to validate.

    Raises:
        SceneError: a ``_target_`` key, a key that is not printable text, a structure that contains itself, nesting
            beyond ``MAX_DEPTH`` or more than ``MAX_VALUES`` values once aliases are expanded.
    """
    # By id of a container: its copy and number of values; None while it is being copied. Aliases share one copy.
    memo: dict[int, tuple[Any, int] | None] = {}
    trail: list[str] = []  # the dotted key of what is being visited

    def error(value: object, expected: str) -> SceneError:
        return SceneError(".".join(trail) or "scene", value, expected, file)

    def visit(item: Any) -> tuple[Any, int]:
        """Return the copy of a container, and the number of values in it."""
        known = memo.get(id(item), ())  # (): not seen yet
        if known is None:
            raise error("an alias of itself", "a structure that does not contain itself")
        if known:
            return known
        if item.__class__ is list and _SCALARS.issuperset(map(type, item)):
            return item.copy(), len(item) + 1  # the rows of an inline mesh
        if len(trail) > MAX_DEPTH:
            raise error("deeper nesting", f"at most {MAX_DEPTH} levels of nesting")
        memo[id(item)] = None
        is_mapping = item.__class__ is dict or isinstance(item, Mapping)
        copy: Any = {} if is_mapping else []
        count = 1
        for name, value in item.items() if is_mapping else enumerate(item):
            count += 1
            if is_mapping and not (name.__class__ is str and name in _good_keys):
                if not isinstance(name, str) or not name.strip() or not name.isprintable() or len(name) > MAX_KEY:
                    raise error(name, f"keys that are printable text of at most {MAX_KEY} characters")
                if name == "_target_":
                    trail.append(name)
                    raise error(value, "no `_target_`: a scene never names Python objects")
                if len(_good_keys) < MAX_GOOD_KEYS:
                    _good_keys.add(str(name))
            if value.__class__ not in _SCALARS and isinstance(value, _CONTAINERS):
                trail.append(str(name))
                value, inner_count = visit(value)
                trail.pop()
                count += inner_count
            if is_mapping:
                copy[name] = value
            else:
                copy.append(value)
        if count > MAX_VALUES:
            raise error(count, f"at most {MAX_VALUES} values once aliases are expanded")
        memo[id(item)] = copy, count
        return copy, count

    if not isinstance(source, Mapping):
        raise SceneError("scene", source, "a mapping with the blocks camera, materials, shapes, ...", file)
    return visit(source)[0]
