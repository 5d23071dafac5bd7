"""Objects of trimesh as parts of a mesh, with their materials, lights and cameras."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator
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


# ---- Materials of trimesh objects: by the rules of glTF (``PBRMaterial``) and MTL (``SimpleMaterial``), which they come from


_FACTORS = ("metallicFactor", "roughnessFactor")
_PICTURES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
#: Keys of a glTF material that stand in its block ``pbrMetallicRoughness``.
_INNER = (*_FACTORS, "baseColorFactor", "baseColorTexture", "metallicRoughnessTexture")
#: Pillow's modes that a PNG file holds.
_MODES = ("1", "L", "LA", "RGB", "RGBA", "I;16", "I")
#: What trimesh says where a file says nothing: of ``SimpleMaterial``, the grey of its colours and its exponent.
_DEFAULT_GREY, _DEFAULT_EXPONENT = (102, 102, 102, 255), 1.0


class MaterialConverter:
    """The materials of trimesh objects, each made once, and their pictures.

    Args:
        label: what errors call their owner.
        wanted: whether there are to be any.
    """

    def __init__(self, label: str, wanted: bool = True) -> None:
        self.label, self.wanted = label, wanted
        # What an id belongs to is kept, so that it stays its own.
        self._materials: dict[tuple[int, bool], tuple[Any, FileMaterial | None, NDArray[np.float64] | None]] = {}
        self._pictures: dict[int, tuple[Any, EncodedImage]] = {}

    def of(
        self, material: Any, colors: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """A material, and the colours ``(V, 3)`` of the vertices with its own multiplied in where they stand for it.

        Raises:
            AssetError: a picture that cannot be used, numbers that no material has.
        """
        if not self.wanted:
            return None, colors
        key = id(material), colors is not None
        if key not in self._materials:
            one = None if colors is None else np.ones((1, 3))
            made, tint = self._simple(material) if hasattr(material, "glossiness") else self._physical(material, one)
            self._materials[key] = material, made, tint
        _, made, tint = self._materials[key]
        return made, colors if colors is None or tint is None else colors * tint

    def _physical(
        self, material: Any, one: NDArray[np.float64] | None
    ) -> tuple[FileMaterial | None, NDArray[np.float64] | None]:
        """A ``PBRMaterial``, or None: the block that a glTF file would have for it."""
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
            block["pbrMetallicRoughness"] = {key: block.pop(key) for key in _INNER if key in block}
        count = len(images)
        text = {"materials": [block], "textures": [{"source": n} for n in range(count)], "images": [{}] * count}
        rules = Materials(Document(Path(self.label), json.dumps(text).encode()))
        rules.images = images
        return rules.of(None if material is None else 0, one)

    def _simple(self, material: Any) -> tuple[FileMaterial, None]:
        """A ``SimpleMaterial``: the statements that an MTL file would have for it.

        Trimesh fills in a grey for colours that a file does not give, which cannot be told from the same grey given.
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
            statements.maps["map_kd"] = Map("map_Kd", "", 0)
            files["map_kd"] = self.picture(material.image, "image")
        made, ignored = material_of(statements, files)
        extra = [str(key)[:80] for key in material.kwargs if key not in ("kd", "ka", "ks", "ns")]
        name = str(material.name or "material")[:80]
        return FileMaterial(name, made, tuple(dict.fromkeys([*ignored, *extra]))), None

    def picture(self, image: Any, what: str) -> EncodedImage:
        """A picture of Pillow's (or an array) as a PNG file in memory. It is called after its content: equal ones are one.

        Raises:
            AssetError: too large, broken, or of colours that are not read.
        """
        if id(image) not in self._pictures:
            self._pictures[id(image)] = image, self._encoded(image, what)
        return self._pictures[id(image)][1]

    def _encoded(self, image: Any, what: str) -> EncodedImage:
        from PIL import Image

        try:
            pillow = image if hasattr(image, "save") else Image.fromarray(np.asarray(image))
            width, height = pillow.size
            if width * height > MAX_PIXELS:
                limit = f"more than {MAX_PIXELS / 2**20:g} Mpixel are not read"
                raise AssetError(self.label, f"{what}: {width} x {height} pixels: {limit}")
            if pillow.mode in ("P", "PA"):
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


# ---- Objects of trimesh (https://trimesh.org) as the parts that mesh files come to: meshes, scenes, their lights and cameras


Matrix = NDArray[np.float64]
#: A node of a scene: its name, the name of what it places, and its ``(4, 4)`` to the scene's space.
Placed = tuple[str, str, Matrix]


def mesh_parts_of(
    source: Any, label: str = "trimesh", *, materials: bool = True, most: int = MOST_PLACED
) -> list[MeshPart]:
    """What a ``trimesh.Trimesh`` or ``trimesh.Scene`` holds, one part for each node and material, in the scene's space.

    Normals are those that the mesh has (given to it, or asked of it before), as when trimesh writes a file. Nothing of the
    object is changed or kept.

    Args:
        source: the object.
        label: what errors call it.
        materials: whether to read its own materials.
        most: vertices or faces that the nodes may come to.

    Raises:
        AssetError: no triangle, numbers that are not finite, an index out of range, a picture that cannot be used.
    """
    import trimesh

    converter = MaterialConverter(label, materials)
    if isinstance(source, trimesh.Trimesh):
        return checked(parts_of(source, "", converter), Path(label))
    if not isinstance(source, trimesh.Scene):
        raise AssetError(label, f"expected a trimesh.Trimesh or trimesh.Scene, got {type(source).__name__}")
    known: dict[str, list[MeshPart]] = {}
    parts: list[MeshPart] = []
    total = 0
    for _, name, matrix in placed_in(source):
        geometry = source.geometry[name]
        total += max(len(geometry.vertices), len(geometry.faces))
        if total > most:
            raise AssetError(label, f"more than {most} vertices or faces once nodes are placed")
        if name not in known:
            known[name] = parts_of(geometry, str(name)[:80] if len(source.geometry) > 1 else "", converter)
        if len(parts) > MOST_PARTS:
            raise too_many_parts(Path(label))
        stays = np.array_equal(matrix, np.eye(4))
        parts += known[name] if stays else [transformed(part, matrix) for part in known[name]]
    parts = checked(parts, Path(label))
    others = [
        f"{type(geometry).__name__} {name}"[:80] for name, geometry in source.geometry.items() if not _solid(geometry)
    ]
    lights, ignored = lights_of(source, label)
    first = parts[0]
    ignored = tuple(dict.fromkeys((*first.ignored, *others, *ignored)))
    fields = {**vars(first), "lights": tuple(lights), "cameras": tuple(_cameras(source)), "ignored": ignored}
    return [MeshPart(**fields), *parts[1:]]


