"""What an EXR file says of its picture beside the pixels: facts by name, as attributes ``torchpt:NAME`` of its header.

EXR has no whole numbers beyond 32 bits that OpenImageIO would write: those are kept as their digits. Fractions are float32.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from os import PathLike
from typing import Any

from torchpt.core.errors import AssetError
from torchpt.images.decode import existing_image, oiio_error

__all__ = ["Fact", "checked_header", "put_header", "read_header"]

Fact = str | int | float

PREFIX = "torchpt:"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}\Z")
_SMALL = 2**31
_DIGITS = re.compile(r"-?[1-9][0-9]{9,}\Z")


def checked_header(header: Mapping[str, Fact]) -> dict[str, Fact]:
    """Facts that a header can hold.

    Raises:
        ValueError: a name that is no identifier, or a value that is no text, number or truth.
    """
    for name, value in header.items():
        if not isinstance(name, str) or not _NAME.match(name):
            raise ValueError(f"header: expected names of letters, digits and _, got {name!r}")
        if not isinstance(value, str | int | float):
            raise ValueError(f"header: {name}: expected text or a number, got {value!r}")
        if isinstance(value, str) and (not value or not value.isprintable()):
            raise ValueError(f"header: {name}: expected printable text, got {value!r}")
    return dict(header)


def put_header(spec: Any, header: Mapping[str, Fact]) -> None:
    """Put facts into an ``OpenImageIO.ImageSpec``."""
    for name, value in header.items():
        if isinstance(value, int):  # truths too
            value = int(value) if -_SMALL <= value < _SMALL else str(value)
        spec.attribute(PREFIX + name, value)


def read_header(path: str | PathLike[str]) -> dict[str, Fact]:
    """Read what an EXR file that torchpt wrote says of its picture.

    ``torchpt render`` and ``Rendering.write`` write ``relmse``, ``relmse_low`` and ``relmse_high`` (where the picture knows its
    error), ``spp``, ``seed``, ``load_seconds build_seconds compile_seconds render_seconds`` and others;
    docs/guides/error.md lists them. Other programs find them as attributes ``torchpt:relmse`` and so on.

    Args:
        path: a picture file.

    Returns:
        Facts by name; empty for a file that has none, and for formats other than EXR. Fractions have float32's seven digits.

    Raises:
        SceneError: ``path`` is none.
        AssetError: a file that is missing, of no known ending, or malformed.
    """
    path = existing_image(path)
    try:
        with path.open("rb") as file:
            if file.read(4) != b"\x76\x2f\x31\x01":
                return {}
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror or error})") from None
    import OpenImageIO as oiio

    picture = oiio.ImageInput.open(str(path))
    if picture is None:
        raise AssetError(path, f"cannot be read ({oiio_error(oiio) or 'unknown format'})")
    try:
        found = [_told(item) for item in picture.spec().extra_attribs]
    finally:
        picture.close()
    return {
        name.removeprefix(PREFIX): _read(value)
        for name, value in found
        if name.startswith(PREFIX) and isinstance(value, str | int | float)
    }


def _told(item: Any) -> tuple[str, Any]:
    """Name and value of an attribute; other programs' need not be UTF-8, and none of those is ours."""
    try:
        return item.name, item.value
    except UnicodeDecodeError:
        return "", None


def _read(value: Fact) -> Fact:
    """A fact as it was; text of ten digits or more that 32 bits cannot hold was a whole number."""
    if isinstance(value, str) and _DIGITS.match(value) and not -_SMALL <= int(value) < _SMALL:
        return int(value)
    return value
