"""The formats that trimesh reads for us: what comes of each, and what is said of files that are damaged or ask for more."""

from __future__ import annotations

import io
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_files import DAE, XAML, zipped

import torchpt
from torchpt.core.errors import AssetError
from torchpt.images import read_texels
from torchpt.scene.meshes import FORMATS, PARSERS, load_mesh

trimesh: Any = import_module("trimesh")  # hardly typed
BALL = trimesh.creation.icosphere(subdivisions=1)


def picture() -> Image.Image:
    return Image.fromarray(np.random.default_rng(3).integers(0, 256, (6, 5, 3), dtype=np.uint8))


def needs(kind: str) -> None:
    for name in PARSERS[kind]:
        pytest.importorskip(name, reason=f"{name} is not installed (extra `formats`)")


def encoded(kind: str) -> bytes:
    """A file of each format."""
    needs(kind)
    if kind == ".xaml":
        return XAML.encode()
    if kind == ".dae":
        return DAE.encode()
    if kind == ".zae":
        picture().save(png := io.BytesIO(), "PNG")
        return zipped(a_dae=DAE.encode(), wood_png=png.getvalue())
    if kind == ".3dxml":
        pytest.skip("nothing writes it")
    exported = (trimesh.Scene(BALL) if kind == ".3mf" else BALL).export(file_type=kind[1:])
    return exported.encode() if isinstance(exported, str) else exported


def loaded(folder: Path, kind: str, data: bytes) -> Any:
    (folder / f"a{kind}").write_bytes(data)
    picture().save(folder / "wood.png")
    return load_mesh(folder / f"a{kind}")


@pytest.mark.parametrize("kind", [".off", ".3mf"])
def test_what_trimesh_writes_is_read(tmp_path: Path, kind: str) -> None:
    (part,) = loaded(tmp_path, kind, encoded(kind))
    assert np.allclose(part.vertices[part.faces], BALL.vertices[BALL.faces], atol=1e-6)
    assert part.normals is None and part.material is None
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
            "film": {"width": 24, "height": 18},
            "shapes": {"ball": {"type": "mesh", "path": str(tmp_path / f"a{kind}")}},
            "lights": {"sky": {"type": "constant", "radiance": 1}},
        },
        "cpu",
    )
    assert torchpt.render(scene, spp=1, compile="off")[9, 12, 0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("kind", [".dae", ".zae"])
def test_collada_has_its_nodes_materials_and_pictures(tmp_path: Path, kind: str) -> None:
    (part,) = loaded(tmp_path, kind, encoded(kind))
    assert np.allclose(part.vertices, [[0, 0, 5], [1, 0, 5], [1, 1, 5]])
    assert np.allclose(part.uvs, [[0, 1], [1, 1], [1, 0.25]])  # row 0 at v = 0
    look = part.material.material
    assert look["type"] == "principled" and look["roughness"] == 1.0 and "metallic" not in look
    texels = read_texels(look["base_color"]["path"])
    assert np.array_equal(texels.values, np.asarray(picture(), np.float32) / np.float32(255)) and texels.eight_bit


def test_xaml_has_its_colours(tmp_path: Path) -> None:
    (part,) = loaded(tmp_path, ".xaml", encoded(".xaml"))
    assert np.allclose(part.colors, [[1.0, 128 / 255, 0.0]] * 3) and np.allclose(part.normals, [[0, 0, 1]] * 3)
    assert part.material.material["reflectance"] == {"type": "vertex_color"}


def test_a_picture_that_is_missing_is_named(tmp_path: Path) -> None:
    data = encoded(".dae").replace(b"wood.png", b"../secret.png")
    with pytest.raises(AssetError, match=r"a\.dae: the file '../secret\.png' is missing"):
        loaded(tmp_path, ".dae", data)
    assert load_mesh(tmp_path / "a.dae", materials=False)


@pytest.mark.parametrize("kind", [kind for kind, packages in PARSERS.items() if packages])
def test_a_package_that_is_missing_is_named(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchpt.scene.meshes.trimesh_formats.find_spec", lambda name: None)
    with pytest.raises(AssetError) as caught:
        loaded(tmp_path, kind, b"")
    line = str(caught.value)
    assert "\n" not in line and f"reading {kind} needs the package" in line and "pip install '.[formats]'" in line
    assert all(name in line for name in PARSERS[kind])


@pytest.mark.parametrize("kind", [".off", ".3mf", ".dae", ".zae", ".xaml"])
def test_damaged_files_are_one_line(tmp_path: Path, kind: str) -> None:
    data = encoded(kind)
    rng = np.random.default_rng(7)
    damages = [b"", b"OFF", b"PK\3\4", b"\0" * 100, data[: len(data) // 2], data[:-1], data + data]
    for _ in range(12):
        damaged = bytearray(data)
        for at in rng.integers(0, len(data), 3):
            damaged[at] = rng.integers(0, 256)
        damages.append(bytes(damaged))
    refused = 0
    for damaged in damages:
        try:
            loaded(tmp_path, kind, damaged)
        except AssetError as error:
            refused += 1
            assert "\n" not in str(error) and str(error).startswith(f"{tmp_path}/a{kind}: ")
    assert refused >= 5


OFF_ERRORS = {
    "an index out of range": (
        "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n",
        "face index outside|: a face has an index outside 0..2",
    ),
    "a vertex that is not finite": ("OFF\n3 1 0\n0 0 nan\n1 0 0\n0 1 0\n3 0 1 2\n", "vertex 0 is not finite"),
    "no face": ("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "a.off: "),
    "more than there is": ("OFF\n99999999 1 0\n0 0 0\n", "malformed .off"),
}


@pytest.mark.parametrize("name", OFF_ERRORS)
def test_what_is_wrong_with_an_off_file(tmp_path: Path, name: str) -> None:
    text, said = OFF_ERRORS[name]
    with pytest.raises(AssetError, match=said):
        loaded(tmp_path, ".off", text.encode())


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_xml_that_declares_entities_is_refused(tmp_path: Path, encoding: str) -> None:
    needs(".dae")
    text = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + DAE.partition("?>")[2]
    with pytest.raises(AssetError, match="declares a document type"):
        loaded(tmp_path, ".dae", text.encode(encoding))
    with pytest.raises(AssetError, match="declares a document type"):
        loaded(tmp_path, ".zae", zipped(a_dae=text.encode(encoding)))


def test_an_archive_that_unfolds_to_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchpt.scene.meshes.trimesh_formats.MAX_UNPACKED", 10_000)
    with pytest.raises(AssetError, match="unfolds to 20000 bytes, more than 10000"):
        needs(".3mf")
        loaded(tmp_path, ".3mf", zipped(a_model=b" " * 20_000))


def test_unknown_endings_are_told_all_formats(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"ending in \.obj.*\.off, \.3mf, \.dae.*got \.step"):
        load_mesh(tmp_path / "a.step")
    assert set(PARSERS) < set(FORMATS)
