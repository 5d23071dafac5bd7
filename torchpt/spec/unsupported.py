"""Types and keys that the scene format knows and this version does not support.

Using one raises a :class:`~torchpt.core.errors.NotBuiltError`. The keys of a type are listed so that a misspelt key is still
reported as unknown. An implementation deletes its row.
"""

from __future__ import annotations

__all__ = ["KEYS", "TYPES"]

#: Name of a table of kinds -> its unsupported types -> the keys of each beside ``type``.
TYPES: dict[str, dict[str, tuple[str, ...]]] = {
    "integrator": {
        "vcm": ("max_depth", "rr_depth", "rr_prob", "radius", "alpha", "strict"),
    },
}

#: Name of a table or type -> its unsupported keys -> the value of each that changes nothing.
KEYS: dict[str, dict[str, object]] = {}
