"""Specs of material parameters: fractions, indices of refraction, normal and bump maps, inner materials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchpt.physics.bsdfs.presets import INDICES
from torchpt.spec import REQUIRED, Color, Custom, Index, Refused, Scalar, Spec
from torchpt.spec.schema import ParsedParams

__all__ = ["GREY", "WHITE", "Heights", "Inner", "Normals", "fraction", "index", "reflectance", "smooth"]

GREY, WHITE = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)


def fraction(default: Any, doc: str) -> Scalar:
    """Return the spec of a number in 0..1, or a texture."""
    return Scalar(default, high=1.0, texture=True, doc=doc)


def reflectance(default: Any, doc: str) -> Color:
    """Return the spec of a colour in 0..1, or a texture."""
    return Color(default, high=1.0, texture=True, doc=doc)


def index(default: float, doc: str) -> Index:
    """Return the spec of an index of refraction: a number, the name of a medium, or a texture."""
    return Index(default, texture=True, media=INDICES, doc=doc)


def smooth(rough: str) -> Custom:
    """Return the spec of roughness for a smooth type: 0 without effect, else an error that suggests the type ``rough``."""
    words = f"0, as this type is smooth (use {rough})"

    def read(value: Any) -> None:
        if isinstance(value, bool | Mapping) or value != 0:
            raise Refused(words)

    return Custom(None, reader=read, words=words, doc="no effect: allows a rough type to be replaced by a smooth one")


@dataclass(frozen=True)
class Normals(Color):
    """Spec of a normal map: a texture whose colours ``c`` are normals ``2 c - 1`` in the tangent frame."""

    default: Any = None
    high: float | None = field(default=1.0, kw_only=True)
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    @property
    def expected(self) -> str:
        """See :attr:`Spec.expected`."""
        return "a texture whose colours hold normals: {type: image, path: FILE} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse everything: textures are read before this is called."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Heights(Scalar):
    """Spec of a bump map: a texture of heights along the normal."""

    default: Any = None
    low: float | None = field(default=None, kw_only=True)
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False

    @property
    def expected(self) -> str:
        """See :attr:`Spec.expected`."""
        return "a texture of heights in the scene's units: {type: image, path: FILE, scale: UNITS} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse everything: textures are read before this is called."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Inner(Spec):
    """Spec of an inner material: a name, or a material that was already read."""

    default: Any = REQUIRED

    @property
    def accepted(self) -> str:
        """See :attr:`Spec.accepted`."""
        return "the name of a material, or a material"

    def read(self, value: Any) -> Any:
        """See :meth:`Spec.read`."""
        if isinstance(value, ParsedParams) or (isinstance(value, str) and value):
            return value
        raise Refused(self.expected)
