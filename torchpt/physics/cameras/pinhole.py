"""What cameras with an angle of view share."""

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

#: What ``fov`` spans: the film's width, height, its smaller or larger side, or its diagonal.
FOV_AXES = ("x", "y", "smaller", "larger", "diagonal")
_FROM_K = ("fov", "fov_axis", "principal_point_offset_x", "principal_point_offset_y", "pixel_aspect")


@dataclass(frozen=True, kw_only=True)
class Pinhole(Camera):
    """A camera whose picture is what a pinhole's is, or blurs it.

    Attributes:
        fov: full angle of view in degrees, a 0-d tensor.
        fov_axis: one of :data:`FOV_AXES`.
        principal_point_offset_x: how far the film's middle lies to the right of where the camera looks, in widths of the
            film, a 0-d tensor; None: not at all, and no instruction for it. Mitsuba's name and sign.
        principal_point_offset_y: the same downwards, in heights.
        pixel_aspect: a pixel's width over its height, a 0-d tensor; None: squares.
    """

    parameters: ClassVar = {
        "fov": Angle(
            39.3,
            above=0.0,
            below=180.0,
            moves=Moves.SURFACES,
            doc="full angle of view along `fov_axis` of the whole film",
        ),
        "fov_axis": Choice("x", names=FOV_AXES, doc="what `fov` spans: a side of the film, or its diagonal"),
        "principal_point_offset_x": Scalar(
            None,
            low=None,
            moves=Moves.SURFACES,
            doc="how far the film's middle lies right of where the camera looks, in widths of the film; 0 by default",
        ),
        "principal_point_offset_y": Scalar(
            None, low=None, moves=Moves.SURFACES, doc="the same downwards, in heights of the film; 0 by default"
        ),
        "pixel_aspect": Scalar(
            None, above=0.0, moves=Moves.SURFACES, doc="a pixel's width over its height, `fy / fx`; 1 by default"
        ),
        "K": Custom(
            None,
            reader=opencv.calibration,
            words=opencv.K_WORDS,
            doc="in place of these: OpenCV's calibration matrix of a picture of `size`",
        ),
        "size": Custom(
            None,
            reader=opencv.size,
            words="[width, height] in pixels",
            doc="of the picture that `K` belongs to; by default the scene's own `film.width` and `film.height`",
        ),
    }

    fov: Tensor
    fov_axis: str
    principal_point_offset_x: Tensor | None = None
    principal_point_offset_y: Tensor | None = None
    pixel_aspect: Tensor | None = None

    @classmethod
    def check(cls, values: dict[str, Any], given: frozenset[str]) -> None:
        """See :class:`Camera`; ``K`` becomes the other parameters."""
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
        values |= opencv.angles(values["K"], values["size"])
        try:
            for name in ("fov", "pixel_aspect"):
                if values[name] is not None:
                    Pinhole.parameters[name].read(values[name])
        except Refused:
            expected = f"{opencv.K_WORDS}, each of the size of a picture"
            raise Refused(expected, values["K"].tolist(), ("K",)) from None

    def sides(self) -> tuple[Tensor, Tensor]:
        """Width and height of the film, in widths of a pixel."""
        width, height = self.film[0], self.film[1]
        return width, height if self.pixel_aspect is None else height / self.pixel_aspect

    def half_width(self) -> Tensor:
        """Tangent of half the horizontal angle of view, of a film in the middle."""
        half = torch.tan(self.fov * (math.pi / 360.0))
        w, h = self.sides()
        if self.fov_axis == "x":
            return half
        if self.fov_axis == "diagonal":
            return half * (w / (w * w + h * h).sqrt())
        if self.fov_axis == "y":
            return half * (w / h)
        other = h < w if self.fov_axis == "smaller" else h > w
        return torch.where(other, half * (w / h), half)

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """How far ``right`` and ``up`` a ray through the film goes for each unit of depth, each ``(N,)``."""
        if self.principal_point_offset_x is not None:
            x = x + self.principal_point_offset_x * self.film[0]
        if self.principal_point_offset_y is not None:
            y = y + self.principal_point_offset_y * self.film[1]
        right, up = self.place(x, y)
        half = self.half_width()
        if self.pixel_aspect is not None:
            up = up / self.pixel_aspect
        return right * half, up * half

    def film_of(self, p: Tensor) -> Tensor | None:
        """See :meth:`Camera.film_of`."""
        return None if self.lens else self.project_homogeneous(p - self.origin())

    def project_homogeneous(self, away: Tensor) -> Tensor:
        """:meth:`film_of` of points that lie ``away (3, N)`` from the origin."""
        right, up, depth = self.covectors() @ away
        half, (width, height) = self.half_width(), self.film
        across, along = right / half, up / half
        if self.pixel_aspect is not None:
            along = along * self.pixel_aspect
        x, y = 0.5 * width * (across + depth), 0.5 * (height * depth - width * along)
        if self.principal_point_offset_x is not None:
            x = x - self.principal_point_offset_x * width * depth
        if self.principal_point_offset_y is not None:
            y = y - self.principal_point_offset_y * height * depth
        return torch.stack((x, y, depth, depth))

    def pixel(self) -> Tensor:
        """See :meth:`Camera.pixel`."""
        spread = self.half_width() * (2.0 / self.film[0])
        if self.pixel_aspect is not None:
            spread = spread / self.pixel_aspect.sqrt()
        return torch.cat((self.origin()[:, 0], torch.stack((torch.ones_like(spread), spread))))

    def intrinsics(self) -> Tensor:
        """See :meth:`Camera.intrinsics`."""
        width, height = self.film[0], self.film[1]
        fx = width / (2.0 * self.half_width())
        fy = fx if self.pixel_aspect is None else fx * self.pixel_aspect
        zero, half = torch.zeros_like(fx), torch.full_like(fx, 0.5)
        x, y = self.principal_point_offset_x, self.principal_point_offset_y
        cx, cy = width * (half if x is None else half - x), height * (half if y is None else half - y)
        rows = torch.stack((fx, zero, cx)), torch.stack((zero, fy, cy)), torch.stack((zero, zero, torch.ones_like(fx)))
        return torch.stack(rows)
