"""The film: reconstruction filters by importance sampling, and sums that lose nothing.

A sample belongs to one pixel: its place is drawn from the filter (Ernst, Stamminger, Greiner, *Filter Importance Sampling*,
2006), so chunks of pixels are independent. Sums are float64, added sample by sample in order, one sum for each stream of the
sampler (``sums.py``). Light that integrators send to other pixels is summed in integers, the same in any order (``splats.py``).
What a picture knows of its own error, and where adaptive sampling spends samples, is in ``error.py``.
"""

from __future__ import annotations

from typing import Any

import torch

from torchpt.physics.film.error import ErrorEstimate, Pilots, pilots_of
from torchpt.physics.film.filters import Filter
from torchpt.physics.film.sums import Film
from torchpt.spec import Kinds
from torchpt.spec.schema import read_params

__all__ = [
    "FILTERS",
    "ErrorEstimate",
    "Film",
    "Filter",
    "Pilots",
    "filter_of",
    "pilots_of",
]

#: The kinds of reconstruction filters.
FILTERS: Kinds[Filter] = Kinds("torchpt.physics.film.kinds", ("gaussian", "box", "tent", "mitchell"))


def filter_of(kind: str, device: torch.device, **given: Any) -> Filter:
    """A filter by name; parameters that are not ``given`` have their defaults.

    Raises:
        SceneError: a parameter that it does not have, or a bad value.
    """
    return FILTERS[kind](read_params(FILTERS[kind], given, "film.filter", None).values, device)
