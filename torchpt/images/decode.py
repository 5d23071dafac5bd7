"""Decode image files to arrays as stored: EXR, HDR and 16-bit colour PNG by OpenImageIO, other formats by Pillow.

The format is recognized by the first bytes of a file, whatever its name. Before memory is allocated, the declared size is
checked against the limit and, where the format allows it, against the size of the file.
"""

from __future__ import annotations

import re
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.core.files import as_path, is_regular, read_regular
from torchpt.images.png import sanitize_png

__all__ = ["MAX_PIXELS", "READABLE", "EncodedImage", "Pixels", "decode_image", "existing_image", "oiio_error"]

MAX_PIXELS = 64 * 2**20  # a header may claim anything: checked before memory is allocated
FLOAT_FORMATS = (".exr", ".hdr")
INTEGER_FORMATS = (".png", ".jpg", ".jpeg", ".ppm", ".pgm", ".bmp", ".tga")
READABLE = FLOAT_FORMATS + INTEGER_FORMATS

_MOST_CHANNELS = 16  # largest number of channels of an image with the largest number of pixels
_SIGNATURES = {
    b"\x89PNG\r\n\x1a\n": ".png",
    b"\xff\xd8\xff": ".jpg",
    b"BM": ".bmp",
    b"\x76\x2f\x31\x01": ".exr",
    b"#?RADIANCE": ".hdr",
    b"#?RGBE": ".hdr",
}
_WHITE_OF_16_BITS = 65535
# Most pixels that one byte of a file can encode: 8 of a 1-bit PNG, deflated by at most 1032 (zlib's technical notes); JPEG,
# TGA, BMP and PNM encode fewer.
_PIXELS_PER_BYTE = 8 * 1032
_HEAD_BYTES = 32  # bytes read to recognize a format; a PNG's depth and colour type are bytes 24 and 25
_LONGEST_REASON = 120  # most characters of a decoder's message in an error
_VALUES_PER_BAND = 2**20  # values read at a time, so that a truncated file fails before all of its memory is touched


@dataclass(frozen=True)
class EncodedImage:
    """An image file in memory, for example from a GLB file or a data: URI.

    Attributes:
        label: name for errors: the file that holds it, and its index there.
        data: the bytes of the image file.
        kind: its format as a file ending without the dot, such as ``png``; empty: unknown.
    """

    label: str
    data: bytes
    kind: str = ""

    def __repr__(self) -> str:
        return f"EncodedImage({self.label!r}, {len(self.data)} bytes, {self.kind!r})"


@dataclass(frozen=True)
class Pixels:
    """Pixels of a file, as stored.

    Attributes:
        values: ``(H, W, C)``, row 0 at the top: integers, booleans or float32.
        white: the stored value that stands for 1; of no meaning for float32.
        channels: channel names of an EXR or HDR; else empty.
    """

    values: NDArray[Any]
    white: int
    channels: tuple[str, ...] = ()

    @property
    def eight_bit(self) -> bool:
        """Return True if values are stored with at most 8 bits."""
        return self.values.dtype.kind in "ub" and self.white <= 255


def existing_image(path: str | PathLike[str]) -> Path:
    """Return the path of an image file after checking that it exists.

    Raises:
        SceneError: ``path`` is not a path.
        AssetError: no such file, not a regular file, or one that neither its ending nor its first bytes name.
    """
    path = as_path(path)
    if path.suffix.lower() not in READABLE and not (is_regular(path) and _ending_of(_head(path))):
        raise AssetError(path, f"unknown kind of image {path.suffix!r}; known: {' '.join(READABLE)}")
    try:
        if not path.exists():
            raise AssetError(path, "no such file")
        if not path.is_file():
            raise AssetError(path, "is not a file")
    except (OSError, ValueError) as problem:
        raise AssetError(path, f"cannot be read ({problem})") from problem
    return path


def decode_image(source: Path | EncodedImage, max_pixels: int) -> Pixels:
    """Decode an existing file, or one in memory.

    Raises:
        AssetError: malformed, truncated, of more than ``max_pixels`` pixels, or CMYK.
    """
    label = str(source) if isinstance(source, Path) else source.label
    try:
        data = _head(source)
        ending = _ending_of(data)
        if ending is None:
            ending = source.suffix.lower() if isinstance(source, Path) else f".{source.kind.lower()}"
        if ending not in READABLE:
            known = " ".join(READABLE)
            raise AssetError(label, f"unknown kind of image {ending.strip('.')!r}; known: {known}")
        # Byte 24 of a PNG: bits a value, here 16. Byte 25: colour type, here RGB, grey with alpha or RGBA. Pillow keeps
        # 8 bits a value of these.
        if ending == ".png" and data[24:26] in (b"\x10\x02", b"\x10\x04", b"\x10\x06"):
            whole = read_regular(source) if isinstance(source, Path) else source.data
            width, height = (int.from_bytes(whole[offset : offset + 4], "big") for offset in (16, 20))
            _check_size(label, width, height, channels=4, max_pixels=max_pixels, file_bytes=len(whole))
            source = EncodedImage(label, sanitize_png(whole), kind="png")
            return _decode_by_oiio(source, label, ending, stored="uint16", max_pixels=max_pixels)
        if ending in FLOAT_FORMATS:
            return _decode_by_oiio(source, label, ending, stored="float", max_pixels=max_pixels)
        return _decode_by_pillow(source, label, ending, max_pixels)
    except AssetError:
        raise
    except OSError as error:
        raise AssetError(label, f"cannot be read ({error.strerror or error})") from None
    except Exception as problem:  # SyntaxError, ValueError, struct.error, zlib.error, text that is no UTF-8, ...
        raise AssetError(label, f"cannot be read ({_first_line(problem)})") from None


