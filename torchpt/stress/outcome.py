"""Run a stress case at the points of its sweep."""

from __future__ import annotations

import math
import time

from torchpt.core.errors import SceneError, TorchptError
from torchpt.stress.case import Case, Measurement, Outcome
from torchpt.stress.harness import Harness

__all__ = ["outcome_of"]


def outcome_of(case: Case, harness: Harness, *, quick: bool = False) -> Outcome:
    """Run a case at all points of its sweep; exceptions are recorded, not raised.

    A search structure may refuse a scene (``brute``, where float32 is too coarse for it). That is recorded, and is no failure:
    ``auto`` takes another one there.

    Args:
        case: the case.
        harness: device, search, engine and dtype of its renders.
        quick: run it at a few points of its sweep only.
    """
    start, readings = time.perf_counter(), []
    for at in case.points(quick=quick):
        try:
            figure, problem, refused = float(case.figure(harness, at)), "", False
        except (TorchptError, ArithmeticError, AssertionError, LookupError, RuntimeError, ValueError) as error:
            figure, problem = math.nan, f"{type(error).__name__}: {' '.join(str(error).split())}"
            # The error of a search structure names the setting that chose it.
            refused = isinstance(error, SceneError) and error.key == "render.accel"
        readings.append(Measurement(at, figure, problem=problem, refused=refused))
    return Outcome(case, tuple(readings), seconds=time.perf_counter() - start)
