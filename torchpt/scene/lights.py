"""The lights block of a scene file as models: lights that are no surfaces. One table."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import model_validator

from torchpt.scene.fields import Color, Vec3, number_field, wrong
from torchpt.scene.validate import Model

__all__ = ["ENVIRONMENTS", "LIGHTS", "Light"]

Angle = Annotated[float, number_field("an angle in degrees, 0 < angle <= 180", lambda x: 0 < x <= 180)]


class Light(Model):
    """What every light has: numbers, each of them a parameter of the scene."""

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


LIGHTS: dict[str, type[Light]] = {
    "point": PointLight,
    "spot": SpotLight,
    "directional": DirectionalLight,
    "constant": ConstantLight,
}
#: Those that surround the scene, of which there may be one.
ENVIRONMENTS = ("constant",)
