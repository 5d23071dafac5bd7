"""Specs of places: points, directions, poses, and the vertices of a mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from torchpt.math.transforms import WITHIN, is_rigid, is_usable, similarity_scale
from torchpt.spec import reading
from torchpt.spec.base import Moves, Spec
from torchpt.spec.reading import Refused

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["Corners", "Direction", "Point", "Pose", "Vertices"]


@dataclass(frozen=True)
class _Vector(Spec):
    """Three numbers."""

    traced: ClassVar[bool] = True

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        return reading.vector(value, self.expected)

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        import torch

        if not bool(torch.isfinite(value.float()).all()):
            raise Refused("numbers finite in float32", "a value that is not finite in float32")


@dataclass(frozen=True)
class Point(_Vector):
    """A point of the scene."""

    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "three finite numbers [x, y, z]"


@dataclass(frozen=True)
class Direction(_Vector):
    """A direction; its length does not matter."""

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a direction other than [0, 0, 0]"

    def read(self, value: Any) -> tuple[float, float, float]:
        """See :class:`Spec`."""
        found = reading.vector(value)
        if not any(found):
            raise Refused(self.expected, list(found))
        return found

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        super().check(value)
        if not bool(value.any()):
            raise Refused(self.expected, value.tolist())


@dataclass(frozen=True)
class Vertices(_Vector):
    """Points ``(V, 3)`` of a mesh in its own space."""

    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "a list of [x, y, z], finite numbers each"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        return reading.rows(value, 3, "[x, y, z]")


@dataclass(frozen=True)
class Corners(Vertices):
    """Normals ``(V, 3)`` or coordinates ``(V, 2)`` of a mesh: a tensor of the scene where its gradients are wanted."""

    place: ClassVar[bool] = False


@dataclass(frozen=True)
class Pose(Spec):
    """Where a thing stands: ``(4, 4)``, from its own space to the world.

    Attributes:
        angles: whether it must keep angles (rotation, reflection, uniform scale).
        rigid: whether a tensor in its place must keep lengths too (rotation, reflection). What is written is not held to it
            here: kinds say what goes with a pose, and how a scale is meant.
        operations: whether it is written as a list of operations; else as a matrix.
    """

    angles: bool = field(default=False, kw_only=True)
    rigid: bool = field(default=False, kw_only=True)
    operations: bool = field(default=True, kw_only=True)
    moves: Moves = field(default=Moves.SURFACES, kw_only=True)

    traced: ClassVar[bool] = True
    place: ClassVar[bool] = True

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        if self.angles:
            return "a transform that keeps angles (rotation, reflection, uniform scale)"
        return f"a matrix that can be inverted, {WITHIN}"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        found = reading.transform(value) if self.operations else reading.matrix(value)
        if self.angles and similarity_scale(found) is None:
            raise Refused(self.expected, found.tolist())
        return found

    def check(self, value: Tensor) -> None:
        """See :class:`Spec`."""
        import torch

        matrix = value.double().cpu().numpy()
        if not bool(torch.isfinite(value.float()).all()):
            raise Refused("numbers finite in float32", "a value that is not finite in float32")
        if not is_usable(matrix):
            raise Refused(f"a matrix that can be inverted, {WITHIN}", matrix.tolist())
        if abs(matrix[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-4:
            raise Refused("a transform whose last row is 0 0 0 1", matrix[3].tolist())
        if self.angles and similarity_scale(matrix, 1e-4) is None:
            raise Refused(self.expected, matrix.tolist())
        if self.rigid and not is_rigid(matrix):
            raise Refused("a pose without scale or shear (torchpt.nn.Renderer keeps one so)", matrix.tolist())
