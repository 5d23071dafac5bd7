"""Arrays out of an ``.npz`` archive that may be anybody's: numbers only, none larger than the bytes that are there."""

from __future__ import annotations

import ast
import struct
import zipfile
from typing import BinaryIO

import numpy as np

__all__ = ["read_arrays"]

_MAGIC = b"\x93NUMPY"


def read_arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """The arrays by name, as ``numpy.savez`` wrote them.

    NumPy's own reader trusts a header that declares any size, and runs a tokenizer over one that is malformed.

    Raises:
        ValueError: no such archive, a member that is compressed (it could unfold to anything) or no array of numbers.
        zipfile.BadZipFile: a damaged one.
    """
    found: dict[str, np.ndarray] = {}
    whole = file.seek(0, 2)
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        if sum(member.compress_size for member in members) > whole:
            raise ValueError("its members overlap")
        for member in members:
            name = member.filename
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                raise ValueError(f"{name[:80]!r} is compressed or encrypted")
            if member.file_size != member.compress_size:
                raise ValueError(f"{name[:80]!r} has two sizes")
            if not name.endswith(".npy"):
                raise ValueError(f"{name[:80]!r} is no array")
            try:
                found[name.removesuffix(".npy")] = _array(archive.read(member))
            except (ValueError, SyntaxError, MemoryError, RecursionError, LookupError, TypeError, struct.error):
                raise ValueError(f"{name[:80]!r} is no array of numbers") from None
    return found


def _array(data: bytes) -> np.ndarray:
    """An array from the bytes of a ``.npy`` file (NumPy enhancement proposal 1)."""
    if not data.startswith(_MAGIC):
        raise ValueError("no array")
    size, start = (
        (struct.unpack_from("<H", data, 8)[0], 10) if data[6] == 1 else (struct.unpack_from("<I", data, 8)[0], 12)
    )
    if size > 10_000:
        raise ValueError("a header that long")
    header = ast.literal_eval(data[start : start + size].decode("latin-1").strip())
    kind, shape = np.dtype(header["descr"]), header["shape"]
    if kind.kind not in "biuf" or not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("no numbers")
    values = np.frombuffer(data, kind, offset=start + size).reshape(
        shape, order="F" if header["fortran_order"] else "C"
    )
    return np.array(values, kind.newbyteorder("="), order="C")
