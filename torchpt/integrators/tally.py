"""Counts of what waves trace."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Tally"]


@dataclass
class Tally:
    """Counts of rays and paths.

    Attributes:
        rays: that were searched for, those of shadows too.
        truncated: paths that were still alive at :data:`torchpt.integrators.path.ENDLESS`.
    """

    rays: int = 0
    truncated: int = 0
