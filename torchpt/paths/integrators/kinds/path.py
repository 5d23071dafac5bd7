"""Path tracing."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from torchpt.paths.integrators.base import DARK_RIMS, DEPTHS, LIGHT_CHOICE, SAMPLES, STRATEGY, Limits
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.spec import Refused

__all__ = ["Path"]


class Path(PathIntegrator):
    """Unidirectional path tracing with next event estimation."""

    name = "path"
    parameters: ClassVar = {
        **DEPTHS,
        **STRATEGY,
        **LIGHT_CHOICE,
        **DARK_RIMS,
        **SAMPLES,
    }

    @property
    def limits(self) -> Limits:
        """Return the depth limits that the parameters set."""
        return Limits(self.max_depth, self.rr_depth)

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values by which paths would never end; arguments as for :meth:`torchpt.spec.FrozenConfig.check`."""
        if values["max_depth"] == -1 and values["rr_prob"] == 1.0:
            expected = "a survival probability below 1 where max_depth is -1 (paths would not end)"
            raise Refused(expected, 1.0, ("rr_prob",))
