"""From a description to parts and parameters: files are read, names resolved, what cannot be hit is dropped and counted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.errors import AssetError, SceneError
from torchpt.format.description import Description
from torchpt.format.materials import MATERIALS, Diffuse, check_material, read_material, resolved
from torchpt.format.schema import Cone, Cube, Cylinder, Disk, Displacement, Instance, Mesh, Rectangle, Shape, Sphere
from torchpt.lights import order
from torchpt.math.transforms import WITHIN, is_usable, similarity_scale
from torchpt.meshes import FileCamera, FileMaterial, MeshPart, load_mesh, unit_cube
from torchpt.meshes.displacement import displaced
from torchpt.records import KINDS
from torchpt.scene.parameters import Parameters
from torchpt.scene.parts import Copy, Part, Source
from torchpt.scene.sources import file_lights, labels_of, sources_of
from torchpt.scene.space import centre_and_unit
from torchpt.scene.texels import Opener
from torchpt.textures import Node

__all__ = ["Built", "build_parts"]


@dataclass(frozen=True)
class Built:
    """Parts in the order of ``records.KINDS``, their parameters, and the lanes' own coordinates (:mod:`torchpt.scene.space`).

    Attributes:
        parts: what can be hit.
        parameters: arrays by dotted name.
        centre: ``(3,)`` float64, subtracted from all positions.
        unit: what all lengths are divided by.
        sources: lights that are no surfaces, in the order of ``lights.order``.
        copies: instances of parts.
    """

    parts: tuple[Part, ...]
    parameters: Parameters
    centre: np.ndarray
    unit: float
    sources: tuple[Source, ...] = ()
    copies: tuple[Copy, ...] = ()


def build_parts(description: Description) -> Built:
    """Resolve a description.

    Raises:
        SceneError: more than one environment, a shape that cannot be placed, or sizes too far apart for float32.
        AssetError: a mesh file that is missing or malformed.
    """
    parameters = Parameters()
    parts: list[Part] = []
    found: list[Source] = []
    opener = Opener(description.textures, description.resolve, parameters, description.file)
    for number, (name, shape) in enumerate(description.shapes.items(), 1):
        if not isinstance(shape, Instance):
            parts += _shape_parts(description, name, shape, number, parameters, opener, found)
    copies: list[Copy] = []
    for number, (name, shape) in enumerate(description.shapes.items(), 1):
        if isinstance(shape, Instance):
            copies += _copies(description, name, shape, number, parts, parameters, opener)
    for name, material in description.materials.items():
        _declare(resolved(material, f"materials.{name}", description.materials, opener), parameters)
    sources = sorted([*sources_of(description, parameters), *found], key=lambda source: order(source.kind))
    parameters["camera.to_world"] = np.asarray(description.camera.pose(), np.float64)
    for name, number in description.camera.numbers().items():
        parameters[f"camera.{name}"] = np.asarray(number, np.float64)
    parts.sort(key=lambda part: KINDS.index(part.kind))
    centre, unit = centre_and_unit(parts, copies, sources, parameters, description.camera, description.file)
    return Built(tuple(parts), parameters, centre, unit, tuple(sources), tuple(copies))


def _copies(
    description: Description,
    name: str,
    shape: Instance,
    number: int,
    parts: list[Part],
    parameters: Parameters,
    opener: Opener,
) -> list[Copy]:
    """An instance, as one copy of each part of its mesh."""
    key, file = f"shapes.{name}", description.file
    mesh = description.shapes.get(shape.of)
    if not isinstance(mesh, Mesh | Cube):
        names = [other for other, value in description.shapes.items() if isinstance(value, Mesh | Cube)]
        known = f" ({', '.join(names[:8])}{', ...' if len(names) > 8 else ''})" if names else " (there is none)"
        raise SceneError(f"{key}.of", shape.of, f"the name of a mesh among the shapes{known}", file)
    parameters[f"{key}.to_world"] = shape.to_world()
    if not is_usable(shape.to_world() @ np.linalg.inv(mesh.to_world())):
        expected = f"a way from where {shape.of} lies to where it is copied that can be inverted, {WITHIN}"
        raise SceneError(f"{key}.transform", shape.to_world().tolist(), expected, file)
    found = []
    for part in (part for part in parts if part.shape == shape.of):
        slot = part.material
        if isinstance(shape.material, str):
            slot = resolved(
                description.materials[shape.material], f"materials.{shape.material}", description.materials, opener
            )
        elif shape.material is not None:
            slot = resolved(shape.material, f"{key}.material", description.materials, opener)
        if slot.emission is not None:
            raise SceneError(f"{key}.material", slot.name, "a material that does not emit: an instance cannot", file)
        _declare(slot, parameters)
        flip = shape.flip_normals != part.flip
        found.append(Copy(key, name, number, part.name, slot, flip, parameters[f"{key}.to_world"]))
    return found


def _declare(slot: ResolvedMaterial, parameters: Parameters) -> None:
    parameters.update({name: np.asarray(value, np.float64) for name, value in slot.numbers().items()})


def _shape_parts(
    description: Description,
    name: str,
    shape: Shape,
    number: int,
    parameters: Parameters,
    opener: Opener,
    sources: list[Source],
) -> list[Part]:
    """A shape as parts; lights that its file has beside them go to ``sources``."""
    prefix = f"shapes.{name}"
    pose = shape.to_world()
    if not isinstance(shape, Mesh | Cube):
        if isinstance(shape, Sphere | Cylinder | Cone):
            with np.errstate(over="ignore", invalid="ignore"):
                pose = pose @ shape.own()
            if not is_usable(pose):
                expected = f"sizes that differ by less than 1e12, and a place: {WITHIN}"
                raise SceneError(prefix, pose.tolist(), expected, description.file)
        parameters[f"{prefix}.to_world"] = pose
        slot = _slot(description, shape, prefix, opener)
        return [
            _part(
                shape, prefix, name, number, kind, pose if local is None else pose @ local, None, parameters, slot,
                local=local, quadric=quadric, label=label,
            )
            for kind, quadric, local, label in _surfaces(shape, pose)
        ]  # fmt: skip
    if isinstance(shape, Cube):
        pieces, source, flat = [unit_cube()], "", True
    elif shape.path is None:
        assert shape.vertices is not None and shape.faces is not None
        piece = MeshPart("", shape.vertices, shape.faces, shape.normals, shape.uvs, None)
        pieces, source, flat = [piece], "", shape.face_normals
    else:
        path = description.resolve(shape.path, f"{prefix}.path")
        pieces, source, flat = load_mesh(path, materials=shape.material is None), str(path), shape.face_normals
    if isinstance(shape, Mesh) and shape.displacement is not None:
        pieces = [_displaced(piece, shape.displacement, prefix, opener, source) for piece in pieces]
    lights = [light for piece in pieces for light in piece.lights]
    sources += file_lights(lights, prefix, pose, source, parameters)
    labels = labels_of([piece.name for piece in pieces])
    parts: list[Part] = []
    known: dict[int, ResolvedMaterial] = {}
    for piece, label in zip(pieces, labels, strict=True):
        stem = prefix if len(pieces) == 1 else f"{prefix}.{label}"
        parameters[f"{stem}.vertices"] = np.asarray(piece.vertices, np.float64)
        parameters[f"{stem}.to_world"] = pose
        own = piece.material if shape.material is None else None
        if own is None:
            slot = _slot(description, shape, stem, opener)
        elif id(own) in known:  # parts of one material share its row and its textures
            slot = known[id(own)]
        else:
            slot = known[id(own)] = _own_slot(own, prefix, f"{stem}.material", source, opener)
        part = _part(shape, stem, name, number, "triangle", pose, piece, parameters, slot, flat=flat, source=source)
        parts.append(part)
    if all(len(part.faces) == 0 for part in parts if part.faces is not None):
        problem = "every face is degenerate (without area)"
        if source:
            raise AssetError(source, f"{problem}, named by {prefix}.path")
        raise SceneError(f"{prefix}.faces", "no face with area", "a face with area", description.file)
    return parts


#: Faces that a displaced mesh may come to.
MOST_FACES = 20_000_000


def _displaced(piece: MeshPart, wish: Displacement, prefix: str, opener: Opener, source: str) -> MeshPart:
    """A piece of a mesh under its displacement map."""
    key = f"{prefix}.displacement"
    if piece.uvs is None:
        problem = f"has no texture coordinates, which {key} needs"
        raise (
            AssetError(source, problem)
            if source
            else SceneError(key, "a mesh without uvs", "uvs beside it", opener.file)
        )
    faces = len(piece.faces) * 4**wish.subdivisions
    if faces > MOST_FACES:
        expected = f"at most {MOST_FACES:,} faces ({faces:,} are asked for)"
        raise SceneError(f"{key}.subdivisions", wish.subdivisions, expected, opener.file)
    heights = opener.values(wish.texture, f"{key}.texture")
    return displaced(piece, lambda uvs: wish.scale * heights(uvs), wish.subdivisions)


#: From the unit disk to the caps of a cylinder's and a cone's own space, facing outward.
_TOP = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
_BOTTOM = np.diag([1.0, -1.0, -1.0, 1.0])


def _surfaces(shape: Shape, pose: np.ndarray) -> list[tuple[str, str, np.ndarray | None, str]]:
    """The primitives of an analytic shape: kind, quadric, placement before the shape's own, and name within the shape."""
    if isinstance(shape, Sphere):
        return (
            [("sphere", "", None, "")] if similarity_scale(pose) is not None else [("quadric", "ellipsoid", None, "")]
        )
    if not isinstance(shape, Cylinder | Cone):
        return [({Rectangle: "rectangle", Disk: "disk"}[type(shape)], "", None, "")]
    caps = {"bottom": _BOTTOM} if isinstance(shape, Cone) else {"bottom": _BOTTOM, "top": _TOP}
    side = [("quadric", shape.type, None, "side" if shape.capped else "")]
    return side + ([("disk", "", local, name) for name, local in caps.items()] if shape.capped else [])


