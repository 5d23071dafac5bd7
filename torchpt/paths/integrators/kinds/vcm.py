"""Vertex connection and merging: ``bdpt``, and camera paths that are merged with photons, for caustics behind glass."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from torchpt.paths.integrators.kinds.bdpt import STRATEGIES, Bdpt
from torchpt.spec import Choice, Refused, Scalar

if TYPE_CHECKING:
    from typing import Self

__all__ = ["Vcm"]


class Vcm(Bdpt):
    """Vertex connection and merging: ``bdpt``, and merges of camera paths with photons. Consistent, not unbiased.

    After Georgiev, Krivanek, Davidovic and Slusallek, "Light Transport Simulation with Vertex Connection and Merging" (2012).
    The radius falls from sample to sample as in Knaus and Zwicker, "Progressive Photon Mapping: A Probabilistic Approach"
    (2011).
    """

    name = "vcm"
    parameters: ClassVar = {
        **Bdpt.parameters,
        "strategy": Choice(
            "mis",
            names=("mis", *STRATEGIES, "merging"),
            doc="how light is found: all ways weighted; or by camera paths that meet it, light samples, light paths joined to "
            "the camera, connections or merges alone",
        ),
        "light_paths": Scalar(1.0, above=0.0, high=1.0, doc="number of light paths for each camera path"),
        "radius": Scalar(
            None,
            above=0.0,
            words="null or a number > 0",
            length=True,
            doc="within which the first sample of each pixel merges paths; null: two pixels, where the camera sees surfaces",
        ),
        "alpha": Scalar(
            0.75,
            above=0.0,
            high=1.0,
            doc="share of the photons that each sample keeps as the radius falls; 1: it does not fall, and bias stays",
        ),
    }

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """Refuse values that contradict each other, or by which paths would never end.

        Arguments as for :meth:`torchpt.spec.FrozenConfig.check`.
        """
        super().check(values, given)
        if values["strategy"] == "merging" and not values["weighted"]:
            # A path of k edges has k - 1 vertices, each of which may be merged.
            raise Refused("true beside strategy=merging", False, ("weighted",))

    @property
    def merging_counts(self) -> bool:
        """See :class:`Integrator`."""
        # A path with a merge has two edges at least.
        return not 0 <= self.max_depth < 2

    @property
    def merges(self) -> bool:
        """See :class:`Integrator`."""
        return self.merging_counts and self.strategy in ("mis", "merging")

    def radius_at(self, sample: int) -> float | None:
        """See :class:`Integrator`: the squared radius falls by ``(k + alpha) / (k + 1)`` behind the k-th sample."""
        if not self.merging_counts:
            return None
        assert self.radius is not None  # the scene's `make_wave` sets it
        n = sample + 1
        log = math.lgamma(n + self.alpha) - math.lgamma(1.0 + self.alpha) - math.lgamma(n + 1.0)
        return self.radius * math.exp(0.5 * log)

    def as_traced(self) -> Self:
        """Return a copy with the default radius, which stages know as the context's ``merging``."""
        return self.but(radius=None, alpha=0.75)
