"""Texels: every format and depth as stored, and images in memory."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage, read_texels, write_image

RNG = np.random.default_rng(11)


def encoded(array: np.ndarray, kind: str, mode: str | None = None, **options: object) -> EncodedImage:
    file = BytesIO()
    image = Image.fromarray(array) if mode is None else Image.fromarray(array).convert(mode)
    image.save(file, {"jpg": "JPEG"}.get(kind, kind.upper()), **options)
    return EncodedImage(f"a.{kind}", file.getvalue(), kind)


def bytes_of(*shape: int) -> np.ndarray:
    return RNG.integers(0, 256, shape, dtype=np.uint8)


@pytest.mark.parametrize(
    ("kind", "channels"), [*((kind, n) for kind in ("png", "tga") for n in (1, 2, 3, 4)), ("bmp", 1), ("bmp", 3)]
)
def test_eight_bits(kind: str, channels: int) -> None:
    array = bytes_of(5, 7, channels)
    image = read_texels(encoded(array[..., 0] if channels == 1 else array, kind))
    assert image.eight_bit and image.values.dtype == np.float32 and image.values.flags.c_contiguous
    np.testing.assert_array_equal(image.values, array.astype(np.float32) / np.float32(255))


def png(width: int, height: int, depth: int, colour: int, rows: bytes, extra: bytes = b"") -> EncodedImage:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    palette = chunk(b"PLTE", extra) if extra else b""
    data = b"\x89PNG\r\n\x1a\n" + head + palette + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return EncodedImage("a.png", data, "png")


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_png_of_few_bits(depth: int) -> None:
    per_row = 8 // depth
    rows = b"\0\x1b\0\xe4"
    image = read_texels(png(per_row, 2, depth, 0, rows))
    levels = [[row >> shift & (1 << depth) - 1 for shift in range(8 - depth, -1, -depth)] for row in (0x1B, 0xE4)]
    np.testing.assert_allclose(image.values[..., 0], np.array(levels) / ((1 << depth) - 1), atol=1e-6)
    assert image.eight_bit


@pytest.mark.parametrize(("colour", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_png_of_sixteen_bits(colour: int, channels: int) -> None:
    array = RNG.integers(0, 65536, (3, 5, channels)).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in array)
    image = read_texels(png(5, 3, 16, colour, rows))
    assert not image.eight_bit
    np.testing.assert_array_equal(image.values, array.astype(np.float32) / np.float32(65535))


def test_a_damaged_png_of_sixteen_bits_is_one_line_and_silent(capfd: pytest.CaptureFixture[str]) -> None:
    """libpng would write to the process's standard error."""
    rows = b"".join(b"\0" + bytes(30) for _ in range(3))
    whole = png(5, 3, 16, 2, rows).data
    stray = whole.replace(b"IDAT", b"IDAX", 1)
    cases = {
        "truncated": whole[:-20],
        "checksum of a chunk IDAT": whole[:50] + b"\xff" + whole[51:],
        "unknown filter": png(5, 3, 16, 2, b"\x07" + rows[1:]).data,
        "93 bytes of pixels declared, got 31": png(5, 3, 16, 2, rows[:31]).data,
        "93 bytes of pixels declared, got 0": stray,
    }
    for problem, data in cases.items():
        with pytest.raises(AssetError, match=f"a.png: cannot be read .*{problem}"):
            read_texels(EncodedImage("a.png", data, "png"))
    assert capfd.readouterr() == ("", "")


def test_interlaced_png_of_sixteen_bits(tmp_path: Path) -> None:
    """Adam7: the passes of a picture of one colour hold as many pixels as the picture."""
    width, height = 5, 3
    passes = [(1, 1), (1, 1), (0, 0), (1, 1), (3, 1), (2, 2), (5, 1)]  # columns, rows
    value = struct.pack(">3H", 1000, 2000, 3000)
    rows = b"".join(b"\0" + columns * value for columns, count in passes for _ in range(count))
    data = png(width, height, 16, 2, rows).data
    head = data[16:28] + b"\1"
    data = data[:16] + head + struct.pack(">I", zlib.crc32(b"IHDR" + head)) + data[33:]
    image = read_texels(EncodedImage("a.png", data, "png"))
    np.testing.assert_allclose(image.values * 65535, np.broadcast_to([1000, 2000, 3000], (3, 5, 3)), rtol=1e-6)


