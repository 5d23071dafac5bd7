"""Specs of material parameters: fractions, indices of refraction, normal and bump maps, inner materials.

A spec declares one key of a scene file: default, range, documentation, and ``read``, which checks a value of the file and
returns it or raises ``Refused``. Models list theirs in ``Bsdf.parameters``. ``expected`` is the phrase of
all that a key accepts, which errors print; ``accepted`` is the same without textures.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchpt.physics.bsdfs.presets import INDICES
from torchpt.spec import REQUIRED, Color, Custom, Index, Refused, Scalar, Spec
from torchpt.spec.schema import ParsedParams

__all__ = [
    "GREY",
    "WHITE",
    "Heights",
    "Inner",
    "Normals",
    "fraction",
    "no_roughness",
    "reflectance",
    "refraction_index",
]

GREY, WHITE = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)  # linear RGB


def fraction(default: Any, doc: str) -> Scalar:
    """Return the spec of a number in 0..1, or a texture."""
    return Scalar(default, low=0.0, high=1.0, texture=True, doc=doc)


def reflectance(default: Any, doc: str) -> Color:
    """Return the spec of a colour in 0..1, or a texture."""
    return Color(default, low=0.0, high=1.0, texture=True, doc=doc)


def refraction_index(default: float, doc: str) -> Index:
    """Return the spec of an index of refraction: a number, the name of a medium, or a texture."""
    return Index(default, texture=True, media=INDICES, doc=doc)


def no_roughness(rough_type: str) -> Custom:
    """Return the spec of roughness for a smooth type: 0 has no effect, others are refused with ``rough_type`` as advice."""
    words = f"0, as this type is smooth (use {rough_type})"

    def read_zero(value: Any) -> None:
        if isinstance(value, bool | Mapping) or value != 0:  # a bool would equal 0; a texture comes as a mapping
            raise Refused(words)

    return Custom(
        None, reader=read_zero, words=words, doc="no effect: allows a rough type to be replaced by a smooth one"
    )


@dataclass(frozen=True)
class Normals(Color):
    """Spec of a normal map: a texture whose colours ``c`` are normals ``2 c - 1`` in the tangent frame."""

    default: Any = None
    high: float | None = field(default=1.0, kw_only=True)
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False
    linear: ClassVar[bool] = True  # the image's numbers are read as they are, without the sRGB curve

    @property
    def expected(self) -> str:
        """Return the words of an error for what the key accepts."""
        return "a texture whose colours hold normals: {type: image, path: FILE} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse everything: a texture never gets here, as textures are opened before other values are read."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Heights(Scalar):
    """Spec of a bump map: a texture of heights along the normal."""

    default: Any = None
    low: float | None = field(default=None, kw_only=True)  # heights may be negative
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False

    @property
    def expected(self) -> str:
        """Return the words of an error for what the key accepts."""
        return "a texture of heights in the scene's units: {type: image, path: FILE, scale: UNITS} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse everything: a texture never gets here, as textures are opened before other values are read."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Inner(Spec):
    """Spec of an inner material: a name, or a material that was already read."""

    default: Any = REQUIRED

    @property
    def accepted(self) -> str:
        """Return the phrase for what the key accepts, without textures."""
        return "the name of a material, or a material"

    def read(self, value: Any) -> Any:
        """Return the value if it names a material or is one whose parameters were parsed; refuse anything else."""
        if isinstance(value, ParsedParams) or (isinstance(value, str) and value):
            return value
        raise Refused(self.expected)
