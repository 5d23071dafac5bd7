"""YAML -> description -> parts -> :class:`Scene`."""

from __future__ import annotations

from torchpt.scene.scene import Scene, load

__all__ = ["Scene", "load"]
