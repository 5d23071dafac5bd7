"""What functions that take scenes say to anything else."""

from __future__ import annotations

from typing import Any

from torchpt.core.errors import SceneError
from torchpt.scene.scene import Scene

__all__ = ["as_scene"]


def as_scene(given: Any, key: str = "scene") -> Scene:
    """A scene as it is.

    Args:
        given: what stands where a scene is expected.
        key: its name in errors.

    Raises:
        SceneError: it is none.
    """
    if not isinstance(given, Scene):
        raise SceneError(key, given, "a scene from torchpt.load")
    return given
