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
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from torchpt.errors import AssetError
from torchpt.images import EncodedImage, read_texels
from torchpt.meshes import load_mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
SECONDS = 5.0
WORDS = [
    "nan",
    "-1",
    "0",
    "1e39",
    "-1e400",
    "99999999999999",
    "4294967295",
    "x",
    "",
    "1/2/3/4",
    "//",
    "\\",
    "\0",
    "#",
    "inf",
]
VALUES: list[Any] = [
    None, True, -1, 0, 3, 2**31, 2**53, 10**30, 1e308, -0.5, float("nan"), "x", "", "data:,", "data:;base64,%", [], {}, [[]],
    [0] * 17, {"index": 0}, {"count": 10**12},
]  # fmt: skip


def picture_bytes(kind: str, mode: str) -> bytes:
    rows = np.random.default_rng(5).integers(0, 256, (23, 17, len(mode)), dtype=np.uint8)
    file = BytesIO()
    options: dict[str, Any] = {"compression": "tga_rle"} if kind == "TGA" and mode == "RGB" else {}
    Image.fromarray(rows[..., 0] if len(mode) == 1 else rows, mode).save(file, kind, **options)
    return file.getvalue()


def float_picture(folder: Path, ending: str, compression: str) -> bytes:
    import OpenImageIO as oiio

    file = str(folder / f"whole.{ending}")
    out = oiio.ImageOutput.create(file)
    assert out is not None
    spec = oiio.ImageSpec(33, 40, 3, "half")
    spec.attribute("compression", compression)
    out.open(file, spec)
    out.write_image(np.random.default_rng(6).random((40, 33, 3), dtype=np.float32))
    out.close()
    return Path(file).read_bytes()


def ply_bytes(layout: str) -> bytes:
    names = ("x", "y", "z", "nx", "ny", "nz", "s", "t")
    header = f"ply\nformat {layout} 1.0\ncomment a\nelement tag 1\nproperty list uchar float w\nelement vertex 4\n"
    header += "".join(f"property float {name}\n" for name in names) + "property uchar red\nproperty uchar green\n"
    header += "property uchar blue\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    if layout == "ascii":
        rows = "".join(f"{x} {y} {z} 0 0 1 {x} {y} 1 2 3\n" for x, y, z in SQUARE)
        return (header + "2 0.5 0.5\n" + rows + "3 0 1 2\n4 0 1 2 3\n").encode()
    order = "<" if "little" in layout else ">"
    body = struct.pack(f"{order}B2f", 2, 0.5, 0.5)
    body += b"".join(struct.pack(f"{order}8f3B", x, y, z, 0, 0, 1, x, y, 1, 2, 3) for x, y, z in SQUARE)
    return header.encode() + body + struct.pack(f"{order}B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)


def gltf_document() -> tuple[dict[str, Any], bytes]:
    image = picture_bytes("PNG", "RGB")
    body = (
        SQUARE.astype("<f4").tobytes()
        + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
        + SQUARE[:, :2].astype("<f4").tobytes()
    )
    body += image + b"\0" * (-len(image) % 4)
    sizes = [48, 12, 32, len(image)]
    views = [{"buffer": 0, "byteOffset": sum(sizes[:i]), "byteLength": size} for i, size in enumerate(sizes)]
    accessors: list[dict[str, Any]] = [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
        {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        {"bufferView": 2, "componentType": 5126, "type": "VEC2", "count": 4},
    ]
    rows = {"indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
    accessors.append({**accessors[0], "sparse": {"count": 1, **rows}})
    texture = {"index": 0, "texCoord": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "rotation": 1}}}
    material = {
        "name": "m",
        "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "baseColorTexture": texture, "metallicFactor": 0},
        "normalTexture": {"index": 0, "scale": 1},
        "emissiveFactor": [0, 0, 1],
        "alphaMode": "MASK",
        "extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1}, "KHR_materials_ior": {"ior": 1.4}},
    }
    cone = {"innerConeAngle": 0.5, "outerConeAngle": 1}
    lamp = {"name": "l", "type": "spot", "color": [1, 1, 1], "intensity": 1, "range": 9, "spot": cone}
    attributes = {"POSITION": 3, "TEXCOORD_0": 2, "NORMAL": 0}
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1, 2], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
            {"mesh": 0, "translation": [1, 2, 3]},
            {"translation": [0, 5, 0], "camera": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}},
        ],
        "extensions": {"KHR_lights_punctual": {"lights": [lamp]}},
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}],
        "meshes": [{"name": "m", "primitives": [{"attributes": attributes, "indices": 1, "material": 0, "mode": 4}]}],
        "materials": [material],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "samplers": [{"wrapS": 10497, "wrapT": 10497, "magFilter": 9729}],
        "textures": [{"source": 0, "sampler": 0}],
        "extensionsUsed": ["KHR_materials_ior"],
    }
    return document, body


