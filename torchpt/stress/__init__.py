"""Stress tests as a command: extreme scenes that break float32 path tracers, against closed forms and float64.

``case.py`` defines a case, ``cases/`` has the cases by topic, ``harness.py`` renders their scenes, ``scene_cases.py`` makes
cases of any scene, ``outcome.py`` runs cases, ``table.py`` and ``plots.py`` show the results.
"""

from __future__ import annotations

from torchpt.stress.case import Case, Measurement, Outcome
from torchpt.stress.harness import Harness
from torchpt.stress.outcome import outcome_of

__all__ = ["Case", "Harness", "Measurement", "Outcome", "outcome_of"]
