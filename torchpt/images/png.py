"""Check PNG files before libpng reads them, since libpng prints its errors to the standard error stream of the process."""

from __future__ import annotations

import struct
import zlib

import numpy as np

__all__ = ["sanitize_png"]

# grey, RGB, grey with alpha, RGBA (PNG specification, 11.2.2)
_CHANNELS_BY_COLOUR_TYPE = {0: 1, 2: 3, 4: 2, 6: 4}
# first column, first row, step of columns and step of rows of each pass (PNG specification, 8.2: Adam7)
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def sanitize_png(data: bytes) -> bytes:
    """Return a PNG of 16 bits a value with only its header, transparent colour and pixels, after checking all of them.

    Args:
        data: bytes of the file; its declared size must have been checked.

    Raises:
        ValueError: a malformed or truncated file.
    """
    width, height, bit_depth, colour_type, compression, filtering, interlace = struct.unpack(">IIBBBBB", data[16:29])
    if bit_depth != 16 or colour_type not in _CHANNELS_BY_COLOUR_TYPE or compression or filtering or interlace > 1:
        raise ValueError("the PNG header is malformed")
    pixel_bytes = 2 * _CHANNELS_BY_COLOUR_TYPE[colour_type]
    chunks: dict[bytes, list[bytes]] = {b"IHDR": [], b"tRNS": [], b"IDAT": []}
    # After the signature of 8 bytes a file is chunks: size of the data, name, data, CRC-32 of name and data.
    offset = 8
    while True:
        if offset + 12 > len(data):
            raise ValueError("truncated")
        size, kind = int.from_bytes(data[offset : offset + 4], "big"), data[offset + 4 : offset + 8]
        if kind == b"IEND":
            break
        if offset + 12 + size > len(data):
            raise ValueError("truncated")
        if kind in chunks:
            if zlib.crc32(data[offset + 4 : offset + 8 + size]) != int.from_bytes(
                data[offset + 8 + size : offset + 12 + size], "big"
            ):
                raise ValueError(f"the checksum of a chunk {kind.decode()} is wrong")
            chunks[kind].append(data[offset + 8 : offset + 8 + size])
        offset += 12 + size
    if len(chunks[b"IHDR"]) != 1 or len(chunks[b"IHDR"][0]) != 13:
        raise ValueError("the PNG header is malformed")
    passes = _PASSES if interlace else ((0, 0, 1, 1),)
    # Columns and rows of each pass. Each row has a byte for its filter (0..4) before its pixels.
    sizes = [(-(-(width - x) // dx), -(-(height - y) // dy)) for x, y, dx, dy in passes]
    sizes = [(columns, rows) for columns, rows in sizes if columns > 0 and rows > 0]
    expected = sum(rows * (1 + columns * pixel_bytes) for columns, rows in sizes)
    stream = zlib.decompressobj()
    filtered_rows = stream.decompress(b"".join(chunks[b"IDAT"]), expected + 1)
    if len(filtered_rows) != expected or not stream.eof:
        raise ValueError(f"truncated: {expected} bytes of pixels declared, got {len(filtered_rows)}")
    offset = 0
    for columns, rows in sizes:
        row_bytes = 1 + columns * pixel_bytes
        if np.frombuffer(filtered_rows, np.uint8, rows * row_bytes, offset)[::row_bytes].max() > 4:
            raise ValueError("a row has an unknown filter")
        offset += rows * row_bytes
    body = _encode_chunk(b"IHDR", chunks[b"IHDR"][0])
    if chunks[b"tRNS"] and len(chunks[b"tRNS"][0]) == pixel_bytes and colour_type in (0, 2):
        body += _encode_chunk(b"tRNS", chunks[b"tRNS"][0])
    return (
        data[:8]
        + body
        + b"".join(_encode_chunk(b"IDAT", part) for part in chunks[b"IDAT"])
        + _encode_chunk(b"IEND", b"")
    )


def _encode_chunk(kind: bytes, data: bytes) -> bytes:
    """Return a chunk with its size and checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
