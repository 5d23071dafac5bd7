"""What the scene format knows but this version does not build: the one table.

Whoever builds a thing deletes its row here. Until then giving it is a :class:`~torchpt.core.errors.NotBuiltError`; its keys
are listed so that a misspelt key is still named as unknown.
"""

from __future__ import annotations

__all__ = ["KEYS", "TYPES"]

#: kind of thing -> its types that are not built -> the keys each of them takes beside ``type``.
TYPES: dict[str, dict[str, tuple[str, ...]]] = {
    "integrator": {
        "bdpt": ("max_depth", "rr_depth", "rr_prob", "clamp", "strict"),
    },
}

#: kind of thing -> keys of built types that are not built -> the value that asks for nothing.
KEYS: dict[str, dict[str, object]] = {}
