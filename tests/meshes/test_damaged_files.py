"""Damaged files: whatever the bytes, one line that names the file; no crash, no hang, no memory for what is not there.

Every kind of file is built here, then damaged from a seed: bytes changed, cut, repeated and zeroed, numbers of text and
JSON replaced by hostile ones. The long form makes more of each.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from damage import damaged, damaged_json
from small_files import (
    FACET,
    MTL,
    OBJ,
    STL,
    float_picture,
    glb,
    gltf_document,
    picture_bytes,
    ply_bytes,
    serialized_square,
    sixteen_bits,
)  # fmt: skip

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage, read_texels
from torchpt.scene.meshes import load_mesh

SECONDS = 5.0


def check_mesh(file: Path) -> None:
    """It loads, with finite numbers, or says what is wrong in one line that names a file; pictures inside it as well."""
    start = time.monotonic()
    try:
        parts = load_mesh(file)
    except AssetError as error:
        assert str(error).isprintable() and str(error).startswith(str(file.parent)), error
        parts = []
    for part in parts:
        assert np.isfinite(part.vertices).all() and part.faces.min() >= 0 and part.faces.max() < len(part.vertices)
        assert part.normals is None or np.isfinite(part.normals).all()
        assert part.uvs is None or np.isfinite(part.uvs).all()
        assert part.colors is None or np.isfinite(part.colors).all()
        for light in part.lights:
            assert np.isfinite([light.position, light.direction]).all() and light.direction.any()
            assert all(np.isfinite(value).all() and np.min(value) >= 0 for value in light.numbers.values())
        assert all(np.isfinite(camera.matrix).all() for camera in part.cameras)
        if part.material is not None:
            for entry in part.material.material.values():
                if isinstance(entry, dict) and isinstance(entry.get("path"), EncodedImage):
                    check_image(entry["path"])
    assert time.monotonic() - start < SECONDS


def check_image(image: EncodedImage) -> None:
    start = time.monotonic()
    try:
        texels = read_texels(image)
    except AssetError as error:
        assert str(error).isprintable() and str(error).startswith(f"{image.label}: "), error
    else:
        assert np.isfinite(texels.values).all() and texels.values.ndim == 3
    assert time.monotonic() - start < SECONDS


def mesh_corpus(ending: str, rng: np.random.Generator) -> Iterator[dict[str, bytes]]:
    """Sets of files: name to bytes; the first name is loaded."""
    document, body = gltf_document()
    beside = {"a.png": picture_bytes("PNG", "RGBA"), "a.bin": body}
    whole: dict[str, list[bytes]] = {
        "obj": [OBJ.encode()],
        "ply": [ply_bytes(layout) for layout in ("ascii", "binary_little_endian", "binary_big_endian")],
        "stl": [STL, f"solid a\n{FACET}endsolid a\n".encode()],
        "serialized": [serialized_square(3), serialized_square(4, double=True)],
        "glb": [glb(document, body)],
        "gltf": [json.dumps({**document, "buffers": [{"byteLength": len(body), "uri": "a.bin"}]}).encode()],
    }
    while True:
        if ending == "mtl":
            yield {"a.obj": OBJ.encode(), "a.mtl": damaged(MTL.encode(), rng), **beside}
        elif ending == "json":
            yield {"a.glb": glb(damaged_json(document, rng), body)}
        else:
            chosen = whole[ending][rng.integers(0, len(whole[ending]))]
            yield {f"a.{ending}": damaged(chosen, rng), "a.mtl": MTL.encode(), **beside}


ENDINGS = ["obj", "mtl", "ply", "stl", "serialized", "glb", "gltf", "json"]


def run_meshes(folder: Path, ending: str, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    corpus = mesh_corpus(ending, rng)
    written: dict[str, bytes] = {}
    for _ in range(count):
        files = next(corpus)
        for name, data in files.items():
            if written.get(name) != data:
                (folder / name).write_bytes(data)
        written = files
        check_mesh(folder / next(iter(files)))


IMAGES: dict[str, Callable[[Path], tuple[bytes, str]]] = {
    "png": lambda folder: (picture_bytes("PNG", "RGBA"), "png"),
    "png16": lambda folder: (sixteen_bits(folder), "png"),
    "jpg": lambda folder: (picture_bytes("JPEG", "RGB"), "jpg"),
    "tga": lambda folder: (picture_bytes("TGA", "RGBA"), "tga"),
    "tga rle": lambda folder: (picture_bytes("TGA", "RGB"), "tga"),
    "bmp": lambda folder: (picture_bytes("BMP", "RGB"), "bmp"),
    "hdr": lambda folder: (float_picture(folder, "hdr", "rle"), "hdr"),
    "exr zip": lambda folder: (float_picture(folder, "exr", "zip"), "exr"),
    "exr piz": lambda folder: (float_picture(folder, "exr", "piz"), "exr"),
    "exr none": lambda folder: (float_picture(folder, "exr", "none"), "exr"),
}


def run_images(folder: Path, name: str, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    whole, kind = IMAGES[name](folder)
    for _ in range(count):
        check_image(EncodedImage("a picture", damaged(whole, rng), kind))


@pytest.mark.parametrize("ending", ENDINGS)
def test_damaged_meshes(tmp_path: Path, ending: str) -> None:
    run_meshes(tmp_path, ending, 1, 50)


@pytest.mark.parametrize("name", IMAGES)
def test_damaged_images(tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    run_images(tmp_path, name, 2, 50)
    assert capfd.readouterr() == ("", "")  # decoders are silent


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 14))
@pytest.mark.parametrize("ending", ENDINGS)
def test_many_damaged_meshes(tmp_path: Path, ending: str, seed: int) -> None:
    run_meshes(tmp_path, ending, seed, 1500)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10, 14))
@pytest.mark.parametrize("name", IMAGES)
def test_many_damaged_images(tmp_path: Path, name: str, seed: int, capfd: pytest.CaptureFixture[str]) -> None:
    run_images(tmp_path, name, seed, 400)
    assert capfd.readouterr() == ("", "")


def _folded(content: bytes) -> bytes:
    """Return a serialized file of one mesh."""
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(content) + struct.pack("<QI", 0, 1)


def declared(folder: Path) -> list[Path]:
    """Files that declare far more than they hold."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    many = 1_900_000_000
    vertex = "element vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
    head = "ply\nformat {} 1.0\n" + vertex + "property list int int vertex_indices\nend_header\n"
    accessor = {"componentType": 5126, "type": "VEC3", "count": many}
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    base = {"nodes": [{"mesh": 0}], "meshes": meshes, "bufferViews": [{"buffer": 0, "byteLength": 4 * many}]}
    rows = {"indices": {"bufferView": 0, "componentType": 5125}, "values": {"bufferView": 0}}
    index = np.zeros(1_000_000, "<u1").tobytes()  # one face, again and again, in nodes again and again
    often = {
        "nodes": [{"mesh": 0}] * 2000,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
            {"bufferView": 1, "componentType": 5121, "type": "SCALAR", "count": len(index)},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteLength": len(index)}],
        "buffers": [{"byteLength": len(index)}],
    }
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 8000, 8000, 8, 6, 0, 0, 0))
    files: dict[str, bytes] = {
        "a.ply": head.format("ascii", many, 1).encode(),
        "b.ply": head.format("binary_little_endian", many, 1).encode(),
        "c.ply": head.format("binary_little_endian", 1, 1).encode() + bytes(12) + struct.pack("<i", many),
        "d.ply": head.format("ascii", 1, 1).encode() + b"0 0 0\n" + str(many).encode() + b" 0 0 0",
        "a.serialized": _folded(struct.pack("<IxQQ", 0x1000, many, 2 * many)),
        "b.serialized": _folded(struct.pack("<IxQQ", 0x1000, 2**24, 2**24) + bytes(1000)),
        "c.serialized": _folded(struct.pack("<I", 0x1000) + b"a" * 2**24),
        "a.stl": bytes(80) + struct.pack("<I", many),
        "a.glb": b"glTF" + struct.pack("<III4s", 2, 4 * 10**9, 4 * 10**9, b"JSON"),
        "b.glb": glb(
            {**base, "accessors": [{**accessor, "bufferView": 0}], "buffers": [{"byteLength": 4 * many}]}, b""
        ),
        "c.glb": glb({**base, "accessors": [{**accessor, "sparse": {"count": many, **rows}}], "buffers": [{}]}, b""),
        "d.glb": glb(often, index),
        "a.png": png + chunk(b"IDAT", zlib.compress(b"\0")),
        "b.png": png[:24] + b"\x10" + png[25:],
        "a.tga": struct.pack("<BBBHHBHHHHBB", 0, 0, 10, 0, 0, 0, 0, 0, 8000, 8000, 32, 0),
        "a.bmp": b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, 8000, 8000, 1, 24, 0, 0, 0, 0, 0, 0),
        "a.hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8000 +X 8000\n" + bytes(64),
    }
    exr = bytearray(float_picture(folder, "exr", "zip"))
    for name in (b"dataWindow", b"displayWindow"):
        at = exr.index(name + b"\0box2i\0") + len(name) + 7 + 4
        exr[at : at + 16] = struct.pack("<4i", 0, 0, 7999, 7999)
    files["a.exr"] = bytes(exr)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return [folder / name for name in files]


