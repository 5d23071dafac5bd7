"""Read glTF 2.0, `.glb` and `.gltf`: triangles, materials, lights and cameras of all nodes, in world space.

Khronos glTF 2.0 specification. A *node* of the file places a mesh, light or camera in the tree of nodes; a mesh is a list of
*primitives* (here: lists of triangles with one material), and each becomes a part. An *accessor* is an array of the file's
binary data. :mod:`.gltf_document` validates the JSON and reads arrays, :mod:`.gltf_material` and :mod:`.gltf_lights` convert.
Unsupported features are listed by name in ``MeshPart.ignored``; a file that requires an unsupported extension is an error.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.scene.meshes.gltf_document import Document
from torchpt.scene.meshes.gltf_lights import PUNCTUAL, camera_at, light_at
from torchpt.scene.meshes.gltf_material import MATERIAL_EXTENSIONS, Materials
from torchpt.scene.meshes.mesh import MOST_PARTS, FileMaterial, MeshPart, too_many_parts, transformed

__all__ = ["load_gltf"]

#: Extensions that are read.
_READ_EXTENSIONS = {*MATERIAL_EXTENSIONS, "KHR_texture_transform", "KHR_mesh_quantization", PUNCTUAL}
#: Vertex attributes that are read.
_ATTRIBUTES = ("POSITION", "NORMAL", "TEXCOORD_0", "COLOR_0")
#: Values of `mode` of a primitive: those of OpenGL.
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Numbers of a node's matrix are below this, so that products of a few matrices are finite.
_LARGEST = 1e30
#: Limit of the vertices or faces, whichever are more, over all nodes of a file (or the file's bytes, where those are more).
MOST_PLACED = 20_000_000


def load_gltf(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return the primitives of a glTF file, one part each, in world space.

    Raises:
        AssetError: a truncated or malformed file, a missing buffer or image, or a required extension that is not supported.
    """
    return _Scene(Document(path, data), len(data)).parts(materials)


