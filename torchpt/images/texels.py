"""Pictures as textures take them: the numbers as stored, and whether they may be sRGB."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from torchpt.errors import AssetError
from torchpt.files import read_regular
from torchpt.images.decode import MAX_PIXELS, EncodedImage, Pixels, existing, pixels_of
from torchpt.images.layers import group_channels

__all__ = ["Texels", "has_alpha", "picture_of", "read_texels"]


@dataclass(frozen=True)
class Texels:
    """A picture's numbers.

    Attributes:
        values: ``(H, W, C)`` float32, row 0 at the top, as stored; integer formats are scaled to 0..1. C is 1 (grey),
            2 (grey, alpha), 3 or 4 (RGB, alpha).
        eight_bit: whether the file stores no more than 8 bits a value: colours are then sRGB by custom.
    """

    values: NDArray[np.float32]
    eight_bit: bool


def read_texels(source: str | PathLike[str] | EncodedImage, max_pixels: int = MAX_PIXELS) -> Texels:
    """Reads a picture without decoding its colours.

    Args:
        source: a file ending in ``.exr .hdr .png .jpg .jpeg .ppm .pgm .bmp .tga``, or one in memory.
        max_pixels: larger pictures are refused before memory is asked for.

    Raises:
        AssetError: a file that is missing, of no known kind, malformed, truncated, too large, CMYK, of more than 4
            channels, or with a value that is not finite.
    """
    file = source if isinstance(source, EncodedImage) else existing(source)
    pixels = pixels_of(file, max_pixels)
    label = file.label if isinstance(file, EncodedImage) else str(file)
    values = picture_of(pixels)
    if values.shape[-1] > 4:
        raise AssetError(label, f"has {values.shape[-1]} channels, expected 1 to 4")
    scaled = np.ascontiguousarray(values, dtype=np.float32)
    if values.dtype.kind == "f":
        bad = np.flatnonzero(~np.isfinite(scaled).all(axis=(1, 2)))
        if len(bad):
            raise AssetError(label, f"holds a value that is not finite (row {bad[0]})")
    else:
        scaled /= np.float32(pixels.white)
    return Texels(scaled, pixels.eight_bit)


def has_alpha(source: str | PathLike[str] | EncodedImage) -> bool:
    """Whether a PNG declares an alpha channel, or transparent colours; False for any other file."""
    try:
        data = source.data if isinstance(source, EncodedImage) else read_regular(source)
    except OSError:
        return False
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        return False
    if data[25:26] in (b"\x04", b"\x06"):
        return True
    chunk = 8
    while chunk + 8 <= len(data) and data[chunk + 4 : chunk + 8] not in (b"IDAT", b"tRNS"):
        chunk += 12 + int.from_bytes(data[chunk : chunk + 4], "big")
    return data[chunk + 4 : chunk + 8] == b"tRNS"


def picture_of(pixels: Pixels) -> NDArray:
    """The picture ``R G B [A]`` of a file with layers, or its first layer; else all there is."""
    if not pixels.channels or pixels.values.dtype.kind != "f":
        return pixels.values
    groups = group_channels(pixels.channels)
    picked = groups.get("image", next(iter(groups.values())))
    if picked == list(range(pixels.values.shape[-1])):
        return pixels.values
    return pixels.values[..., picked]
