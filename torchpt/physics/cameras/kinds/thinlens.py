"""The thin lens camera, with depth of field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import concentric_disk, uniform_polygon
from torchpt.math.vectors import normalize
from torchpt.physics.cameras.pinhole import Pinhole
from torchpt.spec import Integer, Moves, Scalar

__all__ = ["ThinLens"]


@dataclass(frozen=True, kw_only=True)
class ThinLens(Pinhole):
    """A perspective camera whose rays start on a lens and meet in the plane of focus.

    A point at depth ``z`` is blurred to a disk of radius ``aperture_radius |1/focus_distance - 1/z|``, in slopes as of
    :meth:`slopes` (Potmesil and Chakravarty, *A Lens and Aperture Camera Model*, 1981).

    Attributes:
        aperture_radius: radius of the lens in world units, a 0-d tensor.
        focus_distance: depth of the plane of focus, along the viewing direction, a 0-d tensor.
        blades: corners of the aperture, the first of them up; 0 is a disk.
    """

    name = "thinlens"
    # `Moves.SURFACES`: what moves surfaces or the camera, as the lens does.
    parameters: ClassVar = {
        "aperture_radius": Scalar(length=True, moves=Moves.SURFACES, doc="radius of the lens; 0 is a pinhole"),
        "focus_distance": Scalar(
            above=0.0, length=True, moves=Moves.SURFACES, doc="depth of the plane of focus, along the viewing direction"
        ),
        "blades": Integer(
            0, low=3, high=64, also=(0,), doc="corners of the aperture, the first of them up; 0 is a disk"
        ),
    }
    lens: ClassVar[bool] = True
    reaches: ClassVar[tuple[str, ...]] = ("aperture_radius",)

    aperture_radius: Tensor
    focus_distance: Tensor
    blades: int

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`."""
        assert u is not None
        left, high = self._lens(u)
        right, up, ahead = self.axes()
        across, along = self.slopes(x, y)  # of the pinhole's ray: right and up per unit of depth
        # From the point on the lens to the point in focus, divided by the larger of radius and distance: nothing overflows, and
        # a lens of radius 0 gives exactly the rays of a pinhole.
        unit = torch.maximum(self.aperture_radius, self.focus_distance).detach()
        near, far = self.aperture_radius / unit, self.focus_distance / unit
        d = ahead * far + up * (along * far - high * near) + right * (across * far + left * near)
        o = self.origin() + up * (high * self.aperture_radius) - right * (left * self.aperture_radius)
        return o, normalize(d)

    def _lens(self, u: Tensor) -> Tensor:
        """Return points ``(2, N)`` on a lens of radius 1: to the left in the picture, and up."""
        return concentric_disk(u) if self.blades == 0 else uniform_polygon(u, self.blades)

    def film_of(self, p: Tensor, u: Tensor | None = None) -> Tensor:
        """See :meth:`Camera.film_of`: from each point of the lens, a pinhole whose film is moved so as to keep the focus."""
        if u is None:
            return super().film_of(p)
        on_lens = self._on_lens(u)
        seen = self.project_homogeneous(p - (self.origin() + on_lens))
        x, y, _, _ = self.project_homogeneous(on_lens)
        depth, far = seen[2], self.focus_distance
        return torch.stack((seen[0] + x * (depth / far), seen[1] + y * (depth / far), depth, depth))

    def _on_lens(self, u: Tensor) -> Tensor:
        """Return points of the lens ``(3, N)``, from the camera's origin."""
        left, high = self._lens(u) * self.aperture_radius
        right, up, _ = self.axes()
        return up * high - right * left

    def connect(self, p: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :meth:`Camera.connect`."""
        assert u is not None
        on_lens = self._on_lens(u)
        away = p - (self.origin() + on_lens)
        depth = self.project_homogeneous(away)[2]
        ahead = depth > 0
        # The ray's point in the plane of focus, as the pinhole sees it.
        focus = on_lens + away * (self.focus_distance / torch.where(ahead, depth, 1.0))
        x, y, far, _ = self.project_homogeneous(focus)
        return self.origin() + on_lens, x / far, y / far, ahead
