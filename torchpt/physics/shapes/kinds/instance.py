"""Instances: other places of meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torchpt.physics.shapes.base import Shape
from torchpt.spec import REQUIRED, Custom, Refused

__all__ = ["Instance"]


def _of(value: Any) -> str:
    if isinstance(value, str) and value:
        return value
    raise Refused("the name of a mesh among the shapes")


class Instance(Shape):
    """Another place of a mesh, whose triangles it shares; the mesh's own transform does not count here."""

    name = "instance"
    parameters: ClassVar = {
        "of": Custom(
            REQUIRED,
            reader=_of,
            words="the name of a mesh among the shapes",
            doc="whose triangles these are, and whose material where it has none of its own",
        )
    }
    copies = True

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :class:`Shape`."""
        if values["emission"] is not None:
            raise Refused("no emission on an instance (a mesh of its own can shine)", values["emission"], ("emission",))
