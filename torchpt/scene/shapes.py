"""Build the parts of shapes: resolve materials, read files, declare parameters.

:func:`torchpt.scene.build.build_parts` calls :class:`ShapeBuilder`. A *part* is a set of primitives of one kind with one
material, a *copy* an instance of a part. To *resolve* a material is to open its textures and build its BSDF; to *declare* a
parameter is to add it to ``scene.params`` by dotted name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchpt.core.errors import AssetError, EmptyMeshError, ImportedSceneWarning, SceneError, warn_caller
from torchpt.math.transforms import FINITE_WORDS, is_usable
from torchpt.physics.bsdfs import KINDS as BSDFS
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Copy, Parameters, Part, Source
from torchpt.physics.shapes.base import Surface, Triangles
from torchpt.physics.shapes.primitive import PRIMITIVES
from torchpt.physics.textures import Node
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.materials import check_material, plain_material, read_material
from torchpt.scene.materials import declare, resolved
from torchpt.scene.mesh_triangles import Mesh, faces_with_area, ignored_features, mesh_of
from torchpt.scene.meshes import FileMaterial, MeshPart
from torchpt.scene.sizes import size_keys
from torchpt.scene.sources import build_file_lights, unique_labels
from torchpt.scene.texture_loader import TextureLoader
from torchpt.spec import Pose, Vertices, parameters_of
from torchpt.spec.schema import ParsedParams

__all__ = ["ShapeBuilder", "ShapeEntry"]

#: Most names that a warning lists.
MOST_SHOWN = 8


@dataclass(frozen=True)
class ShapeEntry:
    """A shape of the scene, whose parts are built.

    Attributes:
        name: name in the scene.
        number: place in the order of the scene's shapes, from 1; lanes have it as object id.
        shape: the kind and its values.
    """

    name: str
    number: int
    shape: ParsedParams

    @property
    def key(self) -> str:
        """Return the dotted key of the shape."""
        return f"shapes.{self.name}"

    @property
    def to_world(self) -> np.ndarray:
        """Return the transform ``(4, 4)`` from the shape's space to the scene."""
        return self.shape.kind.to_world(self.shape.values)


