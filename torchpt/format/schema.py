"""The shapes of a scene file as models (cameras, materials and lights have files of their own)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from torchpt.errors import SceneError
from torchpt.format.textures import TextureInput, texture_input
from torchpt.meshes import MeshPart
from torchpt.spec.declared import Described
from torchpt.spec.fields import (
    Check,
    FaceArray,
    Flag,
    Rows2,
    Rows3,
    Transform,
    Vec3,
    color,
    file_paths,
    integer,
    number_field,
    wrong,
)  # fmt: skip
from torchpt.spec.validate import Model, construct

__all__ = [
    "SHAPES", "Cone", "Cube", "Cylinder", "Disk", "Instance", "Mesh", "Rectangle", "Shape", "Sphere",
]  # fmt: skip


def _material(value: Any) -> Any:
    """A material's name; an inline one has become a model before the shape is validated."""
    if value is None or isinstance(value, Described) or (isinstance(value, str) and value):
        return value
    raise wrong("the name of a material, or a material")


class Shape(Model):
    """What every shape has.

    Attributes:
        material: a name from the materials block, a material of its own, or None (the file's, else diffuse 0.5).
        transform: ``(4, 4)`` float64, object to world.
        emission: radiance leaving the front side, linear RGB, or None.
        flip_normals: turn the front side around.
    """

    material: Annotated[str | Described | None, Check(_material)] = None
    transform: Transform | None = None
    emission: Annotated[tuple[float, float, float] | None, color(optional=True)] = None
    flip_normals: Flag = False

    def to_world(self) -> NDArray[np.float64]:
        """Object to world, ``(4, 4)`` float64."""
        return np.eye(4) if self.transform is None else self.transform


def _path(value: Any) -> tuple[str, ...] | None:
    return None if value is None else file_paths(value)


def _heights(value: Any) -> TextureInput:
    if isinstance(value, str):
        value = {"texture": value}
    if not isinstance(value, Mapping):
        raise wrong("the name of a texture, or a texture")
    found = texture_input(value, False, -_LARGEST, _LARGEST)
    if getattr(found.texture, "filter", "") == "trilinear":
        raise wrong("nearest or bilinear, as displacement is read at points", "trilinear", ("filter",))
    return found


_LARGEST = float(np.finfo(np.float32).max)


class Displacement(Model):
    """How far vertices move along their normals: ``scale`` times a texture, after cutting triangles in four."""

    texture: Annotated[TextureInput, Check(_heights)]
    scale: Annotated[float, number_field("a finite number")] = 1.0
    subdivisions: Annotated[int, integer(0, 12)] = 0


def _displacement(value: Any) -> Displacement | None:
    if value is None or isinstance(value, Displacement):
        return value
    try:
        return construct(Displacement, value, "", None, "displacement")
    except SceneError as error:
        raise wrong(error.expected, error.value, tuple(part for part in error.key.split(".") if part)) from None


def _object(value: Any) -> tuple[MeshPart, ...] | None:
    """A trimesh object as parts; or parts, which Python code read itself."""
    if value is None:
        return None
    if isinstance(value, list | tuple) and value and all(isinstance(part, MeshPart) for part in value):
        return tuple(value)
    if type(value).__module__.split(".")[0] != "trimesh":
        raise wrong("a trimesh.Trimesh or trimesh.Scene (an object of Python; files have a path)")
    from torchpt.meshes.trimesh_parts import mesh_parts_of

    return tuple(mesh_parts_of(value))


class Mesh(Shape):
    """Triangles from a file, from inline ``vertices`` and ``faces``, or from an object of trimesh.

    Attributes:
        path: candidates, the first existing one is used; None for an inline mesh.
        mesh: what a ``trimesh.Trimesh`` or ``trimesh.Scene`` holds, read once; None where there is none.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, polygons already split into fans.
        normals: ``(V, 3)`` or None.
        uvs: ``(V, 2)`` or None.
        face_normals: shade flat, whatever normals there are.
        displacement: moves the vertices when the scene is built.
    """

    type: Literal["mesh"] = "mesh"
    path: Annotated[tuple[str, ...] | None, Check(_path)] = None
    mesh: Annotated[tuple[MeshPart, ...] | None, Check(_object)] = None
    vertices: Rows3 = None
    faces: FaceArray = None
    normals: Rows3 = None
    uvs: Rows2 = None
    face_normals: Flag = False
    displacement: Annotated[Displacement | None, Check(_displacement)] = None

    @model_validator(mode="after")
    def _complete(self) -> Mesh:
        inline = {name: getattr(self, name) for name in ("vertices", "faces", "normals", "uvs")}
        if self.path is not None and self.mesh is not None:
            raise wrong("either path or mesh, not both", "an object", ("mesh",))
        if self.path is not None or self.mesh is not None:
            for name, value in inline.items():
                if value is not None:
                    given = "path" if self.path is not None else "mesh"
                    raise wrong(f"either {given} or an inline mesh, not both", value.tolist(), (name,))
            return self
        if self.vertices is None or self.faces is None:
            missing = (
                "path"
                if self.vertices is None and self.faces is None
                else "vertices"
                if self.vertices is None
                else "faces"
            )
            raise wrong("a path, or vertices and faces", None, (missing,))
        bad = np.flatnonzero(((self.faces < 0) | (self.faces >= len(self.vertices))).any(axis=1))
        if len(bad):
            expected = f"vertex indices in 0..{len(self.vertices) - 1}"
            raise wrong(expected, self.faces[bad[0]].tolist(), ("faces", int(bad[0])))
        for name in ("normals", "uvs"):
            value = inline[name]
            if value is not None and len(value) != len(self.vertices):
                raise wrong(f"one row for each of the {len(self.vertices)} vertices", len(value), (name,))
        if self.face_normals and self.normals is not None:
            raise wrong("no normals where face_normals is true", len(self.normals), ("normals",))
        return self


