"""What samples go to: sums of the pixels of a picture, or of some of them."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from torchpt.film import Film
from torchpt.samplers import Streams

__all__ = ["Plate"]


@dataclass
class Plate:
    """Pixels that are sampled alike.

    Attributes:
        film: sums of radiance.
        layers: sums of layers of first surfaces, by name.
        streams: where their samples come from.
        places: which pixels of the picture they are ``(n,)`` int64, row by row, where the lanes live; None: all.
    """

    film: Film
    layers: dict[str, Film] = field(default_factory=dict)
    streams: Streams = field(default_factory=Streams)
    places: Tensor | None = None
