"""Link object code into this process without LLVM, whose library takes 47 MB of memory and more time than all kernels together.

Kernels need little of a linker. LLVM compiles them for the large code model, so that every address in them is absolute and has
64 bits, and no table of far functions is needed; they have no writable data, and throw nothing. Objects with anything else, of
another format or of another processor are left to LLVM (:func:`torchpt.native.machine.load_object`).

The format: System V Application Binary Interface, "Object Files"; the relocation: AMD64 Architecture Processor Supplement, 4.4.
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import platform
import struct
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

__all__ = ["Linked", "link"]

#: Start of a file header: 64 bits, little-endian, version 1, any system; a relocatable object for x86-64.
_MAGIC = b"\x7fELF\x02\x01\x01"
_RELOCATABLE, _X86_64 = 1, 62
_HEADER, _SECTION, _SYMBOL, _RELOCATION = (
    struct.Struct(form) for form in ("<16sHHIQQQIHHHHHH", "<IIQQQQIIQQ", "<IBBHQQ", "<QQq")
)
# types of sections
_CODE_OR_DATA, _SYMBOLS, _RELOCATIONS, _RELOCATIONS_WITHOUT_ADDEND = 1, 2, 4, 9
#: Flags of sections: in memory, executable.
_ALLOC, _EXECUTABLE = 0x2, 0x4
#: Flags that a section in memory may have: those, mergeable, strings, and placed anywhere (large).
_KNOWN_FLAGS = _ALLOC | _EXECUTABLE | 0x10 | 0x20 | 0x1000_0000
#: Types of symbols: none, object, function, section. Others, such as thread-local ones, need more of a linker.
_KNOWN_SYMBOLS = (0, 1, 2, 3)
_FUNCTION = 2
_UNDEFINED, _FIRST_RESERVED = 0, 0xFF00  # sections of symbols
#: The relocation: write the 64-bit sum of symbol and addend.
_ABSOLUTE_64 = 1


class Linked(NamedTuple):
    """Linked code.

    Attributes:
        memory: holds the code as long as it is referenced.
        functions: address of each function by its name.
    """

    memory: mmap.mmap
    functions: dict[str, int]


class _Refused(Exception):
    """The object needs more than is done here."""


class _Section(NamedTuple):
    name: int
    type: int
    flags: int
    address: int
    offset: int
    size: int
    link: int
    info: int
    align: int
    entry_bytes: int


class _Symbol(NamedTuple):
    name: int
    info: int
    other: int
    section: int
    value: int
    size: int


def link(code: bytes) -> Linked | None:
    """Link an object file; return None if it has anything but what is said above, or is damaged, or the system is not Linux."""
    if not _here() or code[: len(_MAGIC)] != _MAGIC:
        return None
    try:
        return _linked(code)
    except (_Refused, struct.error, IndexError, OverflowError, OSError, UnicodeDecodeError):
        return None


@functools.cache
def _here() -> bool:
    """Return True where code of x86-64 runs, in 64 bits, and memory is protected as below."""
    return sys.platform == "linux" and platform.machine() == "x86_64" and sys.maxsize > 2**32


def _require(fact: bool) -> None:
    if not fact:
        raise _Refused


def _linked(code: bytes) -> Linked:
    header = _HEADER.unpack_from(code)
    kind, processor, first, section_bytes, count = header[1], header[2], header[6], header[11], header[12]
    _require((kind, processor, section_bytes) == (_RELOCATABLE, _X86_64, _SECTION.size))
    sections = [_Section(*_SECTION.unpack_from(code, first + k * _SECTION.size)) for k in range(count)]
    tables = [section for section in sections if section.type == _SYMBOLS]
    _require(len(tables) == 1 and not any(section.type == _RELOCATIONS_WITHOUT_ADDEND for section in sections))
    symbols = [_Symbol(*row) for row in _rows(code, tables[0], _SYMBOL)]
    names = _content(code, sections[tables[0].link])

    starts, executable, size = _layout(code, sections)
    memory = mmap.mmap(-1, max(size, 1), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    for k, start in starts.items():
        memory[start : start + sections[k].size] = _content(code, sections[k])

    def address_of(symbol: _Symbol) -> int:
        _require(symbol.info & 15 in _KNOWN_SYMBOLS and symbol.section < _FIRST_RESERVED)
        if symbol.section == _UNDEFINED:
            return _function_of_process(_text(names, symbol.name))
        _require(symbol.section in starts and symbol.value <= sections[symbol.section].size)
        return base + starts[symbol.section] + symbol.value

    for section in sections:
        if section.type == _RELOCATIONS and section.info in starts:
            start, end = starts[section.info], sections[section.info].size
            for place, info, addend in _rows(code, section, _RELOCATION):
                _require(info & 0xFFFF_FFFF == _ABSOLUTE_64 and place + 8 <= end)
                value = address_of(symbols[info >> 32]) + addend
                struct.pack_into("<Q", memory, start + place, value & 0xFFFF_FFFF_FFFF_FFFF)
    # Nothing is writable and executable at the same time.
    _protect(base, executable, mmap.PROT_READ | mmap.PROT_EXEC)
    _protect(base + executable, size - executable, mmap.PROT_READ)
    functions = {
        _text(names, symbol.name): address_of(symbol)
        for symbol in symbols
        if symbol.info & 15 == _FUNCTION and symbol.section != _UNDEFINED
    }
    return Linked(memory, functions)


def _layout(code: bytes, sections: list[_Section]) -> tuple[dict[int, int], int, int]:
    """Place the sections that are in memory, code first.

    Returns:
        The start of each section by its number; the bytes of code; the bytes of all, both in whole pages.
    """
    starts: dict[int, int] = {}
    ends: list[int] = []
    at = 0
    for flag in (_EXECUTABLE, 0):
        for k, section in enumerate(sections):
            if section.flags & _ALLOC and section.flags & _EXECUTABLE == flag:
                _require(section.type == _CODE_OR_DATA and not section.flags & ~_KNOWN_FLAGS)
                _require(section.align <= mmap.PAGESIZE and section.offset + section.size <= len(code))
                at = _up(at, max(section.align, 1))
                starts[k] = at
                at += section.size
        at = _up(at, mmap.PAGESIZE)
        ends.append(at)
    return starts, ends[0], ends[1]


def _up(size: int, unit: int) -> int:
    """Return the size rounded up to whole units."""
    return -(-size // unit) * unit


def _content(code: bytes, section: _Section) -> bytes:
    _require(section.offset + section.size <= len(code))
    return code[section.offset : section.offset + section.size]


def _rows(code: bytes, section: _Section, form: struct.Struct) -> Iterator[tuple[Any, ...]]:
    _require(section.entry_bytes == form.size)
    return form.iter_unpack(_content(code, section))


def _text(names: bytes, start: int) -> str:
    end = names.find(b"\0", start)
    _require(end >= 0)
    return names[start:end].decode()


@functools.cache
def _function_of_process(name: str) -> int:
    """Return the address of a function that the process has loaded, such as ``memset``: the one that LLVM would find."""
    try:
        address = ctypes.cast(ctypes.CDLL(None)[name], ctypes.c_void_p).value
    except AttributeError:
        raise _Refused from None
    assert address
    return address


def _protect(address: int, size: int, protection: int) -> None:
    """Set the protection of whole pages."""
    if size and ctypes.CDLL(None).mprotect(ctypes.c_void_p(address), ctypes.c_size_t(size), protection):
        raise _Refused
