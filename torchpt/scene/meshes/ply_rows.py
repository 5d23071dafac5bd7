"""Where the rows of an ASCII PLY file are others than its header declares: the format has one row a line."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

__all__ = ["find_mismatch"]


class _Property(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def count(self) -> str: ...


class _Element(Protocol):
    @property
    def name(self) -> str: ...
    @property
    def size(self) -> int: ...
    @property
    def properties(self) -> Sequence[_Property]: ...


def find_mismatch(data: bytes, start: int, elements: Iterable[_Element]) -> str | None:
    """What is wrong with the first row that its header does not describe; None where there is none.

    Args:
        data: the file.
        start: where the header ends.
        elements: of the header, in order.
    """
    lines = iter(enumerate(_lines(data[start:]), len(_lines(data[:start]))))
    for element in elements:
        if not element.properties:
            continue
        for row in range(element.size):
            number, words = next(((number, line.split()) for number, line in lines if line.strip()), (0, None))
            if words is None:
                return f"truncated: {element.size} of element {element.name} declared, {row} lines found"
            wrong = _row(words, element.properties)
            if wrong:
                return f"line {number}: {element.name} {row} {wrong}"
    return None


def _lines(text: bytes) -> list[bytes]:
    return text.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")


def _row(words: Sequence[bytes], properties: Sequence[_Property]) -> str | None:
    at = 0
    for each in properties:
        length = 0
        if each.count and at < len(words):
            try:
                length = int(words[at])
            except ValueError:
                return f"has {_word(words[at])} as the length of {each.name[:40]}, expected a whole number >= 0"
            if length < 0:
                return f"has {_word(words[at])} as the length of {each.name[:40]}, expected a whole number >= 0"
        at += 1 + length
    return None if at == len(words) else f"has {len(words)} values, the properties in the header come to {at}"


def _word(word: bytes) -> str:
    return repr(word[:40].decode("latin-1"))
