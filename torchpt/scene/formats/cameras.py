"""Read the camera block of a scene file, for scenes and for views of them through another camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchpt.physics.cameras import KINDS
from torchpt.spec.schema import ParsedParams, read_typed, refuse_unused_keys

__all__ = ["read_camera"]


def read_camera(raw: Any, film: Mapping[str, Any], file: str | None) -> ParsedParams:
    """Read the camera block.

    Args:
        raw: the block as written.
        film: the film block as written; its size is that of a ``K`` without ``size``.
        file: scene file, for errors.

    Raises:
        SceneError: a wrong key or value.
    """
    default = KINDS.names[0]  # the type of a block without one
    if isinstance(raw, Mapping) and raw.get("K") is not None and raw.get("size") is None:
        size = [film.get("width"), film.get("height")]
        raw = raw if None in size else {**raw, "size": size}
    refuse_unused_keys("camera", KINDS, raw, default=default, file=file)
    return read_typed("camera", KINDS, raw, key="camera", file=file, default=default)
