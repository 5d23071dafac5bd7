"""The base class of perspective cameras: angle of view, principal point, pixel aspect ratio."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.cameras import opencv
from torchpt.physics.cameras.base import Camera
from torchpt.spec import Angle, Choice, Custom, Moves, Refused, Scalar

__all__ = ["FOV_AXES", "Pinhole"]

#: Values of ``fov_axis``: ``fov`` spans the film's width, height, smaller or larger side, or diagonal.
FOV_AXES = ("x", "y", "smaller", "larger", "diagonal")
#: Parameters that ``K`` determines, and that a scene file must not set beside it.
_FROM_K = ("fov", "fov_axis", "principal_point_offset_x", "principal_point_offset_y", "pixel_aspect")


@dataclass(frozen=True, kw_only=True)
class Pinhole(Camera):
    """A camera with the perspective of a pinhole, possibly blurred by a lens.

    Attributes:
        fov: full angle of view in degrees, a 0-d tensor.
        fov_axis: one of :data:`FOV_AXES`.
        principal_point_offset_x: offset of the film's centre to the right of the viewing direction, in film widths, a 0-d
            tensor; None: 0, without any computation. Mitsuba's name and sign.
        principal_point_offset_y: offset downward, in heights of the film, as above.
        pixel_aspect: width of a pixel over its height, a 0-d tensor; None: 1.
    """

    # All of them move points of the film relative to surfaces, as ``Moves.SURFACES`` says of surfaces and of the camera.
    parameters: ClassVar = {
        "fov": Angle(
            39.3,
            above=0.0,
            below=180.0,
            moves=Moves.SURFACES,
            doc="full angle of view along `fov_axis` of the whole film",
        ),
        "fov_axis": Choice("x", names=FOV_AXES, doc="side or diagonal of the film that `fov` spans"),
        "principal_point_offset_x": Scalar(
            None,
            low=None,
            moves=Moves.SURFACES,
            doc="offset of the film's centre to the right of the viewing direction, in widths of the film; 0 by default",
        ),
        "principal_point_offset_y": Scalar(
            None,
            low=None,
            moves=Moves.SURFACES,
            doc="offset of the film's centre downward, in heights of the film; 0 by default",
        ),
        "pixel_aspect": Scalar(
            None, above=0.0, moves=Moves.SURFACES, doc="width of a pixel over its height, `fy / fx`; 1 by default"
        ),
        "K": Custom(
            None,
            reader=opencv.calibration,
            words=opencv.K_WORDS,
            doc="OpenCV's calibration matrix for a picture of `size`, in place of the parameters above",
        ),
        "size": Custom(
            None,
            reader=opencv.size,
            words="[width, height] in pixels",
            doc="size of the picture that `K` belongs to; `film.width` and `film.height` of the scene by default",
        ),
    }

    fov: Tensor
    fov_axis: str
    principal_point_offset_x: Tensor | None = None
    principal_point_offset_y: Tensor | None = None
    pixel_aspect: Tensor | None = None

    @classmethod
    def check(cls, values: dict[str, Any], given: frozenset[str]) -> None:
        """Check the parameters as :meth:`Camera.check` does, and convert ``K`` to the other ones."""
        super().check(values, given)
        if values["K"] is None:
            if "size" in given:
                raise Refused("a size only beside K", list(values["size"]), ("size",))
            return
        for name in _FROM_K:
            if name in given:
                raise Refused(f"either K or {name}, not both", values[name], (name,))
        if values["size"] is None:
            raise Refused(
                "[width, height] of the picture that K belongs to, or film.width and film.height", None, ("size",)
            )
        values |= opencv.parameters_of_k(values["K"], values["size"])
        try:
            for name in ("fov", "pixel_aspect"):
                if values[name] is not None:
                    Pinhole.parameters[name].read(values[name])  # refuses values out of range
        except Refused:
            expected = f"{opencv.K_WORDS}, each of the size of a picture"
            raise Refused(expected, values["K"].tolist(), ("K",)) from None

    def sides(self) -> tuple[Tensor, Tensor]:
        """Return width and height of the film in units of a pixel's width."""
        width, height = self.film[0], self.film[1]
        return width, height if self.pixel_aspect is None else height / self.pixel_aspect

    def half_width(self) -> Tensor:
        """Return the tangent of half the horizontal angle of view, for a centred film."""
        half = torch.tan(self.fov * (math.pi / 360.0))
        w, h = self.sides()
        if self.fov_axis == "x":
            return half
        if self.fov_axis == "diagonal":
            return half * (w / (w * w + h * h).sqrt())
        if self.fov_axis == "y":
            return half * (w / h)
        spans_height = h < w if self.fov_axis == "smaller" else h > w
        return torch.where(spans_height, half * (w / h), half)

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slopes of rays through film positions: right and up per unit of depth, each ``(N,)``."""
        if self.principal_point_offset_x is not None:
            x = x + self.principal_point_offset_x * self.film[0]
        if self.principal_point_offset_y is not None:
            y = y + self.principal_point_offset_y * self.film[1]
        right, up = self.place(x, y)  # from the film's centre, both in half widths of the film
        half = self.half_width()  # slope of the film's edge
        if self.pixel_aspect is not None:
            up = up / self.pixel_aspect
        return right * half, up * half

    def area_scale(self, depth: Tensor) -> Tensor:
        """Return square pixels per solid angle ``(N,)`` along vectors of length 1 with these depths ``(N,)``."""
        # Pixels per unit of slope, squared; the solid angle of an area on a plane falls with the third power of the depth.
        scale = (0.5 * self.film[0] / self.half_width()) ** 2 / depth.abs() ** 3
        scale = scale * torch.linalg.det(self.covectors()).abs()  # 1 for orthogonal axes
        return scale if self.pixel_aspect is None else scale * self.pixel_aspect

    def film_density(self, d: Tensor) -> Tensor:
        """See :meth:`Camera.film_density`; a lens changes nothing, as its rays meet in a plane."""
        return self.area_scale(self.project_homogeneous(d)[2])

    def film_of(self, p: Tensor, u: Tensor | None = None) -> Tensor:
        """See :meth:`Camera.film_of`."""
        return self.project_homogeneous(p - self.origin())

    def project_homogeneous(self, away: Tensor) -> Tensor:
        """Return :meth:`film_of` for points at offsets ``away (3, N)`` from the camera's origin."""
        right, up, depth = self.covectors() @ away  # components of `away` along the axes of the picture, (N,) each
        half, (width, height) = self.half_width(), self.film
        # In half widths of the film, times the depth.
        across, along = right / half, up / half
        if self.pixel_aspect is not None:
            along = along * self.pixel_aspect
        x, y = 0.5 * width * (across + depth), 0.5 * (height * depth - width * along)
        if self.principal_point_offset_x is not None:
            x = x - self.principal_point_offset_x * width * depth
        if self.principal_point_offset_y is not None:
            y = y - self.principal_point_offset_y * height * depth
        return torch.stack((x, y, depth, depth))  # x h, y h, h and depth: here h is the depth

    def pixel(self) -> Tensor:
        """Return the footprint of a pixel ``(5,)``: origin of the rays, ``w`` 1, ``spread``; see :meth:`Camera.pixel`."""
        spread = self.half_width() * (2.0 / self.film[0])  # width of a pixel at distance 1
        if self.pixel_aspect is not None:
            spread = spread / self.pixel_aspect.sqrt()  # the root of the area of a pixel that is not square
        return torch.cat((self.origin()[:, 0], torch.stack((torch.ones_like(spread), spread))))

    def intrinsics(self) -> Tensor:
        """Return OpenCV's ``K (3, 3)`` in pixels, as :meth:`Camera.intrinsics`."""
        width, height = self.film[0], self.film[1]
        fx = width / (2.0 * self.half_width())
        fy = fx if self.pixel_aspect is None else fx * self.pixel_aspect
        zero, half = torch.zeros_like(fx), torch.full_like(fx, 0.5)
        x, y = self.principal_point_offset_x, self.principal_point_offset_y
        cx, cy = width * (half if x is None else half - x), height * (half if y is None else half - y)
        rows = torch.stack((fx, zero, cx)), torch.stack((zero, fy, cy)), torch.stack((zero, zero, torch.ones_like(fx)))
        return torch.stack(rows)
