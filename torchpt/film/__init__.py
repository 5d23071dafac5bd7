"""The film: reconstruction filters by importance sampling, and sums that lose nothing.

A sample belongs to one pixel: its place is drawn from the filter (Ernst, Stamminger, Greiner, *Filter Importance Sampling*,
2006), so nothing is splatted and chunks of pixels are independent. Sums are float64, added sample by sample in order, one
sum for each stream of the sampler. What a picture knows of its own error comes from ``pilots.py`` and ``known_error.py``;
``sharing.py`` says where adaptive sampling spends samples.
"""

from __future__ import annotations

from typing import Any

import torch

from torchpt.film.base import Filter
from torchpt.film.known_error import KnownError
from torchpt.film.pilots import Pilots, pilots_of
from torchpt.film.sums import Film
from torchpt.spec import Kinds
from torchpt.spec.declared import values_of

__all__ = [
    "FILTERS",
    "Film",
    "Filter",
    "KnownError",
    "Pilots",
    "filter_of",
    "pilots_of",
]

#: The kinds of reconstruction filters.
FILTERS: Kinds[Filter] = Kinds("torchpt.film.kinds", ("gaussian", "box", "tent", "mitchell"))


def filter_of(kind: str, device: torch.device, **given: Any) -> Filter:
    """A filter by name; parameters that are not ``given`` have their defaults.

    Raises:
        SceneError: a parameter that it does not have, or a bad value.
    """
    return FILTERS[kind](values_of(FILTERS[kind], given, "film.filter", None).values, device)
