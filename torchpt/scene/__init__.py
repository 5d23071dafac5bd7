"""YAML -> description -> parts -> :class:`Scene`."""

from __future__ import annotations

from torchpt.scene.loading import load
from torchpt.scene.scene import Scene

__all__ = ["Scene", "load"]
