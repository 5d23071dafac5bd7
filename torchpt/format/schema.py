"""The camera of a scene file as a model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from torchpt.errors import SceneError
from torchpt.math import transforms
from torchpt.spec.fields import (
    Affine,
    Vec3,
    choice,
    integer,
    number_field,
    wrong,
)  # fmt: skip
from torchpt.spec.validate import Model, refuse_foreign, select

__all__ = [
    "CAMERAS", "CAMERA_LENGTHS", "CAMERA_NUMBERS", "FOV_AXES", "Camera", "Orthographic", "Perspective", "ThinLens",
    "read_camera",
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


CAMERAS: dict[str, type[Camera]] = {
    "perspective": Perspective,
    "thinlens": ThinLens,
    "orthographic": Orthographic,
}
