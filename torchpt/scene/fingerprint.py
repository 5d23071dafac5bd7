"""Hash everything that a scene was built from: scenes whose pictures may differ have different hashes.

Checkpoints and runs compare them. Besides these hashes a picture depends on the settings only. Files are not read again: their
loaded contents are hashed.
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

#: By scene, its build and the hashes of it.
_build_hashes_of: WeakKeyDictionary[Scene, tuple[SceneBuild, dict[str, str]]] = WeakKeyDictionary()


def fingerprints(scene: Scene, params: Mapping[str, Tensor] | None = None) -> dict[str, str]:
    """Return hashes of a scene by part: its camera, its parameters by block, and each field of :class:`SceneBuild`.

    They depend neither on the process and the device nor on the paths of the scene's files.

    Args:
        scene: the scene, with the present values of its parameters.
        params: tensors in place of the scene's, by name.

    Raises:
        SceneError: a BSDF of the caller with an attribute that cannot be hashed.
    """
    tensors = {**scene.readable_params(), **(params or {})}
    parts: dict[str, Any] = {"camera": [scene.description.camera]}
    for name in sorted(tensors):
        parts.setdefault(name.partition(".")[0], []).append((name, tensors[name]))
    try:
        return _hashes(parts) | _build_hashes(scene)
    except TypeError as problem:
        raise SceneError("materials", str(problem), "models whose contents can be compared") from None


def _build_hashes(scene: Scene) -> dict[str, str]:
    """Return the hashes of a scene's build, cached unless it has BSDFs of the caller, which may change."""
    built = scene.built
    if scene in _build_hashes_of:
        hashed_build, hashes = _build_hashes_of[scene]
        if hashed_build is built:
            return hashes
    parts = {field.name: getattr(built, field.name) for field in fields(built)}
    del parts["parameters"]  # the values as loaded; the present ones are hashed with `params`
    found = _hashes(parts)
    if not scene.own_models:
        _build_hashes_of[scene] = built, found
    return found


def _hashes(parts: Mapping[str, Any]) -> dict[str, str]:
    """Return the hash of each part by name, in hexadecimal."""
    return {name: tree.fingerprint(part).hex() for name, part in parts.items()}


def fingerprint(scene: Scene) -> str:
    """Return one hash of a whole scene: that of all its :func:`fingerprints`."""
    return tree.fingerprint(fingerprints(scene)).hex()
