"""Pictures that lights shine by, read from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.images import read_texels
from torchpt.images.colour import srgb_to_linear
from torchpt.spec import Refused

__all__ = ["radiance_of"]


def radiance_of(source: Path, key: str) -> NDArray[np.float32]:
    """A picture as radiance ``(H, W, 3)`` float32: grey ones in all channels, 8-bit ones decoded from sRGB, no alpha.

    Args:
        source: the picture.
        key: the parameter that names it, for the error.

    Raises:
        Refused: a negative value.
        AssetError: an image that is malformed.
    """
    read = read_texels(source)
    values = read.values[..., :3] if read.values.shape[2] >= 3 else read.values[..., :1].repeat(3, 2)
    if read.eight_bit:
        values = srgb_to_linear(torch.from_numpy(np.ascontiguousarray(values))).numpy()
    if values.min() < 0:
        raise Refused(f"numbers >= 0 in the texels of {source}", float(values.min()), (key,))
    return np.ascontiguousarray(values)
