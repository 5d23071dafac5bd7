"""Hammersley's points: a two-dimensional low-discrepancy set of fixed size, from which maps and the BRDF table are sampled."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import reverse_bits

__all__ = ["hammersley", "van_der_corput"]


def van_der_corput(index: Tensor) -> Tensor:
    """Return the radical inverse in base 2 ``(N,)`` of ``index (N,)`` in ``[0, 2^32)``; float64 in ``[0, 1)``."""
    return reverse_bits(index.to(torch.int64)).double() * 2.0**-32


def hammersley(n: int) -> Tensor:
    """Return the points ``(i / n, van_der_corput(i))`` (Hammersley 1960): ``(2, n)`` float64 in ``[0, 1)``."""
    i = torch.arange(n)
    return torch.stack((i.double() / n, van_der_corput(i)))
