"""Images for textures, from files and from arrays in a scene: values as stored, and whether they may be sRGB-encoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.core.autograd import outside_transforms
from torchpt.core.errors import AssetError
from torchpt.core.files import read_regular
from torchpt.images.colour import srgb_to_linear
from torchpt.images.decode import MAX_PIXELS, EncodedImage, Pixels, decode_image, existing_image
from torchpt.images.layers import group_channels
from torchpt.spec import Refused

__all__ = [
    "ACCEPTED_TEXELS",
    "ByteImage",
    "Texels",
    "check_source",
    "decoded_bytes",
    "has_alpha",
    "read_texels",
    "select_picture",
    "texels_from_array",
    "texels_to_radiance",
]

#: What is accepted as an array of texels, for errors.
ACCEPTED_TEXELS = "texels (H, W, C), channels last, or (H, W), C from 1 to 4: finite numbers, or 8 bits a value (uint8)"
#: Values that are decoded at a time.
_BAND = 1 << 15


@dataclass(frozen=True)
class Texels:
    """Values of an image, not decoded.

    Attributes:
        stored: ``(H, W, C)``, row 0 at the top: integers, booleans or float32. C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB,
            alpha).
        eight_bit: True: stored with at most 8 bits a value, so colours are sRGB-encoded by convention.
        white: the integer that stands for 1; None: floats.
    """

    stored: NDArray[Any]
    eight_bit: bool
    white: int | None = None

    @cached_property
    def values(self) -> NDArray[np.float32]:
        """``(H, W, C)`` float32; integers are scaled to 0..1."""
        if self.white is None:
            return self.stored
        values = self.stored.astype(np.float32)
        values /= np.float32(self.white)
        return values

    @cached_property
    def decoded(self) -> NDArray[np.float32]:
        """``(H, W, C)`` float32, colours decoded from sRGB; the last of 2 or 4 channels is alpha, which is not."""
        channels = self.stored.shape[2]
        colours = channels - (1 if channels in (2, 4) else 0)
        linear = self.linear(colours)
        return linear if colours == channels else np.concatenate((linear, self.values[..., colours:]), axis=2)

    def is_encoded(self, colorspace: str) -> bool:
        """Return True if colours are to be decoded from sRGB: whole numbers for ``srgb``, those of 8 bits for ``auto``."""
        return self.eight_bit if colorspace == "auto" else colorspace == "srgb" and self.white is not None

    def linear(self, channels: int) -> NDArray[np.float32]:
        """Return the first channels, decoded from sRGB; values of 8 bits by a table."""
        if self.white is None or self.white > 255:
            return srgb_to_linear(torch.from_numpy(np.ascontiguousarray(self.values[..., :channels]))).numpy()
        table = decoded_bytes(encoded=True, white=self.white)
        linear = np.empty((*self.stored.shape[:2], channels), np.float32)
        rows = max(1, _BAND // max(1, linear[0].size))
        for first in range(0, len(linear), rows):
            # numpy makes indices of 8 bytes: a band of them fits the cache. "clip" needs no copy of `out`.
            numbers = self.stored[first : first + rows, :, :channels].astype(np.uint8)
            np.take(table, numbers, out=linear[first : first + rows], mode="clip")
        return linear

    def as_bytes(self, encoded: bool) -> ByteImage | None:
        """Return the image with its values as bytes; None where these are no bytes. Asked again it is the same object.

        ``encoded``: whether colours are decoded from sRGB.
        """
        if self.white != 255 or self.stored.dtype != np.uint8:
            return None
        return self._byte_images.setdefault(encoded, ByteImage(self.stored, encoded))

    @cached_property
    def _byte_images(self) -> dict[bool, ByteImage]:
        return {}


@cache
def decoded_bytes(encoded: bool, white: int = 255) -> NDArray[np.float32]:
    """Return what the whole numbers ``0 .. white`` stand for ``(white + 1,)``; ``encoded``: they are sRGB."""
    numbers = np.arange(white + 1, dtype=np.float32) / np.float32(white)
    if not encoded:
        return numbers
    with outside_transforms():
        return srgb_to_linear(torch.from_numpy(numbers)).numpy()


@dataclass(eq=False)
class ByteImage:
    """An image of 8 bits a value that stands for its values ``(H, W, C)`` in float32.

    Attributes:
        stored: ``(H, W, C)`` uint8.
        encoded: True: colours are decoded from sRGB. The last of 2 or 4 channels, alpha, is not.
        needs_floats: True: someone reads the values in another way than texel by texel.
        is_read_packed: True: someone reads them so.
    """

    stored: NDArray[np.uint8]
    encoded: bool
    needs_floats: bool = False
    is_read_packed: bool = False

    @property
    def shape(self) -> tuple[int, int, int]:
        """Return H, W and C."""
        height, width, channels = self.stored.shape
        return height, width, channels

    def values(self) -> NDArray[np.float32]:
        """Return the values ``(H, W, C)``."""
        texels = Texels(self.stored, eight_bit=True, white=255)
        return texels.decoded if self.encoded else texels.values

    def min(self) -> float:
        """Return the least value."""
        return self._extreme(np.min)

    def max(self) -> float:
        """Return the greatest value."""
        return self._extreme(np.max)

    def _extreme(self, of: Callable[..., Any]) -> float:
        channels = self.shape[2]
        colours = channels - (1 if channels in (2, 4) else 0)
        found = [decoded_bytes(self.encoded)[of(self.stored[..., :colours])]]
        if colours < channels:
            found.append(decoded_bytes(encoded=False)[of(self.stored[..., colours:])])
        return float(of(found))


def read_texels(source: str | PathLike[str] | EncodedImage, max_pixels: int = MAX_PIXELS) -> Texels:
    """Read an image without decoding its colours.

    Args:
        source: a file ending in ``.exr .hdr .png .jpg .jpeg .ppm .pgm .bmp .tga``, or one in memory.
        max_pixels: larger images are refused before memory is allocated.

    Raises:
        AssetError: a file that is missing, of unknown format, malformed, truncated, too large, CMYK, of more than 4
            channels, or with a value that is not finite.
    """
    file = source if isinstance(source, EncodedImage) else existing_image(source)
    pixels = decode_image(file, max_pixels)
    label = file.label if isinstance(file, EncodedImage) else str(file)
    values = select_picture(pixels)
    if values.shape[-1] > 4:
        raise AssetError(label, f"has {values.shape[-1]} channels, expected 1 to 4")
    if values.dtype.kind != "f":
        return Texels(values, pixels.eight_bit, int(pixels.white))
    values = np.ascontiguousarray(values, dtype=np.float32)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise AssetError(label, f"holds a value that is not finite (row {bad[0]})")
    return Texels(values, pixels.eight_bit)


def texels_from_array(value: Any) -> Texels:
    """Return an array as an image ``(H, W, C)``, row 0 at the top; uint8 and uint16 are scaled to 0..1.

    Raises:
        Refused: another shape, values that are not finite in float32, or too many pixels.
    """
    if not isinstance(value, np.ndarray | list | tuple):
        raise Refused(ACCEPTED_TEXELS)
    try:
        array = np.asarray(value)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise Refused(ACCEPTED_TEXELS, "rows of different lengths") from None
    if array.dtype.kind not in "iuf" or array.ndim not in (2, 3):
        raise Refused(ACCEPTED_TEXELS, f"{array.dtype} of shape {array.shape}")
    array = array if array.ndim == 3 else array[..., None]
    if not array.size or array.shape[2] > 4 or array.shape[0] * array.shape[1] > MAX_PIXELS:
        raise Refused(ACCEPTED_TEXELS, f"shape {array.shape}")
    with np.errstate(over="ignore"):
        values = np.array(array, np.float32, order="C")
    bad = np.flatnonzero(~np.isfinite(values).all(axis=(1, 2)))
    if len(bad):
        raise Refused(ACCEPTED_TEXELS, f"a value that is not finite (row {bad[0]})")
    if array.dtype not in (np.uint8, np.uint16):
        return Texels(values, eight_bit=False)
    return Texels(array.copy(), array.dtype == np.uint8, int(np.iinfo(array.dtype).max))


def texels_to_radiance(texels: Texels, source: str, key: str, colorspace: str = "auto") -> NDArray[np.float32]:
    """Return an image as radiance ``(H, W, 3)``: grey repeated in all channels, alpha dropped.

    Args:
        texels: the image.
        source: its name for errors.
        key: the scene parameter that refers to it, for errors.
        colorspace: ``srgb`` decodes whole numbers, ``auto`` those of 8 bits, ``linear`` none.

    Raises:
        Refused: a negative value.
    """
    channels = 3 if texels.stored.shape[2] >= 3 else 1
    values = texels.linear(channels) if texels.is_encoded(colorspace) else texels.values[..., :channels]
    if channels == 1:
        values = values.repeat(3, 2)
    if values.min() < 0:
        raise Refused(f"numbers >= 0 in the texels of {source}", float(values.min()), (key,))
    return np.ascontiguousarray(values)


def check_source(values: Mapping[str, Any]) -> None:
    """Check that exactly one of ``path`` and ``data`` is given.

    Raises:
        Refused: neither or both are given.
    """
    if values["path"] is None and values["data"] is None:
        raise Refused("a file path or data (one of them is required)", None, ("path",))
    if values["path"] is not None and values["data"] is not None:
        raise Refused("either path or data, not both", "texels", ("data",))


def has_alpha(source: str | PathLike[str] | EncodedImage) -> bool:
    """Return True for a PNG, TGA or EXR file with alpha (also a PNG with a transparent colour); False for any other."""
    try:
        data = source.data if isinstance(source, EncodedImage) else read_regular(source)
    except OSError:
        return False
    if data.startswith(b"\x76\x2f\x31\x01") and not isinstance(source, EncodedImage):
        import OpenImageIO as oiio

        picture = oiio.ImageInput.open(str(source))
        if picture is None:
            return False
        names = picture.spec().channelnames
        picture.close()
        return "A" in names
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        name = f".{source.kind}" if isinstance(source, EncodedImage) else str(source)
        # Bytes 2 and 16 of a TGA: the kind, here grey, and bits a pixel.
        return name.lower().endswith(".tga") and data[16:17] == (
            b"\x10" if data[2:3] in (b"\x03", b"\x0b") else b"\x20"
        )
    if data[25:26] in (b"\x04", b"\x06"):  # the colour type: grey with alpha, or RGB with alpha
        return True
    # A transparent colour is a chunk tRNS before the pixels (IDAT). A chunk is size, name, data and checksum.
    chunk = 8  # offset of the first one, after the signature
    while chunk + 8 <= len(data) and data[chunk + 4 : chunk + 8] not in (b"IDAT", b"tRNS"):
        chunk += 12 + int.from_bytes(data[chunk : chunk + 4], "big")
    return data[chunk + 4 : chunk + 8] == b"tRNS"


def select_picture(pixels: Pixels) -> NDArray:
    """Return the channels ``R G B [A]`` of a file with layers, or its first layer; of other files all channels."""
    if not pixels.channels or pixels.values.dtype.kind != "f":
        return pixels.values
    groups = group_channels(pixels.channels)
    channels = groups.get("image", [])
    if not channels or (len(groups) > 1 and [pixels.channels[index] for index in channels] == ["A"]):
        channels = next(indices for name, indices in groups.items() if name != "image")  # alpha alone is no picture
    if channels == list(range(pixels.values.shape[-1])):
        return pixels.values
    return pixels.values[..., channels]
