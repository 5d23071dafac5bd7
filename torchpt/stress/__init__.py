"""Stiff and extreme cases as a command: what float32 tracers break at, against closed forms and float64.

``case.py`` says what a case is, ``cases/`` holds them by topic, ``harness.py`` renders for them, ``own_scene.py`` makes cases
of any scene, ``outcome.py`` runs them, ``table.py`` and ``plots.py`` show what came of it.
"""

from __future__ import annotations

from torchpt.stress.case import Case, Measurement, Outcome
from torchpt.stress.harness import Harness
from torchpt.stress.outcome import outcome_of

__all__ = ["Case", "Harness", "Measurement", "Outcome", "outcome_of"]
