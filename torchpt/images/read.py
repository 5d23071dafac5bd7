"""Read pictures: colours become linear light."""

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
    """Read the picture of a file.

    Args:
        path: a file ending in ``.exr .hdr .png .jpg .jpeg .ppm .pgm .bmp .tga``.
        linear: what the numbers of an integer format mean. False (the default): colours, sRGB-encoded, which are
            decoded to linear light. True: data (normals, roughness, masks), which is returned as stored, scaled to
            0..1. EXR and HDR are linear by definition: no difference. An alpha channel is never decoded.

    Returns:
        ``(H, W, C)`` float32 on the CPU, row 0 at the top; C is 1 (grey), 2 (grey, alpha), 3 or 4 (RGB, alpha). Of an
        EXR with layers, the picture ``R G B [A]``; where it has none, its first layer.

    Raises:
        SceneError: ``path`` is none.
        AssetError: a file that is missing, of no known ending, malformed, truncated, CMYK or larger than 64 Mpixel.
    """
    pixels = decode_image(existing_image(path), MAX_PIXELS)
    image = _tensor(select_picture(pixels))
    if pixels.values.dtype.kind == "f":
        return image
    image /= pixels.white
    if linear:
        return image
    colours = image.shape[-1] - (1 if image.shape[-1] in (2, 4) else 0)
    return torch.cat([srgb_to_linear(image[..., :colours]), image[..., colours:]], dim=-1)


def read_layers(path: str | PathLike[str]) -> dict[str, Tensor]:
    """Read every layer of an EXR: name to ``(H, W, C)`` float32; the picture itself is called ``image``.

    The picture's alpha channel ``A`` is a layer of its own, ``alpha``. Other formats hold one layer, ``image``, as
    `read_image` returns it.

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
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))
