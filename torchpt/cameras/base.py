"""What every camera has, and what a kind of camera must say."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import ClassVar

from torch import Tensor

from torchpt.math.vectors import normalize

__all__ = ["Camera"]


@dataclass(frozen=True)
class Camera(ABC):
    """A camera on a film.

    Attributes:
        to_world: pose ``(4, 4)``; its scale is ignored, as only the axes' directions and the origin matter.
        width: of the whole film in pixels.
        height: of the whole film in pixels.
        film: the same two as ``(2,)`` numbers of the lanes' dtype.
        lens: whether rays also depend on a place on a lens.
    """

    to_world: Tensor
    width: int
    height: int
    film: Tensor

    lens: ClassVar[bool] = False

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
        ``spread`` a pixel's side at distance 1 in the middle of the picture; of parallel rays ``e`` is the unit direction
        against them, ``w`` is 0, and ``spread`` a pixel's side.
        """

    def kind(self) -> tuple[object, ...]:
        """What is not a tensor: the stages are compiled anew where it differs."""
        values = (getattr(self, field.name) for field in fields(self) if field.name not in ("width", "height"))
        return (type(self).__name__, *(value for value in values if not isinstance(value, Tensor)))

    def place(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Film positions in pixels as ``right`` and ``up`` of the film's middle, in half widths of the film."""
        width, height = self.film[0], self.film[1]
        right = x * (2.0 / width) - 1.0
        return right, (1.0 - y * (2.0 / height)) * (height / width)

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Unit vectors ``(3, 1)`` in the world: right in the picture, up, and where the camera looks."""
        axes = normalize(self.to_world[:3, :3])
        return -axes[:, 0:1], axes[:, 1:2], axes[:, 2:3]

    def origin(self) -> Tensor:
        """Where the camera stands ``(3, 1)``."""
        return self.to_world[:3, 3:4]