class _Scene:
    """Reader of the nodes of one document; ``size``: bytes of the file."""

    def __init__(self, document: Document, size: int) -> None:
        self.document, self.json, self.path = document, document.json, document.path
        # Many nodes may refer to one mesh: a small file must not take unlimited memory.
        self.max_placed = max(MOST_PLACED, size)
        self.materials = Materials(document)

    def parts(self, materials: bool) -> list[MeshPart]:
        """Return the primitives of all nodes in world space, with the file's lights and cameras on the first."""
        required = [name for name in self.json.get("extensionsRequired", []) if name not in _READ_EXTENSIONS]
        if required:
            raise AssetError(self.path, f"requires the extension {str(required[0])[:80]}, which is not read")
        nodes = list(self.nodes())
        cameras = [camera_at(self.document, node, matrix) for node, matrix in nodes if "camera" in node]
        cameras = tuple(camera for camera in cameras if camera is not None)
        left_out = [name for name in ("animations", "skins") if self.json.get(name)]
        if self.json.get("cameras") and not cameras:
            left_out.append("cameras")
        # The readers of materials and textures list their own extensions.
        elsewhere = ("KHR_materials_", "KHR_texture_", "EXT_texture_")
        used = [str(name) for name in (*self.json.get("extensionsUsed", []), *self.json.get("extensions", {}))]
        left_out += [name for name in used if name not in _READ_EXTENSIONS and not name.startswith(elsewhere)]
        lights = tuple(
            light_at(self.document, node, matrix, left_out)
            for node, matrix in nodes
            if PUNCTUAL in node.get("extensions", {})
        )
        placed = [(node, matrix) for node, matrix in nodes if "mesh" in node]
        total_size = total_parts = 0
        for node, _ in placed:  # before anything is read
            primitives = self.document.item("meshes", node["mesh"])["primitives"]
            total_size += sum(map(self.size, primitives))
            if total_size > self.max_placed:
                raise AssetError(self.path, f"more than {self.max_placed} vertices or faces once nodes are placed")
            total_parts += len(primitives)
            if total_parts > MOST_PARTS:
                raise too_many_parts(self.path)
        parts = []
        for node, matrix in placed:
            mesh = self.document.item("meshes", node["mesh"])
            for number, primitive in enumerate(mesh["primitives"]):
                part = self.primitive(mesh, node, number, primitive, materials, left_out)
                if part is not None:
                    parts.append(transformed(part, matrix))
        # Names of what the whole file lacks, known once all of it is read.
        parts = [replace(part, ignored=tuple(dict.fromkeys((*left_out, *part.ignored)))) for part in parts]
        # `checked` drops parts without faces, so lights and cameras go with the first other one.
        holder = next((number for number, part in enumerate(parts) if len(part.faces)), None)
        if holder is not None:
            parts[holder] = replace(parts[holder], lights=lights, cameras=cameras)
        return parts

    def size(self, primitive: dict[str, Any]) -> int:
        """Return a primitive's declared number of vertices or faces, whichever is larger; 0 where its accessor will raise."""

        def declared(accessor: Any) -> int:
            count = self.document.item("accessors", accessor).get("count")
            return count if type(count) is int and 0 < count <= self.max_placed else 0

        vertices = declared(primitive["attributes"]["POSITION"])
        indices = declared(primitive["indices"]) if "indices" in primitive else vertices
        # A strip or fan has nearly as many faces as indices.
        return max(vertices, indices // (3 if primitive.get("mode", _TRIANGLES) == _TRIANGLES else 1))

    def nodes(self) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
        """Yield every node of the scene with its world matrix."""
        nodes = self.json.get("nodes", [])
        if "scenes" in self.json:
            roots = self.document.item("scenes", self.json.get("scene", 0)).get("nodes", [])
        else:
            indices = range(len(nodes))
            children = {child for index in indices for child in self.document.item("nodes", index).get("children", [])}
            roots = [index for index in indices if index not in children]
        stack = [(index, np.eye(4)) for index in reversed(roots)]
        seen: set[int] = set()
        while stack:
            index, parent = stack.pop()
            node = self.document.item("nodes", index)
            if index in seen:
                raise AssetError(self.path, f"node {index} has two parents (nodes form a tree)")
            seen.add(index)
            matrix = parent @ self.local(node, index)
            yield node, matrix
            stack += [(child, matrix) for child in reversed(node.get("children", []))]

    def local(self, node: dict[str, Any], index: int) -> NDArray[np.float64]:
        """Return the matrix ``(4, 4)`` from a node's space to its parent's: ``matrix``, or translation, rotation and scale."""
        if "matrix" in node:
            matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # stored by columns
        else:
            # A quaternion x y z w; one of another length than 1 is normalized, one of length 0 is no rotation.
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
        if not (np.abs(matrix) < _LARGEST).all():  # False for NaN too
            raise AssetError(self.path, f"node {index} has a transform that is not finite")
        return matrix

    def primitive(
        self, mesh: dict[str, Any], node: dict[str, Any], number: int, primitive: dict[str, Any],
        materials: bool, left_out: list[str],
    ) -> MeshPart | None:  # fmt: skip
        """Return a primitive as a part in its mesh's space; None for points and lines.

        Args:
            mesh: the mesh, for its name.
            node: the node that places it.
            number: index of the primitive in the mesh.
            primitive: the primitive's object.
            materials: True to read its material.
            left_out: names of unsupported features of the file; gets further ones.
        """
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            left_out.append("points and lines")
            return None
        attributes = primitive["attributes"]
        read = self.document.accessor
        vertices = read(attributes["POSITION"], "VEC3")
        normals = read(attributes["NORMAL"], "VEC3") if "NORMAL" in attributes else None
        uvs = read(attributes["TEXCOORD_0"], "VEC2") if "TEXCOORD_0" in attributes else None
        rgba = read(attributes["COLOR_0"], "VEC3", "VEC4").clip(0.0, 1.0) if "COLOR_0" in attributes else None
        colors = None if rgba is None else rgba[:, :3]
        for name, value in (("NORMAL", normals), ("TEXCOORD_0", uvs), ("COLOR_0", colors)):
            if value is not None and len(value) != len(vertices):
                raise AssetError(self.path, f"{name} has {len(value)} rows for {len(vertices)} vertices")
        if "indices" in primitive:
            index = read(primitive["indices"], "SCALAR").astype(np.int64).reshape(-1)
        else:
            index = np.arange(len(vertices))
        faces = _triangles(index, mode, self.path)
        label = str(mesh.get("name") or node.get("name") or "")[:80]
        label = label if len(mesh["primitives"]) == 1 else f"{label}{number}"
        ignored = [str(name) for name in attributes if name not in (*_ATTRIBUTES, "TANGENT", "JOINTS_0", "WEIGHTS_0")]
        ignored += [str(name) for name in primitive.get("extensions", {})]
        if primitive.get("targets"):
            ignored.append("morph targets")
        if "skin" in node:
            ignored.append("skin")
        material: FileMaterial | None = None
        if materials:
            material, colors = self.materials.convert(primitive.get("material"), colors)
            block = self.document.item("materials", primitive["material"]) if "material" in primitive else {}
            translucent = block.get("alphaMode", "OPAQUE") != "OPAQUE"
            if translucent and rgba is not None and rgba.shape[1] == 4 and (rgba[:, 3] < 1.0).any():
                ignored.append("COLOR_0 (its alpha)")
            if "normalTexture" in block and uvs is not None and _any_mirrored(uvs, faces):
                ignored.append("normalTexture (its green channel where texture coordinates are mirrored)")
        return MeshPart(
            name=label,
            vertices=vertices,
            faces=faces,
            normals=normals,
            uvs=uvs,
            colors=colors,
            material=material,
            ignored=tuple(dict.fromkeys(ignored)),
            flat=normals is None,  # as the format wants it
        )


def _any_mirrored(uvs: NDArray[np.float64], faces: NDArray[np.int64]) -> bool:
    """Return True where texture coordinates ``(V, 2)``, whose v goes down, go round a face ``(F, 3)`` against its corners."""
    inside = faces[((faces >= 0) & (faces < len(uvs))).all(1)]
    a, b, c = (uvs[inside[:, k]] for k in range(3))
    (x, y), (u, v) = (b - a).T, (c - a).T
    return bool((x * v - y * u > 0).any())


def _triangles(index: NDArray[np.int64], mode: int, path: Path) -> NDArray[np.int64]:
    """Return the faces ``(F, 3)`` of a triangle list, strip or fan of indices (glTF 2.0, 3.7.2.1)."""
    if mode == _TRIANGLES:
        if len(index) % 3:
            raise AssetError(path, f"{len(index)} indices are no whole number of triangles")
        return index.reshape(-1, 3)
    first = np.arange(max(len(index) - 2, 0))  # of each face, the position in `index` where it begins
    if mode == _FAN:
        return np.stack([index[first + 1], index[first + 2], np.broadcast_to(index[:1], first.shape)], axis=1)
    odd = first % 2  # every other face of a strip has its last two vertices swapped
    return np.stack([index[first], index[first + 1 + odd], index[first + 2 - odd]], axis=1)