def _slot(description: Description, shape: Shape, prefix: str, opener: Opener) -> ResolvedMaterial:
    """The material that the scene gives a shape, or the grey of one that has none."""
    given, known = shape.material, description.materials
    if isinstance(given, str):
        return resolved(known[given], f"materials.{given}", known, opener)
    return resolved(Diffuse() if given is None else given, f"{prefix}.material", known, opener)


def _own_slot(own: FileMaterial, prefix: str, key: str, source: str, opener: Opener) -> ResolvedMaterial:
    """A mesh file's own material.

    Raises:
        AssetError: something that a material cannot have; it names the file and the material.
    """
    try:
        material = read_material(own.material, key, MATERIALS, None)
        check_material(material, key, {}, {}, None)
        return resolved(material, key, {}, opener.sharing(f"{prefix}.textures"))
    except SceneError as error:
        raise AssetError(source, f"material {own.name[:80]!r}: {error}") from None


def _part(
    shape: Shape,
    prefix: str,
    name: str,
    number: int,
    kind: str,
    pose: np.ndarray,
    piece: MeshPart | None,
    parameters: Parameters,
    slot: ResolvedMaterial,
    *,
    flat: bool = True,
    source: str = "",
    local: np.ndarray | None = None,
    quadric: str = "",
    label: str = "",
) -> Part:
    _declare(slot, parameters)
    emission, names = shape.emission, (f"shapes.{name}.emission",)
    emission_texture = slot.emission if emission is None and isinstance(slot.emission, Node) else None
    if emission_texture is not None:
        emission, names = (1.0, 1.0, 1.0), (f"{slot.name}.emission_strength",)
    elif emission is None and isinstance(slot.emission, tuple):
        emission, names = slot.emission, (f"{slot.name}.emission", f"{slot.name}.emission_strength")
    if emission is not None and names[0] not in parameters:
        parameters[names[0]] = np.asarray(emission, np.float64)
    faces, dropped = _solid(piece, pose) if piece is not None else (None, 0)
    return Part(
        name=prefix,
        shape=name,
        object_id=number,
        kind=kind,
        material=slot,
        emission=emission,
        emission_names=names if emission is not None else (),
        emission_texture=emission_texture,
        flip=shape.flip_normals,
        to_world=pose,
        local=local,
        quadric=quadric,
        piece=label,
        vertices=None if piece is None else piece.vertices,
        faces=faces,
        normals=None if piece is None or flat else piece.normals,
        uvs=None if piece is None else piece.uvs,
        colors=None if piece is None else piece.colors,
        smooth=not flat,
        dropped=dropped,
        source=source,
        ignored=_ignored(piece, pose),
    )


