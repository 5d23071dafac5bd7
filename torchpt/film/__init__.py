"""The film: reconstruction filters by importance sampling, and sums that lose nothing.

A sample belongs to one pixel: its place is drawn from the filter (Ernst, Stamminger, Greiner, *Filter Importance Sampling*,
2006), so nothing is splatted and chunks of pixels are independent. Sums are float64, added sample by sample in order, one
sum for each randomization of the sampler: their spread is the picture's own error.
"""

from __future__ import annotations

from torchpt.film.base import Filter
from torchpt.film.sums import RELMSE_FLOOR, Film
from torchpt.spec import Kinds

__all__ = ["FILTERS", "RELMSE_FLOOR", "Film", "Filter"]

#: The kinds of reconstruction filters.
FILTERS: Kinds[Filter] = Kinds("torchpt.film.kinds", ("gaussian", "box", "tent", "mitchell"))