def placed_in(scene: Any) -> Iterator[Placed]:
    """The nodes of a ``trimesh.Scene`` that place meshes, in the order of its graph."""
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        if name in scene.geometry and _solid(scene.geometry[name]):
            yield str(node), name, np.array(matrix, np.float64)


def _solid(geometry: Any) -> bool:
    """Whether it has faces, unlike points and paths."""
    return len(getattr(geometry, "faces", ())) > 0


def parts_of(mesh: Any, name: str, converter: MaterialConverter) -> list[MeshPart]:
    """A ``trimesh.Trimesh`` in its own space, one part for each material; unchecked.

    Raises:
        AssetError: an index out of range, a picture that cannot be used.
    """
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):  # before anything is looked up by them
        raise AssetError(converter.label, f"a face has an index outside 0..{len(vertices) - 1}")
    visual = mesh.visual
    normals: Matrix | None = None
    if "vertex_normals" in mesh._cache.cache:  # as trimesh's exporters tell: else they are made up from the faces
        normals = np.array(mesh.vertex_normals, np.float64)
        normals = normals if normals.shape == vertices.shape else None
    if visual.kind == "face":
        # Every corner of its own, so that colours end at edges; the shading stays that of the mesh.
        normals = smooth_normals(vertices, faces) if normals is None else normals
        corners = faces.reshape(-1)
        colors = np.repeat(_linear(visual.face_colors), 3, axis=0)
        material, colors = converter.of(None, colors)
        faces = np.arange(len(corners)).reshape(-1, 3)
        return [MeshPart(name, vertices[corners], faces, normals[corners], None, colors, material)]
    if visual.kind != "texture":
        colors = _linear(visual.vertex_colors) if visual.kind == "vertex" else None
        material, colors = converter.of(None, colors)
        return [MeshPart(name, vertices, faces, normals, None, colors, material)]
    uvs = visual.uv
    if uvs is not None and len(uvs) == len(vertices) and uvs.shape[1] >= 2:
        uvs = np.stack((uvs[:, 0], 1.0 - uvs[:, 1]), axis=1).astype(np.float64)  # trimesh counts v from the bottom row
    else:
        uvs = None
    colors = mesh.vertex_attributes.get("color")
    colors = _linear(colors) if colors is not None and np.shape(colors)[:1] == (len(vertices),) else None
    several = getattr(visual.material, "materials", None)
    if several is None:
        material, colors = converter.of(visual.material, colors)
        return [MeshPart(name, vertices, faces, normals, uvs, colors, material)]
    which = np.asarray(visual.face_materials)
    parts = []
    for number, each in enumerate(several):
        material, tinted = converter.of(each, colors)
        parts.append(MeshPart(f"{name}{number}", vertices, faces[which == number], normals, uvs, tinted, material))
    return parts


def _linear(colors: Any) -> Matrix:
    """Colours ``(n, 3)`` of 0..1, of trimesh's bytes (or floats); they are linear, as in glTF."""
    values = np.asarray(colors)[:, :3]
    return values / 255.0 if values.dtype.kind in "ui" else values.astype(np.float64)


def lights_of(scene: Any, label: str) -> tuple[list[FileLight], list[str]]:
    """The lights that a ``trimesh.Scene`` was given (it makes up others where it is asked), and what of them is not used.

    Raises:
        AssetError: a light that has no place in the graph, or numbers that none can have.
    """
    lights: list[FileLight] = []
    left_out: list[str] = []
    for light in vars(scene).get("_lights") or ():
        try:
            matrix = np.array(scene.graph[light.name][0], np.float64)
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
        text = json.dumps({"extensions": {PUNCTUAL: {"lights": [block]}}})
        node = {"extensions": {PUNCTUAL: {"light": 0}}}
        lights.append(light_at(Document(Path(label), text.encode()), node, matrix, left_out))
    return lights, left_out


def _cameras(scene: Any) -> Iterator[FileCamera]:
    """The camera of a scene that has one, for users to copy."""
    if scene.has_camera:
        matrix = np.array(scene.camera_transform, np.float64)
        fov = float(scene.camera.fov[0])
        yield FileCamera(str(scene.camera.name), "perspective", matrix, f"fov: {fov:.6g}, fov_axis: x")


class Notes(logging.Handler):
    """What trimesh warns of, as a list rather than on stderr. A context."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one."""
        self.texts.append(" ".join(record.getMessage().split())[:80])

    def __enter__(self) -> Notes:
        """Listen."""
        logging.getLogger("trimesh").addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop listening."""
        logging.getLogger("trimesh").removeHandler(self)
