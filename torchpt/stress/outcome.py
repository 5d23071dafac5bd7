"""Runs cases."""

from __future__ import annotations

import math
import time

from torchpt.errors import TorchptError
from torchpt.stress.bench import Bench
from torchpt.stress.case import Case, Outcome, Reading

__all__ = ["outcome_of"]


def outcome_of(case: Case, bench: Bench, quick: bool = False) -> Outcome:
    """What a case comes to; a figure that cannot be had is told, not raised."""
    begun, readings = time.perf_counter(), []
    for at in case.chosen(quick):
        try:
            figure, problem = float(case.figure(bench, at)), ""
        except (TorchptError, ArithmeticError, AssertionError, LookupError, RuntimeError, ValueError) as error:
            figure, problem = math.nan, f"{type(error).__name__}: {' '.join(str(error).split())}"
        readings.append(Reading(at, figure, problem))
    return Outcome(case, tuple(readings), time.perf_counter() - begun)
