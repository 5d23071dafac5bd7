"""Hammersley's points: a plane set of a known size whose points keep clear of one another."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import reverse_bits

__all__ = ["hammersley", "van_der_corput"]


def van_der_corput(index: Tensor) -> Tensor:
    """Radical inverse in base 2 of ``index (N,)`` in ``[0, 2^32)``: its bits mirrored at the point; float64 in ``[0, 1)``."""
    return reverse_bits(index.to(torch.int64)).double() * 2.0**-32


def hammersley(n: int) -> Tensor:
    """``(2, n)`` float64 in ``[0, 1)``: ``(i / n, van_der_corput(i))`` (Hammersley 1960)."""
    i = torch.arange(n)
    return torch.stack((i.double() / n, van_der_corput(i)))
