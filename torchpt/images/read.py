"""Read image files as tensors of linear values."""

from __future__ import annotations

from os import PathLike

import numpy as np
import torch
from torch import Tensor

from torchpt.images.colour import srgb_to_linear
from torchpt.images.decode import MAX_PIXELS, decode_image, existing_image
from torchpt.images.layers import group_channels
from torchpt.images.texels import select_picture

__all__ = ["read_image", "read_layers"]


def read_image(path: str | PathLike[str], linear: bool = False) -> Tensor:
    """Read an image file.

    Args:
        path: a file ending in ``.exr .hdr .png .jpg .jpeg .ppm .pgm .bmp .tga``.
        linear: for integer formats. False (the default): values are sRGB colours and are decoded to linear ones. True: values
            are data (normals, roughness, masks), and are returned as stored, scaled to 0..1. EXR and HDR are always linear. An
            alpha channel is never decoded.

    Returns:
        ``(H, W, C)`` float32 on the CPU, row 0 at the top; C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB, alpha). From an EXR
        with layers the channels ``R G B [A]``, or else its first layer.

    Raises:
        SceneError: ``path`` is not a path.
        AssetError: a file that is missing, of unknown format, malformed, truncated, CMYK or larger than 64 Mpixel.
    """
    pixels = decode_image(existing_image(path), MAX_PIXELS)
    image = _tensor(select_picture(pixels))
    if pixels.values.dtype.kind == "f":
        return image
    image /= pixels.white
    if linear:
        return image
    colours = image.shape[-1] - (1 if image.shape[-1] in (2, 4) else 0)  # number of channels without alpha
    return torch.cat([srgb_to_linear(image[..., :colours]), image[..., colours:]], dim=-1)


def read_layers(path: str | PathLike[str]) -> dict[str, Tensor]:
    """Read all layers of an EXR: ``(H, W, C)`` float32 by name; the picture itself is ``image``.

    The picture's alpha channel ``A`` is the layer ``alpha``. Other formats have one layer, ``image``, as `read_image` returns
    it.

    Raises:
        SceneError, AssetError: as `read_image`.
    """
    path = existing_image(path)
    if path.suffix.lower() != ".exr":
        return {"image": read_image(path)}
    pixels = decode_image(path, MAX_PIXELS)
    if pixels.values.dtype.kind != "f":  # another format under this name
        return {"image": read_image(path)}
    groups = group_channels(pixels.channels)
    image = groups.get("image", [])
    if len(image) > 1 and pixels.channels[image[-1]] == "A":
        groups["alpha"] = [image.pop()]
    return {name: _tensor(pixels.values[..., indices]) for name, indices in groups.items()}


def _tensor(pixels: np.ndarray) -> Tensor:
    """Return an array as a float32 tensor."""
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))
