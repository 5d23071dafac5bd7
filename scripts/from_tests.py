"""Importing this lets scripts import what they share with tests: the modules of ``tests/references``."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "references"))
