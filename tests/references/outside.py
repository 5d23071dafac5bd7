"""Values that a parameter must refuse, derived from its declaration."""

from __future__ import annotations

import math
from typing import Any

from torchpt.spec import Choice, Flag, Integer, Spec

__all__ = ["numbers_outside", "values_outside"]


def numbers_outside(spec: Spec) -> list[float]:
    """Return numbers beyond each end of a differentiable number's range, and values that are not finite."""
    found = [math.nan, math.inf, -math.inf]
    for end, by, open_end in (("low", -1.0, "above"), ("high", 1.0, "below")):
        bound, limit = getattr(spec, end, None), getattr(spec, open_end, None)
        if limit is not None:
            found += [limit, limit + by]
        elif bound is not None:
            found.append(bound + by * 1e-3 * max(1.0, abs(bound)))
    return found


def values_outside(spec: Spec) -> list[Any]:
    """Return values that a scene file must not give to a parameter."""
    if hasattr(spec, "low") and not isinstance(spec, Integer):
        return [*numbers_outside(spec), True, "much", [1, 2]]
    if isinstance(spec, Integer):
        below = spec.low - 1 if spec.low - 1 not in spec.also else spec.low - 2
        return [below, spec.high + 1, spec.low + 0.5, "many", True]
    if isinstance(spec, Choice):
        return ["no such word", 3]
    return [3] if isinstance(spec, Flag) else ["no such thing", {"a": 1}]
