"""Metadata of an EXR file: values by name, stored as attributes ``torchpt:NAME`` of its header.

OpenImageIO writes no integers beyond 32 bits to EXR: those are stored as text. Fractions are float32.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from os import PathLike
from typing import Any

from torchpt.core.errors import ArgumentValueError, AssetError
from torchpt.images.decode import existing_image, oiio_error

__all__ = ["Fact", "checked_header", "put_header", "read_header"]

#: A value of the metadata.
Fact = str | int | float

#: Of the attributes' names.
PREFIX = "torchpt:"
# An identifier of at most 100 letters, digits and underscores.
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}\Z")
# 32-bit integers are below it.
_INT32_END = 2**31
# Ten digits or more, with or without a sign: text that may be an integer beyond 32 bits.
_LONG_INTEGER = re.compile(r"-?[1-9][0-9]{9,}\Z")


def checked_header(header: Mapping[str, Fact]) -> dict[str, Fact]:
    """Return the metadata after checking that a header can store it.

    Raises:
        SceneError: a name that is not an identifier, or a value that is not printable text, a number or a bool; also a
            ``ValueError``.
    """
    for name, value in header.items():
        if not isinstance(name, str) or not _IDENTIFIER.match(name):
            raise ArgumentValueError("header", name, "names of letters, digits and _")
        if not isinstance(value, str | int | float):
            raise ArgumentValueError(f"header.{name}", value, "text or a number")
        if isinstance(value, str) and (not value or not value.isprintable()):
            raise ArgumentValueError(f"header.{name}", value, "printable text")
    return dict(header)


def put_header(spec: Any, header: Mapping[str, Fact]) -> None:
    """Add metadata to an ``OpenImageIO.ImageSpec``."""
    for name, value in header.items():
        if isinstance(value, int):  # bools too
            value = int(value) if -_INT32_END <= value < _INT32_END else str(value)
        spec.attribute(PREFIX + name, value)


def read_header(path: str | PathLike[str]) -> dict[str, Fact]:
    """Read the metadata of an EXR file that torchpt wrote.

    ``torchpt render`` and ``Rendering.write`` write ``relmse``, ``relmse_low`` and ``relmse_high`` (if the error was
    estimated), ``spp``, ``seed``, ``load_seconds build_seconds compile_seconds render_seconds`` and others;
    docs/guides/error.md lists them. Other programs find them as attributes ``torchpt:relmse`` and so on.

    Args:
        path: an image file.

    Returns:
        Values by name; empty for a file without metadata, and for formats other than EXR. Fractions have seven digits.

    Raises:
        SceneError: ``path`` is not a path.
        AssetError: a file that is missing, of no known ending, or malformed.
    """
    path = existing_image(path)
    try:
        with path.open("rb") as file:
            if file.read(4) != b"\x76\x2f\x31\x01":  # the magic number of OpenEXR
                return {}
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror or error})") from None
    import OpenImageIO as oiio

    picture = oiio.ImageInput.open(str(path))
    if picture is None:
        raise AssetError(path, f"cannot be read ({oiio_error(oiio) or 'unknown format'})")
    try:
        found = [_name_and_value(item) for item in picture.spec().extra_attribs]
    finally:
        picture.close()
    return {
        name.removeprefix(PREFIX): _decoded(value)
        for name, value in found
        if name.startswith(PREFIX) and isinstance(value, str | int | float)
    }


def _name_and_value(item: Any) -> tuple[str, Any]:
    """Return name and value of an attribute; empty for one that is not UTF-8, which torchpt does not write."""
    try:
        return item.name, item.value
    except UnicodeDecodeError:
        return "", None


def _decoded(value: Fact) -> Fact:
    """Return a value as it was before writing: text of ten digits or more was an integer beyond 32 bits."""
    if isinstance(value, str) and _LONG_INTEGER.match(value) and not -_INT32_END <= int(value) < _INT32_END:
        return int(value)
    return value
