"""Find the first row of an ASCII PLY file that its header does not describe (the format has one row per line).

:mod:`torchpt.scene.meshes.ply` reads words without regard to lines, which is fast; only for an error does it call this module.
A PLY file is a list of *elements* (vertices, faces), each a table of rows with the *properties* that the header declares.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

__all__ = ["find_mismatch"]


class _Property(Protocol):
    """A column; ``count`` is the type of a list's length, "" for a single number."""

    @property
    def name(self) -> str: ...
    @property
    def count(self) -> str: ...


class _Element(Protocol):
    """A table of ``size`` rows."""

    @property
    def name(self) -> str: ...
    @property
    def size(self) -> int: ...
    @property
    def properties(self) -> Sequence[_Property]: ...


def find_mismatch(data: bytes, start: int, elements: Iterable[_Element]) -> str | None:
    """Return a description of the first row that does not match the header; None where all match.

    Args:
        data: the file.
        start: offset of the header's end.
        elements: elements of the header, in order.
    """
    lines = iter(enumerate(_lines(data[start:]), len(_lines(data[:start]))))
    for element in elements:
        if not element.properties:
            continue
        for row in range(element.size):
            number, words = next(((number, line.split()) for number, line in lines if line.strip()), (0, None))
            if words is None:
                return f"truncated: {element.size} of element {element.name} declared, {row} lines found"
            mismatch = _row_mismatch(words, element.properties)
            if mismatch:
                return f"line {number}: {element.name} {row} {mismatch}"
    return None


def _lines(text: bytes) -> list[bytes]:
    """Return the lines of a text with any of the three line ends."""
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")


def _row_mismatch(words: Sequence[bytes], properties: Sequence[_Property]) -> str | None:
    """Return how the words of a row differ from the properties; None where they match."""
    at = 0  # index of the next word
    for declared in properties:
        length = 0
        if declared.count and at < len(words):
            try:
                length = int(words[at])
            except ValueError:
                length = -1
            if length < 0:
                return f"has {_quoted(words[at])} as the length of {declared.name[:40]}, expected a whole number >= 0"
        at += 1 + length  # a number, or a length and the items of a list
    return None if at == len(words) else f"has {len(words)} values, the properties in the header come to {at}"


def _quoted(word: bytes) -> str:
    """Return the start of a word in quotes, for errors."""
    return repr(word[:40].decode("latin-1"))
