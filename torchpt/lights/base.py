"""What a light is that is no surface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torchpt.spec import Spec

__all__ = ["Light"]


class Light:
    """A kind of light.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares.
        distant: whether it is infinitely far.
        environment: whether it surrounds the scene, of which there may be one.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    distant: ClassVar[bool] = False
    environment: ClassVar[bool] = False

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that do not go together.

        Raises:
            Refused: says which, and what is accepted.
        """
