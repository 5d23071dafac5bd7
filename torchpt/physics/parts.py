"""The numbers of a scene by dotted name, and what each of them is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchpt.core.tree import NOT_FINGERPRINTED
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.shapes.quadrics import Quadric
from torchpt.physics.textures import Node
from torchpt.spec import Spec, parameters_of

__all__ = ["Copy", "Parameters", "Part", "Source"]


# ---- The numbers of a scene by dotted name, and what each of them is


class Parameters(dict[str, np.ndarray]):
    """Arrays by dotted name, which become the tensors of ``scene.params``.

    Attributes:
        specs: what each of them is.
        stated: texels that the scene states itself, in no file.
    """

    def __init__(self) -> None:
        super().__init__()
        self.specs: dict[str, Spec] = {}
        self.stated: set[str] = set()

    def declare(self, name: str, value: Any, spec: Spec) -> None:
        """Add one; texels stay as they are, all else is kept in float64."""
        keeps = isinstance(value, np.ndarray) and value.dtype == np.float32
        self[name] = value if keeps else np.asarray(value, np.float64)
        self.specs[name] = spec

    def declare_all(self, prefix: str, kind: Any, values: Mapping[str, Any]) -> None:
        """Add those parameters of a kind that are traced and have a value; ``transform`` is called ``to_world``."""
        for key, spec in parameters_of(kind).items():
            if not spec.differentiable:
                continue
            if key == "transform":
                self.declare(f"{prefix}.to_world", np.eye(4) if values[key] is None else values[key], spec)
            elif isinstance(values[key], float | tuple | np.ndarray):
                self.declare(f"{prefix}.{key}", values[key], spec)


# ---- Parts: what the shapes of a description come to before they are tensors of one world. Static, float64, in numpy


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
        emission_texture: the texture, or None.
        emission_names: dotted names of that radiance and, where it has one, of its strength.
        flip: whether the normals are turned around.
        to_world: ``(4, 4)`` float64.
        local: ``(4, 4)`` float64 applied before the parameter ``to_world``, or None; where several parts share that.
        quadric: its surface in its own space, where the kind is ``quadric``.
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
    material: ResolvedMaterial
    emission: tuple[float, float, float] | None
    emission_names: tuple[str, ...]
    flip: bool
    to_world: np.ndarray
    local: np.ndarray | None = None
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
    material: ResolvedMaterial
    flip: bool
    to_world: np.ndarray


@dataclass(frozen=True)
class Source:
    """A light that is no surface.

    Attributes:
        name: dotted prefix of its parameters, e.g. ``lights.sky``.
        kind: one of ``lights.KINDS``.
        values: of its parameters as it was loaded, those that are no tensors included.
    """

    name: str
    kind: str
    values: Mapping[str, Any] = field(default_factory=dict)