def _ending_of(head: bytes) -> str | None:
    """Return the ending of the format that a file's first bytes name, or None."""
    return next((ending for magic, ending in _SIGNATURES.items() if head.startswith(magic)), None)


def _head(source: Path | EncodedImage) -> bytes:
    if isinstance(source, EncodedImage):
        return source.data[:_HEAD_BYTES]
    with source.open("rb") as file:
        return file.read(_HEAD_BYTES)


def _check_size(
    label: str, width: int, height: int, channels: int, max_pixels: int, file_bytes: int | None = None
) -> None:
    """Raise an AssetError for an image that is empty, too large, or larger than a file of ``file_bytes`` bytes can encode."""
    if width < 1 or height < 1 or channels < 1:
        raise AssetError(label, f"has no pixels ({width} x {height}, {channels} channels)")
    if width * height > max_pixels or width * height * channels > _MOST_CHANNELS * max_pixels:
        limit = f"{max_pixels / 2**20:g} Mpixel" if max_pixels >= 2**20 else f"{max_pixels} pixels"
        raise AssetError(label, f"{width} x {height} pixels, {channels} channels: more than {limit} are not read")
    if file_bytes is not None and width * height > _PIXELS_PER_BYTE * file_bytes:
        raise AssetError(label, f"cannot be read ({width} x {height} pixels declared in {file_bytes} bytes)")


#: Pixels as they are to be seen from those of a file, by its orientation (TIFF 6.0).
_UPRIGHT: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda x: x,
    2: np.fliplr,
    3: lambda x: np.rot90(x, 2),
    4: np.flipud,
    5: lambda x: x.swapaxes(0, 1),
    6: lambda x: np.rot90(x, -1),
    7: lambda x: np.rot90(x.swapaxes(0, 1), 2),
    8: lambda x: np.rot90(x, 1),
}


