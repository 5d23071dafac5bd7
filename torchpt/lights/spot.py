"""Spots: points that shine within a cone about ``Lights.normal``; ``Lights.e1`` holds the cutoff angle and the slope.

Whole up to the beam's edge, from there falling linearly in the angle to zero at the cutoff, as Mitsuba's ``spot``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.angles import azimuth
from torchpt.math.vectors import cross, dot

__all__ = ["falloff"]


def falloff(wi: Tensor, axis: Tensor, cutoff: Tensor, slope: Tensor) -> Tensor:
    """Share ``(N,)`` of the intensity that goes along ``-wi``.

    Args:
        wi: unit directions toward the light ``(3, N)``.
        axis: unit ``(3, N)``.
        cutoff: in radians ``(N,)``.
        slope: one over the angle from the beam's edge to the cutoff ``(N,)``.
    """
    aside = cross(axis.expand_as(wi), wi)
    sine = dot(aside, aside).clamp_min(torch.finfo(wi.dtype).tiny).sqrt()
    return ((cutoff - azimuth(-dot(wi, axis), sine)) * slope).clamp(0.0, 1.0)
