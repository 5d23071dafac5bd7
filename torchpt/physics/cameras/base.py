"""What every camera has, and what a kind of camera must say."""

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
    """A camera on a film. Fields of a kind are the values of its parameters: tensors of the lanes' dtype, or plain values.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares; those that are traced are differentiable.
        lens: whether rays also depend on a place on a lens.
        reaches: parameters that say how far from its origin a camera's rays may start.
        projects: whether :meth:`project` says where a point is seen.
        sized_by: what errors say instead, where a pose has a scale.
        to_world: pose ``(4, 4)``; its scale is ignored, as only the axes' directions and the origin matter.
        resolution: width and height of the whole film in pixels.
        film: the same two as ``(2,)`` numbers of the lanes' dtype.
    """

    to_world: Tensor
    resolution: tuple[int, int]
    film: Tensor

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = POSES
    lens: ClassVar[bool] = False
    reaches: ClassVar[tuple[str, ...]] = ()
    projects: ClassVar[bool] = False
    sized_by: ClassVar[str] = ""

    @classmethod
    def check(cls, values: dict[str, Any], given: frozenset[str]) -> None:
        """Fill in the pose, from what the file states of it, and refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """
        values["to_world"] = pose_of(values, given, cls.sized_by)

    @classmethod
    def on(cls, to_world: Tensor, resolution: tuple[int, int], values: Mapping[str, Any]) -> Self:
        """A camera of this kind on a film of ``resolution`` pixels, from the values of its parameters."""
        own = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        film = to_world.new_tensor(resolution)
        return cls(**{**own, "to_world": to_world, "resolution": resolution, "film": film})

    @abstractmethod
    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """Rays through film positions.

        Args:
            x: ``(N,)`` in pixels from the left edge of the whole film.
            y: ``(N,)`` in pixels from its upper edge.
            u: ``(2, N)`` in [0, 1), the place on the lens; None where the camera has none.

        Returns:
            Origins, ``(3, 1)`` where all rays share one, else ``(3, N)``, and unit directions ``(3, N)``.
        """

    @abstractmethod
    def pixel(self) -> Tensor:
        """How large a pixel is in the world, ``(5,)``: ``e``, ``w``, ``spread``.

        From a point ``p`` the camera lies toward ``e - w p``, and a pixel's footprint there, across the line of sight, is
        ``spread`` times that vector's length on a side. Of rays from one place ``e`` is that place, ``w`` is 1, and
        ``spread`` a pixel's side at distance 1 where the camera looks; of parallel rays ``e`` is the unit direction
        against them, ``w`` is 0, and ``spread`` a pixel's side. Of a pixel that is no square, the root of its area.
        """

    def project(self, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where points are seen, differentiable in them and in the camera; asked for only where it ``projects``.

        Args:
            offset: from the camera's origin to points before it ``(3, N)``, or directions, of any length.

        Returns:
            The film position ``x, y`` in pixels, each ``(N,)``, as :meth:`rays` takes it, and the scale ``(N,)`` of areas: a
            surface element ``dA`` with the unit normal ``n`` covers ``scale |n . offset| dA`` square pixels, and a solid
            angle ``dw`` about unit directions ``scale dw``.
        """
        raise NotImplementedError

    def film_of(self, p: Tensor) -> Tensor | None:
        """Where points ``(3, N)`` of the world lie on the film: ``x h``, ``y h``, ``h`` and their depth, ``(4, N)``.

        Affine in ``p``: a line of the world is one on the film. ``x, y`` are pixels as :meth:`rays` takes them; with
        ``h`` or the depth not positive a point lies behind the camera. None: a picture that no such map makes (a lens that
        blurs it), so that edges on it are not differentiated.
        """
        return None

    def intrinsics(self) -> Tensor | None:
        """OpenCV's ``K (3, 3)`` in pixels, see :mod:`torchpt.physics.cameras.opencv`; None where no such matrix says it."""
        return None

    def kind(self) -> tuple[object, ...]:
        """What is not a tensor: the stages are compiled anew where it differs."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "resolution"}
        return (self.name, *((key, value) for key, value in own.items() if not isinstance(value, Tensor)))

    def place(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Film positions in pixels as ``right`` and ``up`` of the film's middle, in half widths of the film."""
        width, height = self.film[0], self.film[1]
        right = x * (2.0 / width) - 1.0
        return right, (1.0 - y * (2.0 / height)) * (height / width)

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Unit vectors ``(3, 1)`` in the world: right in the picture, up, and where the camera looks."""
        axes = normalize(self.to_world[:3, :3])
        return -axes[:, 0:1], axes[:, 1:2], axes[:, 2:3]

    def covectors(self) -> Tensor:
        """Rows ``(3, 3)`` that tell how far a vector of the world goes along each of the :meth:`axes`.

        Those are the axes themselves where they are at right angles, as poses are up to a thousandth. So far, and where
        derivatives are taken by single entries, rays follow the axes as they are.
        """
        return torch.linalg.inv(torch.cat(self.axes(), 1))

    def origin(self) -> Tensor:
        """Where the camera stands ``(3, 1)``."""
        return self.to_world[:3, 3:4]
