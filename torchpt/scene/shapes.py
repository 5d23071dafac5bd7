"""Shapes of a description as parts: materials resolved, files read, everything that is a number declared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchpt.core.errors import AssetError, SceneError
from torchpt.math.transforms import WITHIN, is_usable
from torchpt.physics.bsdfs import KINDS as BSDFS
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Copy, Parameters, Part, Source
from torchpt.physics.shapes.base import Surface, Triangles
from torchpt.physics.shapes.primitive import PRIMITIVES
from torchpt.physics.textures import Node
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.materials import check_material, plain_material, read_material
from torchpt.scene.materials import declare, resolved
from torchpt.scene.mesh_triangles import Mesh, ignored, mesh_of, solid
from torchpt.scene.meshes import FileMaterial, MeshPart
from torchpt.scene.sources import build_file_lights, unique_labels
from torchpt.scene.texture_loader import TextureLoader
from torchpt.spec import Pose, Vertices, parameters_of
from torchpt.spec.schema import ParsedParams

__all__ = ["ShapeBuilder", "ShapeEntry"]


@dataclass(frozen=True)
class ShapeEntry:
    """A shape of a scene.

    Attributes:
        name: in the scene.
        number: order in the scene, from 1.
        shape: what it is.
    """

    name: str
    number: int
    shape: ParsedParams

    @property
    def key(self) -> str:
        """Its dotted key."""
        return f"shapes.{self.name}"

    @property
    def to_world(self) -> np.ndarray:
        """Its transform."""
        return self.shape.kind.to_world(self.shape.values)


class ShapeBuilder:
    """Makes parts of shapes.

    Attributes:
        sources: lights that mesh files have beside the triangles, in the order in which they were met.
    """

    def __init__(self, description: Description, parameters: Parameters, texture_loader: TextureLoader) -> None:
        self.description, self.parameters, self.texture_loader = description, parameters, texture_loader
        self.sources: list[Source] = []
        self._slots: dict[str, ResolvedMaterial] = {}
        self._declared: set[int] = set()

    def parts(self, owner: ShapeEntry) -> list[Part]:
        """What a shape comes to; no instance."""
        triangles = owner.shape.kind.triangles(owner.shape.values)
        return self._primitives(owner) if triangles is None else self._meshes(owner, triangles)

    def copies(self, owner: ShapeEntry, parts: list[Part]) -> list[Copy]:
        """An instance, as one copy of each of the ``parts`` of its mesh."""
        key, file, shapes = owner.key, self.description.file, self.description.shapes
        of, material = owner.shape["of"], owner.shape["material"]
        mesh = shapes.get(of)
        if mesh is None or not mesh.kind.meshed:
            names = [other for other, value in shapes.items() if value.kind.meshed]
            known = f" ({', '.join(names[:8])}{', ...' if len(names) > 8 else ''})" if names else " (there is none)"
            raise SceneError(f"{key}.of", of, f"the name of a mesh among the shapes{known}", file)
        self.parameters.declare(f"{key}.to_world", owner.to_world, Pose())
        if not is_usable(owner.to_world @ np.linalg.inv(mesh.kind.to_world(mesh.values))):
            expected = f"a way from where {of} lies to where it is copied that can be inverted, {WITHIN}"
            raise SceneError(f"{key}.transform", owner.to_world.tolist(), expected, file)
        made = []
        for part in (part for part in parts if part.shape == of):
            slot = part.material if material is None else self._material(material, key)
            if slot.emission is not None:
                raise SceneError(
                    f"{key}.material", slot.name, "a material that does not emit: an instance cannot", file
                )
            declare(slot, self.parameters)
            flip = owner.shape["flip_normals"] != part.flip
            pose = self.parameters[f"{key}.to_world"]
            made.append(Copy(key, owner.name, owner.number, part.name, slot, flip, pose))
        return made

    def _primitives(self, owner: ShapeEntry) -> list[Part]:
        """A shape of primitives that share one pose."""
        shape, pose = owner.shape, owner.to_world
        own = shape.kind.own(shape.values)
        if own is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                pose = pose @ own
            if not is_usable(pose):
                expected = f"sizes that differ by less than 1e12, and a place: {WITHIN}"
                raise SceneError(owner.key, pose.tolist(), expected, self.description.file)
        surfaces = shape.kind.surfaces(shape.values, pose)
        self._declare_pose(owner.key, pose, surfaces)
        slot = self._material(shape["material"], owner.key)
        return [
            self._part(owner, owner.key, slot, surface, pose if surface.local is None else pose @ surface.local)
            for surface in surfaces
        ]

    def _declare_pose(self, stem: str, pose: np.ndarray, surfaces: list[Surface]) -> None:
        angles = any(PRIMITIVES[surface.kind].angles for surface in surfaces)
        self.parameters.declare(f"{stem}.to_world", pose, Pose(angles=angles))

    def _meshes(self, owner: ShapeEntry, triangles: Triangles) -> list[Part]:
        """A shape of triangles: a part for each material of its file."""
        shape, pose = owner.shape, owner.to_world
        mesh = mesh_of(triangles, owner.key, self.description, self.texture_loader, materials=shape["material"] is None)
        lights = [light for piece in mesh.pieces for light in piece.lights]
        self.sources += build_file_lights(lights, owner.key, pose, mesh.source, self.parameters)
        labels = unique_labels([piece.name for piece in mesh.pieces])
        parts: list[Part] = []
        known: dict[int, ResolvedMaterial] = {}
        for piece, label in zip(mesh.pieces, labels, strict=True):
            stem = owner.key if len(mesh.pieces) == 1 else f"{owner.key}.{label}"
            self.parameters.declare(f"{stem}.vertices", piece.vertices, Vertices())
            self._declare_pose(stem, pose, [])
            own = piece.material if shape["material"] is None else None
            if own is None:
                slot = self._material(shape["material"], stem)
            elif id(own) in known:  # parts of one material share its row and its textures
                slot = known[id(own)]
            else:
                slot = known[id(own)] = self._file_material(own, owner.key, f"{stem}.material", mesh.source)
            part = self._part(owner, stem, slot, Surface("triangle"), pose)
            parts.append(_with_triangles(part, piece, mesh))
        if all(len(part.faces) == 0 for part in parts if part.faces is not None):
            problem = "every face is degenerate (without area)"
            if mesh.source:
                raise AssetError(mesh.source, f"{problem}, named by {owner.key}.path")
            raise SceneError(f"{owner.key}.faces", "no face with area", "a face with area", self.description.file)
        return parts

    def _material(self, given: Any, stem: str) -> ResolvedMaterial:
        """The material that the scene gives a shape, by name or its own; the grey of one that has none."""
        known = self.description.materials
        if isinstance(given, str):
            if given not in self._slots:
                self._slots[given] = resolved(known[given], f"materials.{given}", known, self.texture_loader)
            return self._slots[given]
        return resolved(plain_material() if given is None else given, f"{stem}.material", known, self.texture_loader)

    def _file_material(self, own: FileMaterial, prefix: str, key: str, source: str) -> ResolvedMaterial:
        """A mesh file's own material.

        Raises:
            AssetError: something that a material cannot have; it names the file and the material.
        """
        try:
            material = read_material(own.material, key, BSDFS, None)
            check_material(material, key, {}, {}, None)
            return resolved(material, key, {}, self.texture_loader.sharing(f"{prefix}.textures"))
        except SceneError as error:
            raise AssetError(source, f"material {own.name[:80]!r}: {error}") from None

    def _part(self, owner: ShapeEntry, stem: str, slot: ResolvedMaterial, surface: Surface, pose: np.ndarray) -> Part:
        """A surface of a shape, without what only triangles have; its emission and its material's numbers are declared."""
        if slot is not self._slots.get(slot.name.removeprefix("materials.")) or id(slot) not in self._declared:
            declare(slot, self.parameters)
            self._declared.add(id(slot))
        emission, names = owner.shape["emission"], (f"{owner.key}.emission",)
        texture = slot.emission if emission is None and isinstance(slot.emission, Node) else None
        if emission is not None and names[0] not in self.parameters:
            self.parameters.declare(names[0], emission, parameters_of(owner.shape.kind)["emission"])
        if texture is not None:
            emission, names = (1.0, 1.0, 1.0), (f"{slot.name}.emission_strength",)
        elif emission is None and isinstance(slot.emission, tuple):
            emission, names = slot.emission, (f"{slot.name}.emission", f"{slot.name}.emission_strength")
        if emission is not None and names[0] not in self.parameters:
            self.parameters[names[0]] = np.asarray(emission, np.float64)
        return Part(
            name=stem,
            shape=owner.name,
            object_id=owner.number,
            kind=surface.kind,
            material=slot,
            emission=emission,
            emission_names=names if emission is not None else (),
            emission_texture=texture,
            flip=owner.shape["flip_normals"],
            to_world=pose,
            local=surface.local,
            quadric=surface.quadric,
            piece=surface.label,
        )


def _with_triangles(part: Part, piece: MeshPart, mesh: Mesh) -> Part:
    """A part with its triangles."""
    faces, dropped = solid(piece, part.to_world)
    return replace(
        part,
        vertices=piece.vertices,
        faces=faces,
        normals=None if mesh.flat else piece.normals,
        uvs=piece.uvs,
        colors=piece.colors,
        smooth=not mesh.flat,
        dropped=dropped,
        source=mesh.source,
        ignored=ignored(piece, part.to_world),
    )