class ShapeBuilder:
    """Builder of the parts of shapes.

    Attributes:
        sources: lights of mesh files, in the order of shapes.
        empty: names of the meshes that are left out, as none of their faces has an area.
    """

    def __init__(self, description: Description, parameters: Parameters, texture_loader: TextureLoader) -> None:
        self.description, self.parameters, self.texture_loader = description, parameters, texture_loader
        self.sources: list[Source] = []
        self.empty: list[str] = []
        self._named_materials: dict[str, ResolvedMaterial] = {}
        self._declared: set[int] = set()  # ids of the materials whose parameters are declared

    def parts(self, entry: ShapeEntry) -> list[Part]:
        """Return the parts of a shape other than an instance."""
        # Kinds of shapes are `meshed` (triangles) or a few primitives, for which `triangles` returns None.
        triangles = entry.shape.kind.triangles(entry.shape.values)
        return self._primitives(entry) if triangles is None else self._meshes(entry, triangles)

    def copies(self, entry: ShapeEntry, parts: list[Part]) -> list[Copy]:
        """Return the copies of an instance, one for each of the ``parts`` of its mesh."""
        key, file, shapes = entry.key, self.description.file, self.description.shapes
        mesh_name, own_material = entry.shape["of"], entry.shape["material"]
        mesh = shapes.get(mesh_name)
        if mesh is None or not mesh.kind.meshed:
            names = [other for other, value in shapes.items() if value.kind.meshed]
            known = f" ({', '.join(names[:8])}{', ...' if len(names) > 8 else ''})" if names else " (there is none)"
            raise SceneError(f"{key}.of", mesh_name, f"the name of a mesh among the shapes{known}", file)
        self.parameters.declare(f"{key}.to_world", entry.to_world, Pose())
        if not is_usable(entry.to_world @ np.linalg.inv(mesh.kind.to_world(mesh.values))):
            expected = f"a way from where {mesh_name} lies to where it is copied that can be inverted, {FINITE_WORDS}"
            raise SceneError(f"{key}.transform", entry.to_world.tolist(), expected, file)
        copies = []
        for part in (part for part in parts if part.shape == mesh_name):
            material = part.material if own_material is None else self._material(own_material, key)
            if material.emission is not None:
                raise SceneError(
                    f"{key}.material", material.name, "a material that does not emit: an instance cannot", file
                )
            declare(material, self.parameters)
            flip = entry.shape["flip_normals"] != part.flip  # relative to the part
            pose = self.parameters[f"{key}.to_world"]
            copies.append(
                Copy(
                    name=key,
                    shape=entry.name,
                    object_id=entry.number,
                    of=part.name,
                    material=material,
                    flip=flip,
                    to_world=pose,
                )
            )
        return copies

    def _primitives(self, entry: ShapeEntry) -> list[Part]:
        """Return the parts of a shape of primitives, which share its pose."""
        shape, pose = entry.shape, entry.to_world
        own_map = shape.kind.own(shape.values)  # (4, 4) by sizes and positions such as `radius`; None: the identity
        if own_map is not None:
            with np.errstate(over="ignore", invalid="ignore"):  # `is_usable` finds what is not finite
                pose = pose @ own_map
            if not is_usable(pose):
                expected = f"sizes that differ by less than 1e12, and a place: {FINITE_WORDS}"
                raise SceneError(entry.key, pose.tolist(), expected, self.description.file)
        surfaces = shape.kind.surfaces(shape.values, pose)
        self._declare_pose(entry.key, pose, surfaces)
        for key in size_keys(shape.kind):
            self.parameters.declare(f"{entry.key}.{key}", shape[key], parameters_of(shape.kind)[key])
        material = self._material(shape["material"], entry.key)
        return [
            self._part(entry, entry.key, material, surface, pose if surface.local is None else pose @ surface.local)
            for surface in surfaces
        ]

    def _declare_pose(self, stem: str, pose: np.ndarray, surfaces: list[Surface]) -> None:
        """Declare ``STEM.to_world``; some kinds of primitives accept only poses that keep angles."""
        angles = any(PRIMITIVES[surface.kind].needs_similarity for surface in surfaces)
        self.parameters.declare(f"{stem}.to_world", pose, Pose(angles=angles))

    def _meshes(self, entry: ShapeEntry, triangles: Triangles) -> list[Part]:
        """Return the parts of a mesh, one for each material of its file."""
        shape, pose = entry.shape, entry.to_world
        own_materials = shape["material"] is None
        try:
            mesh = mesh_of(triangles, entry.key, self.description, self.texture_loader, materials=own_materials)
        except EmptyMeshError:
            if not self.description.allows_empty_meshes:
                raise
            self.empty.append(entry.name)
            return []
        faces = [faces_with_area(piece, pose) for piece in mesh.pieces]
        if self.description.allows_empty_meshes and not any(len(kept) for kept, _ in faces):
            self.empty.append(entry.name)
            return []
        lights = [light for piece in mesh.pieces for light in piece.lights]
        self.sources += build_file_lights(lights, entry.key, pose, mesh.source, self.parameters)
        labels = unique_labels([piece.name for piece in mesh.pieces])
        parts: list[Part] = []
        file_materials: dict[int, ResolvedMaterial] = {}  # by id of the file's record
        for piece, label, kept in zip(mesh.pieces, labels, faces, strict=True):
            stem = entry.key if len(mesh.pieces) == 1 else f"{entry.key}.{label}"
            self.parameters.declare(f"{stem}.vertices", piece.vertices, Vertices())
            self._declare_pose(stem, pose, [])
            own = piece.material if shape["material"] is None else None
            if own is None:
                material = self._material(shape["material"], stem)
            elif id(own) in file_materials:  # parts of one material share its parameters and textures
                material = file_materials[id(own)]
            else:
                material = self._file_material(own, entry.key, f"{stem}.material", mesh.source)
                file_materials[id(own)] = material
            part = self._part(entry, stem, material, Surface("triangle"), pose)
            parts.append(_with_triangles(part, piece, mesh, *kept))
        if all(len(part.faces) == 0 for part in parts if part.faces is not None):
            problem = "every face is degenerate (without area)"
            if mesh.source:
                raise AssetError(mesh.source, f"{problem}, named by {entry.key}.path")
            raise SceneError(f"{entry.key}.faces", "no face with area", "a face with area", self.description.file)
        return parts

    def warn_of_empty_meshes(self) -> None:
        """Warn of the meshes that were left out.

        Warns:
            ImportedSceneWarning: once for all of them.
        """
        if self.empty:
            shown = ", ".join(self.empty[:MOST_SHOWN]) + (", ..." if len(self.empty) > MOST_SHOWN else "")
            text = f"meshes without a face that has an area are left out: {shown} ({len(self.empty)} in all)"
            warn_caller(f"{self.description.file}: {text}", ImportedSceneWarning)

    def _material(self, given: Any, stem: str) -> ResolvedMaterial:
        """Return the material of a shape: a named one, one in place, or the default grey.

        Args:
            given: the value of the shape's key ``material``: a name, a parsed material, or None.
            stem: dotted prefix of the part's parameters.
        """
        known = self.description.materials
        if isinstance(given, str):
            if given not in self._named_materials:
                self._named_materials[given] = resolved(known[given], f"materials.{given}", known, self.texture_loader)
            return self._named_materials[given]
        return resolved(plain_material() if given is None else given, f"{stem}.material", known, self.texture_loader)

    def _file_material(self, own: FileMaterial, prefix: str, key: str, source: str) -> ResolvedMaterial:
        """Return a mesh file's own material.

        Args:
            own: the record of the file's reader.
            prefix: dotted key of the shape; images are named ``PREFIX.textures.FILE``.
            key: dotted prefix of the material's parameters.
            source: the file.

        Raises:
            AssetError: a wrong key or value; names the file and the material.
        """
        try:
            material = read_material(own.material, key=key, types=BSDFS, file=None)
            check_material(material, key=key, materials={}, textures={}, file=None)
            return resolved(material, key, {}, self.texture_loader.sharing(f"{prefix}.textures"))
        except SceneError as error:
            raise AssetError(source, f"material {own.name[:80]!r}: {error}") from None

    def _part(
        self, entry: ShapeEntry, stem: str, material: ResolvedMaterial, surface: Surface, pose: np.ndarray
    ) -> Part:
        """Return the part of a surface, without triangles, and declare its emission and the parameters of its material.

        Emission is that of the shape, else that of the material; ``names`` are its parameters: radiance and strength.
        """
        named = self._named_materials.get(material.name.removeprefix("materials."))
        if material is not named or id(material) not in self._declared:
            declare(material, self.parameters)
            self._declared.add(id(material))
        emission, names = entry.shape["emission"], (f"{entry.key}.emission",)
        texture = material.emission if emission is None and isinstance(material.emission, Node) else None
        if emission is not None and names[0] not in self.parameters:
            self.parameters.declare(names[0], emission, parameters_of(entry.shape.kind)["emission"])
        if texture is not None:
            emission, names = (1.0, 1.0, 1.0), (f"{material.name}.emission_strength",)
        elif emission is None and isinstance(material.emission, tuple):
            emission, names = material.emission, (f"{material.name}.emission", f"{material.name}.emission_strength")
        if emission is not None and names[0] not in self.parameters:
            self.parameters[names[0]] = np.asarray(emission, np.float64)
        return Part(
            name=stem,
            shape=entry.name,
            object_id=entry.number,
            kind=surface.kind,
            material=material,
            emission=emission,
            emission_names=names if emission is not None else (),
            emission_texture=texture,
            flip=entry.shape["flip_normals"],
            to_world=pose,
            part_to_shape=surface.local,
            quadric=surface.quadric,
            piece=surface.label,
        )


def _with_triangles(part: Part, piece: MeshPart, mesh: Mesh, faces: np.ndarray, dropped: int) -> Part:
    """Return a part with its triangles; ``faces`` and ``dropped``: see :func:`faces_with_area`."""
    flat = mesh.flat or piece.flat
    return replace(
        part,
        vertices=piece.vertices,
        faces=faces,
        normals=None if flat else piece.normals,
        uvs=piece.uvs,
        colors=piece.colors,
        smooth=not flat,
        dropped=dropped,
        source=mesh.source,
        ignored=ignored_features(piece, part.to_world),
    )