class Sphere(Shape):
    """An analytic sphere; ``center`` and ``radius`` before the transform."""

    type: Literal["sphere"] = "sphere"
    center: Vec3 = (0.0, 0.0, 0.0)
    radius: Annotated[float, number_field("a number > 0", lambda x: x > 0)] = 1.0

    def own(self) -> NDArray[np.float64]:
        """The unit sphere to this one before its transform, ``(4, 4)``."""
        return _placed(self.center, (self.radius, self.radius, self.radius), np.eye(3))


def _placed(origin: Any, size: tuple[float, float, float], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = turn * size
    matrix[:3, 3] = origin
    return matrix


#: z to y, by a turn about x: the axis of cylinders and cones lies along their own z.
_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


class Cylinder(Shape):
    """An analytic cylinder about an axis along y, ``center`` half-way up, before the transform.

    Attributes:
        capped: closed by two disks.
    """

    type: Literal["cylinder"] = "cylinder"
    center: Vec3 = (0.0, 0.0, 0.0)
    radius: Annotated[float, number_field("a number > 0", lambda x: x > 0)] = 1.0
    height: Annotated[float, number_field("a number > 0", lambda x: x > 0)] = 1.0
    capped: Flag = True

    def own(self) -> NDArray[np.float64]:
        """The cylinder ``x^2 + y^2 = 1, 0 <= z <= 1`` to this one before its transform, ``(4, 4)``."""
        bottom = np.subtract(self.center, (0.0, 0.5 * self.height, 0.0))
        return _placed(bottom, (self.radius, self.radius, self.height), _UPRIGHT)


class Cone(Shape):
    """An analytic cone with its axis along y, before the transform.

    Attributes:
        apex: its tip.
        height: from the tip to the base along y: the base lies below the tip where it is negative.
        slope: radius over distance from the tip, along the axis: the base's radius is ``slope |height|``.
        capped: closed by a disk.
    """

    type: Literal["cone"] = "cone"
    apex: Vec3 = (0.0, 0.0, 0.0)
    height: Annotated[float, number_field("a number other than 0", lambda x: x != 0)] = -1.0
    slope: Annotated[float, number_field("a number > 0", lambda x: x > 0)] = 1.0
    capped: Flag = True

    def own(self) -> NDArray[np.float64]:
        """The cone ``x^2 + y^2 = (1 - z)^2, 0 <= z <= 1`` to this one before its transform, ``(4, 4)``."""
        turn = _UPRIGHT if self.height < 0 else _UPRIGHT * [[1.0], [-1.0], [-1.0]]
        base, length = np.add(self.apex, (0.0, self.height, 0.0)), abs(self.height)
        return _placed(base, (self.slope * length, self.slope * length, length), turn)


def _of(value: Any) -> Any:
    if isinstance(value, str) and value:
        return value
    raise wrong("the name of a mesh among the shapes")


class Instance(Shape):
    """Another place of a mesh, whose triangles it shares.

    Attributes:
        of: the mesh's name; its own transform does not count here.
        material: None takes the mesh's.
    """

    type: Literal["instance"] = "instance"
    of: Annotated[str, Check(_of)]

    @model_validator(mode="after")
    def _dark(self) -> Instance:
        if self.emission is not None:
            raise wrong("no emission on an instance (a mesh of its own can shine)", self.emission, ("emission",))
        return self


class Rectangle(Shape):
    """The square ``[-1, 1]^2`` in the xy plane with normal +z, then transformed."""

    type: Literal["rectangle"] = "rectangle"


class Disk(Shape):
    """The unit disk in the xy plane with normal +z, then transformed."""

    type: Literal["disk"] = "disk"


class Cube(Shape):
    """The cube ``[-1, 1]^3`` with outward face normals, then transformed."""

    type: Literal["cube"] = "cube"


SHAPES: dict[str, type[Shape]] = {
    "mesh": Mesh,
    "sphere": Sphere,
    "rectangle": Rectangle,
    "disk": Disk,
    "cube": Cube,
    "cylinder": Cylinder,
    "cone": Cone,
    "instance": Instance,
}
