"""Hammersley's points: a plane set of a known size whose points keep clear of one another."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["hammersley", "van_der_corput"]

_HALVES = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


def van_der_corput(index: Tensor) -> Tensor:
    """Radical inverse in base 2 of ``index (N,)`` in ``[0, 2^32)``: its bits mirrored at the point; float64 in ``[0, 1)``."""
    x = index.to(torch.int64)
    for shift, mask in _HALVES:
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return x.double() * 2.0**-32


def hammersley(n: int) -> Tensor:
    """``(2, n)`` float64 in ``[0, 1)``: ``(i / n, van_der_corput(i))`` (Hammersley 1960)."""
    i = torch.arange(n)
    return torch.stack((i.double() / n, van_der_corput(i)))
