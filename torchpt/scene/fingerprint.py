"""Hashes of all that a scene came to, by walking it: two scenes that differ in anything that is rendered have two.

What a picture depends on beside these is the run's settings. No file is read again: what of it counts is what was made of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from torch import Tensor

from torchpt.core import tree
from torchpt.errors import SceneError
from torchpt.scene.scene import Scene

__all__ = ["fingerprint", "fingerprints"]


def fingerprints(scene: Scene, params: Mapping[str, Tensor] | None = None) -> dict[str, str]:
    """Return a hash of each part of a scene: its camera, its tensors by their blocks, and each field of what it came to.

    They are the same in every process and on every device, wherever the scene's files lie.

    Args:
        scene: whose tensors are hashed as they are now.
        params: tensors in place of its own, by name.

    Raises:
        SceneError: a model of the caller's own that holds what has no contents to compare.
    """
    tensors = {**scene.params, **(params or {})}
    parts: dict[str, Any] = {"camera": [scene.description.camera]}
    for name in sorted(tensors):
        parts.setdefault(name.partition(".")[0], []).append((name, tensors[name]))
    built = {field.name: getattr(scene.built, field.name) for field in fields(scene.built)}
    del built["parameters"]  # as it was loaded; its tensors are above, as they are now
    try:
        return {name: tree.fingerprint(part).hex() for name, part in {**parts, **built}.items()}
    except TypeError as problem:
        raise SceneError("materials", str(problem), "models whose contents can be compared") from None


def fingerprint(scene: Scene) -> str:
    """Return one hash of a whole scene, see :func:`fingerprints`."""
    return tree.fingerprint(fingerprints(scene)).hex()