def glb(document: Any, body: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


OBJ = (
    "mtllib a.mtl\no thing\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE)
    + "vt 0 0\nvt 1 0.5\nvn 0 0 1\nusemtl m\nf 1/1/1 2/2/1 3/1/1 4/2/1\nf -1//1 -2//1 -3//1\ns off\nl 1 2\n"
)  # fmt: skip
MTL = (
    "newmtl m\nKa 1 1 1\nKd 0.5 0.5 0.5\nKs 0.1 0.1 0.1\nNs 10\nNi 1.5\nd 1\nTr 0\nTf 1 1 1\nillum 2\nPr 0.5\nPm 0\n"
    "map_Kd -s 1 2 3 -o 1 1 -clamp on a.png\nbump -bm 0.5 a.png\nmap_d -imfchan m a.png\nnorm a.png\nKe 1 1 1\n"
)
STL = b"solid".ljust(80) + struct.pack("<I", 1) + struct.pack("<12fH", 0, 0, 1, *SQUARE[:3].ravel(), 0)
FACET = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """One kind of damage to bytes."""
    data, size = bytearray(whole), len(whole)
    kind = rng.integers(0, 6)
    if kind == 0:
        for at in rng.integers(0, size, rng.integers(1, 8)):
            data[at] = rng.integers(0, 256)
    elif kind == 1:
        del data[rng.integers(0, size) :]
    elif kind == 2:  # a count, or an offset
        at = int(rng.integers(0, size))
        data[at : at + 4] = struct.pack(rng.choice(["<I", ">I"]), int(rng.choice([0, 1, 2**16, 2**31 - 1, 2**32 - 1])))
    elif kind == 3:
        a, b = sorted(rng.integers(0, size, 2))
        data[a:b] = bytes(b - a)
    elif kind == 4:
        a, b = sorted(rng.integers(0, size, 2))
        data[a:a] = data[a:b]
    else:  # a word of text
        words = bytes(data).split(b" ")
        words[rng.integers(0, len(words))] = str(rng.choice(WORDS)).encode()
        data = bytearray(b" ".join(words))
    return bytes(data)


def damaged_json(document: Any, rng: np.random.Generator) -> Any:
    """A document with one value replaced, taken out or repeated."""
    document = json.loads(json.dumps(document))
    places: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key in list(node) if isinstance(node, dict) else range(len(node)):
            places.append((node, key))
            if isinstance(node[key], dict | list):
                walk(node[key])

    walk(document)
    node, key = places[rng.integers(0, len(places))]
    if rng.random() < 0.15:
        del node[key]
    else:
        node[key] = VALUES[rng.integers(0, len(VALUES))]
    return document


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


ENDINGS = ["obj", "mtl", "ply", "stl", "glb", "gltf", "json"]


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


def sixteen_bits(folder: Path) -> bytes:
    import OpenImageIO as oiio

    file = str(folder / "whole.png")
    out = oiio.ImageOutput.create(file)
    assert out is not None
    out.open(file, oiio.ImageSpec(9, 11, 3, "uint16"))
    out.write_image(np.random.default_rng(7).integers(0, 65536, (11, 9, 3)).astype(np.uint16))
    out.close()
    return Path(file).read_bytes()


def run_images(folder: Path, name: str, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    whole, kind = IMAGES[name](folder)
    for _ in range(count):
        check_image(EncodedImage("a picture", damaged(whole, rng), kind))


@pytest.mark.parametrize("ending", ENDINGS)
def test_damaged_meshes(tmp_path: Path, ending: str) -> None:
    run_meshes(tmp_path, ending, 1, 100)


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


def declared(folder: Path) -> list[Path]:
    """Files that declare far more than they hold."""
    import zlib

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
from torchpt.errors import AssetError
from torchpt.images import read_texels
from torchpt.meshes import FORMATS, load_mesh
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
def test_declared_sizes_cost_no_memory(tmp_path: Path) -> None:
    files = [str(file) for file in declared(tmp_path) if not file.name.startswith("whole")]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, *files], env=os.environ, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


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
