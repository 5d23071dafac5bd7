"""Runs cases."""

from __future__ import annotations

import math
import time

from torchpt.core.errors import SceneError, TorchptError
from torchpt.stress.case import Case, Measurement, Outcome
from torchpt.stress.harness import Harness

__all__ = ["outcome_of"]


def outcome_of(case: Case, harness: Harness, quick: bool = False) -> Outcome:
    """What a case comes to; a figure that cannot be had is told, not raised.

    A search that is asked for by name may refuse a scene (``brute``, where float32 is too coarse for it): that is told too, and
    is no failure, as ``auto`` takes another one there.
    """
    begun, readings = time.perf_counter(), []
    for at in case.points(quick):
        try:
            figure, problem, refused = float(case.figure(harness, at)), "", False
        except (TorchptError, ArithmeticError, AssertionError, LookupError, RuntimeError, ValueError) as error:
            figure, problem = math.nan, f"{type(error).__name__}: {' '.join(str(error).split())}"
            refused = isinstance(error, SceneError) and error.key == "render.accel"
        readings.append(Measurement(at, figure, problem, refused))
    return Outcome(case, tuple(readings), time.perf_counter() - begun)
