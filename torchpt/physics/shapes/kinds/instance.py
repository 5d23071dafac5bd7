"""Instances of meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torchpt.physics.shapes.base import Shape
from torchpt.spec import REQUIRED, Custom, Refused

__all__ = ["Instance"]


def _of(value: Any) -> str:
    """Return the name of a shape, or refuse another value."""
    if isinstance(value, str) and value:
        return value
    raise Refused("the name of a mesh among the shapes")


class Instance(Shape):
    """A copy of a mesh with its own transform and material, which shares the triangles; the mesh's transform does not apply."""

    name = "instance"
    parameters: ClassVar = {
        "of": Custom(
            REQUIRED,
            reader=_of,
            words="the name of a mesh among the shapes",
            doc="the mesh: its triangles are used, and its material unless one is given",
        )
    }
    copies = True  # the shape `of` is drawn once more, in place of primitives of its own

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Shape.check`."""
        if values["emission"] is not None:
            raise Refused("no emission on an instance (a mesh of its own can shine)", values["emission"], ("emission",))
