"""Records of a scene before they become tensors: parameters, parts of shapes, instances, lights without a surface.

The scene reader makes them of a scene file. From them :class:`~torchpt.physics.world.World` is built, on one device.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchpt.core.tree import NOT_FINGERPRINTED
from torchpt.images import ByteImage
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.shapes.quadrics import Quadric
from torchpt.physics.textures import Node
from torchpt.spec import Spec, parameters_of

__all__ = ["Copy", "Parameters", "Part", "Source"]


# ---- Parameters


class Parameters(dict[str, np.ndarray]):
    """Arrays by dotted name, which become the tensors of ``scene.params``.

    Attributes:
        specs: the spec of each parameter by name.
        texels_in_scene: names of parameters whose texels are given in the scene, not in an image file.
        images: by name those whose values stand in an image that is not decoded yet; their arrays have shapes alone.
    """

    def __init__(self) -> None:
        super().__init__()
        self.specs: dict[str, Spec] = {}
        self.texels_in_scene: set[str] = set()
        self.images: dict[str, ByteImage] = {}

    def declare(self, name: str, value: Any, spec: Spec) -> None:
        """Add a parameter, in float64 unless it is a float32 array, or an image in place of one (texels)."""
        if isinstance(value, ByteImage):
            self.images[name] = value
            value = np.broadcast_to(np.float32(0.0), value.shape)  # takes no memory
        is_texels = isinstance(value, np.ndarray) and value.dtype == np.float32
        self[name] = value if is_texels else np.asarray(value, np.float64)
        self.specs[name] = spec

    def decoded(self, name: str) -> np.ndarray:
        """Return the values of a parameter."""
        return self.images[name].values() if name in self.images else self[name]

    def declare_all(self, prefix: str, kind: Any, values: Mapping[str, Any]) -> None:
        """Add the differentiable parameters of a kind that have a value; ``transform`` becomes ``to_world``."""
        for key, spec in parameters_of(kind).items():
            if not spec.differentiable:
                continue
            if key == "transform":
                self.declare(f"{prefix}.to_world", np.eye(4) if values[key] is None else values[key], spec)
            elif isinstance(values[key], float | tuple | np.ndarray):
                self.declare(f"{prefix}.{key}", values[key], spec)


# ---- Shapes and lights of a description, in numpy and float64


@dataclass(frozen=True)
class Part:
    """Primitives of one kind that share a shape, a material and an emission.

    Attributes:
        name: dotted prefix of the parameters, e.g. ``shapes.bunny``.
        shape: name of the shape in the scene.
        object_id: index of the shape in the scene, from 1.
        kind: kind of primitive, one of :data:`torchpt.physics.shapes.geometry.KINDS`.
        material: material of the part.
        emission: radiance, or the factor of ``emission_texture``; None if it does not emit.
        emission_texture: the texture, or None.
        emission_names: dotted names of the parameters of radiance and, if it has one, strength.
        flip: whether to flip the normals.
        to_world: ``(4, 4)`` float64.
        part_to_shape: ``(4, 4)`` float64 from the part's space to the shape's, applied before ``to_world``, which several parts
            of a shape may share; None: the identity.
        quadric: the surface in object space, for the kind ``quadric``.
        piece: name within the shape, if the shape has several parts of one name.
        vertices: ``(V, 3)`` float64 in the file's own space; None for analytic shapes.
        faces: ``(F, 3)`` int64.
        normals: ``(V, 3)`` from the file, or None.
        uvs: ``(V, 2)``, or None.
        colors: ``(V, 3)`` linear, or None.
        smooth: whether shading normals are interpolated.
        dropped: number of faces left out because they have no area.
        source: the file from which the part was read, or "".
        ignored: features of the file that are not used.
    """

    name: str
    shape: str
    object_id: int
    kind: str
    material: ResolvedMaterial
    emission: tuple[float, float, float] | None
    emission_names: tuple[str, ...]
    flip: bool
    to_world: np.ndarray
    part_to_shape: np.ndarray | None = None
    quadric: type[Quadric] | None = None
    piece: str = ""
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    emission_texture: Node | None = None
    colors: np.ndarray | None = None
    smooth: bool = False
    dropped: int = 0
    source: str = field(default="", metadata=NOT_FINGERPRINTED)
    ignored: tuple[str, ...] = field(default=(), metadata=NOT_FINGERPRINTED)

    @property
    def primitive_count(self) -> int:
        """Return the number of primitives."""
        return 1 if self.faces is None else len(self.faces)


@dataclass(frozen=True)
class Copy:
    """An instance of one part of a mesh; it shares the triangles of that part.

    Attributes:
        name: dotted prefix of the parameters, e.g. ``shapes.third_bunny``.
        shape: name of the instance in the scene.
        object_id: index of the instance in the scene, from 1.
        of: :attr:`Part.name` of the part that is instanced.
        material: material of the instance.
        flip: whether to flip the normals relative to the part.
        to_world: ``(4, 4)`` float64, replaces the transform of the part.
    """

    name: str
    shape: str
    object_id: int
    of: str
    material: ResolvedMaterial
    flip: bool
    to_world: np.ndarray


@dataclass(frozen=True)
class Source:
    """A light without a surface.

    Attributes:
        name: dotted prefix of the parameters, e.g. ``lights.sky``.
        kind: one of ``lights.KINDS``.
        values: values of all parameters as loaded, those that are no tensors included.
    """

    name: str
    kind: str
    values: Mapping[str, Any] = field(default_factory=dict)
