"""A glTF file as a checked document: its schema, buffers, accessors, nodes."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.core.files import is_regular, read_regular

__all__ = ["BLOCKS", "ROOT", "Document", "NumberReader", "SchemaError", "check"]


# ---- What each part of a glTF document must be for the reader to follow it: objects, lists, texts, numbers, by key
#
# Khronos glTF 2.0 specification, 5 (properties reference). Ranges of numbers are their readers' matter; only what is read is
# checked, when it is first asked for. Errors name the element, as ``meshes[0].primitives[1].attributes.POSITION``.


class SchemaError(ValueError):
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
        SchemaError: the first thing in it that is something else, or missing.
    """
    if isinstance(kind, _Object):
        if not isinstance(value, dict):
            raise SchemaError(f"{where}: expected an object, got {_brief(value)}")
        for key in kind.required:
            if key not in value:
                raise SchemaError(f"{where}: {key} is missing")
        for key, item in value.items():
            inner = kind.keys.get(key, kind.others)
            if inner is not None:
                check(item, inner, f"{where}.{key[:80]}" if where else key)
    elif isinstance(kind, _List):
        if not isinstance(value, list) or (kind.length is not None and len(value) != kind.length):
            expected = "a list" if kind.length is None else f"a list of {kind.length} numbers"
            raise SchemaError(f"{where}: expected {expected}, got {_brief(value)}")
        if kind.items is not _ANY:
            for number, item in enumerate(value):
                check(item, kind.items, f"{where}[{number}]")
    elif kind is not _ANY:
        fits = isinstance(value, _TYPES[kind]) and not isinstance(value, bool)
        if not fits or (kind is _NUMBER and not -_LARGEST <= value <= _LARGEST):
            raise SchemaError(f"{where}: expected {kind}, got {_brief(value)}")


