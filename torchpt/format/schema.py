"""The blocks of a scene file as models: camera and shapes (materials and lights have files of their own). One table each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from torchpt.errors import SceneError
from torchpt.format.materials import Material
from torchpt.format.textures import TextureInput, texture_input
from torchpt.math import transforms
from torchpt.spec.fields import (
    Affine,
    Check,
    FaceArray,
    Flag,
    Rows2,
    Rows3,
    Transform,
    Vec3,
    choice,
    color,
    file_paths,
    integer,
    number_field,
    wrong,
)  # fmt: skip
from torchpt.spec.validate import Model, construct, refuse_foreign, select

__all__ = [
    "CAMERAS", "CAMERA_LENGTHS", "CAMERA_NUMBERS", "FOV_AXES", "SHAPES", "Camera", "Cone", "Cube", "Cylinder",
    "Disk", "Instance", "Mesh", "Orthographic", "Perspective", "Rectangle", "Shape", "Sphere", "ThinLens", "read_camera",
]  # fmt: skip

FOV_AXES = ("x", "y", "diagonal", "smaller", "larger")
_UP = (0.0, 1.0, 0.0)


def _rounded(x: float) -> float:
    return float(np.float32(x))


#: The numbers that cameras have: what is accepted, in words and as a test of the float32 that it becomes.
CAMERA_NUMBERS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "fov": ("an angle in degrees, 0 < fov < 180", lambda x: 0 < _rounded(x) < 180),
    "aperture_radius": ("a number >= 0 (0 is a pinhole)", lambda x: x >= 0),
    "focus_distance": ("a number > 0", lambda x: _rounded(x) > 0),
    "width": ("a number > 0", lambda x: _rounded(x) > 0),
}
#: Those of them that are lengths.
CAMERA_LENGTHS = ("aperture_radius", "focus_distance", "width")


class Camera(Model):
    """What every camera has: a pose, by ``origin``, ``target``, ``up`` or by ``to_world``."""

    origin: Vec3 | None = None
    target: Vec3 | None = None
    up: Vec3 | None = None
    to_world: Affine = None

    @model_validator(mode="after")
    def _posed(self) -> Camera:
        if self.to_world is not None:
            for name in ("origin", "target", "up"):
                if getattr(self, name) is not None:
                    raise wrong("either to_world or origin, target and up, not both", getattr(self, name), (name,))
            turn = self.to_world[:3, :3]
            if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-3:
                hint = " (an orthographic camera is sized by width)" if isinstance(self, Orthographic) else ""
                raise wrong(f"a pose without scale or shear{hint}", self.to_world.tolist(), ("to_world",))
            return self
        for name in ("origin", "target"):
            if getattr(self, name) is None:
                raise wrong("a point [x, y, z] (a camera needs origin and target, or to_world)", None, (name,))
        try:
            self.pose()
        except SceneError as error:
            raise wrong(error.expected, error.value, (error.key,)) from None
        return self

    def pose(self) -> NDArray[np.float64]:
        """Camera to world, ``(4, 4)``: the camera looks along its +z, +y is up, +x is left in the picture (Mitsuba)."""
        if self.to_world is not None:
            return self.to_world
        return transforms.look_at(self.origin, self.target, self.up or _UP, key="")

    def numbers(self) -> dict[str, float]:
        """Its numbers by key, those of :data:`CAMERA_NUMBERS`."""
        return {name: getattr(self, name) for name in CAMERA_NUMBERS if name in type(self).model_fields}


class _Angular(Camera):
    """A camera with an angle of view.

    Attributes:
        fov: full angle of view in degrees along ``fov_axis`` of the whole film.
    """

    fov: Annotated[float, number_field(*CAMERA_NUMBERS["fov"])] = 39.3
    fov_axis: Annotated[str, choice(*FOV_AXES)] = "x"


class Perspective(_Angular):
    """A pinhole camera."""

    type: Literal["perspective"] = "perspective"


class ThinLens(_Angular):
    """A camera with depth of field.

    Attributes:
        aperture_radius: of the lens, in world units.
        focus_distance: depth of the plane in focus, from the lens along the viewing direction.
        blades: corners of the aperture, a regular polygon in the circle of ``aperture_radius``; 0 is the disk itself.
    """

    type: Literal["thinlens"] = "thinlens"
    aperture_radius: Annotated[float, number_field(*CAMERA_NUMBERS["aperture_radius"])]
    focus_distance: Annotated[float, number_field(*CAMERA_NUMBERS["focus_distance"])]
    blades: Annotated[int, integer(3, 64, also=(0,))] = 0


class Orthographic(Camera):
    """A parallel projection.

    Attributes:
        width: what the film's width shows, in world units (Mitsuba's has 2, times the scale of its ``to_world``).
    """

    type: Literal["orthographic"] = "orthographic"
    width: Annotated[float, number_field(*CAMERA_NUMBERS["width"])] = 2.0


def read_camera(raw: Any, file: str | None) -> Camera:
    """The camera of a scene file's block."""
    refuse_foreign("camera", CAMERAS, raw, "perspective", file)
    return select("camera", CAMERAS, raw, "camera", file, "perspective")


def _material(value: Any) -> Any:
    """A material's name; an inline one has become a model before the shape is validated."""
    if value is None or isinstance(value, Material) or (isinstance(value, str) and value):
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

    material: Annotated[str | Material | None, Check(_material)] = None
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
    return texture_input(value, False, -_LARGEST, _LARGEST)


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


class Mesh(Shape):
    """Triangles from a file, or from inline ``vertices`` and ``faces``.

    Attributes:
        path: candidates, the first existing one is used; None for an inline mesh.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, polygons already split into fans.
        normals: ``(V, 3)`` or None.
        uvs: ``(V, 2)`` or None.
        face_normals: shade flat, whatever normals there are.
        displacement: moves the vertices when the scene is built.
    """

    type: Literal["mesh"] = "mesh"
    path: Annotated[tuple[str, ...] | None, Check(_path)] = None
    vertices: Rows3 = None
    faces: FaceArray = None
    normals: Rows3 = None
    uvs: Rows2 = None
    face_normals: Flag = False
    displacement: Annotated[Displacement | None, Check(_displacement)] = None

    @model_validator(mode="after")
    def _complete(self) -> Mesh:
        inline = {name: getattr(self, name) for name in ("vertices", "faces", "normals", "uvs")}
        if self.path is not None:
            for name, value in inline.items():
                if value is not None:
                    raise wrong("either path or an inline mesh, not both", value.tolist(), (name,))
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


CAMERAS: dict[str, type[Camera]] = {
    "perspective": Perspective,
    "thinlens": ThinLens,
    "orthographic": Orthographic,
}
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
