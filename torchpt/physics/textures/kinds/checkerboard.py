"""Checkerboards of two colours, stored as a repeated image of 2 x 2 texels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.textures.atlas import ImageNode
from torchpt.physics.textures.base import CHANNELS, Mapped, Node, Opening
from torchpt.spec import Choice, Color, Pair

__all__ = ["Checkerboard"]


class Checkerboard(Mapped):
    """Two alternating colours: a repeat has two squares each way, as in Mitsuba."""

    name = "checkerboard"
    parameters: ClassVar = {
        "color0": Color((0.4, 0.4, 0.4), doc="colour of the square at the origin"),
        "color1": Color((0.2, 0.2, 0.2), doc="colour of its neighbours"),
        "scale": Pair((1.0, 1.0), single=True, doc="number of repeats in a unit of u and of v"),
        "filter": Choice(
            "nearest",
            names=("nearest", "trilinear"),
            doc="trilinear: fades to the mean of both colours where a pixel covers several squares",
        ),
    }
    filters = ("trilinear",)

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :meth:`Texture.open`."""
        channel = opening.channel_index(CHANNELS[:4], "squares have no alpha")
        opening.declare_all(cls, values)
        matrix = cls.matrix(values, repeats=values["scale"])
        filtered = values["filter"] in cls.filters  # the values that average over footprints
        return ImageNode(
            texels=opening.name,  # the name that `_squares` finds the colours by
            channel=channel,
            wrap="repeat",
            nearest=True,
            transform=matrix,
            scale=(1.0, 1.0, 1.0),
            filtered=filtered,
            compute=_squares,
        )


def _squares(parameters: Mapping[str, Tensor], name: str) -> Tensor:
    """Return the image ``(2, 2, 3)`` of one repeat; ``name``: the texture's dotted name."""
    a, b = parameters[f"{name}.color0"], parameters[f"{name}.color1"]
    return torch.stack((torch.stack((a, b)), torch.stack((b, a))))
