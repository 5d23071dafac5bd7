"""Write pictures: whole or not at all.

A file is encoded beside its destination under a name of its own and then moved over it, so a reader never sees half a
picture and a failure leaves what was there before.
"""

from __future__ import annotations

import os
import secrets
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

from torchpt.core.errors import OutputError
from torchpt.core.files import as_path
from torchpt.images.colour import display
from torchpt.images.header import Fact, checked_header, put_header
from torchpt.images.layers import channel_names

__all__ = ["WRITABLE", "check_writable", "output_path", "temporary_beside", "write_error", "write_image"]

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
    """Write a picture in the format that the file's ending names.

    ``.exr`` holds float32 and the layers, as channels of one part; ``.hdr`` holds RGBE (steps of 0.4 % of the
    brightest channel, no negative values): both keep linear radiance untouched. ``.png .jpg .jpeg .ppm`` hold 8 bits
    of what `colour.display` makes of it.

    Args:
        path: where to; an existing file is replaced.
        image: ``(H, W, C)`` linear, C = 1, 3 or 4 (alpha is kept by EXR and PNG).
        layers: name to ``(H, W, C)`` or ``(H, W)``; kept by ``.exr`` only. The names of `film.aovs` get the usual
            channels: ``albedo.R/G/B normal.X/Y/Z Z position.X/Y/Z uv.U/V object_id A variance.R/G/B
            samples``.
        exposure: stops (8-bit formats).
        tonemap: none, reinhard, aces or filmic (8-bit formats).
        gamma: ``"srgb"`` or an exponent (8-bit formats).
        header: facts by name (letters, digits and _), each printable text or a number; kept by ``.exr`` only, as attributes
            ``torchpt:NAME``, and read by :func:`torchpt.read_header`.

    Raises:
        SceneError: ``path`` is none.
        OutputError: an ending that is not written, or a place that cannot be written.
        ValueError: an image or layer of another shape, a header that no file could hold.
    """
    destination = output_path(path)
    pixels, facts = _pixels("image", image), checked_header(header or {})
    temporary = temporary_beside(destination)
    if temporary.suffix == ".exr":
        named = {"image": pixels} | {name: _pixels(name, layer) for name, layer in (layers or {}).items()}
        for name, layer in named.items():
            if layer.shape[:2] != pixels.shape[:2]:
                raise ValueError(f"layer {name!r} is {tuple(layer.shape[:2])}, the picture {tuple(pixels.shape[:2])}")
        channels = [channel for name, layer in named.items() for channel in channel_names(name, layer.shape[2])]
        twice = sorted({channel for channel in channels if channels.count(channel) > 1})
        if twice:
            raise ValueError(f"two layers have the channel {twice[0]} (a picture of 4 channels has its alpha: A)")
        encode = partial(_encode_float, temporary, np.concatenate(list(named.values()), axis=2), channels, facts)
    elif temporary.suffix == ".hdr":  # RGBE has no sign: the encoder would wrap around
        rgb = np.nan_to_num(_rgb(pixels), nan=0.0, posinf=1e30).clip(0, 1e30)
        encode = partial(_encode_float, temporary, rgb, ["R", "G", "B"], {})
    else:
        levels = _levels(pixels, temporary.suffix == ".png", exposure, tonemap, gamma)
        encode = partial(_encode_integer, temporary, levels)
    try:
        encode()
        os.replace(temporary, destination)
    except (OSError, ValueError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    finally:
        with suppress(OSError):  # it is only there after a failure
            temporary.unlink()


def check_writable(path: str | PathLike[str], endings: tuple[str, ...] = WRITABLE) -> Path:
    """Find out before a long render whether its picture can be written; leaves nothing behind.

    Args:
        path: where to.
        endings: the formats that count.

    Returns:
        The file itself, links resolved.

    Raises:
        OutputError: an ending that is not written, a folder that is missing or cannot be written, a folder in the way.
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
    """The file that is meant, links resolved; an ending that is not among those accepted is an OutputError."""
    destination = as_path(path)
    if destination.suffix.lower() not in endings:
        problem = f"cannot write the kind {destination.suffix!r}" if destination.suffix else "needs an ending"
        raise OutputError(path, f"{problem}; accepted: {' '.join(endings)}")
    try:
        found = Path(os.path.realpath(destination))  # a link stays a link: its target is replaced
        if found.exists() and not (found.is_file() or found.is_dir()):
            raise OutputError(path, "is a device or pipe, no file that could be replaced")
    except (OSError, ValueError) as problem:
        raise OutputError(path, write_error(problem, destination)) from problem
    return found


def temporary_beside(destination: Path) -> Path:
    """A name that nothing has yet, where a file is made before it is moved to its place."""
    return destination.parent / f".torchpt-{secrets.token_hex(8)}{destination.suffix.lower()}"


def write_error(problem: Exception, destination: Path) -> str:
    """Why a file could not be written, for an OutputError."""
    if not destination.parent.exists():
        return f"cannot be written: there is no folder {destination.parent}"
    return f"cannot be written ({getattr(problem, 'strerror', None) or problem})"


def _pixels(name: str, image: Tensor) -> np.ndarray:
    if not isinstance(image, Tensor) or not image.is_floating_point():
        hint = "; hand over its .image" if hasattr(image, "image") else ""
        got = f"numbers of {image.dtype}" if isinstance(image, Tensor) else type(image).__name__
        raise ValueError(f"{name}: expected a tensor of linear floats (H, W, C), got {got}{hint}")
    pixels = image.detach().to("cpu", torch.float32)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or 0 in pixels.shape:
        raise ValueError(f"{name}: expected (H, W, C), got {tuple(image.shape)}")
    if name == "image" and pixels.shape[2] not in (1, 3, 4):
        raise ValueError(f"image: expected 1, 3 or 4 channels, got {pixels.shape[2]}")
    return np.ascontiguousarray(pixels.numpy())


def _rgb(pixels: np.ndarray) -> np.ndarray:
    return np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]


#: Held while OpenEXR has threads.
_encoding = Lock()


@contextmanager
def _threads_of_openexr() -> Iterator[None]:
    """Let OpenEXR have its threads, and end them afterwards.

    A process that is forked while they are there has none of them, and waits for them for ever as soon as it writes a file.
    """
    import OpenImageIO as oiio

    with _encoding:
        wanted = oiio.get_int_attribute("exr_threads")
        try:
            yield
        finally:
            oiio.attribute("exr_threads", -1)  # none
            oiio.ImageOutput.create("picture.exr")  # which heeds it
            oiio.attribute("exr_threads", wanted)


def _encode_float(temporary: Path, pixels: np.ndarray, channels: list[str], facts: dict[str, Fact]) -> None:
    import OpenImageIO as oiio

    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, "float")
    spec.channelnames = channels
    if temporary.suffix == ".exr":
        spec.attribute("compression", "zip")
        put_header(spec, facts)
    with _threads_of_openexr():
        encoder = oiio.ImageOutput.create("picture" + temporary.suffix)
        if encoder is None:
            raise OSError(oiio.geterror())
        opened = encoder.open(str(temporary), spec)
        written = opened and encoder.write_image(np.ascontiguousarray(pixels))
        done = encoder.close() and written
    if not done:
        _try_bytes(temporary, pixels.nbytes + 64 * height + 2**16)
        said = encoder.geterror() or "the encoder failed"
        raise OSError(said.replace(str(temporary), "the file"))


def _try_bytes(path: Path, size: int) -> None:
    """Write as many zeros as an encoder may have wanted to write: it failed and does not tell the system's reason.

    Raises:
        OSError: the system's: the disk is full, the file may not grow, its folder is gone.
    """
    block = bytes(min(size, 2**20))
    with open(path, "wb") as file:
        for _ in range(-(-size // len(block))):
            file.write(block)


def _encode_integer(temporary: Path, levels: np.ndarray) -> None:
    from PIL import Image

    kind = {".png": "PNG", ".ppm": "PPM"}.get(temporary.suffix, "JPEG")
    options: dict[str, Any] = {"quality": 95} if kind == "JPEG" else {}
    encoded = BytesIO()
    Image.fromarray(levels).save(encoded, kind, **options)  # a kind by name: else Pillow imports all that it knows
    temporary.write_bytes(encoded.getvalue())


def _levels(pixels: np.ndarray, alpha: bool, exposure: float, tonemap: str, gamma: str | float) -> np.ndarray:
    """The bytes that a screen shows, ``(H, W, 3)``, or 4 where there is an alpha channel and the format keeps it."""
    shown = display(torch.from_numpy(_rgb(pixels)), exposure, tonemap, gamma)
    if alpha and pixels.shape[2] == 4:
        coverage = torch.nan_to_num(torch.from_numpy(pixels[..., 3:]), nan=0.0).clamp(0, 1)
        shown = torch.cat([shown, coverage], dim=-1)
    return (shown * 255 + 0.5).to(torch.uint8).numpy()
