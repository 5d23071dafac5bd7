"""Direct light: ``path`` with the base class's limits, a ``max_depth`` of 2."""

from __future__ import annotations

from typing import ClassVar

from torchpt.paths.integrators.base import DARK_RIMS, LIGHT_CHOICE, SAMPLES, STRATEGY
from torchpt.paths.integrators.kinds.path import Path
from torchpt.paths.integrators.path import PathIntegrator

__all__ = ["Direct"]


class Direct(PathIntegrator):
    """Emission and direct light only: path tracing of depth 2."""

    name = "direct"
    parameters: ClassVar = {**STRATEGY, **LIGHT_CHOICE, **DARK_RIMS, **SAMPLES}

    def to_depth(self, depth: int) -> PathIntegrator:
        """See :meth:`PathIntegrator.to_depth`: ``path`` has the parameter that this integrator lacks."""
        return Path(**self.values, max_depth=depth)