def _brief(value: Any) -> str:
    """A value of JSON in a few words."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**40:
        return "a number of very many digits"
    return repr(value)[:60] if value is not None else "null"


# ---- A glTF 2.0 document and its bytes: GLB chunks, buffers, data: URIs, accessors
#
# Khronos glTF 2.0 specification, 3.6 (binary data), 4.4 (GLB). Every declared size is held against what is there.


_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
#: Most rows of an accessor that has nothing but sparse ones: the others are zeros for which no byte is there.
_MOST_ZEROS = 2**20


class Document:
    """The JSON of a file, and what it points to.

    Attributes:
        path: the file.
        json: its object.
    """

    def __init__(self, path: Path, data: bytes) -> None:
        self.path = path
        binary: bytes | None = None
        if data[:4] == b"glTF":
            data, binary = _chunks(path, data)
        elif path.suffix.lower() == ".glb":
            raise AssetError(path, "no GLB file (it does not start with glTF and a header)")
        try:
            self.json = json.loads(data)
        except (ValueError, RecursionError):
            raise AssetError(path, "the JSON is missing or malformed") from None
        if not isinstance(self.json, dict):
            raise AssetError(path, "the JSON is no object")
        self._check(self.json, ROOT, "")
        self._checked: set[tuple[str, int]] = set()
        self._buffers: dict[int, bytes] = {}
        if binary is not None:
            first = self.json.get("buffers")
            if isinstance(first, list) and first and isinstance(first[0], dict) and "uri" not in first[0]:
                self._buffers[0] = binary

    def item(self, block: str, index: Any) -> dict[str, Any]:
        """An object of one of the document's lists, of which all that is read is of the right kind."""
        items = self.json.get(block, [])
        if type(index) is not int or not isinstance(items, list) or not 0 <= index < len(items):
            count = len(items) if isinstance(items, list) else 0
            raise AssetError(self.path, f"{block} {str(index)[:40]} does not exist ({count} are declared)")
        if (block, index) not in self._checked:
            self._check(items[index], BLOCKS[block], f"{block}[{index}]")
            self._checked.add((block, index))
        return items[index]

    def _check(self, value: Any, kind: Any, where: str) -> None:
        try:
            check(value, kind, where)
        except SchemaError as wrong:
            raise AssetError(self.path, f"malformed glTF: {wrong}") from None

    def resource(self, uri: Any, where: str) -> bytes:
        """The bytes of a data: URI, or of a file beside the document."""
        if not isinstance(uri, str):
            raise AssetError(self.path, f"{where}: the uri is no text")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                return base64.b64decode(body, validate=True) if head.endswith(";base64") else unquote_to_bytes(body)
            except (binascii.Error, ValueError):
                raise AssetError(self.path, f"{where}: malformed data: URI") from None
        file = self.file(uri, where)
        try:
            return read_regular(file)
        except OSError as error:
            raise AssetError(file, f"cannot be read ({error.strerror}), {where} of {self.path}") from None

    def file(self, uri: str, where: str) -> Path:
        """The file that a relative URI names."""
        if "://" in uri:
            raise AssetError(self.path, f"{where}: only files and data: URIs are read, got {uri[:60]!r}")
        for name in dict.fromkeys((unquote(uri), uri)):
            file = self.path.parent / name
            if is_regular(file):
                return file
        raise AssetError(self.path, f"{where}: the file {uri[:80]!r} is missing")

    def view(self, number: Any) -> tuple[memoryview, int | None]:
        """The bytes of a bufferView, and its stride where it has one."""
        view = self.item("bufferViews", number)
        index = view.get("buffer")
        begin, length = view.get("byteOffset", 0), view.get("byteLength")
        if not all(type(x) is int and x >= 0 for x in (begin, length)):
            raise AssetError(self.path, f"bufferViews {number} has a size that is no whole number >= 0")
        data = self._buffer(index)
        assert isinstance(length, int)
        if begin + length > len(data):
            raise AssetError(self.path, f"bufferViews {number} reaches beyond its buffer of {len(data)} bytes")
        return memoryview(data)[begin : begin + length], view.get("byteStride")

    def _buffer(self, index: Any) -> bytes:
        buffer = self.item("buffers", index)
        if index not in self._buffers:
            if "uri" not in buffer:
                raise AssetError(self.path, f"buffers {index} has neither a uri nor a binary chunk")
            self._buffers[index] = self.resource(buffer["uri"], f"buffers {index}")
        return self._buffers[index]

    def accessor(self, number: Any, *kinds: str) -> NDArray[np.float64]:
        """The rows of an accessor of one of some types, ``(n, width)`` float64; normalized integers become 0..1 or -1..1."""
        accessor = self.item("accessors", number)
        where = f"accessors {number}"
        kind, code, count = accessor.get("type"), accessor.get("componentType"), accessor.get("count")
        if kind not in kinds or code not in _COMPONENTS:
            raise AssetError(
                self.path, f"{where} holds {str(kind)[:40]} of {str(code)[:40]}, expected {' or '.join(kinds)}"
            )
        if type(count) is not int or count < 0:
            raise AssetError(self.path, f"{where} has a count that is no whole number >= 0")
        component, width = np.dtype(_COMPONENTS[code]), _WIDTHS[kind]
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            offset = accessor.get("byteOffset", 0)
            values = self._rows(accessor["bufferView"], offset, count, component, width, where).astype(np.float64)
        elif sparse is None:
            raise AssetError(self.path, f"{where} has no data (no bufferView)")
        elif count > _MOST_ZEROS:
            raise AssetError(self.path, f"{where} declares {count} rows without data (at most {_MOST_ZEROS} are read)")
        else:
            values = np.zeros((count, width))
        if sparse is not None:
            self._displace(values, sparse, component, width, where)
        if accessor.get("normalized") and component.kind in "iu":
            values = np.maximum(values / np.iinfo(component).max, -1.0)
        return values

    def _rows(self, view: Any, offset: Any, count: int, component: np.dtype, width: int, where: str) -> NDArray[Any]:
        data, stride = self.view(view)
        packed = component.itemsize * width
        stride = packed if stride is None else stride
        if not all(type(x) is int and x >= 0 for x in (offset, stride)):
            raise AssetError(self.path, f"{where} has an offset or stride that is no whole number >= 0")
        needed = offset + (count - 1) * stride + packed if count else 0
        if stride < packed or needed > len(data):
            raise AssetError(self.path, f"{where} reaches beyond its bufferView: {count} elements of {packed} bytes")
        if not count:
            return np.zeros((0, width), component)
        raw = np.frombuffer(data, np.uint8, needed - offset, offset)
        rows = np.lib.stride_tricks.as_strided(raw, (count, packed), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(component)

    def _displace(self, values: NDArray[np.float64], sparse: Any, component: np.dtype, width: int, where: str) -> None:
        """Puts the rows of a sparse accessor over those of its base (specification 3.6.2.3)."""
        where = f"{where}.sparse"
        count, indices, rows = sparse["count"], sparse["indices"], sparse["values"]
        if (
            type(count) is not int
            or not 0 <= count <= len(values)
            or indices["componentType"] not in (5121, 5123, 5125)
        ):
            raise AssetError(self.path, f"{where} has a count or a componentType out of range")
        kind = np.dtype(_COMPONENTS[indices["componentType"]])
        at = self._rows(indices["bufferView"], indices.get("byteOffset", 0), count, kind, 1, where).reshape(-1)
        if count and int(at.max()) >= len(values):
            raise AssetError(self.path, f"{where} has an index outside 0..{len(values) - 1}")
        found = self._rows(rows["bufferView"], rows.get("byteOffset", 0), count, component, width, where)
        values[at.astype(np.int64)] = found


class NumberReader:
    """What objects of a document come to: reads their numbers.

    Args:
        document: whose they are.
        what: what errors call the one that is read.
    """

    def __init__(self, document: Document, what: str) -> None:
        self.document, self.what = document, what

    def number(self, block: dict[str, Any], key: str, default: float, high: float, low: float = 0.0) -> float:
        """Return a number of the file, in a range.

        Raises:
            AssetError: it is none, or lies outside.
        """
        value = block.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise self.wrong(f"{key} {str(value)[:40]!r} is no number in {low:g}..{high:g}")
        return float(value)

    def numbers(
        self, block: dict[str, Any], key: str, default: tuple[float, ...], high: float = 1.0, low: float = 0.0
    ) -> tuple[float, ...]:
        """Return as many numbers as the default has; see :meth:`number`."""
        values = block.get(key, default)
        if not isinstance(values, list | tuple) or len(values) != len(default):
            raise self.wrong(f"{key} {str(values)[:40]!r} is not {len(default)} numbers")
        return tuple(self.number({key: value}, key, 0.0, high, low) for value in values)

    def wrong(self, problem: str) -> AssetError:
        """Return the error that names the object."""
        return AssetError(self.document.path, f"{self.what}: {problem}")


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a GLB file."""
    if len(data) < 20:
        raise AssetError(path, f"truncated: {len(data)} bytes")
    version, length = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
    if version != 2:
        raise AssetError(path, f"glTF version {version}, expected 2")
    if length > len(data):
        raise AssetError(path, f"truncated: {length} bytes declared, got {len(data)}")
    found: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= length:
        size, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + 8]
        if at + 8 + size > length:
            raise AssetError(path, f"truncated: a chunk of {size} bytes reaches beyond the file")
        found.setdefault(kind, data[at + 8 : at + 8 + size])
        at += 8 + size
    return found.get(b"JSON", b""), found.get(b"BIN\0", b"")
