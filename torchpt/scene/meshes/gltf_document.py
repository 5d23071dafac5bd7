"""Validate the JSON of a glTF file against a schema, and read its buffers and accessors.

A *buffer* is binary data, a *bufferView* a range of bytes of it, an *accessor* an array in a bufferView: ``count`` rows of a
*type* (SCALAR, VEC3, ...) whose *component type* is a number of OpenGL. A ``.glb`` file holds JSON and one buffer as *chunks*.
The readers of glTF ask a :class:`Document` for items of the JSON and for arrays; :class:`NumberReader` checks ranges of single
numbers.
"""

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


# ---- Schema of glTF documents: the types of all elements that are read
#
# Khronos glTF 2.0 specification, 5 (properties reference). Elements are checked when they are first read; the code that reads
# a number checks its range. Errors name the element, as ``meshes[0].primitives[1].attributes.POSITION``.


class SchemaError(ValueError):
    """An element of the wrong type; the text names it and says what is accepted."""


@dataclass(frozen=True)
class _Object:
    """Schema of an object: schemas by key, required keys, and the schema of all other keys (None: not checked)."""

    keys: Mapping[str, Any] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    others: Any = None


@dataclass(frozen=True)
class _List:
    """Schema of a list: the schema of its items, and the length where it is fixed."""

    items: Any
    length: int | None = None


# Schemas of single values: the phrase that errors print; and the types of each.
_NUMBER, _WHOLE, _TEXT, _ANY = "a number", "a whole number", "text", "anything"
_TYPES: dict[str, tuple[type, ...]] = {_NUMBER: (int, float), _WHOLE: (int,), _TEXT: (str,)}
_LARGEST = 1e300  # so that conversion to float cannot fail; the code that reads a number has its range

_OBJECT = _Object()  # whatever is in it
# A reference to a texture.
_TEXTURE_INFO = _Object(
    {"extensions": _Object({"KHR_texture_transform": _OBJECT}), "texCoord": _ANY, "index": _WHOLE}, ("index",)
)
_TEXTURES = _Object(  # textures of the core material and of all its extensions
    {
        name: _TEXTURE_INFO
        for name in (
            "baseColorTexture", "metallicRoughnessTexture", "specularTexture", "transmissionTexture", "clearcoatTexture",
        )
    }
)  # fmt: skip
# Rows that replace some of an accessor's.
_SPARSE = _Object(
    {
        "count": _WHOLE,
        "indices": _Object({"bufferView": _WHOLE, "componentType": _WHOLE}, ("bufferView", "componentType")),
        "values": _Object({"bufferView": _WHOLE}, ("bufferView",)),
    },
    ("count", "indices", "values"),
)

#: Schema of the items of each list of the document, by the list's key.
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
            "pbrMetallicRoughness": _TEXTURES,
            "normalTexture": _TEXTURE_INFO,
            "emissiveTexture": _TEXTURE_INFO,
            "extensions": _Object(others=_TEXTURES),
        }
    ),
    "accessors": _Object({"type": _TEXT, "componentType": _WHOLE, "count": _WHOLE, "sparse": _SPARSE}),
    "bufferViews": _OBJECT,
    "buffers": _OBJECT,
    "images": _OBJECT,
    "textures": _Object({"extensions": _OBJECT}),
    "samplers": _Object({"wrapS": _WHOLE, "wrapT": _WHOLE}),
}
#: Schema of the document; :data:`BLOCKS` has the items of its lists.
ROOT = _Object(
    {
        "extensionsRequired": _List(_TEXT),
        "extensionsUsed": _List(_TEXT),
        "extensions": _Object({"KHR_lights_punctual": _Object({"lights": _List(_Object({"spot": _OBJECT}))})}),
        **{name: _List(_ANY) for name in BLOCKS},
    }
)


def check(value: Any, kind: Any, where: str) -> None:
    """Check a value of JSON against a schema.

    Args:
        value: the parsed JSON.
        kind: the schema: one of :data:`BLOCKS`, or :data:`ROOT`.
        where: the element's name for errors; empty for the document itself.

    Raises:
        SchemaError: names the first element that is missing or of another type.
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
    """Return a short description of a value of JSON."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)}"
    # Python refuses to print integers of more than some thousand digits.
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > 10**40:
        return "a number of very many digits"
    return repr(value)[:60] if value is not None else "null"


# ---- Documents and their bytes: GLB chunks, buffers, data: URIs, accessors
#
# Khronos glTF 2.0 specification, 3.6 (binary data), 4.4 (GLB). Every declared size is checked against the bytes that exist.


#: Component types of OpenGL as NumPy's; numbers of rows' types.
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
#: Largest count of an accessor with sparse rows only: its zeros are not in the file, so the file's size is no limit.
_MOST_ZEROS = 2**20
#: Component types of indices: unsigned integers.
_INDEX_COMPONENTS = (5121, 5123, 5125)
#: A GLB file begins with magic, version and length (4 bytes each); each chunk with its length and kind (4 bytes each).
_GLB_HEADER, _CHUNK_HEADER = 12, 8


