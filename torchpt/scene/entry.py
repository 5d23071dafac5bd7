"""Check that what a caller passes as a scene is one; entry points such as ``torchpt.render`` call this first."""

from __future__ import annotations

from typing import Any

from torchpt.core.errors import SceneError
from torchpt.scene.scene import Scene

__all__ = ["as_scene"]


def as_scene(argument: Any, key: str = "scene") -> Scene:
    """Return a scene unchanged.

    Args:
        argument: what the caller passed.
        key: name of the argument in errors.

    Raises:
        SceneError: not a scene.
    """
    if not isinstance(argument, Scene):
        raise SceneError(key, argument, "a scene from torchpt.load")
    return argument
