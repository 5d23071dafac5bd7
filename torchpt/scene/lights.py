"""The lights block of a scene file as models: lights that are no surfaces. One table."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from torchpt.math.transforms import similarity_scale
from torchpt.scene.fields import Check, Color, Transform, Vec3, file_paths, number_field, scalar, wrong
from torchpt.scene.validate import Model

__all__ = ["ENVIRONMENTS", "LIGHTS", "Light"]

Angle = Annotated[float, number_field("an angle in degrees, 0 < angle <= 180", lambda x: 0 < x <= 180)]


class Light(Model):
    """What every light has: numbers, each of them a parameter of the scene (textures apart)."""

    type: str

    def numbers(self) -> dict[str, Any]:
        """Its parameters by name."""
        return {name: getattr(self, name) for name in type(self).model_fields if name != "type"}


class PointLight(Light):
    """A point that shines alike in all directions.

    Attributes:
        intensity: power per solid angle.
    """

    type: Literal["point"] = "point"
    position: Vec3
    intensity: Color = (1.0, 1.0, 1.0)


class SpotLight(Light):
    """A point that shines within a cone about the direction to ``target``.

    Attributes:
        intensity: within the beam.
        cutoff_angle: from the axis, in degrees; nothing shines beyond.
        beam_width: from the axis, in degrees, up to which the intensity is whole; from there it falls linearly in the angle
            to zero at the cutoff. By default three quarters of the cutoff.
    """

    type: Literal["spot"] = "spot"
    position: Vec3
    target: Vec3
    intensity: Color = (1.0, 1.0, 1.0)
    cutoff_angle: Angle = 20.0
    beam_width: Angle = 15.0

    @model_validator(mode="before")
    @classmethod
    def _default_beam(cls, raw: Any) -> Any:
        cutoff = raw.get("cutoff_angle", 20.0)
        if raw.get("beam_width") is None and isinstance(cutoff, int | float):
            return {**raw, "beam_width": 0.75 * cutoff}
        return raw

    @model_validator(mode="after")
    def _aimed(self) -> SpotLight:
        if self.position == self.target:
            raise wrong("a point other than the position", list(self.target), ("target",))
        if self.beam_width > self.cutoff_angle:
            raise wrong(f"an angle of at most cutoff_angle ({self.cutoff_angle:g})", self.beam_width, ("beam_width",))
        return self


class DirectionalLight(Light):
    """Parallel light from infinitely far.

    Attributes:
        direction: where the light goes.
        irradiance: on a surface that faces it.
    """

    type: Literal["directional"] = "directional"
    direction: Vec3
    irradiance: Color = (1.0, 1.0, 1.0)

    @model_validator(mode="after")
    def _directed(self) -> DirectionalLight:
        if not any(self.direction):
            raise wrong("a direction other than [0, 0, 0]", list(self.direction), ("direction",))
        return self


class ConstantLight(Light):
    """An environment of one radiance from all directions."""

    type: Literal["constant"] = "constant"
    radiance: Color = (1.0, 1.0, 1.0)


class EnvmapLight(Light):
    """An environment given by a picture of all directions (:mod:`torchpt.lights.envmap`).

    Attributes:
        path: candidates, the first existing one is used.
        scale: factor of its radiance.
        transform: turns it (and may mirror it); where it is moved to, and how much it is enlarged, do not matter.
    """

    type: Literal["envmap"] = "envmap"
    path: Annotated[tuple[str, ...], Check(file_paths)]
    scale: Annotated[float, scalar()] = 1.0
    transform: Transform | None = None

    def numbers(self) -> dict[str, Any]:
        return {"scale": self.scale, "to_world": self.to_world()}  # its texels are read when the scene is built

    def to_world(self) -> NDArray[np.float64]:
        """The map's own space to world, ``(4, 4)`` float64."""
        return np.eye(4) if self.transform is None else self.transform

    @model_validator(mode="after")
    def _turned(self) -> EnvmapLight:
        if similarity_scale(self.to_world()) is None:
            expected = "a transform that keeps angles (rotation, reflection, uniform scale)"
            raise wrong(expected, self.to_world().tolist(), ("transform",))
        return self


LIGHTS: dict[str, type[Light]] = {
    "point": PointLight,
    "spot": SpotLight,
    "directional": DirectionalLight,
    "constant": ConstantLight,
    "envmap": EnvmapLight,
}
#: Those that surround the scene, of which there may be one.
ENVIRONMENTS = ("constant", "envmap")
