"""Stress tests as a command: extreme scenes that break float32 path tracers, against closed forms and float64.

``case.py`` defines a case, ``cases/`` has the cases by topic, ``bench.py`` renders their scenes, ``own_scene.py`` makes cases
of any scene, ``outcome.py`` runs cases, ``table.py`` and ``plots.py`` show the results.
"""

from __future__ import annotations

from torchpt.stress.bench import Bench
from torchpt.stress.case import Case, Outcome, Reading
from torchpt.stress.outcome import outcome_of

__all__ = ["Bench", "Case", "Outcome", "Reading", "outcome_of"]
