"""Write image files; a failure leaves no partial file.

A file is encoded under a temporary name in the same folder and then moved to its destination, so a reader never sees half an
image, and after a failure the old file is still there.
"""

from __future__ import annotations

import os
import secrets
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from io import BytesIO
from os import PathLike
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import ArgumentValueError, OutputError
from torchpt.core.files import as_path
from torchpt.images.colour import display
from torchpt.images.header import Fact, checked_header, put_header
from torchpt.images.layers import channel_names

__all__ = [
    "WRITABLE",
    "check_writable",
    "open_pillow_writer",
    "output_path",
    "temporary_beside",
    "write_error",
    "write_image",
]

#: Largest radiance in an ``.hdr``: RGBE holds numbers up to 2^127.
_LARGEST_RGBE = 1e30
#: Quality of JPEGs: the highest that Pillow's manual advises.
_JPEG_QUALITY = 95
#: Supported endings of file names.
WRITABLE = (".exr", ".hdr", ".png", ".jpg", ".jpeg", ".ppm")


def write_image(
    path: str | PathLike[str],
    image: Tensor,
    layers: dict[str, Tensor] | None = None,
    exposure: float = 0.0,
    tonemap: str = "none",
    gamma: str | float = "srgb",
    header: Mapping[str, Fact] | None = None,
) -> None:
    """Write an image in the format of the file's ending.

    ``.exr`` stores float32 and all layers, as channels of one part; ``.hdr`` stores RGBE (steps of 0.4 % of the brightest
    channel, no negative values): both store linear radiance. ``.png .jpg .jpeg .ppm`` store the values of `colour.display` in
    8 bits.

    Args:
        path: the file; an existing one is replaced.
        image: ``(H, W, C)`` linear, C = 1, 3 or 4 (alpha is stored in EXR and PNG).
        layers: ``(H, W, C)`` or ``(H, W)`` by name; stored in ``.exr`` only. Layers named in `film.aovs` get the usual
            channels: ``albedo.R/G/B normal.X/Y/Z Z position.X/Y/Z uv.U/V object_id A variance.R/G/B
            samples``.
        exposure: stops (8-bit formats).
        tonemap: none, reinhard, aces or filmic (8-bit formats).
        gamma: ``"srgb"`` or an exponent (8-bit formats).
        header: printable text or numbers by name (letters, digits and _); stored in ``.exr`` only, as attributes
            ``torchpt:NAME``, and read by :func:`torchpt.read_header`.

    Raises:
        SceneError: ``path`` is not a path; an image or layer of another shape, or a header that cannot be stored, also a
            ``ValueError``.
        OutputError: an unsupported ending, or a path that cannot be written.
    """
    destination = output_path(path)
    pixels, facts = _checked_pixels("image", image), checked_header(header or {})
    temporary = temporary_beside(destination)
    if temporary.suffix == ".exr":
        by_name = {"image": pixels} | {name: _checked_pixels(name, layer) for name, layer in (layers or {}).items()}
        for name, layer in by_name.items():
            if layer.shape[:2] != pixels.shape[:2]:
                height, width = pixels.shape[:2]
                expected = f"a layer of the picture's {height} x {width} pixels"
                raise ArgumentValueError(f"layers.{name}: expected {expected}, got {tuple(layer.shape)}")
        channels = [channel for name, layer in by_name.items() for channel in channel_names(name, layer.shape[2])]
        duplicates = sorted({channel for channel in channels if channels.count(channel) > 1})
        if duplicates:
            expected = "layers of different channels (a picture of 4 channels has its alpha: A)"
            raise ArgumentValueError(f"layers: expected {expected}, got two with the channel {duplicates[0]}")
        encode = partial(_encode_float, temporary, np.concatenate(list(by_name.values()), axis=2), channels, facts)
    elif temporary.suffix == ".hdr":  # RGBE has no sign: the encoder would wrap around
        rgb = np.nan_to_num(_rgb(pixels), nan=0.0, posinf=_LARGEST_RGBE).clip(0, _LARGEST_RGBE)
        encode = partial(_encode_float, temporary, rgb, ["R", "G", "B"], {})
    else:
        levels = _display_bytes(pixels, exposure, tonemap, gamma, with_alpha=temporary.suffix == ".png")
        encode = partial(_encode_integer, temporary, levels)
    try:
        encode()
        os.replace(temporary, destination)
    except (OSError, ValueError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    finally:
        with suppress(OSError):  # exists only after a failure
            temporary.unlink()


def check_writable(path: str | PathLike[str], endings: tuple[str, ...] = WRITABLE) -> Path:
    """Check before a long render that its image can be written; creates no file.

    Args:
        path: the file.
        endings: supported endings.

    Returns:
        The path with symbolic links resolved.

    Raises:
        OutputError: an unsupported ending, a folder that is missing or not writable, or a path that is a folder.
    """
    destination = output_path(path, endings)
    try:
        if destination.is_dir():
            raise OutputError(path, "is a folder")
        temporary = temporary_beside(destination)
        temporary.touch(exist_ok=False)
        temporary.unlink()
        with suppress(FileNotFoundError):
            os.stat(destination)  # a name too long is another error
        os.stat(destination.parent)
    except (OSError, ValueError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    return destination


def output_path(path: str | PathLike[str], endings: tuple[str, ...] = WRITABLE) -> Path:
    """Return the path with symbolic links resolved.

    Raises:
        OutputError: an unsupported ending, or a device or pipe.
    """
    destination = as_path(path)
    if destination.suffix.lower() not in endings:
        problem = f"cannot write the kind {destination.suffix!r}" if destination.suffix else "needs an ending"
        raise OutputError(path, f"{problem}; accepted: {' '.join(endings)}")
    try:
        target = Path(os.path.realpath(destination))  # replace the target of a link, not the link
        if target.exists() and not (target.is_file() or target.is_dir()):
            raise OutputError(path, "is a device or pipe, no file that could be replaced")
    except (OSError, ValueError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    return target


def temporary_beside(destination: Path) -> Path:
    """Return an unused temporary path in the folder of the destination, with the same ending."""
    return destination.parent / f".torchpt-{secrets.token_hex(8)}{destination.suffix.lower()}"


def write_error(problem: Exception, destination: Path) -> str:
    """Return the reason why a file could not be written, for an OutputError."""
    if not destination.parent.exists():
        return f"cannot be written: there is no folder {destination.parent}"
    return f"cannot be written ({getattr(problem, 'strerror', None) or problem})"


def _checked_pixels(name: str, image: Tensor) -> np.ndarray:
    """Return an image or layer as float32 ``(H, W, C)``; ``name``: ``image`` or the layer's, for errors."""
    if not isinstance(image, Tensor) or not image.is_floating_point():
        hint = "; hand over its .image" if hasattr(image, "image") else ""
        got = f"numbers of {image.dtype}" if isinstance(image, Tensor) else type(image).__name__
        raise ArgumentValueError(f"{name}: expected a tensor of linear floats (H, W, C), got {got}{hint}")
    pixels = image.detach().to("cpu", torch.float32)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise ArgumentValueError(f"{name}: expected (H, W, C), got {tuple(image.shape)}")
    if name == "image" and pixels.shape[2] not in (1, 3, 4):
        raise ArgumentValueError(f"image: expected 1, 3 or 4 channels, got {pixels.shape[2]}")
    return np.ascontiguousarray(pixels.numpy())


def _rgb(pixels: np.ndarray) -> np.ndarray:
    """Return three channels: grey repeated, alpha dropped."""
    return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]


#: Held while OpenEXR has threads.
_openexr_lock = Lock()


@contextmanager
def _openexr_threads() -> Iterator[None]:
    """Let OpenEXR have its threads, and end them afterwards.

    A process that is forked while they are there has none of them, and waits for them for ever as soon as it writes a file.
    """
    import OpenImageIO as oiio

    with _openexr_lock:
        thread_count = oiio.get_int_attribute("exr_threads")
        try:
            yield
        finally:
            oiio.attribute("exr_threads", -1)  # none
            oiio.ImageOutput.create("picture.exr")  # applies the attribute; nothing is written
            oiio.attribute("exr_threads", thread_count)


def _encode_float(temporary: Path, pixels: np.ndarray, channels: list[str], facts: dict[str, Fact]) -> None:
    """Write an EXR or HDR file; ``facts`` go into the header of an EXR.

    Raises:
        OSError: with the encoder's or the system's reason.
    """
    import OpenImageIO as oiio

    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, "float")
    spec.channelnames = channels
    if temporary.suffix == ".exr":
        spec.attribute("compression", "zip")
        put_header(spec, facts)
    with _openexr_threads():
        encoder = oiio.ImageOutput.create("picture" + temporary.suffix)
        if encoder is None:
            raise OSError(oiio.geterror())
        opened = encoder.open(str(temporary), spec)
        written = opened and encoder.write_image(np.ascontiguousarray(pixels))
        succeeded = encoder.close() and written
    if not succeeded:
        # About what an uncompressed file takes: pixels, an offset and a header for each row, the file's header.
        _write_zeros(temporary, pixels.nbytes + 64 * height + 2**16)
        reason = encoder.geterror() or "the encoder failed"
        raise OSError(reason.replace(str(temporary), "the file"))


def _write_zeros(path: Path, size: int) -> None:
    """Write zeros of the size of the image, to get the system's reason for the failure of an encoder that reports none.

    Raises:
        OSError: of the system: the disk is full, the file may not grow, its folder is gone.
    """
    block = bytes(min(size, 2**20))
    with open(path, "wb") as file:
        for _ in range(-(-size // len(block))):
            file.write(block)


def _encode_integer(temporary: Path, levels: np.ndarray) -> None:
    """Write bytes ``(H, W, 3 or 4)`` as PNG, PPM or JPEG, by the file's ending."""
    kind = {".png": "PNG", ".ppm": "PPM"}.get(temporary.suffix, "JPEG")
    options: dict[str, Any] = {"quality": _JPEG_QUALITY} if kind == "JPEG" else {}
    encoded = BytesIO()
    with open_pillow_writer(encoded) as writer:
        writer.write(levels, format=kind, is_batch=False, **options)
    temporary.write_bytes(encoded.getvalue())


def open_pillow_writer(encoded: BytesIO) -> Any:
    """Return imageio's writer of 8-bit pictures and GIFs, a context that encodes into memory when it ends.

    Each call of its ``write`` names the format.
    """
    import imageio.v3 as iio

    with warnings.catch_warnings():
        # Without a file name imageio warns that no ending tells it the format. With one it would import all of Pillow's
        # formats to look the ending up, which takes longer than writing the picture.
        warnings.filterwarnings("ignore", "Can't determine file format", UserWarning)
        return iio.imopen(encoded, "w", plugin="pillow")


def _display_bytes(
    pixels: np.ndarray, exposure: float, tonemap: str, gamma: str | float, *, with_alpha: bool
) -> np.ndarray:
    """Return display values as bytes ``(H, W, 3)``; ``(H, W, 4)`` if the image has alpha and ``with_alpha`` asks for it."""
    shown = display(torch.from_numpy(_rgb(pixels)), exposure, tonemap, gamma)
    if with_alpha and pixels.shape[2] == 4:
        coverage = torch.nan_to_num(torch.from_numpy(pixels[..., 3:]), nan=0.0).clamp(0, 1)
        shown = torch.cat([shown, coverage], dim=-1)
    return (shown * 255 + 0.5).to(torch.uint8).numpy()
