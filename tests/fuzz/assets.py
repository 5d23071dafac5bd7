"""Damaged files of every format that torchpt reads, from a seed; each is read, and rendered if it can be."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from damage import WORDS, damaged, damaged_json
from PIL import Image
from small_files import (
    DAE,
    FACET,
    MTL,
    OBJ,
    STL,
    XAML,
    float_picture,
    glb,
    gltf_document,
    picture_bytes,
    ply_bytes,
    serialized_square,
    sixteen_bits,
    zipped,
)

#: A file to damage: what it holds, what stands beside it, and what is loaded where that is another.
Sound = tuple[str, bytes]


@cache
def sound(folder: Path) -> dict[str, Sound]:
    """A name and the bytes of a file, by what it is."""
    document, body = gltf_document()
    png = picture_bytes("PNG", "RGB")
    trimesh: Any = import_module("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=0)
    off = ball.export(file_type="off")
    files: dict[str, Sound] = {
        "obj": ("a.obj", OBJ.encode()),
        "mtl": ("a.mtl", MTL.encode()),
        **{
            f"ply {layout}": ("a.ply", ply_bytes(layout))
            for layout in ("ascii", "binary_little_endian", "binary_big_endian")
        },
        "stl": ("a.stl", STL),
        "serialized": ("a.serialized", serialized_square()),
        "stl ascii": ("a.stl", f"solid a\n{FACET}endsolid a\n".encode()),
        "glb": ("a.glb", glb(document, body)),
        "gltf": ("a.gltf", json.dumps({**document, "buffers": [{"byteLength": len(body), "uri": "a.bin"}]}).encode()),
        "bin": ("a.bin", body),
        "off": ("a.off", off.encode() if isinstance(off, str) else off),
        "3mf": ("a.3mf", trimesh.Scene(ball).export(file_type="3mf")),
        "dae": ("a.dae", DAE.encode()),
        "zae": ("a.zae", zipped(a_dae=DAE.encode(), wood_png=png)),
        "xaml": ("a.xaml", XAML.encode()),
        "3dxml": ("a.3dxml", zipped(Manifest_xml=b"<Manifest><Root>a.xml</Root></Manifest>", a_xml=b"<Model_3dxml/>")),
        **{f"png {mode}": ("a.png", picture_bytes("PNG", mode)) for mode in ("L", "LA", "RGB")},
        "png palette": ("a.png", _palette()),
        "png 16": ("a.png", sixteen_bits(folder)),
        "png RGBA": ("a.png", picture_bytes("PNG", "RGBA")),  # the last one stays there for others
        "jpg": ("a.jpg", picture_bytes("JPEG", "RGB")),
        "tga": ("a.tga", picture_bytes("TGA", "RGBA")),
        "tga rle": ("a.tga", picture_bytes("TGA", "RGB")),
        "bmp": ("a.bmp", picture_bytes("BMP", "RGB")),
        "ppm": ("a.ppm", picture_bytes("PPM", "RGB")),
        "pgm": ("a.pgm", b"P2\n4 3\n255\n" + b"0 1 2 3\n" * 3),
        "hdr": ("a.hdr", float_picture(folder, "hdr", "rle")),
        **{f"exr {kind}": ("a.exr", float_picture(folder, "exr", kind)) for kind in EXR},
        "npz": ("a.ckpt", _checkpoint(folder)),
    }
    return files


EXR = ("none", "rle", "zip", "zips", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab")


def _palette() -> bytes:
    rows = np.random.default_rng(5).integers(0, 9, (23, 17), dtype=np.uint8)
    picture = Image.fromarray(rows, "P")
    picture.putpalette(list(range(27)))
    file = io.BytesIO()
    picture.save(file, "PNG", transparency=3, bits=4)
    return file.getvalue()


BALL: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
    "film": {"width": 4, "height": 4},
    "lights": {"s": {"type": "constant", "radiance": 1}},
    "shapes": {"b": {"type": "sphere"}},
}


def _checkpoint(folder: Path) -> bytes:
    """The state of a render."""
    import torchpt

    file = folder / "whole.ckpt"
    file.unlink(missing_ok=True)
    torchpt.render(torchpt.load(BALL), spp=2, checkpoint=str(file), compile="off", threads=1)
    return file.read_bytes()


def write_sound(folder: Path) -> None:
    """All files, sound."""
    for name, data in {name: data for name, data in sound(folder).values()}.items():
        (folder / name).write_bytes(data)
    (folder / "wood.png").write_bytes(picture_bytes("PNG", "RGB"))
    (folder / "b.png").write_bytes(picture_bytes("PNG", "RGBA"))


def damaged_asset(seed: int, folder: Path) -> str:
    """Damage one file, read it, and put it right again."""
    rng = np.random.default_rng([seed, 21])
    files = sound(folder)
    kind = list(files)[rng.integers(len(files))]
    name, data = files[kind]
    hurt = data
    for _ in range(int(rng.choice([1, 1, 1, 2, 4]))):
        hurt = _hurt(kind, hurt, rng)
    (folder / name).write_bytes(hurt)
    try:
        return USES.get(kind.split()[0], _as_picture)(folder / name, rng)
    finally:
        (folder / name).write_bytes({name: data for name, data in files.values()}[name])


def _hurt(kind: str, data: bytes, rng: np.random.Generator) -> bytes:
    """Damage that fits the format, or any."""
    if not data or rng.random() < 0.4:
        return damaged(data, rng) if data else b"x"
    if kind in ("glb", "gltf"):
        document, body = gltf_document()
        try:
            document = json.loads(data) if kind == "gltf" else document
        except ValueError:
            return damaged(data, rng)
        changed = damaged_json(document, rng)
        return json.dumps(changed).encode() if kind == "gltf" else glb(changed, body)
    if kind in ("3mf", "zae", "3dxml", "npz"):
        return _hurt_archive(data, rng)
    if kind in ("obj", "mtl", "dae", "xaml", "off", "stl ascii", "ply ascii", "pgm"):
        return hurt_text(data, rng)
    head = data[:200]  # where the counts are
    return damaged(head, rng) + data[200:]


def hurt_text(data: bytes, rng: np.random.Generator) -> bytes:
    """Numbers and words of text replaced, lines repeated, moved and left out."""
    kind = rng.integers(4)
    if kind == 0:
        lines = data.split(b"\n")
        at = rng.integers(len(lines))
        lines.insert(int(rng.integers(len(lines))), lines[at])
        return b"\n".join(lines[:at] + lines[at + 1 :]) if rng.random() < 0.3 else b"\n".join(lines)
    words = data.split(b" ")
    for _ in range(int(rng.choice([1, 1, 3]))):
        at = rng.integers(len(words))
        words[at] = str(rng.choice([*WORDS, "1e-45", "3e38", "-2147483649", "1_0", "١", "0x10", "1e5000"])).encode()
    return b" ".join(words)


def _hurt_archive(data: bytes, rng: np.random.Generator) -> bytes:
    """One member of an archive damaged, under a sound table of contents."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {info.filename: archive.read(info) for info in archive.infolist()}
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, NotImplementedError, EOFError):
        return damaged(data, rng)
    except Exception:  # zlib's own, of a member that was damaged before
        return damaged(data, rng)
    if not members:
        return damaged(data, rng)
    chosen = list(members)[rng.integers(len(members))]
    if rng.random() < 0.1:
        members[f"../{chosen}"] = members.pop(chosen)
    elif members[chosen]:
        members[chosen] = hurt_text(members[chosen], rng) if rng.random() < 0.5 else damaged(members[chosen], rng)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return file.getvalue()


