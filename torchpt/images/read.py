"""Read pictures: OpenEXR and Radiance HDR through OpenImageIO, the 8- and 16-bit formats through imageio."""

from __future__ import annotations

import warnings
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.errors import AssetError
from torchpt.images.colour import srgb_to_linear
from torchpt.images.layers import group_channels

__all__ = ["MAX_PIXELS", "READABLE", "read_image", "read_layers"]

MAX_PIXELS = 64 * 2**20  # a header may claim anything: refuse before memory is asked for
MAX_VALUES = 16 * MAX_PIXELS  # pixels times channels
FLOAT_FORMATS = (".exr", ".hdr")
INTEGER_FORMATS = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tga")
READABLE = FLOAT_FORMATS + INTEGER_FORMATS


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
        AssetError: a file that is missing, of no known ending, malformed, truncated or larger than 64 Mpixel.
    """
    path = _existing(path)
    if path.suffix.lower() in FLOAT_FORMATS:
        pixels, channels = _read_float(path)
        groups = group_channels(channels)
        return _tensor(pixels[..., groups.get("image", next(iter(groups.values())))])
    image = _read_integer(path)
    if linear:
        return image
    colours = image.shape[-1] - (1 if image.shape[-1] in (2, 4) else 0)
    return torch.cat([srgb_to_linear(image[..., :colours]), image[..., colours:]], dim=-1)


def read_layers(path: str | PathLike[str]) -> dict[str, Tensor]:
    """Read every layer of an EXR: name to ``(H, W, C)`` float32; the picture itself is called ``image``.

    Other formats hold one layer, ``image``, as `read_image` returns it.

    Raises:
        AssetError: as `read_image`.
    """
    path = _existing(path)
    if path.suffix.lower() != ".exr":
        return {"image": read_image(path)}
    pixels, channels = _read_float(path)
    return {name: _tensor(pixels[..., indices]) for name, indices in group_channels(channels).items()}


def _existing(path: str | PathLike[str]) -> Path:
    path = Path(fspath(path))
    if path.suffix.lower() not in READABLE:
        raise AssetError(path, f"unknown kind of image {path.suffix!r}; known: {' '.join(READABLE)}")
    try:
        if not path.exists():
            raise AssetError(path, "no such file")
        if not path.is_file():
            raise AssetError(path, "is not a file")
    except (OSError, ValueError) as problem:
        raise AssetError(path, f"cannot be read ({problem})") from problem
    return path


def _check_size(path: Path, width: int, height: int, channels: int) -> None:
    if width < 1 or height < 1 or channels < 1:
        raise AssetError(path, f"has no pixels ({width} x {height}, {channels} channels)")
    if width * height > MAX_PIXELS or width * height * channels > MAX_VALUES:
        raise AssetError(path, f"{width} x {height} pixels, {channels} channels: more than 64 Mpixel are not read")


def _tensor(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(pixels, dtype=np.float32))


def _read_float(path: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """All channels of the first part of an EXR or HDR: ``(H, W, C)`` and their names."""
    import OpenImageIO as oiio

    source = oiio.ImageInput.open(str(path))
    if source is None:
        raise AssetError(path, f"cannot be read ({oiio.geterror() or 'unknown format'})")
    try:
        spec = source.spec()
        if spec.deep:
            raise AssetError(path, "holds deep pixels, which are not read")
        _check_size(path, spec.width, spec.height, spec.nchannels)
        channels = tuple(spec.channelnames)
        pixels = source.read_image("float")
        if pixels is None:
            raise AssetError(path, f"cannot be read ({source.geterror() or 'truncated'})")
    finally:
        source.close()
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels), channels


def _read_integer(path: Path) -> Tensor:
    """Values 0..1 as stored, ``(H, W, C)``."""
    import imageio.v3 as iio

    try:
        with warnings.catch_warnings(), iio.imopen(path.read_bytes(), "r", plugin="pillow") as source:
            warnings.simplefilter("ignore")  # Pillow warns of large files; the check below refuses them
            shape = source.properties(index=0).shape
            _check_size(path, shape[1], shape[0], shape[2] if len(shape) > 2 else 1)
            exotic = source.metadata(index=0).get("mode") in ("CMYK", "YCbCr", "LAB", "HSV")
            mode: dict[str, Any] = {"mode": "RGB"} if exotic else {}
            pixels = np.asarray(source.read(index=0, **mode))
    except AssetError:
        raise
    except Exception as problem:  # decoders raise OSError, SyntaxError, ValueError, struct.error, zlib.error, ...
        raise AssetError(path, f"cannot be read ({_brief(problem)})") from problem
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.dtype == np.uint8:
        return _tensor(pixels) / 255
    if pixels.dtype in (np.uint16, np.int32):  # Pillow holds some 16-bit files in 32 bits
        return _tensor(pixels) / 65535
    return _tensor(pixels)  # bool


def _brief(problem: Exception) -> str:
    problem = problem.__cause__ if isinstance(problem.__cause__, Exception) else problem  # imageio wraps Pillow's
    return (str(problem).splitlines() or [type(problem).__name__])[0][:120]
