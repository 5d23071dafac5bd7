"""The camera of a scene file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchpt.physics.cameras import KINDS
from torchpt.spec.schema import ParsedParams, read_typed, refuse_unused_keys

__all__ = ["read_camera"]


def read_camera(raw: Any, film: Mapping[str, Any], file: str | None) -> ParsedParams:
    """The camera of a scene file's block.

    Args:
        raw: as written.
        film: the film block as written, by whose size a ``K`` in pixels is read that does not say its own.
        file: scene file for errors.

    Raises:
        SceneError: what is wrong with it.
    """
    if isinstance(raw, Mapping) and raw.get("K") is not None and raw.get("size") is None:
        size = [film.get("width"), film.get("height")]
        raw = raw if None in size else {**raw, "size": size}
    refuse_unused_keys("camera", KINDS, raw, KINDS.names[0], file)
    return read_typed("camera", KINDS, raw, "camera", file, KINDS.names[0])
