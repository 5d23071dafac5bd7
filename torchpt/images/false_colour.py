"""A number as a colour: from black over purple and orange to a pale yellow, evenly as the eye counts."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["MAP", "NOT_FINITE", "false_colour"]

#: Of matplotlib's maps one that also orders by lightness, for every kind of sight and for print.
MAP = "magma"
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
    from matplotlib import colormaps

    finite = torch.isfinite(values)
    place = torch.where(finite, values.double() / top, 0.0).clamp(0.0, 1.0)
    colours = torch.from_numpy(colormaps[MAP](place.cpu().numpy())[..., :3])
    return torch.where(finite.cpu()[..., None], colours, torch.tensor(NOT_FINITE, dtype=torch.float64)).float()
