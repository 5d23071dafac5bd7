"""The film: filter importance sampling, sums of samples, and the error estimate.

A sample counts for one pixel: its film position is sampled from the filter (Ernst, Stamminger, Greiner, *Filter Importance
Sampling*, 2006), so chunks of pixels are independent. ``sums.py`` adds samples in float64 and in order, one sum for each
randomization of the sampler (read it first); ``splats.py`` adds splats, which are radiance that paths send to other pixels than
their own, in fixed point, exact in any order; ``error.py`` estimates the error and allocates samples for adaptive sampling.
``filters.py`` has the base class of filters, ``kinds/`` one file for each.
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
    """Return a filter by name.

    Args:
        kind: the ``type`` in a scene file.
        device: device of the lanes.
        given: values of parameters; the others have their defaults.

    Raises:
        SceneError: an unknown parameter, or a bad value.
    """
    return FILTERS[kind](read_params(FILTERS[kind], given, "film.filter", None).values, device)