def _decode_by_oiio(source: Path | EncodedImage, label: str, ending: str, stored: str, max_pixels: int) -> Pixels:
    """Decode all channels of the first part of a file with OpenImageIO, as ``stored`` values: ``uint16`` or ``float``."""
    if isinstance(source, EncodedImage):  # OpenImageIO reads files only
        with tempfile.NamedTemporaryFile(suffix=ending) as file:
            file.write(source.data)
            file.flush()
            return _decode_by_oiio(Path(file.name), label, ending, stored, max_pixels)
    import OpenImageIO as oiio

    options = oiio.ImageSpec()
    options.attribute("oiio:UnassociatedAlpha", 1)  # a PNG's colours as stored, not multiplied by alpha
    options.attribute("oiio:RawColor", 1)  # nor converted to another colour space
    picture = oiio.ImageInput.open(str(source), options)
    if picture is None:
        raise AssetError(label, f"cannot be read ({oiio_error(oiio) or 'unknown format'})")
    try:
        spec = picture.spec()
        # Radiance files may have their pixels in any order.
        upright = _UPRIGHT[spec.get_int_attribute("Orientation", 1) if ending == ".hdr" else 1]
        if spec.deep:
            raise AssetError(label, "holds deep pixels, which are not read")
        _check_size(label, spec.width, spec.height, spec.nchannels, max_pixels)
        values: NDArray[Any] | None = None
        if spec.tile_width:
            values = picture.read_image(stored)
            if values is None:
                raise AssetError(label, f"cannot be read ({oiio_error(picture) or 'truncated'})")
            values = values.reshape(spec.height, spec.width, spec.nchannels)
            return Pixels(upright(values), white=_WHITE_OF_16_BITS, channels=tuple(spec.channelnames))
        step = max(1, _VALUES_PER_BAND // (spec.width * spec.nchannels))
        for start in range(0, spec.height, step):
            end = min(start + step, spec.height)
            band = picture.read_scanlines(0, 0, spec.y + start, spec.y + end, 0, 0, spec.nchannels, stored)
            if band is None:
                raise AssetError(label, f"cannot be read ({oiio_error(picture) or 'truncated'})")
            if values is None:
                values = np.empty((spec.height, spec.width, spec.nchannels), band.dtype)
            values[start:end] = band.reshape(end - start, spec.width, spec.nchannels)
        assert values is not None
        return Pixels(upright(values), white=_WHITE_OF_16_BITS, channels=tuple(spec.channelnames))
    finally:
        picture.close()


def _decode_by_pillow(source: Path | EncodedImage, label: str, ending: str, max_pixels: int) -> Pixels:
    """Decode a file of an integer format with Pillow."""
    from PIL.BmpImagePlugin import BmpImageFile
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile
    from PIL.PpmImagePlugin import PpmImageFile
    from PIL.TgaImagePlugin import TgaImageFile

    # Pillow's plugins are called directly, not through imageio, which would hand a damaged file to all of Pillow's forty
    # formats, apply Pillow's limit of sizes before ours, and give no reason for a failure.
    plugin = {".png": PngImageFile, ".jpg": JpegImageFile, ".jpeg": JpegImageFile, ".bmp": BmpImageFile}
    plugin |= {".tga": TgaImageFile, ".ppm": PpmImageFile, ".pgm": PpmImageFile}
    data = read_regular(source) if isinstance(source, Path) else source.data
    with _quiet_pillow():
        return _pillow_pixels(plugin[ending](BytesIO(data)), label, len(data), max_pixels)


_quiet_lock, _quiet_count = threading.Lock(), 0
#: Modules that Pillow's warnings name.
_WARNING_MODULES = r"PIL\b|torchpt\.images\.decode$"


@contextmanager
def _quiet_pillow() -> Iterator[None]:
    """Ignore Pillow's warnings within: they are of odd metadata, which is not used.

    Several threads may be within at a time. The filters are the process's: :func:`warnings.catch_warnings` would drop the
    warnings of other threads, and restore filters that others have changed.
    """
    global _quiet_count
    with _quiet_lock:
        _quiet_count += 1
        if _quiet_count == 1:
            warnings.filterwarnings("ignore", module=_WARNING_MODULES)
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_count -= 1
            if _quiet_count == 0:
                filters = cast("list[Any]", warnings.filters)
                filters[:] = [entry for entry in filters if entry != _FILTER]


#: The entry that this filter makes: action, message, category, module, line.
_FILTER = ("ignore", None, Warning, re.compile(_WARNING_MODULES), 0)


def _pillow_pixels(picture: Any, label: str, size: int, max_pixels: int) -> Pixels:
    width, height = picture.size
    _check_size(label, width, height, len(picture.getbands()), max_pixels, size)
    if picture.mode not in _MODES:
        raise AssetError(label, f"colours stored as {picture.mode} are not read; expected grey or RGB")
    if "transparency" in picture.info and picture.mode in _GREYS:
        return _with_transparent_grey(picture)
    if "transparency" in picture.info and picture.mode in ("P", "RGB"):
        picture.load()
        picture = picture.convert("RGBA")
    elif picture.mode == "P":
        picture.load()
        picture = picture.convert(picture.palette.mode if picture.palette.mode in ("RGB", "RGBA") else "RGB")
    values = np.array(picture)
    return Pixels(values[..., None] if values.ndim == 2 else values, white=_MODES[picture.mode])


#: Pillow's modes of grey PNG files.
_GREYS = ("1", "L", "I;16", "I;16B", "I;16L", "I")


def _with_transparent_grey(picture: Any) -> Pixels:
    """Return grey pixels of a PNG with an alpha channel, 0 where they have its transparent value, and else 1."""
    transparent, white = picture.info["transparency"], _MODES[picture.mode]
    # Pillow scales pixels of 2 and 4 bits to 8, but not this value. It forgets the number of bits when it loads them.
    transparent *= {"L;2": 85, "L;4": 17}.get(picture.tile[0].args, 1)
    values = np.array(picture)
    if picture.mode == "1":
        values, white, transparent = values.astype(np.uint8), 1, int(bool(transparent))
    alpha = np.where(values == transparent, 0, white).astype(values.dtype)
    return Pixels(np.stack((values, alpha), -1), white=white)


# Pillow's modes that are supported, with the value that stands for 1
_MODES = {
    **{"1": 1, "L": 255, "LA": 255, "P": 255, "RGB": 255, "RGBA": 255},
    # 16 bits a value, in three byte orders; "I" (32 bits) is what Pillow makes of 16-bit grey in some formats.
    **dict.fromkeys(("I;16", "I;16B", "I;16L", "I"), _WHITE_OF_16_BITS),
}


def oiio_error(source: Any) -> str:
    """Return the error message of OpenImageIO, or of one of its inputs, as one line; empty: none."""
    try:
        found = source.geterror()
    except UnicodeDecodeError:  # the message quotes bytes of the file
        return "malformed"
    return _first_line(found) if found.strip() else ""


def _first_line(problem: object) -> str:
    """Return the first line of a decoder's message, shortened."""
    return (str(problem).strip().splitlines() or [type(problem).__name__])[0][:_LONGEST_REASON]