SCRIPT = """
import resource, sys
from pathlib import Path
import OpenImageIO, PIL.Image, PIL.TgaImagePlugin, torch  # what is imported is no part of the measurement
from torchpt.core.errors import AssetError
from torchpt.images import read_texels
from torchpt.scene.meshes import FORMATS, load_mesh
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[1:]:
    try:
        (load_mesh if Path(name).suffix in FORMATS else read_texels)(Path(name))
    except AssetError as error:
        assert str(error).startswith(name) and "\\n" not in str(error), error
    else:
        raise SystemExit(f"{name} was read")
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 64 * 1024, f"{name}: {grown} KiB more"
"""


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory in KiB is Linux's")
@pytest.mark.slow
def test_declared_sizes_cost_no_memory(tmp_path: Path) -> None:
    files = [str(file) for file in declared(tmp_path) if not file.name.startswith("whole")]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *files], env=os.environ, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.slow
def test_long_lines_and_deep_nesting(tmp_path: Path) -> None:
    """Inputs on which a naive reader takes quadratic time or overflows its stack."""
    files = {
        "a.gltf": b"[" * 200_000,
        "b.gltf": b'{"a":' * 200_000,
        "a.obj": b"v 0 0 0\n" + b"f" + b" 1" * 500_000 + b"\n",
        "b.obj": b"# what goes on\\\n" * 200_000,
        "c.obj": (OBJ + "f " + "1/" * 200_000).encode(),
        "a.ply": b"ply\nformat ascii 1.0\n" + b"comment x\n" * 100_000,
        "a.stl": b"solid " + b"vertex " * 500_000,
    }
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd " + "-s 1 " * 100_000)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_mesh(tmp_path / name)
