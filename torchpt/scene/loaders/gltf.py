"""Binary glTF 2.0 (GLB): triangles of every node, moved by the node's world matrix; base colour and emission.

Read here from the JSON and BIN chunks (Khronos glTF 2.0 specification, 3.6 and 4.4); every declared size is held
against the file. Textures and other material features are listed as ignored.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.errors import AssetError
from torchpt.scene.loaders.mesh_part import MAX_VERTICES, FileMaterial, MeshPart, transformed

__all__ = ["load_glb"]

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6


def load_glb(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """The primitives of a GLB file, one part each, in world space.

    Raises:
        AssetError: truncated, malformed, compressed, or with sparse accessors.
    """
    document, binary = _chunks(path, data)
    reader = _Reader(path, document, binary)
    try:
        return reader.parts(materials)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        raise AssetError(path, f"malformed glTF ({type(error).__name__}: {error})") from None


def _chunks(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20 or data[:4] != b"glTF":
        raise AssetError(path, "no GLB file (it does not start with glTF and a header)")
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
    try:
        document = json.loads(found.get(b"JSON", b""))
    except (ValueError, RecursionError):
        raise AssetError(path, "the JSON chunk is missing or no JSON") from None
    if not isinstance(document, dict):
        raise AssetError(path, "the JSON chunk is no object")
    return document, found.get(b"BIN\0", b"")


class _Reader:
    """Looks things up in one document."""

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes) -> None:
        self.path, self.document, self.binary = path, document, binary

    def item(self, block: str, index: Any) -> dict[str, Any]:
        items = self.document.get(block, [])
        if not isinstance(index, int) or not isinstance(items, list) or not 0 <= index < len(items):
            raise AssetError(self.path, f"{block} {index} does not exist ({len(items)} are declared)")
        return items[index]

    def parts(self, materials: bool) -> list[MeshPart]:
        for name in self.document.get("extensionsRequired", []):
            if name in _COMPRESSED:
                raise AssetError(self.path, f"geometry compressed with {name} is not read; export it uncompressed")
        left_out = [name for name in ("animations", "skins", "cameras") if self.document.get(name)]
        left_out += [name for name in self.document.get("extensions", {})]
        parts, total = [], 0
        for node, matrix in self.nodes():
            if "mesh" not in node:
                continue
            mesh = self.item("meshes", node["mesh"])
            for number, primitive in enumerate(mesh["primitives"]):
                part = self.primitive(mesh, node, number, primitive, materials, left_out)
                if part is None:
                    continue
                total += len(part.vertices)
                if total > MAX_VERTICES:
                    raise AssetError(self.path, f"more than {MAX_VERTICES} vertices once nodes are placed")
                parts.append(transformed(part, matrix))
        return parts

    def nodes(self) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
        """Every node of the scene with its world matrix."""
        nodes = self.document.get("nodes", [])
        if "scenes" in self.document:
            roots = self.item("scenes", self.document.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in children]
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        seen: set[int] = set()
        while stack:
            index, parent = stack.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise AssetError(self.path, f"node {index} has two parents (nodes form a tree)")
            seen.add(index)
            matrix = parent @ self.local(node, index)
            yield node, matrix
            stack += [(child, matrix) for child in reversed(node.get("children", []))]

    def local(self, node: dict[str, Any], index: int) -> NDArray[np.float64]:
        if "matrix" in node:
            matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # stored by columns
        else:
            x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=np.float64)
            norm = x * x + y * y + z * z + w * w
            double = 2.0 / norm if norm > 0 else 0.0
            rotation = np.eye(3) + double * np.array(
                [
                    [-(y * y + z * z), x * y - z * w, x * z + y * w],
                    [x * y + z * w, -(x * x + z * z), y * z - x * w],
                    [x * z - y * w, y * z + x * w, -(x * x + y * y)],
                ]
            )
            matrix = np.eye(4)
            matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
            matrix[:3, 3] = node.get("translation", (0, 0, 0))
        if not np.isfinite(matrix).all():
            raise AssetError(self.path, f"node {index} has a transform that is not finite")
        return matrix

    def primitive(
        self, mesh: dict[str, Any], node: dict[str, Any], number: int, primitive: dict[str, Any],
        materials: bool, left_out: list[str],
    ) -> MeshPart | None:  # fmt: skip
        """One primitive as a part in its mesh's space; None for points and lines."""
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            left_out.append("points and lines")
            return None
        for name in primitive.get("extensions", {}):
            if name in _COMPRESSED:
                raise AssetError(self.path, f"geometry compressed with {name} is not read; export it uncompressed")
        attributes = primitive["attributes"]
        vertices = self.accessor(attributes["POSITION"], "VEC3")
        rows = {"NORMAL": "VEC3", "TEXCOORD_0": "VEC2"}
        normals, uvs = (self.accessor(attributes[k], w) if k in attributes else None for k, w in rows.items())
        for name, value in (("NORMAL", normals), ("TEXCOORD_0", uvs)):
            if value is not None and len(value) != len(vertices):
                raise AssetError(self.path, f"{name} has {len(value)} rows for {len(vertices)} vertices")
        if "indices" in primitive:
            index = self.accessor(primitive["indices"], "SCALAR").astype(np.int64).reshape(-1)
        else:
            index = np.arange(len(vertices))
        label = str(mesh.get("name") or node.get("name") or "")
        label = label if len(mesh["primitives"]) == 1 else f"{label}{number}"
        material = self.material(primitive["material"]) if materials and "material" in primitive else None
        ignored = list(left_out) + [name for name in attributes if name.startswith("COLOR_")]
        ignored += ["morph targets"] * bool(primitive.get("targets")) + ["skin"] * ("skin" in node)
        unique = tuple(dict.fromkeys(ignored))
        return MeshPart(label, vertices, _triangles(index, mode, self.path), normals, uvs, material, unique)

    def accessor(self, number: Any, kind: str) -> NDArray[np.float64]:
        """The rows of an accessor as ``(n, width)`` float64."""
        accessor = self.item("accessors", number)
        where = f"accessor {number}"
        if "sparse" in accessor:
            raise AssetError(self.path, f"{where} is sparse, which is not read")
        if accessor["type"] != kind or accessor["componentType"] not in _COMPONENTS:
            raise AssetError(self.path, f"{where} holds {accessor['type']}, expected {kind}")
        if "bufferView" not in accessor:
            raise AssetError(self.path, f"{where} has no data (no bufferView)")
        view = self.item("bufferViews", accessor["bufferView"])
        if view.get("buffer", 0) != 0 or "uri" in self.item("buffers", 0):
            raise AssetError(self.path, f"{where} lies outside the file; only the GLB's own buffer is read")
        component, width = np.dtype(_COMPONENTS[accessor["componentType"]]), _WIDTHS[kind]
        count, packed = accessor["count"], component.itemsize * width
        stride = view.get("byteStride", packed)
        offset, begin, length = accessor.get("byteOffset", 0), view.get("byteOffset", 0), view["byteLength"]
        if not all(type(x) is int and x >= 0 for x in (count, stride, offset, begin, length)):
            raise AssetError(self.path, f"{where} has a size that is no whole number >= 0")
        needed = offset + (count - 1) * stride + packed if count else 0
        if stride < packed or needed > length or begin + length > len(self.binary):
            raise AssetError(self.path, f"{where} reaches beyond its buffer: {count} elements of {packed} bytes")
        if not count:
            return np.zeros((0, width))
        raw = np.frombuffer(self.binary, np.uint8, needed - offset, begin + offset)
        rows = np.lib.stride_tricks.as_strided(raw, (count, packed), (stride, 1), writeable=False)
        values = np.ascontiguousarray(rows).view(component).astype(np.float64)
        if accessor.get("normalized") and component.kind in "iu":
            values = np.maximum(values / np.iinfo(component).max, -1.0)
        return values

    def material(self, number: Any) -> FileMaterial:
        """Base colour and emission; everything else by name."""
        material = self.item("materials", number)
        pbr = material.get("pbrMetallicRoughness", {})
        extensions = material.get("extensions", {})
        base = [float(x) for x in pbr.get("baseColorFactor", (1, 1, 1, 1))][:3]
        glow = [float(x) for x in material.get("emissiveFactor", (0, 0, 0))]
        strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1))
        if len(base) != 3 or not all(0 <= x <= 1 for x in base):
            raise AssetError(self.path, f"material {number}: baseColorFactor {base} is outside 0..1")
        emission = [x * strength for x in glow]
        if len(emission) != 3 or not all(0 <= x <= 3e38 for x in emission):
            raise AssetError(self.path, f"material {number}: emissiveFactor {glow} is not finite and >= 0")
        ignored = [key for block in (pbr, material) for key in block if key.endswith("Texture")]
        ignored += ["metallicFactor"] * (pbr.get("metallicFactor", 1) != 0)
        alpha = material.get("alphaMode", "OPAQUE")
        ignored += [f"alphaMode {alpha}"] * (alpha != "OPAQUE")
        ignored += [name for name in extensions if name != "KHR_materials_emissive_strength"]
        rgb = (base[0], base[1], base[2])
        light = (emission[0], emission[1], emission[2]) if any(emission) else None
        return FileMaterial(str(material.get("name") or f"material{number}"), rgb, light, tuple(ignored))


def _triangles(index: NDArray[np.int64], mode: int, path: Path) -> NDArray[np.int64]:
    """Index triples of a triangle list, strip or fan (glTF 2.0, 3.7.2.1)."""
    if mode == _TRIANGLES:
        if len(index) % 3:
            raise AssetError(path, f"{len(index)} indices are no whole number of triangles")
        return index.reshape(-1, 3)
    first = np.arange(max(len(index) - 2, 0))
    if mode == _FAN:
        return np.stack([index[first + 1], index[first + 2], np.broadcast_to(index[:1], first.shape)], axis=1)
    odd = first % 2
    return np.stack([index[first], index[first + 1 + odd], index[first + 2 - odd]], axis=1)
