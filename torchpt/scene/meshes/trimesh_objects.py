"""Convert trimesh objects to mesh parts, with their materials, lights and cameras.

Scenes with objects of trimesh, files that trimesh reads (:mod:`.trimesh_formats`) and :func:`torchpt.from_trimesh` use this
module. A ``trimesh.Scene`` has *geometries* by name, and a graph whose nodes place each of them any number of times. Its
materials and lights are written as those of glTF or MTL files, whose readers convert them.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage
from torchpt.images.decode import MAX_PIXELS
from torchpt.scene.meshes.gltf import MOST_PLACED
from torchpt.scene.meshes.gltf_document import Document
from torchpt.scene.meshes.gltf_lights import PUNCTUAL, light_at
from torchpt.scene.meshes.gltf_material import Materials
from torchpt.scene.meshes.mesh import (
    MOST_PARTS,
    FileCamera,
    FileLight,
    FileMaterial,
    MeshPart,
    checked,
    smooth_normals,
    too_many_parts,
    transformed,
)
from torchpt.scene.meshes.mtl_material import Map, Statements, material_of

__all__ = ["MaterialConverter", "Placed", "lights_of", "mesh_parts_of", "parts_of", "placed_in"]


# ---- Materials of trimesh objects: converted as those of glTF (``PBRMaterial``) and MTL (``SimpleMaterial``)


#: Attributes of ``PBRMaterial``, named as the keys of glTF: factors and images.
_FACTORS = ("metallicFactor", "roughnessFactor")
_PICTURES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
#: Keys of the block ``pbrMetallicRoughness`` of a glTF material.
_METALLIC_ROUGHNESS = (*_FACTORS, "baseColorFactor", "baseColorTexture", "metallicRoughnessTexture")
#: Pillow's modes that a PNG file holds.
_MODES = ("1", "L", "LA", "RGB", "RGBA", "I;16", "I")
#: Trimesh's defaults of ``SimpleMaterial``: the grey of its colours, and its exponent.
_DEFAULT_GREY, _DEFAULT_EXPONENT = (102, 102, 102, 255), 1.0


class MaterialConverter:
    """Converter of the materials of trimesh objects and their images; each is converted once.

    Args:
        label: name of the object in errors.
        wanted: False to leave out all materials.
    """

    def __init__(self, label: str, *, wanted: bool = True) -> None:
        self.label, self.wanted = label, wanted
        # By id of trimesh's object, which is stored too, since an id is unique only while its object lives. Materials also by
        # whether the vertices have colours; with them goes the colour (1, 3) by which those are multiplied, or None.
        self._materials: dict[tuple[int, bool], tuple[Any, FileMaterial | None, NDArray[np.float64] | None]] = {}
        self._pictures: dict[int, tuple[Any, EncodedImage]] = {}

    def convert(
        self, material: Any, colors: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """Return a material, and the vertex colours ``(V, 3)``, multiplied by the base colour where they take its place.

        Raises:
            AssetError: an unsupported image, or numbers out of range.
        """
        if not self.wanted:
            return None, colors
        key = id(material), colors is not None
        if key not in self._materials:
            # White in place of the vertex colours comes back as the colour that multiplies them.
            white = None if colors is None else np.ones((1, 3))
            is_simple = hasattr(material, "glossiness")  # of SimpleMaterial
            converted, tint = self._simple(material) if is_simple else self._physical(material, white)
            self._materials[key] = material, converted, tint
        _, converted, tint = self._materials[key]
        return converted, colors if colors is None or tint is None else colors * tint

    def _physical(
        self, material: Any, white: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """Convert a ``PBRMaterial`` or None by way of a glTF material; ``white (1, 3)``: vertex colours, or None without."""
        block: dict[str, Any] = {}
        images: dict[int, str | EncodedImage] = {}
        if material is not None:
            block = {"name": str(material.name or "material")}
            for key in (*_FACTORS, "alphaMode", "alphaCutoff"):
                if getattr(material, key) is not None:
                    block[key] = getattr(material, key)
            if material.baseColorFactor is not None:
                block["baseColorFactor"] = (np.asarray(material.baseColorFactor, np.float64) / 255.0).tolist()
            if material.emissiveFactor is not None:
                block["emissiveFactor"] = np.asarray(material.emissiveFactor, np.float64).tolist()
            for key in _PICTURES:
                picture = getattr(material, key)
                if picture is not None:
                    block[key] = {"index": len(images)}
                    images[len(images)] = self.picture(picture, key)
            block["pbrMetallicRoughness"] = {key: block.pop(key) for key in _METALLIC_ROUGHNESS if key in block}
        # A document of this one material, whose texture n is image n.
        count = len(images)
        document = {"materials": [block], "textures": [{"source": n} for n in range(count)], "images": [{}] * count}
        converter = Materials(Document(Path(self.label), json.dumps(document).encode()))
        converter.images = images
        return converter.convert(None if material is None else 0, white)

    def _simple(self, material: Any) -> tuple[FileMaterial, None]:
        """Convert a ``SimpleMaterial`` by way of the statements of an MTL file.

        Trimesh fills in a grey for missing colours; the same grey from a file cannot be told from it and counts as missing too.
        """
        statements = Statements()
        files: dict[str, Any] = {}
        for key, value in (("kd", material.diffuse), ("ks", material.specular)):
            if tuple(np.asarray(value).tolist()) != _DEFAULT_GREY:
                red, green, blue = (float(level) / 255.0 for level in value[:3])
                statements.colors[key] = red, green, blue
        if material.diffuse[3] < 255:
            statements.numbers["d"] = float(material.diffuse[3]) / 255.0
        if material.glossiness != _DEFAULT_EXPONENT:
            statements.numbers["ns"] = float(material.glossiness)
        if material.image is not None:
            statements.maps["map_kd"] = Map(key="map_Kd", name="", line=0)
            files["map_kd"] = self.picture(material.image, "image")
        converted, ignored = material_of(statements, files)
        extra = [str(key)[:80] for key in material.kwargs if key not in ("kd", "ka", "ks", "ns")]
        name = str(material.name or "material")[:80]
        return FileMaterial(name, converted, tuple(dict.fromkeys([*ignored, *extra]))), None

    def picture(self, image: Any, what: str) -> EncodedImage:
        """Encode a Pillow image (or an array) as a PNG file in memory, named by ``what`` and a hash of its content.

        Raises:
            AssetError: an image that is too large, broken, or of an unsupported mode.
        """
        if id(image) not in self._pictures:
            self._pictures[id(image)] = image, self._encoded(image, what)
        return self._pictures[id(image)][1]

    def _encoded(self, image: Any, what: str) -> EncodedImage:
        """Encode an image without the cache."""
        from PIL import Image

        try:
            pillow = image if hasattr(image, "save") else Image.fromarray(np.asarray(image))
            width, height = pillow.size
            if width * height > MAX_PIXELS:
                limit = f"more than {MAX_PIXELS / 2**20:g} Mpixel are not read"
                raise AssetError(self.label, f"{what}: {width} x {height} pixels: {limit}")
            if pillow.mode in ("P", "PA"):  # with a palette
                pillow = pillow.convert("RGBA" if pillow.mode == "PA" or "transparency" in pillow.info else "RGB")
            if pillow.mode not in _MODES:
                expected = "expected grey or RGB"
                raise AssetError(self.label, f"{what}: colours stored as {pillow.mode} are not read; {expected}")
            data = BytesIO()
            pillow.save(data, "PNG", compress_level=1)
        except AssetError:
            raise
        except Exception as error:
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
            raise AssetError(self.label, f"{what} cannot be read ({reason})") from None
        digest = hashlib.blake2b(data.getvalue(), digest_size=6).hexdigest()
        return EncodedImage(f"{what} {digest}", data.getvalue(), "png")


# ---- Meshes, scenes, lights and cameras of trimesh (https://trimesh.org)


Matrix = NDArray[np.float64]
#: A node of a scene: its name, the name of its geometry, and its ``(4, 4)`` to world space.
Placed = tuple[str, str, Matrix]


def mesh_parts_of(
    source: Any, label: str = "trimesh", *, materials: bool = True, most: int = MOST_PLACED
) -> list[MeshPart]:
    """Return the parts of a ``trimesh.Trimesh`` or ``trimesh.Scene``, one for each node and material, in world space.

    Normals are used where the mesh has them (set by the caller, or computed by trimesh before), as in trimesh's exporters. The
    object is neither changed nor kept.

    Args:
        source: the object.
        label: name of the object in errors.
        materials: True to read the object's own materials.
        most: limit of the vertices or faces over all nodes.

    Raises:
        AssetError: no triangle, numbers that are not finite, an index out of range, an unsupported image.
    """
    import trimesh

    converter = MaterialConverter(label, wanted=materials)
    if isinstance(source, trimesh.Trimesh):
        return checked(parts_of(source, "", converter), Path(label))
    if not isinstance(source, trimesh.Scene):
        raise AssetError(label, f"expected a trimesh.Trimesh or trimesh.Scene, got {type(source).__name__}")
    parts_by_geometry: dict[str, list[MeshPart]] = {}
    parts: list[MeshPart] = []
    total = 0
    for _, name, matrix in placed_in(source):
        geometry = source.geometry[name]
        total += max(len(geometry.vertices), len(geometry.faces))
        if total > most:
            raise AssetError(label, f"more than {most} vertices or faces once nodes are placed")
        if name not in parts_by_geometry:
            parts_by_geometry[name] = parts_of(geometry, str(name)[:80] if len(source.geometry) > 1 else "", converter)
        if len(parts) > MOST_PARTS:
            raise too_many_parts(Path(label))
        own = parts_by_geometry[name]
        parts += own if np.array_equal(matrix, np.eye(4)) else [transformed(part, matrix) for part in own]
    parts = checked(parts, Path(label))
    others = [
        f"{type(geometry).__name__} {name}"[:80]
        for name, geometry in source.geometry.items()
        if not _has_faces(geometry)
    ]
    lights, ignored = lights_of(source, label)
    first = parts[0]
    ignored = tuple(dict.fromkeys((*first.ignored, *others, *ignored)))
    first = replace(first, lights=tuple(lights), cameras=tuple(_cameras(source)), ignored=ignored)
    return [first, *parts[1:]]


def placed_in(scene: Any) -> Iterator[Placed]:
    """Yield the nodes of a ``trimesh.Scene`` that have a mesh, in the order of its graph."""
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name in scene.geometry and _has_faces(scene.geometry[name]):
            yield str(node), name, np.array(matrix, np.float64)


def _has_faces(geometry: Any) -> bool:
    """Return True for a geometry with faces, unlike points and paths."""
    return len(getattr(geometry, "faces", ())) > 0


def parts_of(mesh: Any, name: str, converter: MaterialConverter) -> list[MeshPart]:
    """Return the parts of a ``trimesh.Trimesh`` in its own space, one for each material; unchecked.

    Raises:
        AssetError: an index out of range, an unsupported image.
    """
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):  # before anything is looked up by them
        raise AssetError(converter.label, f"a face has an index outside 0..{len(vertices) - 1}")
    visual = mesh.visual
    normals: Matrix | None = None
    # As in trimesh's exporters: asked for normals that it does not have, trimesh would compute them from the faces.
    if "vertex_normals" in mesh._cache.cache:
        normals = np.array(mesh.vertex_normals, np.float64)
        normals = normals if normals.shape == vertices.shape else None
    if visual.kind == "face":
        # Split vertices, so that colours end at edges; normals stay those of the mesh.
        normals = smooth_normals(vertices, faces) if normals is None else normals
        corners = faces.reshape(-1)
        colors = np.repeat(_linear(visual.face_colors), 3, axis=0)
        material, colors = converter.convert(None, colors)
        faces = np.arange(len(corners)).reshape(-1, 3)
        return [
            MeshPart(
                name=name,
                vertices=vertices[corners],
                faces=faces,
                normals=normals[corners],
                uvs=None,
                colors=colors,
                material=material,
            )
        ]
    if visual.kind != "texture":
        colors = _linear(visual.vertex_colors) if visual.kind == "vertex" else None
        material, colors = converter.convert(None, colors)
        return [
            MeshPart(
                name=name, vertices=vertices, faces=faces, normals=normals, uvs=None, colors=colors, material=material
            )
        ]
    uvs = visual.uv
    if uvs is not None and len(uvs) == len(vertices) and uvs.shape[1] >= 2:
        uvs = np.stack((uvs[:, 0], 1.0 - uvs[:, 1]), axis=1).astype(np.float64)  # trimesh counts v from the bottom row
    else:
        uvs = None
    colors = mesh.vertex_attributes.get("color")
    colors = _linear(colors) if colors is not None and np.shape(colors)[:1] == (len(vertices),) else None
    several = getattr(visual.material, "materials", None)
    if several is None:
        material, colors = converter.convert(visual.material, colors)
        return [
            MeshPart(
                name=name, vertices=vertices, faces=faces, normals=normals, uvs=uvs, colors=colors, material=material
            )
        ]
    material_of_face = np.asarray(visual.face_materials)  # (F,) index into `several`
    parts = []
    for number, trimesh_material in enumerate(several):
        material, tinted = converter.convert(trimesh_material, colors)
        faces_of_material = faces[material_of_face == number]
        parts.append(
            MeshPart(
                name=f"{name}{number}",
                vertices=vertices,
                faces=faces_of_material,
                normals=normals,
                uvs=uvs,
                colors=tinted,
                material=material,
            )
        )
    return parts


def _linear(colors: Any) -> Matrix:
    """Return trimesh's colours, bytes or floats, as ``(n, 3)`` of 0..1; they are linear, as in glTF."""
    values = np.asarray(colors)[:, :3]
    return values / 255.0 if values.dtype.kind in "ui" else values.astype(np.float64)