def test_png_with_palette(tmp_path: Path) -> None:
    image = read_texels(png(2, 1, 8, 3, b"\0\0\1", bytes([255, 0, 51, 0, 102, 255])))
    np.testing.assert_allclose(image.values, [[[1, 0, 0.2], [0, 0.4, 1]]], atol=1e-6)
    picture = Image.fromarray(np.array([[0, 1]], np.uint8), "P")
    picture.putpalette([255, 0, 51, 0, 102, 255])
    picture.save(tmp_path / "a.png", transparency=bytes([51, 255]))
    image = read_texels(tmp_path / "a.png")
    np.testing.assert_allclose(image.values, [[[1, 0, 0.2, 0.2], [0, 0.4, 1, 1]]], atol=1e-6)


def test_jpeg_grey_colour_and_cmyk() -> None:
    array = np.full((16, 16, 3), (200, 100, 50), np.uint8)
    np.testing.assert_allclose(read_texels(encoded(array, "jpg", quality=95)).values, array / 255, atol=0.02)
    assert read_texels(encoded(array[..., 0], "jpg")).values.shape == (16, 16, 1)
    with pytest.raises(AssetError, match="a.jpg: colours stored as CMYK are not read"):
        read_texels(encoded(array, "jpg", "CMYK"))


@pytest.mark.parametrize("stored", ["half", "float"])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_half_and_float(tmp_path: Path, stored: str, channels: int) -> None:
    import OpenImageIO as oiio

    array = RNG.random((4, 6, channels), dtype=np.float32).astype(np.float16).astype(np.float32) * 64
    file = str(tmp_path / "a.exr")
    out = oiio.ImageOutput.create(file)
    assert out is not None
    out.open(file, oiio.ImageSpec(6, 4, channels, stored))
    out.write_image(array)
    out.close()
    image = read_texels(file)
    assert not image.eight_bit
    np.testing.assert_array_equal(image.values, array)
    memory = read_texels(EncodedImage("inside", Path(file).read_bytes()))
    np.testing.assert_array_equal(memory.values, array)


def test_the_bytes_say_what_a_file_is(tmp_path: Path) -> None:
    array = bytes_of(3, 4, 3)
    (tmp_path / "a.jpg").write_bytes(encoded(array, "png").data)
    np.testing.assert_allclose(read_texels(tmp_path / "a.jpg").values, array / 255, atol=1e-6)
    (tmp_path / "b.exr").write_bytes(encoded(array, "png").data)
    np.testing.assert_allclose(read_texels(tmp_path / "b.exr").values, array / 255, atol=1e-6)


def test_the_cap_is_the_callers(tmp_path: Path) -> None:
    image = encoded(bytes_of(10, 10, 3), "png")
    with pytest.raises(AssetError, match="a.png: 10 x 10 pixels, 3 channels: more than 99 pixels are not read"):
        read_texels(image, max_pixels=99)
    assert read_texels(image, max_pixels=100).values.shape == (10, 10, 3)


def test_declared_sizes_cost_no_memory(tmp_path: Path) -> None:
    def refused(image: EncodedImage) -> None:
        with pytest.raises(AssetError) as caught:
            read_texels(image)
        assert "\n" not in str(caught.value) and str(caught.value).startswith(f"{image.label}: ")

    hdr = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8000 +X 8000\n" + b"\0" * 64
    tracemalloc.start()
    refused(png(8000, 8000, 8, 6, b"\0"))
    refused(png(8000, 8000, 16, 6, b"\0"))
    refused(png(60000, 60000, 8, 6, b"\0"))
    refused(EncodedImage("a.hdr", hdr, "hdr"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 * 2**20


def test_unknown_and_not_finite(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="inside: unknown kind of image 'webp'"):
        read_texels(EncodedImage("inside", b"RIFF", "webp"))
    write_image(tmp_path / "a.exr", torch.tensor([0.0, float("nan"), 1.0]).expand(2, 2, 3))
    with pytest.raises(AssetError, match="not finite"):
        read_texels(tmp_path / "a.exr")