class Document:
    """The JSON of a file, and the binary data that it refers to.

    Attributes:
        path: the file.
        json: the top-level object.
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
        if binary is not None:  # buffer 0 without a uri is the binary chunk
            first = self.json.get("buffers")
            if isinstance(first, list) and first and isinstance(first[0], dict) and "uri" not in first[0]:
                self._buffers[0] = binary

    def item(self, block: str, index: Any) -> dict[str, Any]:
        """Return entry `index` of list `block`, checked against the schema on first use.

        Raises:
            AssetError: no such entry, or one that does not match the schema.
        """
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
        """Return the bytes of a data: URI, or of a file beside the document; ``where``: the element, for errors."""
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
        """Return the path of the file that a relative URI names; ``where``: the element, for errors."""
        if "://" in uri:
            raise AssetError(self.path, f"{where}: only files and data: URIs are read, got {uri[:60]!r}")
        for name in dict.fromkeys((unquote(uri), uri)):  # some exporters write % and blanks unquoted
            file = self.path.parent / name
            if is_regular(file):
                return file
        raise AssetError(self.path, f"{where}: the file {uri[:80]!r} is missing")

    def view(self, number: Any) -> tuple[memoryview, int | None]:
        """Return the bytes of a bufferView, and its stride (bytes from row to row) or None where rows are packed."""
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
        """Return the rows of an accessor ``(n, width)``, float64; normalized integers become floats of -1..1.

        Args:
            number: index of the accessor.
            kinds: accepted types, such as ``VEC3``.

        Raises:
            AssetError: another type, or data that are missing or reach beyond their buffer.
        """
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
            values = self._rows(
                accessor["bufferView"], offset=offset, count=count, component=component, width=width, where=where
            ).astype(np.float64)
        elif count > _MOST_ZEROS:
            raise AssetError(self.path, f"{where} declares {count} rows without data (at most {_MOST_ZEROS} are read)")
        else:
            values = np.zeros((count, width))
        if sparse is not None:
            self._replace_rows(values, sparse, component, width, where)
        if accessor.get("normalized") and component.kind in "iu":
            values = np.maximum(values / np.iinfo(component).max, -1.0)
        return values

    def _rows(self, view: Any, offset: Any, count: int, component: np.dtype, width: int, where: str) -> NDArray[Any]:
        """Return ``count`` rows of ``width`` components that begin ``offset`` bytes into a bufferView."""
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
        # One row of bytes for each row, which a stride may set apart.
        rows = np.lib.stride_tricks.as_strided(raw, (count, packed), (stride, 1), writeable=False)
        return np.ascontiguousarray(rows).view(component)

    def _replace_rows(
        self, values: NDArray[np.float64], sparse: Any, component: np.dtype, width: int, where: str
    ) -> None:
        """Overwrite rows by those of a sparse accessor (specification 3.6.2.3)."""
        where = f"{where}.sparse"
        count, indices, rows = sparse["count"], sparse["indices"], sparse["values"]
        if type(count) is not int or not 0 <= count <= len(values) or indices["componentType"] not in _INDEX_COMPONENTS:
            raise AssetError(self.path, f"{where} has a count or a componentType out of range")
        kind = np.dtype(_COMPONENTS[indices["componentType"]])
        at = self._rows(
            indices["bufferView"],
            offset=indices.get("byteOffset", 0),
            count=count,
            component=kind,
            width=1,
            where=where,
        ).reshape(-1)
        if count and int(at.max()) >= len(values):
            raise AssetError(self.path, f"{where} has an index outside 0..{len(values) - 1}")
        found = self._rows(
            rows["bufferView"],
            offset=rows.get("byteOffset", 0),
            count=count,
            component=component,
            width=width,
            where=where,
        )
        values[at.astype(np.int64)] = found


class NumberReader:
    """Reader of the numbers of a document's object, with range checks.

    Args:
        document: the document.
        what: name of the object in errors.
    """

    def __init__(self, document: Document, what: str) -> None:
        self.document, self.what = document, what

    def number(self, block: dict[str, Any], key: str, default: float, high: float, low: float = 0.0) -> float:
        """Return a number of the file, in a range.

        Args:
            block: the object that has the number.
            key: key of the number.
            default: its value where it is missing.
            high: largest accepted value.
            low: smallest accepted value.

        Raises:
            AssetError: not a number, or out of range.
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
    """Return the JSON chunk and the binary chunk of a GLB file."""
    if len(data) < _GLB_HEADER + _CHUNK_HEADER:
        raise AssetError(path, f"truncated: {len(data)} bytes")
    version, length = (int.from_bytes(data[at : at + 4], "little") for at in (4, 8))
    if version != 2:
        raise AssetError(path, f"glTF version {version}, expected 2")
    if length > len(data):
        raise AssetError(path, f"truncated: {length} bytes declared, got {len(data)}")
    found: dict[bytes, bytes] = {}
    at = _GLB_HEADER
    while at + _CHUNK_HEADER <= length:
        size, kind = int.from_bytes(data[at : at + 4], "little"), data[at + 4 : at + _CHUNK_HEADER]
        begin = at + _CHUNK_HEADER
        if begin + size > length:
            raise AssetError(path, f"truncated: a chunk of {size} bytes reaches beyond the file")
        found.setdefault(kind, data[begin : begin + size])  # the first of each kind
        at = begin + size
    return found.get(b"JSON", b""), found.get(b"BIN\0", b"")