def lights_of(scene: Any, label: str) -> tuple[list[FileLight], list[str]]:
    """Return the lights that were set on a ``trimesh.Scene`` (not those that trimesh makes up), and unsupported features.

    Raises:
        AssetError: a light without a transform in the graph, or numbers out of range.
    """
    lights: list[FileLight] = []
    left_out: list[str] = []
    for light in vars(scene).get("_lights") or ():  # the property `lights` would make some up
        try:
            placed, _ = scene.graph[light.name]  # matrix, and the name of a geometry
            matrix = np.array(placed, np.float64)
        except (KeyError, ValueError):
            raise AssetError(
                label, f"the light {light.name!r} has no place: scene.graph[light.name] = matrix"
            ) from None
        kind = type(light).__name__.removesuffix("Light").lower()
        color = (np.asarray(light.color, np.float64)[:3] / 255.0).tolist()
        block: dict[str, Any] = {"name": str(light.name), "type": kind, "color": color, "intensity": light.intensity}
        if kind == "spot":
            block["spot"] = {"innerConeAngle": light.innerConeAngle, "outerConeAngle": light.outerConeAngle}
        if light.radius is not None:
            block["range"] = light.radius
        # Trimesh's lights are those of glTF's extension: they are converted as a document of one light.
        text = json.dumps({"extensions": {PUNCTUAL: {"lights": [block]}}})
        node = {"extensions": {PUNCTUAL: {"light": 0}}}
        lights.append(light_at(Document(Path(label), text.encode()), node, matrix, left_out))
    return lights, left_out


def _cameras(scene: Any) -> Iterator[FileCamera]:
    """Yield the camera of a scene, if any, for users to copy."""
    if scene.has_camera:
        matrix = np.array(scene.camera_transform, np.float64)
        fov = float(scene.camera.fov[0])
        yield FileCamera(
            name=str(scene.camera.name), kind="perspective", matrix=matrix, film_text=f"fov: {fov:.6g}, fov_axis: x"
        )


class Notes(logging.Handler):
    """Context manager that collects trimesh's warnings in ``texts`` in place of stderr."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Append the message of a record."""
        self.texts.append(" ".join(record.getMessage().split())[:80])

    def __enter__(self) -> Notes:
        """Attach to trimesh's logger."""
        logging.getLogger("trimesh").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        """Detach from trimesh's logger."""
        logging.getLogger("trimesh").removeHandler(self)
