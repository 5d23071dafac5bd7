"""Map numbers to colours with the perceptually uniform colour map magma, from black to pale yellow."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["MAP", "NOT_FINITE", "false_colour"]

#: Name of a matplotlib colour map; its lightness rises too, for colour blindness and print.
MAP = "magma"
#: Colour of values that are not finite: a green that is not in the map.
NOT_FINITE = (0.0, 1.0, 0.0)


def false_colour(values: Tensor, top: float) -> Tensor:
    """Return the colours of values 0..``top``; larger ones get the colour of ``top``, non-finite ones `NOT_FINITE`.

    Args:
        values: any shape.
        top: the value of the brightest colour, above 0.

    Returns:
        ``(..., 3)`` display values 0..1, float32.
    """
    from matplotlib import colormaps

    finite = torch.isfinite(values)
    fraction = torch.where(finite, values.double() / top, 0.0).clamp(0.0, 1.0)
    colours = torch.from_numpy(colormaps[MAP](fraction.cpu().numpy())[..., :3])
    return torch.where(finite.cpu()[..., None], colours, torch.tensor(NOT_FINITE, dtype=torch.float64)).float()
