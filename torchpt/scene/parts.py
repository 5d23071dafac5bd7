"""Parts: what the shapes of a description come to before they are tensors of one world. Static, float64, in numpy."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchpt.bsdfs import Bsdf
from torchpt.textures import Node

__all__ = ["Copy", "MaterialSlot", "Part", "Reading", "Source", "Value", "VertexColors"]


@dataclass(frozen=True)
class VertexColors:
    """The colours of a mesh's vertices in place of a number or colour; ``channel`` as of a node."""

    channel: int | None


#: A texture in place of a number or a colour.
Reading = Node | VertexColors
Value = float | tuple[float, float, float] | Reading


@dataclass(frozen=True)
class MaterialSlot:
    """One material: one row of one BSDF model.

    Attributes:
        model: its model, in the variant that it needs.
        name: dotted prefix of its parameters, e.g. ``materials.red``.
        values: what the model is given, by parameter name: colours as three floats, numbers as one, textures.
        two_sided: whether the back of an opaque model reflects as the front does.
        opacity: fraction of the light that meets the surface at all.
        alpha_cutoff: where set, opacity below it counts as 0, else as 1.
        emission: radiance, or None where it does not emit.
        emission_strength: factor of it.
        normal_map: a colour texture, or None.
        normal_strength: factor of how far its normals lean.
        bump_map: a number texture, or None.
        inner: the two materials of a blend, whose own ``values`` hold but the weight.
    """

    model: Bsdf
    name: str
    values: dict[str, Value]
    two_sided: bool = True
    opacity: float | Node = 1.0
    alpha_cutoff: float | None = None
    emission: tuple[float, float, float] | Node | None = None
    emission_strength: float = 1.0
    normal_map: Node | None = None
    normal_strength: float = 1.0
    bump_map: Node | None = None
    inner: tuple[MaterialSlot, ...] = ()

    def all(self) -> list[MaterialSlot]:
        """Itself and the materials that it blends."""
        return [self, *(slot for inner in self.inner for slot in inner.all())]

    def numbers(self) -> dict[str, float | tuple[float, float, float]]:
        """Its parameters by dotted name, those of inner materials included, textures excepted."""
        mine: dict[str, Value] = dict(self.values)
        if self.opacity != 1.0:
            mine["opacity"] = self.opacity
        if self.emission is not None:
            mine |= {"emission": self.emission, "emission_strength": self.emission_strength}
        if self.normal_strength != 1.0:
            mine["normal_strength"] = self.normal_strength
        found = {f"{self.name}.{key}": value for key, value in mine.items() if isinstance(value, float | tuple)}
        for inner in self.inner:
            found |= inner.numbers()
        return found

    def readings(self) -> list[Reading]:
        """Its textures, those of inner materials included."""
        mine = [*self.values.values(), self.opacity, self.emission, self.normal_map, self.bump_map]
        found: list[Reading] = [value for value in mine if isinstance(value, Node | VertexColors)]
        return [*found, *(reading for inner in self.inner for reading in inner.readings())]


@dataclass(frozen=True)
class Part:
    """Primitives of one kind that share a shape, a material and an emission.

    Attributes:
        name: dotted prefix of its parameters, e.g. ``shapes.bunny``.
        shape: name of the shape in the scene.
        object_id: order of the shape in the scene, from 1.
        kind: one of ``records.KINDS``.
        material: its material.
        emission: radiance, or None where it does not emit; where a texture gives it, what that is multiplied by.
        glow: the texture, or None.
        emission_names: dotted names of that radiance and, where it has one, of its strength.
        flip: whether the normals are turned around.
        to_world: ``(4, 4)`` float64.
        local: ``(4, 4)`` float64 applied before the parameter ``to_world``, or None; where several parts share that.
        quadric: which of ``records.QUADRICS``, or "".
        piece: its name within its shape, where the shape has several under one name.
        vertices: ``(V, 3)`` float64 in the file's own space; None for analytic shapes.
        faces: ``(F, 3)`` int64.
        normals: ``(V, 3)`` from the file, or None.
        uvs: ``(V, 2)``, or None.
        colors: ``(V, 3)`` linear, or None.
        smooth: whether shading normals are interpolated.
        dropped: faces without area, left out.
        source: the file it was read from, or "".
        ignored: what of the file is not used.
    """

    name: str
    shape: str
    object_id: int
    kind: str
    material: MaterialSlot
    emission: tuple[float, float, float] | None
    emission_names: tuple[str, ...]
    flip: bool
    to_world: np.ndarray
    local: np.ndarray | None = None
    quadric: str = ""
    piece: str = ""
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    glow: Node | None = None
    colors: np.ndarray | None = None
    smooth: bool = False
    dropped: int = 0
    source: str = ""
    ignored: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Copy:
    """An instance of one part of a mesh, whose triangles it shares.

    Attributes:
        name: dotted prefix of its parameters, e.g. ``shapes.third_bunny``.
        shape: name of the instance in the scene.
        object_id: order of the instance in the scene, from 1.
        of: the part's name.
        material: its material.
        flip: whether the normals are turned around, compared with the part's.
        to_world: ``(4, 4)`` float64, in place of the part's own.
    """

    name: str
    shape: str
    object_id: int
    of: str
    material: MaterialSlot
    flip: bool
    to_world: np.ndarray


@dataclass(frozen=True)
class Source:
    """A light that is no surface.

    Attributes:
        name: dotted prefix of its parameters, e.g. ``lights.sky``.
        kind: one of ``records.SOURCES``.
    """

    name: str
    kind: str
