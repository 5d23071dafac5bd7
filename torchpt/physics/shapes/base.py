"""The base class of shapes: parameters, and the primitives that they become.

The scene reader calls these methods while it builds a scene: sizes and positions of a shape become a matrix
(:meth:`Shape.own`), which together with the parameter ``transform`` maps standard primitives (unit sphere, unit disk, ...) to
the world.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchpt import spec
from torchpt.math.transforms import affine, constant, tensor_of
from torchpt.spec import Color, Custom, Flag, Moves, Pose, Refused, Spec

__all__ = ["BOTTOM", "TOP", "UPRIGHT", "Place", "Shape", "Size", "Surface", "Triangles", "placed"]

if TYPE_CHECKING:
    from torchpt.physics.shapes.quadrics import Quadric
    from torchpt.spec.schema import ParsedParams

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Size(spec.Scalar):
    """Spec of a length before the transform. ``to_world`` is the pose at the lengths that the scene file says."""

    moves: Moves = field(default=Moves.SURFACES, kw_only=True)


@dataclass(frozen=True)
class Place(spec.Point):
    """Spec of a point before the transform. ``to_world`` is the pose at the points that the scene file says."""

    moves: Moves = field(default=Moves.SURFACES, kw_only=True)


@dataclass(frozen=True)
class Surface:
    """One primitive of a shape, other than triangles.

    Attributes:
        kind: kind of primitive, one of :data:`torchpt.physics.shapes.geometry.KINDS`.
        label: name within the shape, if it has several primitives, such as `side` and `top`.
        local: ``(4, 4)`` from the primitive's space to the shape's; None for the identity.
        quadric: the surface in object space, for the kind ``quadric``.
    """

    kind: str
    label: str = ""
    local: Matrix | None = None
    quadric: type[Quadric] | None = None


@dataclass(frozen=True)
class Triangles:
    """The triangles of a shape, or the file that contains them.

    Attributes:
        path: paths of files, of which the first that exists is read; None: the arrays below are used.
        vertices: ``(V, 3)`` float64 in object space.
        faces: ``(F, 3)`` int64 indices of vertices.
        normals: ``(V, 3)`` at the vertices, or None.
        uvs: ``(V, 2)`` texture coordinates at the vertices, or None.
        colors: ``(V, 3)`` linear colours at the vertices, or None.
        shape_index: which mesh of the file is taken; None: all.
        flat: use face normals even if vertex normals are given.
        displacement: ``texture``, ``scale`` and ``subdivisions`` of :class:`~torchpt.physics.shapes.kinds.mesh.Displacement`,
            or None.
        object: in place of a file an object of trimesh, or a tuple of :class:`~torchpt.scene.meshes.MeshPart`; None otherwise.
    """

    path: tuple[str, ...] | None = None
    shape_index: int | None = None
    vertices: Matrix | None = None
    faces: NDArray[np.int64] | None = None
    normals: Matrix | None = None
    uvs: Matrix | None = None
    colors: Matrix | None = None
    flat: bool = False
    displacement: ParsedParams | None = None
    object: Any = None


def _material(value: Any) -> Any:
    """Return the name of a material, or a material that the scene reader has already made of an inline one.

    Other plain data is refused: the class of a made material is not known here.
    """
    plain = isinstance(value, str | bool | int | float | Mapping | Sequence | np.ndarray)
    if plain and not (isinstance(value, str) and value):
        raise Refused("the name of a material, or a material")
    return value


class Shape:
    """A kind of shape.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters.
        meshed: whether the shape consists of triangles, which instances may share.
        copies: whether the shape is an instance of another one, its parameter ``of``.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {
        "material": Custom(
            None,
            reader=_material,
            words="the name of a material, or a material",
            doc="material; by default the one in the shape's file, else diffuse with reflectance 0.5",
        ),
        "transform": Pose(
            None,
            words="a list of translate, scale, rotate, matrix, look_at, applied in order",
            doc="from object space to the world; the identity by default",
        ),
        "emission": Color(None, doc="radiance emitted on the front side; none by default"),
        "flip_normals": Flag(False, doc="whether to swap front and back"),
    }
    meshed: ClassVar[bool] = False
    copies: ClassVar[bool] = False

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that contradict each other; ``given`` are the names of the parameters that the scene file sets.

        Raises:
            Refused: with the parameter and the accepted values.
        """

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Any:
        """Return the map ``(4, 4)`` from the space of the primitives to the shape's, by sizes and positions; None: identity.

        The result is a tensor if any of ``values`` is one, else an array.
        """
        return None

    @classmethod
    def to_world(cls, values: Mapping[str, Any]) -> Matrix:
        """Return the transform from the shape's space to the world, ``(4, 4)`` float64."""
        return np.eye(4) if values["transform"] is None else values["transform"]

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """Return the primitives of the shape; none if it consists of triangles.

        Args:
            values: values of the parameters.
            pose: ``(4, 4)`` from the space of the primitives to the world.
        """
        return []

    @classmethod
    def triangles(cls, values: Mapping[str, Any]) -> Triangles | None:
        """Return the triangles of the shape; None if it consists of other primitives."""
        return None


def placed(origin: Sequence[Any], size: Sequence[Any], turn: Matrix) -> Any:
    """Return scale by ``size``, then rotation ``turn (3, 3)``, then translation to ``origin`` as ``(4, 4)``.

    The result is a tensor, on the device of the first tensor among the numbers, if any is one; else an array.
    """
    device = next((number.device for number in (*origin, *size) if isinstance(number, Tensor)), None)
    translation, factors = (
        np.array(three) if device is None else tensor_of([*three], device) for three in (origin, size)
    )
    return affine(constant(turn, factors) * factors, translation)  # columns of the rotation times the sizes


#: Rotates z to y about x: in scene files axes of rotation lie along y, those of quadrics along z.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
#: Maps ``(4, 4)`` from the unit disk at z = 0, facing +z, to the caps of a quadric at z = 1 and z = 0, facing outward.
TOP = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
BOTTOM = np.diag([1.0, -1.0, -1.0, 1.0])
