"""Count versions of a scene's tensors, to find those that were replaced or changed in place.

A scene checks changed parameters again and rebuilds its caches; a backward pass refuses parameters that changed since the
picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from weakref import ref

from torch import Tensor

from torchpt.core.errors import RenderError

__all__ = ["AFTER", "VersionCounter", "changed_versions", "check_unchanged"]

#: Phrase for errors of a backward pass.
AFTER = "after the picture whose gradient is asked for"


def changed_versions(before: Mapping[str, int], now: Mapping[str, int]) -> dict[str, int]:
    """Return the versions that differ from ``before``, and those that cannot be compared (0 or negative)."""
    return {name: version for name, version in now.items() if not 0 < version == before.get(name)}


def check_unchanged(before: Mapping[str, int], now: Mapping[str, int], since: str) -> None:
    """Raise where parameters have changed.

    Args:
        before: versions that must not have changed.
        now: versions of all parameters.
        since: phrase of when ``before`` was taken, for the error.

    Raises:
        RenderError: a parameter was replaced or changed in place.
    """
    for name, version in before.items():
        if now.get(name) != version:
            hint = "hand it over by params, whose values a picture keeps, or change it later"
            raise RenderError(f"scene.params[{name!r}] was changed {since}: {hint}")


class VersionCounter:
    """Counter of versions of named tensors."""

    def __init__(self) -> None:
        # By name: the tensor, its count of changes by torch (`Tensor._version`; -1 where torch counts none), and our version.
        self._latest: dict[str, tuple[ref[Tensor], int, int]] = {}

    def of(self, params: Mapping[str, Tensor]) -> dict[str, int]:
        """Return version numbers by name; one changes when its tensor is replaced, or changed in place by torch's count.

        Tensors of ``torch.inference_mode`` do not count changes; their versions are negative. Other objects have version 0.
        """
        found: dict[str, int] = {}
        for name, value in params.items():
            if not isinstance(value, Tensor):
                found[name] = 0
                continue
            torch_version = -1 if value.is_inference() else value._version
            before = self._latest.get(name)
            if before is None:
                number = 1
            else:
                tensor, before_torch_version, number = before
                if tensor() is not value or before_torch_version != torch_version:
                    number += 1
            self._latest[name] = ref(value), torch_version, number
            found[name] = number if torch_version >= 0 else -number
        return found
