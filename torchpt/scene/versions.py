"""Which of a scene's tensors are others than they were, or were changed in place."""

from __future__ import annotations

from collections.abc import Mapping
from weakref import ref

from torch import Tensor

from torchpt.core.errors import RenderError

__all__ = ["AFTER", "VersionCounter", "changed_versions", "check_unchanged"]

#: Since when a scene may not have changed whose gradient is asked for.
AFTER = "after the picture whose gradient is asked for"


def changed_versions(before: Mapping[str, int], now: Mapping[str, int]) -> dict[str, int]:
    """Of editions, those that are others than before, and those of which nobody can tell."""
    return {name: version for name, version in now.items() if not 0 < version == before.get(name)}


def check_unchanged(before: Mapping[str, int], now: Mapping[str, int], since: str) -> None:
    """Refuse to go on with another scene than it was.

    Args:
        before: editions that are to be the same.
        now: those of all parameters.
        since: when they were taken, for the error.

    Raises:
        RenderError: one of the scene's own parameters was replaced, or changed in place.
    """
    for name, version in before.items():
        if now.get(name) != version:
            hint = "hand it over by params, whose values a picture keeps, or change it later"
            raise RenderError(f"scene.params[{name!r}] was changed {since}: {hint}")


class VersionCounter:
    """Numbers what tensors hold, by their names, as far as it is asked for."""

    def __init__(self) -> None:
        self._latest: dict[str, tuple[ref[Tensor], int, int]] = {}  # tensor, its version, number

    def of(self, params: Mapping[str, Tensor]) -> dict[str, int]:
        """By name a number, which is another one once there is another tensor, or torch counts a change in place.

        Tensors of ``torch.inference_mode`` count no changes: their numbers are negative. That of what is no tensor is 0.
        """
        found: dict[str, int] = {}
        for name, value in params.items():
            if not isinstance(value, Tensor):
                found[name] = 0
                continue
            version = -1 if value.is_inference() else value._version
            before = self._latest.get(name)
            number = 1 if before is None else before[2]
            if before is None or before[0]() is not value or before[1] != version:
                number += before is not None
                self._latest[name] = ref(value), version, number
            found[name] = number if version >= 0 else -number
        return found
