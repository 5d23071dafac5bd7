"""The base class of cameras.

Camera space has the viewing direction along +z, up along +y, and +x to the *left* in the picture (Mitsuba's convention). Film
positions are in pixels from the upper left corner of the whole film, y downward.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchpt.math.vectors import normalize
from torchpt.physics.cameras.poses import POSES, pose_of
from torchpt.spec import Spec

__all__ = ["Camera"]


@dataclass(frozen=True, kw_only=True)
class Camera(ABC):
    """A camera and its film. A subclass has its parameters as fields: tensors of the world's dtype, or plain values.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters; those whose spec is ``differentiable`` are tensors.
        lens: whether rays also depend on a point on a lens.
        reaches: names of parameters that bound the distance of ray origins from the camera's origin, such as a lens radius.
        parallel: whether all rays are parallel.
        projects: whether :meth:`project` is implemented.
        sized_by: hint for the error about a pose with a scale: the parameter that sizes the picture instead.
        to_world: pose ``(4, 4)``; its scale is ignored, as only the axes' directions and the origin matter.
        resolution: width and height of the whole film in pixels.
        film: the resolution as a tensor ``(2,)`` of the world's dtype.
    """

    to_world: Tensor
    resolution: tuple[int, int]
    film: Tensor

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = POSES
    lens: ClassVar[bool] = False
    reaches: ClassVar[tuple[str, ...]] = ()
    parallel: ClassVar[bool] = False
    projects: ClassVar[bool] = False
    sized_by: ClassVar[str] = ""

    @classmethod
    def check(cls, values: dict[str, Any], given: frozenset[str]) -> None:
        """Set ``to_world`` from the parameters of the pose, and refuse values that contradict each other.

        Args:
            values: values of the parameters by name; ``to_world`` is written.
            given: names of the parameters that the scene file sets.

        Raises:
            Refused: with the parameter and the accepted values.
        """
        values["to_world"] = pose_of(values, given, cls.sized_by)

    @classmethod
    def on(cls, to_world: Tensor, resolution: tuple[int, int], values: Mapping[str, Any]) -> Self:
        """Return a camera of this kind for a film of ``resolution`` pixels, from the values of its parameters."""
        parameters = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        film = to_world.new_tensor(resolution)
        return cls(**{**parameters, "to_world": to_world, "resolution": resolution, "film": film})

    @abstractmethod
    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return rays through film positions.

        Args:
            x: ``(N,)`` in pixels from the left edge of the whole film.
            y: ``(N,)`` in pixels from the upper edge.
            u: ``(2, N)`` in [0, 1), samples the lens; None without a lens.

        Returns:
            Origins, ``(3, 1)`` if all rays share one, else ``(3, N)``, and unit directions ``(3, N)``.
        """

    def connect(self, p: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the places where rays of the camera start that come through points.

        Args:
            p: points ``(3, N)``.
            u: ``(2, N)`` in [0, 1), samples the lens as in :meth:`rays`; None without a lens.

        Returns:
            Origins of the rays ``(3, N)``, the film positions ``x, y (N,)`` that they belong to, as for :meth:`rays`, and a
            mask ``(N,)`` of points in front of the camera, without which the others are meaningless.

        Raises:
            NotImplementedError: light paths cannot be joined to cameras of this kind.
        """
        raise NotImplementedError

    def film_density(self, d: Tensor) -> Tensor:
        """Return the density ``(N,)`` of film positions, in square pixels, over unit directions ``d (3, N)`` of rays.

        It is per steradian at the origin of the rays; if all rays are parallel, per area across them. Needed beside
        :meth:`connect`.
        """
        raise NotImplementedError

    @abstractmethod
    def pixel(self) -> Tensor:
        """Return the footprint of a pixel in the world as ``(5,)``: ``e (3)``, ``w``, ``spread``.

        From a point ``p`` the camera lies in direction ``e - w p``, and the side of a pixel's footprint there, perpendicular
        to this direction, is ``spread`` times its length. If all rays start at one point, ``e`` is this point, ``w`` is 1, and
        ``spread`` is the side of a pixel at distance 1 along the viewing direction. If they are parallel, ``e`` is the unit
        direction against them, ``w`` is 0, and ``spread`` is the side of a pixel. The side of a pixel that is not square is
        the root of its area.
        """

    def project(self, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Project points to the film, differentiable in points and camera; called only if ``projects``.

        Args:
            offset: vectors ``(3, N)`` of any length from the camera's origin to points in front of it.

        Returns:
            Film positions ``x, y`` in pixels, each ``(N,)``, as for :meth:`rays`, and the scale ``(N,)`` of areas: a surface
            element ``dA`` with unit normal ``n`` covers ``scale |n . offset| dA`` square pixels; for unit ``offset`` a solid
            angle ``dw`` covers ``scale dw``.
        """
        raise NotImplementedError

    def film_of(self, p: Tensor, u: Tensor | None = None) -> Tensor | None:
        """Return homogeneous film coordinates ``x h``, ``y h``, ``h`` and the depth of points ``p (3, N)``, as ``(4, N)``.

        They are affine in ``p``, so lines stay lines. ``x, y`` are in pixels as for :meth:`rays`; points with ``h`` or depth
        not positive lie behind the camera. None: the camera has no such map, and edges in its picture are not differentiated.

        Args:
            p: points ``(3, N)``.
            u: ``(2, N)`` in [0, 1), samples the lens as in :meth:`rays`; None: its middle, or a camera without a lens.
        """
        return None

    def intrinsics(self) -> Tensor | None:
        """Return OpenCV's ``K (3, 3)`` in pixels, see :mod:`torchpt.physics.cameras.opencv`; None for cameras without one."""
        return None

    def kind(self) -> tuple[object, ...]:
        """Return all fields that are no tensors, as part of the cache key of compiled stages."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "resolution"}
        return (self.name, *((key, value) for key, value in values.items() if not isinstance(value, Tensor)))

    def place(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return film positions as distances right of and above the film's centre, in half widths of the film."""
        width, height = self.film[0], self.film[1]
        right = x * (2.0 / width) - 1.0
        return right, (1.0 - y * (2.0 / height)) * (height / width)

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return unit vectors ``(3, 1)`` in the world: right and up in the picture, and the viewing direction."""
        axes = normalize(self.to_world[:3, :3])
        return -axes[:, 0:1], axes[:, 1:2], axes[:, 2:3]

    def covectors(self) -> Tensor:
        """Return the inverse ``(3, 3)`` of the matrix of :meth:`axes`: its rows give the components of a vector along them.

        For orthogonal axes the rows are the axes. Poses are orthogonal to a thousandth only, and derivatives by single entries
        of a pose leave orthogonality, so the exact inverse is needed to match :meth:`rays`.
        """
        return torch.linalg.inv(torch.cat(self.axes(), 1))

    def origin(self) -> Tensor:
        """Return the position of the camera ``(3, 1)``."""
        return self.to_world[:3, 3:4]
