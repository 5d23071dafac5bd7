"""Cameras: from film positions to rays, one kind a file.

A pose is Mitsuba's ``to_world``: the camera looks along its own ``+z``, ``+y`` is up and ``+x`` points to the image's left,
so that image right is ``(target - origin) x up``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchpt.cameras.base import Camera
from torchpt.cameras.orthographic import Orthographic
from torchpt.cameras.perspective import FOV_AXES, Perspective

if TYPE_CHECKING:
    from torchpt.cameras.thinlens import ThinLens

__all__ = ["FOV_AXES", "Camera", "Orthographic", "Perspective", "ThinLens"]


def __getattr__(name: str) -> Any:
    """A lens is imported where a scene has one."""
    if name == "ThinLens":
        from torchpt.cameras.thinlens import ThinLens

        return ThinLens
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
