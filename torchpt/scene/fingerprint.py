"""Hashes of all that a scene came to, by walking it: two scenes that differ in anything that is rendered have two.

What a picture depends on beside these is the run's settings. No file is read again: what of it counts is what was made of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any
from weakref import WeakKeyDictionary

from torch import Tensor

from torchpt.core import tree
from torchpt.core.errors import SceneError
from torchpt.scene.build import SceneBuild
from torchpt.scene.scene import Scene

__all__ = ["fingerprint", "fingerprints"]

#: What scenes came to, and its hashes.
_known: WeakKeyDictionary[Scene, tuple[SceneBuild, dict[str, str]]] = WeakKeyDictionary()


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
    try:
        return _hashes(parts) | _build_hashes(scene)
    except TypeError as problem:
        raise SceneError("materials", str(problem), "models whose contents can be compared") from None


def _build_hashes(scene: Scene) -> dict[str, str]:
    """Return the hashes of what a scene came to; once, unless models of the caller's own may have changed since."""
    built, known = scene.built, _known.get(scene)
    if known is not None and known[0] is built:
        return known[1]
    parts = {field.name: getattr(built, field.name) for field in fields(built)}
    del parts["parameters"]  # as it was loaded: its tensors count as they are now
    found = _hashes(parts)
    if not scene.own_models:
        _known[scene] = built, found
    return found


def _hashes(parts: Mapping[str, Any]) -> dict[str, str]:
    return {name: tree.fingerprint(part).hex() for name, part in parts.items()}


def fingerprint(scene: Scene) -> str:
    """Return one hash of a whole scene, see :func:`fingerprints`."""
    return tree.fingerprint(fingerprints(scene)).hex()
