"""Put ``tests/references`` on the import path, so that scripts can import modules that they share with tests."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "references"))
