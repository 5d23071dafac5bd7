"""What parameters of materials are, beyond numbers and colours: fractions, indices, maps, other materials."""

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
    """A number in 0..1, or a texture."""
    return Scalar(default, high=1.0, texture=True, doc=doc)


def reflectance(default: Any, doc: str) -> Color:
    """A colour in 0..1, or a texture."""
    return Color(default, high=1.0, texture=True, doc=doc)


def index(default: float, doc: str) -> Index:
    """An index of refraction: a number, a medium's name, or a texture."""
    return Index(default, texture=True, media=INDICES, doc=doc)


def smooth(rough: str) -> Custom:
    """The roughness of a type that has none: 0, which says nothing; ``rough`` is the type to use instead."""
    words = f"0, as this type is smooth (use {rough})"

    def read(value: Any) -> None:
        if isinstance(value, bool | Mapping) or value != 0:
            raise Refused(words)

    return Custom(None, reader=read, words=words, doc="nothing: there so that rough and smooth types can be exchanged")


@dataclass(frozen=True)
class Normals(Color):
    """Normals in the surface's own frame, which a texture alone can give: ``2 c - 1`` of its colours c."""

    default: Any = None
    high: float | None = field(default=1.0, kw_only=True)
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False
    linear: ClassVar[bool] = True

    @property
    def expected(self) -> str:
        """See :class:`Spec`."""
        return "a texture whose colours hold normals: {type: image, path: FILE} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse what is no texture."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Heights(Scalar):
    """Heights along the normal, which a texture alone can give."""

    default: Any = None
    low: float | None = field(default=None, kw_only=True)
    texture: bool = field(default=True, kw_only=True)

    differentiable: ClassVar[bool] = False

    @property
    def expected(self) -> str:
        """See :class:`Spec`."""
        return "a texture of heights in the scene's units: {type: image, path: FILE, scale: UNITS} or {texture: NAME}"

    def read(self, value: Any) -> Any:
        """Refuse what is no texture."""
        raise Refused(self.expected)


@dataclass(frozen=True)
class Inner(Spec):
    """Another material: its name, or one in its place, which has been read before."""

    default: Any = REQUIRED

    @property
    def accepted(self) -> str:
        """See :class:`Spec`."""
        return "the name of a material, or a material"

    def read(self, value: Any) -> Any:
        """See :class:`Spec`."""
        if isinstance(value, ParsedParams) or (isinstance(value, str) and value):
            return value
        raise Refused(self.expected)
