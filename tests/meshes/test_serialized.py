"""Mitsuba's serialized meshes: both versions and precisions beside Mitsuba's own reader, several in a file, damage."""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_files import SQUARE, serialized_bytes, serialized_square

import torchpt
from torchpt.core.errors import AssetError, SceneError
from torchpt.scene.meshes import load_mesh

VERSIONS = [(3, False), (3, True), (4, False), (4, True)]


def write(folder: Path, data: bytes) -> Path:
    file = folder / "a.serialized"
    file.write_bytes(data)
    return file


@pytest.mark.parametrize(("version", "double"), VERSIONS)
def test_all_attributes_are_read(tmp_path: Path, version: int, double: bool) -> None:
    whole, bare = load_mesh(write(tmp_path, serialized_square(version, double=double)))
    close = 0.0 if double else 1e-7
    assert whole.normals is not None and whole.uvs is not None and whole.colors is not None
    assert whole.name == ("größe" if version == 4 else "") and not whole.flat
    np.testing.assert_array_equal(whole.vertices, SQUARE)
    np.testing.assert_array_equal(whole.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(whole.normals, np.tile([0.0, 0.6, 0.8], (4, 1)), rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(whole.uvs, SQUARE[:, :2] * 0.5, rtol=0.0, atol=close)
    np.testing.assert_allclose(whole.colors, np.linspace(0.1, 1.2, 12).reshape(4, 3), rtol=0.0, atol=close)
    assert whole.material is not None and whole.material.material["reflectance"] == {"type": "vertex_color"}
    np.testing.assert_array_equal(bare.vertices[:, 2], 1.0)
    assert bare.flat and bare.normals is None and bare.uvs is None and bare.colors is None and bare.material is None


@pytest.mark.mitsuba
@pytest.mark.parametrize(("version", "double"), VERSIONS)
def test_mitsuba_reads_the_same(tmp_path: Path, version: int, double: bool) -> None:
    from mitsuba_scene import load_mitsuba

    mitsuba = load_mitsuba("scalar_rgb")
    file = write(tmp_path, serialized_square(version, double=double))
    for index in (0, 1):
        (part,) = load_mesh(file, index=index)
        peer = mitsuba.load_dict({"type": "serialized", "filename": str(file), "shape_index": index})
        values = mitsuba.traverse(peer)
        for name, rows in (("positions", part.vertices), ("normals", part.normals), ("texcoords", part.uvs)):
            if rows is not None:
                np.testing.assert_allclose(np.array(values[f"vertex_{name}"]), rows.ravel(), atol=1e-6)
        np.testing.assert_array_equal(np.array(values["faces"]), part.faces.ravel())


def scene(file: Path, **keys: Any) -> dict[str, Any]:
    return {
        "camera": {"origin": [0.5, 0.5, 4], "target": [0.5, 0.5, 0]},
        "film": {"width": 4, "height": 4},
        "lights": {"s": {"type": "constant", "radiance": 1}},
        "shapes": {"m": {"type": "mesh", "path": str(file), **keys}},
    }


def test_scene_files_take_one_mesh_or_all(tmp_path: Path) -> None:
    file = write(tmp_path, serialized_square())
    assert [
        torchpt.load(scene(file, **keys)).faces("shapes.m").shape[0]
        for keys in ({"shape_index": 0}, {"shape_index": 1})
    ] == [2, 1]
    parts = torchpt.load(scene(file)).built.parts
    assert [(part.faces.shape[0], part.smooth) for part in parts if part.faces is not None] == [
        (2, True),
        (1, False),
    ]  # the second asks for face normals
    image = torchpt.render(torchpt.load(scene(file, shape_index=0)), spp=4, compile="off")
    assert (image[..., 0] < image[..., 2]).any()  # the colours of the vertices


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"shape_index": 2}, "has 2 meshes, 0..1; shape_index 2 is asked for"),
        ({"shape_index": -1}, "shapes.m.shape_index: "),
        ({"shape_index": 1.5}, "shapes.m.shape_index: "),
        ({"shape_index": 0, "path": "a.ply"}, "shapes.m.shape_index: "),
        ({"shape_index": 0, "path": None, "vertices": [[0, 0, 0]] * 3, "faces": [[0, 1, 2]]}, "shapes.m.shape_index: "),
    ],
)
def test_wrong_indices_are_one_line(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    file = write(tmp_path, serialized_square())
    with pytest.raises((AssetError, SceneError)) as caught:
        torchpt.load(scene(file, **keys))
    assert words in str(caught.value) and "\n" not in str(caught.value)


def one(content: bytes, version: int = 4) -> bytes:
    """Return a file of one mesh with any content."""
    return struct.pack("<HH", 0x041C, version) + zlib.compress(content) + struct.pack("<QI", 0, 1)


WHOLE = serialized_square()
MALFORMED = {
    "empty": (b"", "mesh 0 does not start with 0x041C"),
    "other": (b"ply\n" + WHOLE, "mesh 0 does not start with 0x041C"),
    "version": (WHOLE[:2] + b"\5\0" + WHOLE[4:], "mesh 0 is of version 5; versions 3 and 4 are read"),
    "cut": (WHOLE[:-40], "truncated"),
    "no end": (WHOLE[:-4], "truncated"),
    "no mesh": (WHOLE[:-4] + bytes(4), "says 0 meshes"),
    "many": (WHOLE[:-4] + b"\xff\xff\xff\xff", "says 4294967295 meshes"),
    "offset": (WHOLE[:-12] + struct.pack("<QI", len(WHOLE), 2), "the offset of mesh 1 is"),
    "twice": (WHOLE[:-12] + struct.pack("<QQI", 0, 0, 2), "the offset of mesh 1 is 0"),
    "stream": (WHOLE[:6] + b"\xff\xff" + WHOLE[8:], "mesh 0 is malformed"),
    "short": (
        one(struct.pack("<IxQQ", 0x1000, 3, 1) + bytes(36)),
        "truncated: mesh 0 has 0 bytes where 12 are declared",
    ),
    "name": (one(struct.pack("<I", 0x1000) + b"a" * 5000), "a name of more than 4096 bytes"),
    "huge": (one(struct.pack("<IxQQ", 0x1000, 2**40, 2**63)), "unfolds to"),
    "bomb": (one(struct.pack("<IxQQ", 0x1000, 2**23, 0) + bytes(2**20)), "truncated: mesh 0 has 1048576 bytes"),
    "index": (one(struct.pack("<IxQQ9f3I", 0x1000, 3, 1, *range(9), 0, 1, 3)), "face 0 has an index outside 0..2"),
    "not finite": (one(struct.pack("<IxQQ9f3I", 0x1000, 3, 1, *[np.inf] * 9, 0, 1, 2)), "vertex 0 is not finite"),
    "no face": (one(struct.pack("<IxQQ9f", 0x1000, 3, 0, *range(9))), "the mesh is empty"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_one_line(tmp_path: Path, name: str) -> None:
    data, words = MALFORMED[name]
    file = write(tmp_path, data)
    with pytest.raises(AssetError) as caught:
        load_mesh(file)
    message = str(caught.value)
    assert message.startswith(str(file)) and words in message and "\n" not in message


def test_a_file_unfolds_to_a_bounded_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchpt.scene.meshes.serialized.MAX_UNPACKED", 200)
    square = {"vertices": SQUARE, "faces": [[0, 1, 2], [0, 2, 3]]}  # 72 bytes, and 4 of its name
    file = write(tmp_path, serialized_bytes([square] * 3))
    assert len(load_mesh(file, index=2)) == 1
    with pytest.raises(AssetError, match="mesh 2 unfolds to 76 bytes"):
        load_mesh(file)


def test_long_names_take_no_longer_than_other_bytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    meshes, starts, at = [], [], 0
    for _ in range(1000):
        name = rng.integers(1, 128, 4000, np.uint8).tobytes() + b"\0"
        content = struct.pack("<I", 0x1000) + name + struct.pack("<QQ9f3I", 3, 1, *range(9), 0, 1, 2)
        meshes.append(struct.pack("<HH", 0x041C, 4) + zlib.compress(content))
        starts.append(at)
        at += len(meshes[-1])
    file = write(tmp_path, b"".join(meshes) + struct.pack("<1000QI", *starts, 1000))
    start = time.process_time()
    assert len(load_mesh(file)) == 1000
    assert time.process_time() - start < 5.0
