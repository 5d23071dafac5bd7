"""Parameters of which a few are fast."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest

__all__ = ["few"]


def few(values: Iterable[Any], number: int) -> list[Any]:
    """Return parameters for ``pytest.mark.parametrize``: ``number`` of them, evenly spread, are fast, the others slow."""
    values = list(values)
    kept = {0} if number == 1 else {round(k * (len(values) - 1) / (number - 1)) for k in range(number)}
    return [value if k in kept else _slow(value) for k, value in enumerate(values)]


def _slow(value: Any) -> Any:
    slow = pytest.mark.slow
    if isinstance(value, type(pytest.param())):
        return pytest.param(*value.values, marks=[*value.marks, slow], id=value.id)
    return pytest.param(*value, marks=slow) if isinstance(value, tuple) else pytest.param(value, marks=slow)