def _ignored(piece: MeshPart | None, pose: np.ndarray) -> tuple[str, ...]:
    """What of a mesh file is not used; cameras as a scene file would have them."""
    if piece is None:
        return ()
    own = piece.material
    cameras = [_as_written(camera, pose) for camera in piece.cameras]
    return (*piece.ignored, *cameras, *(() if own is None else own.ignored))


def _as_written(camera: FileCamera, pose: np.ndarray) -> str:
    """A mesh file's camera as the block of a scene file, mesh under ``pose``."""
    with np.errstate(over="ignore", invalid="ignore"):
        matrix = pose @ camera.matrix
        origin, ahead, up = matrix[:3, 3], -matrix[:3, 2], matrix[:3, 1]
        target, up = (origin + ahead / np.linalg.norm(ahead), up / np.linalg.norm(up))
    places = {"origin": origin, "target": target, "up": up}
    rows = ", ".join(f"{key}: [{', '.join(f'{x + 0.0:.6g}' for x in value)}]" for key, value in places.items())
    return f"camera {camera.name}: {{type: {camera.kind}, {rows}, {camera.film}}}"


def _solid(piece: MeshPart, pose: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces that have an area, and how many do not."""
    columns = pose[:3, :3] @ piece.vertices.T
    p0, p1, p2 = (columns[:, piece.faces[:, k]] for k in range(3))
    # Relative to the longest edge, so that neither tiny nor huge meshes are mistaken for degenerate ones.
    longest = np.maximum(np.abs(p1 - p0), np.abs(p2 - p0)).max(0)
    safe = np.where(longest > 0, longest, 1.0)
    (ax, ay, az), (bx, by, bz) = (p1 - p0) / safe, (p2 - p0) / safe
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    solid = (longest > 0) & (square > 1e-24)
    return np.ascontiguousarray(piece.faces[solid]), int((~solid).sum())
