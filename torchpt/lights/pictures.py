"""Pictures that lights shine by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.images import Texels, read_texels
from torchpt.images.colour import srgb_to_linear
from torchpt.spec import Refused

__all__ = ["radiance_in", "radiance_of"]


def radiance_of(source: Path, key: str) -> NDArray[np.float32]:
    """A picture as radiance ``(H, W, 3)`` float32: grey ones in all channels, 8-bit ones decoded from sRGB, no alpha.

    Args:
        source: the picture.
        key: the parameter that names it, for the error.

    Raises:
        Refused: a negative value.
        AssetError: an image that is malformed.
    """
    return radiance_in(read_texels(source), str(source), key)


def radiance_in(read: Texels, source: str, key: str) -> NDArray[np.float32]:
    """The same of a picture that was read; ``source``: what errors call it."""
    values = read.values[..., :3] if read.values.shape[2] >= 3 else read.values[..., :1].repeat(3, 2)
    if read.eight_bit:
        values = srgb_to_linear(torch.from_numpy(np.ascontiguousarray(values))).numpy()
    if values.min() < 0:
        raise Refused(f"numbers >= 0 in the texels of {source}", float(values.min()), (key,))
    return np.ascontiguousarray(values)
