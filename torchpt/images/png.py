"""PNG files made safe for libpng, which tells its complaints to the standard error stream of the process."""

from __future__ import annotations

import struct
import zlib

import numpy as np

__all__ = ["sanitize_png"]

_CHANNELS = {0: 1, 2: 3, 4: 2, 6: 4}
# first column and row of a pass, and steps between them (PNG specification, 8.2: Adam7)
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def sanitize_png(data: bytes) -> bytes:
    """A PNG of 16 bits a value with nothing but its header, transparent colour and pixels, all of which are sound.

    Args:
        data: the file; its declared size has been accepted.

    Raises:
        ValueError: what is wrong with it.
    """
    width, height, depth, color, compression, filtering, interlace = struct.unpack(">IIBBBBB", data[16:29])
    if depth != 16 or color not in _CHANNELS or compression or filtering or interlace > 1:
        raise ValueError("the PNG header is malformed")
    pixel = 2 * _CHANNELS[color]
    parts: dict[bytes, list[bytes]] = {b"IHDR": [], b"tRNS": [], b"IDAT": []}
    at = 8
    while True:
        if at + 12 > len(data):
            raise ValueError("truncated")
        size, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        if kind == b"IEND":
            break
        if at + 12 + size > len(data):
            raise ValueError("truncated")
        if kind in parts:
            if zlib.crc32(data[at + 4 : at + 8 + size]) != int.from_bytes(data[at + 8 + size : at + 12 + size], "big"):
                raise ValueError(f"the checksum of a chunk {kind.decode()} is wrong")
            parts[kind].append(data[at + 8 : at + 8 + size])
        at += 12 + size
    if len(parts[b"IHDR"]) != 1 or len(parts[b"IHDR"][0]) != 13:
        raise ValueError("the PNG header is malformed")
    passes = _PASSES if interlace else ((0, 0, 1, 1),)
    sizes = [(-(-(width - x) // dx), -(-(height - y) // dy)) for x, y, dx, dy in passes]
    sizes = [(columns, rows) for columns, rows in sizes if columns > 0 and rows > 0]
    expected = sum(rows * (1 + columns * pixel) for columns, rows in sizes)
    stream = zlib.decompressobj()
    rows_of_all = stream.decompress(b"".join(parts[b"IDAT"]), expected + 1)
    if len(rows_of_all) != expected or not stream.eof:
        raise ValueError(f"truncated: {expected} bytes of pixels declared, got {len(rows_of_all)}")
    at = 0
    for columns, rows in sizes:
        line = 1 + columns * pixel
        if np.frombuffer(rows_of_all, np.uint8, rows * line, at)[::line].max() > 4:
            raise ValueError("a row has an unknown filter")
        at += rows * line
    body = _chunk(b"IHDR", parts[b"IHDR"][0])
    if parts[b"tRNS"] and len(parts[b"tRNS"][0]) == pixel and color in (0, 2):
        body += _chunk(b"tRNS", parts[b"tRNS"][0])
    return data[:8] + body + b"".join(_chunk(b"IDAT", part) for part in parts[b"IDAT"]) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
