"""Check the type of scenes that callers pass."""

from __future__ import annotations

from typing import Any

from torchpt.core.errors import SceneError
from torchpt.scene.scene import Scene

__all__ = ["as_scene"]


def as_scene(given: Any, key: str = "scene") -> Scene:
    """Return a scene unchanged.

    Args:
        given: the argument.
        key: name of the argument in errors.

    Raises:
        SceneError: not a scene.
    """
    if not isinstance(given, Scene):
        raise SceneError(key, given, "a scene from torchpt.load")
    return given