def _as_mesh(file: Path, rng: np.random.Generator) -> str:
    """A mesh in a scene, plain or with a texture, a displacement, a copy."""
    from tries import load_and_render

    ending = file.suffix if file.suffix not in (".mtl", ".bin") else {".mtl": ".obj", ".bin": ".gltf"}[file.suffix]
    shape: dict[str, Any] = {"type": "mesh", "path": str(file.with_suffix(ending))}
    shapes: dict[str, Any] = {"m": shape}
    how = rng.integers(5)
    if how == 1:
        shape["displacement"] = {
            "texture": {"type": "image", "path": str(file.parent / "b.png")},
            "scale": 0.1,
            "subdivisions": 1,
        }
    elif how == 2:
        shapes["copy"] = {"type": "instance", "of": "m", "transform": [{"translate": [0, 1, 0]}]}
    elif how == 3:
        shape["material"] = {"type": "diffuse", "reflectance": {"type": "image", "path": str(file.parent / "b.png")}}
    return load_and_render({**BALL, "shapes": shapes}, int(rng.integers(200)))


def _as_picture(file: Path, rng: np.random.Generator) -> str:
    """A picture by itself, as a texture, as a map, as the sky."""
    from tries import load_and_render

    from torchpt.images import has_alpha, read_header, read_image, read_layers

    how = rng.integers(6)
    has_alpha(file)
    if how == 0:
        return f"read {tuple(read_image(file).shape)}"
    if how == 1:
        return f"read {len(read_layers(file))} layers"
    if how == 2:
        return f"read {len(read_header(file))} facts"
    image = {"type": "image", "path": str(file)}
    if how == 3:
        return load_and_render({**BALL, "lights": {"e": {"type": "envmap", "path": str(file)}}}, int(rng.integers(200)))
    material = (
        {"type": "diffuse", "reflectance": image}
        if how == 4
        else {"type": "diffuse", "normal_map": image, "opacity": image}
    )
    return load_and_render(
        {**BALL, "shapes": {"b": {"type": "rectangle", "material": material}}}, int(rng.integers(200))
    )


def _as_checkpoint(file: Path, rng: np.random.Generator) -> str:
    """A state to go on from."""
    del rng
    import torchpt

    torchpt.render(torchpt.load(BALL), spp=2, checkpoint=str(file), resume=True, compile="off", threads=1)
    return "gone on"


USES: dict[str, Callable[[Path, np.random.Generator], str]] = {
    **dict.fromkeys(
        ("obj", "mtl", "ply", "stl", "serialized", "glb", "gltf", "bin", "off", "3mf", "dae", "zae", "xaml", "3dxml"),
        _as_mesh,
    ),
    "npz": _as_checkpoint,
}
