"""A number as a colour: from black over purple and orange to a pale yellow, evenly as the eye counts."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["NOT_FINITE", "false_colour"]

#: Of magma (van der Walt and Smith 2015, CC0), at 17 places; between them straight lines, within 1 % of the original.
_MAGMA = (
    "000004 0a0822 1d1147 36106b 51127c 6a1c81 832681 9c2e7f b73779 "
    "cf4070 e55064 f4695c fb8761 fea571 fec287 fde0a1 fcfdbf"
)
#: What is no number: a green that the other colours do not have.
NOT_FINITE = (0.0, 1.0, 0.0)


def false_colour(values: Tensor, top: float) -> Tensor:
    """Values 0..``top`` as colours; beyond it they look like ``top``, and what is not finite is `NOT_FINITE`.

    Args:
        values: any shape.
        top: above 0.

    Returns:
        ``(..., 3)`` display values 0..1, float32.
    """
    table = torch.tensor([list(bytes.fromhex(word)) for word in _MAGMA.split()], dtype=torch.float64) / 255.0
    finite = torch.isfinite(values)
    place = torch.where(finite, values.double() / top, 0.0).clamp(0.0, 1.0) * (len(table) - 1)
    below = place.long().clamp(max=len(table) - 2)
    colours = torch.lerp(table[below], table[below + 1], (place - below)[..., None])
    return torch.where(finite[..., None], colours, torch.tensor(NOT_FINITE, dtype=torch.float64)).float()
