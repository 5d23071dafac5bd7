"""What a shape is: what it declares, and the surfaces that it comes to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from torchpt import spec
from torchpt.math.transforms import affine, constant, tensor_of
from torchpt.spec import Color, Custom, Flag, Pose, Refused, Spec

__all__ = ["BOTTOM", "TOP", "UPRIGHT", "Place", "Shape", "Size", "Surface", "Triangles", "placed"]

if TYPE_CHECKING:
    from torchpt.physics.shapes.quadrics import Quadric
    from torchpt.spec.schema import ParsedParams

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Size(spec.Scalar):
    """A length of a shape before its transform: part of its ``to_world``, no tensor of its own."""

    differentiable: ClassVar[bool] = False


@dataclass(frozen=True)
class Place(spec.Point):
    """A point of a shape before its transform: part of its ``to_world``, no tensor of its own."""

    differentiable: ClassVar[bool] = False


@dataclass(frozen=True)
class Surface:
    """One primitive that a shape comes to.

    Attributes:
        kind: of primitive, one of ``records.KINDS``.
        label: its name within the shape, where that has several.
        local: ``(4, 4)`` from the primitive's own space to the shape's; None: the same.
        quadric: its surface in its own space, where the kind is ``quadric``.
    """

    kind: str
    label: str = ""
    local: Matrix | None = None
    quadric: type[Quadric] | None = None


@dataclass(frozen=True)
class Triangles:
    """The triangles that a shape comes to, or the file that has them.

    Attributes:
        path: candidates, the first that is there is used; None: the arrays.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64.
        normals: ``(V, 3)``, or None.
        uvs: ``(V, 2)``, or None.
        flat: shade flat, whatever normals there are.
        displacement: ``texture``, ``scale`` and ``subdivisions`` of :class:`~torchpt.physics.shapes.kinds.mesh.Displacement`,
            or None.
        object: of trimesh, or parts of a mesh, in place of a file; None: no such thing.
    """

    path: tuple[str, ...] | None = None
    vertices: Matrix | None = None
    faces: NDArray[np.int64] | None = None
    normals: Matrix | None = None
    uvs: Matrix | None = None
    flat: bool = False
    displacement: ParsedParams | None = None
    object: Any = None


def _material(value: Any) -> Any:
    """A material's name; whoever reads a scene has made one that is written out before the shape is read."""
    plain = isinstance(value, str | bool | int | float | Mapping | Sequence | np.ndarray)
    if plain and not (isinstance(value, str) and value):
        raise Refused("the name of a material, or a material")
    return value


class Shape:
    """A kind of shape.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares.
        meshed: whether it is made of triangles, which instances may share.
        copies: whether it is an instance of another shape: ``of``.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {
        "material": Custom(
            None,
            reader=_material,
            words="the name of a material, or a material",
            doc="what it is made of; none: what its file says, else diffuse 0.5",
        ),
        "transform": Pose(
            None,
            words="a list of translate, scale, rotate, matrix, look_at, applied in order",
            doc="from its own space to the world; none: the two are the same",
        ),
        "emission": Color(None, doc="radiance that leaves the front; none: it does not shine"),
        "flip_normals": Flag(False, doc="turns the front around"),
    }
    meshed: ClassVar[bool] = False
    copies: ClassVar[bool] = False

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Any:
        """From the space of its surfaces to its own, ``(4, 4)``: its size and place before its transform; None: the same.

        A tensor of what are tensors among ``values``, a matrix of numbers.
        """
        return None

    @classmethod
    def to_world(cls, values: Mapping[str, Any]) -> Matrix:
        """Its transform, ``(4, 4)`` float64."""
        return np.eye(4) if values["transform"] is None else values["transform"]

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """The primitives that it comes to; none where it is made of triangles.

        Args:
            values: of its parameters.
            pose: ``(4, 4)`` from the space of its surfaces to the world.
        """
        return []

    @classmethod
    def triangles(cls, values: Mapping[str, Any]) -> Triangles | None:
        """The triangles that it comes to; None where it is made of primitives of other kinds."""
        return None


def placed(origin: Sequence[Any], size: Sequence[Any], turn: Matrix) -> Any:
    """A scale, then a rotation ``(3, 3)``, then a move, as ``(4, 4)``: a tensor where any of the six numbers is one."""
    device = next((number.device for number in (*origin, *size) if isinstance(number, Tensor)), None)
    place, factors = (np.array(three) if device is None else tensor_of([*three], device) for three in (origin, size))
    return affine(constant(turn, factors) * factors, place)


#: z to y, by a turn about x: the axis of what turns about one lies along its surfaces' z.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
#: From the unit disk to the caps of a surface between z = 0 and z = 1, facing outward.
TOP = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
BOTTOM = np.diag([1.0, -1.0, -1.0, 1.0])
