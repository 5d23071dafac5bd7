"""Meshes with the materials of their own files, in a scene: what is built, what wins, what is said of errors."""

from __future__ import annotations

import base64
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError
from torchpt.scene.formats.description import settings

FLAT = {"width": 32, "height": 32, "filter": "box"}
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"


def scene(path: Path, **shape: Any) -> dict[str, Any]:
    """A mesh in the square [-1, 1]^2 that fills the picture, under a white sky."""
    return {
        "camera": {"type": "perspective", "origin": [0, 0, 2], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 53.13},
        "shapes": {"m": {"type": "mesh", "path": str(path), **shape}},
        "lights": {"sky": {"type": "constant", "radiance": 1.0}},
    }


def shoot(path: Path, spp: int = 16, **shape: Any) -> np.ndarray:
    made = torchpt.load(scene(path, **shape), device="cpu")
    image = torchpt.render(made, spp=spp, film=FLAT, integrator={"type": "path", "max_depth": 2}, compile="off")
    return image.numpy()


def quarters(folder: Path) -> np.ndarray:
    """Writes ``a b.png``: red and green above, blue and white below; returns it ``(2, 2, 3)``."""
    rows = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]], np.uint8)
    Image.fromarray(rows.repeat(8, 0).repeat(8, 1)).save(folder / "a b.png")
    return rows / 255.0


def obj(folder: Path, mtl: str, faces: str = "usemtl m\nf 1/1 2/2 3/3 4/4\n") -> Path:
    (folder / "a.mtl").write_text(f"newmtl m\n{mtl}")
    (folder / "a.obj").write_text(f"mtllib a.mtl\n{SQUARE}{faces}")
    return folder / "a.obj"


def middles(image: np.ndarray) -> np.ndarray:
    """The middle of each quarter of a picture, ``(2, 2, 3)``."""
    side = len(image) // 2
    blocks = image.reshape(2, side, 2, side, 3)[:, side // 4 : -side // 4, :, side // 4 : -side // 4]
    return blocks.mean((1, 3))


def test_an_obj_shows_its_picture_upright(tmp_path: Path) -> None:
    colors = quarters(tmp_path)
    image = shoot(obj(tmp_path, "Kd 0.5 0.5 0.5\nmap_Kd a b.png"))
    np.testing.assert_allclose(middles(image), 0.5 * colors, atol=0.02)


def test_options_of_an_mtl_map_count_v_from_the_bottom(tmp_path: Path) -> None:
    """v' = v / 2 + 1 / 2: the picture's upper half, twice as tall."""
    colors = quarters(tmp_path)
    image = shoot(obj(tmp_path, "Kd 1 1 1\nmap_Kd -s 1 0.5 1 -o 0 0.5 a b.png"))
    np.testing.assert_allclose(middles(image), colors[[0, 0]], atol=0.02)


def test_the_scenes_material_wins_over_the_files(tmp_path: Path) -> None:
    file = obj(tmp_path, "map_Kd gone.png")
    with pytest.raises(AssetError, match=r"a\.mtl: line 2: the image file 'gone.png' is missing"):
        torchpt.load(scene(file), device="cpu")
    image = shoot(file, material={"type": "diffuse", "reflectance": [0.2, 0.4, 0.6]})
    np.testing.assert_allclose(image.mean((0, 1)), (0.2, 0.4, 0.6), atol=0.01)


def test_parts_of_one_material_share_it(tmp_path: Path) -> None:
    """A GLB whose mesh is there twice: one material, one picture in memory, its own parameters."""
    data = json.loads((_gltf(tmp_path)).read_text())
    data["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [0, 0, -1]}]
    Image.new("RGB", (2, 2)).save(tmp_path / "picture.png")
    (tmp_path / "a.gltf").write_text(json.dumps(data))
    made = torchpt.load(scene(tmp_path / "a.gltf"), device="cpu")
    assert [name for name in made.params if "texture" in name] == ["shapes.m.textures.picture"]
    assert [name for name in made.params if name.endswith("roughness")] == ["shapes.m.part0.material.roughness"]
    assert [name for name in made.params if name.endswith("vertices")] == [
        "shapes.m.part0.vertices",
        "shapes.m.part1.vertices",
    ]


def _gltf(folder: Path, **material: Any) -> Path:
    """A square with a picture on it, in a `.gltf` with its buffer inside."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "<f4").tobytes()
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4").tobytes()
    body = points + uvs + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    pbr = {"baseColorTexture": {"index": 0}, "metallicFactor": 0}
    document = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 4},
            {"bufferView": 2, "componentType": 5123, "type": "SCALAR", "count": 6},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 32},
            {"buffer": 0, "byteOffset": 80, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(body), "uri": "data:;base64," + base64.b64encode(body).decode()}],
        "materials": [{"name": "painted", "pbrMetallicRoughness": pbr, **material}],
        "textures": [{"source": 0}],
        "images": [{"uri": "picture.png"}],
    }
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def test_a_gltf_shows_its_picture_upright(tmp_path: Path) -> None:
    colors = quarters(tmp_path)
    (tmp_path / "a b.png").rename(tmp_path / "picture.png")
    image = middles(shoot(_gltf(tmp_path, extensions={"KHR_materials_unlit": {}})))
    np.testing.assert_allclose(image, colors, atol=0.02)
    principled = middles(shoot(_gltf(tmp_path)))
    assert (principled[colors == 1] > 0.7).all() and (principled[colors == 0] < 0.15).all()


def test_a_texture_transform_turns_the_picture_clockwise(tmp_path: Path) -> None:
    """As KHR_texture_transform says of a rotation of the coordinates by 90 degrees, here brought back over the square."""
    colors = quarters(tmp_path)
    (tmp_path / "a b.png").rename(tmp_path / "picture.png")
    turned = {"KHR_texture_transform": {"rotation": np.pi / 2, "offset": [0, 1]}}
    pbr = {"baseColorTexture": {"index": 0, "extensions": turned}}
    file = _gltf(tmp_path, pbrMetallicRoughness=pbr, extensions={"KHR_materials_unlit": {}})
    np.testing.assert_allclose(middles(shoot(file)), np.rot90(colors, -1), atol=0.02)


def test_alpha_of_the_base_colour_covers(tmp_path: Path) -> None:
    rows = np.full((16, 16, 4), 0, np.uint8)
    rows[:, :8, 3] = 200  # a black left half; the right half is not there
    Image.fromarray(rows).save(tmp_path / "picture.png")
    black = {"extensions": {"KHR_materials_unlit": {}}}
    image = middles(shoot(_gltf(tmp_path, alphaMode="MASK", **black)))
    np.testing.assert_allclose(image[:, 0], 0.0, atol=1e-3)
    np.testing.assert_allclose(image[:, 1], 1.0, atol=1e-3)
    image = middles(shoot(_gltf(tmp_path, alphaMode="BLEND", **black), spp=64))
    np.testing.assert_allclose(image[:, 0], 1 - 200 / 255, atol=0.03)


def test_vertex_colours_of_a_ply(tmp_path: Path) -> None:
    header = "".join(f"property float {name}\n" for name in "xyz") + "".join(
        f"property uchar {name}\n" for name in ("red", "green", "blue")
    )
    rows = "-1 -1 0 255 0 0\n1 -1 0 255 0 0\n1 1 0 255 0 0\n-1 1 0 255 0 0\n"
    text = f"ply\nformat ascii 1.0\nelement vertex 4\n{header}element face 1\nproperty list uchar int vertex_indices\n"
    (tmp_path / "a.ply").write_text(f"{text}end_header\n{rows}4 0 1 2 3\n")
    np.testing.assert_allclose(shoot(tmp_path / "a.ply").mean((0, 1)), (1, 0, 0), atol=0.01)


def test_info_names_what_is_left_out(tmp_path: Path) -> None:
    quarters(tmp_path)
    made = torchpt.load(scene(obj(tmp_path, "Kd 1 1 1\nmap_Ke a b.png\nTf 0 1 0\nillum 4\nrefl x.png")), device="cpu")
    assert made.info(settings(made.description))["shapes"]["m"]["ignored_in_file"] == ["refl", "Tf"]


@pytest.mark.parametrize(
    ("mtl", "problem"),
    [
        ("map_Kd broken.png", r"broken\.png: cannot be read"),
        ("map_d -imfchan m a b.png", r"a b\.png: has no alpha channel, asked for by shapes\.m\.material\.opacity"),
        ("map_Kd high.exr", r"a\.obj: material 'm': shapes\.m\.material\.reflectance: expected numbers in 0\.\.1"),
    ],
)
def test_errors_are_one_line(tmp_path: Path, mtl: str, problem: str) -> None:
    quarters(tmp_path)
    (tmp_path / "broken.png").write_bytes((tmp_path / "a b.png").read_bytes()[:60])
    torchpt.write_image(tmp_path / "high.exr", torch.full((2, 2, 3), 5.0))
    with pytest.raises(AssetError, match=problem) as caught:
        torchpt.load(scene(obj(tmp_path, mtl)), device="cpu")
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("assets", [True, False])
def test_the_duck_renders(assets: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """With Khronos' duck where it is at hand, and with the one that ships."""
    if not assets:
        monkeypatch.delenv("TORCHPT_ASSETS", raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = torchpt.load("duck", device="cpu")
    image = torchpt.render(made, spp=4, film={"width": 64, "height": 64}, compile="off").numpy()
    assert np.isfinite(image).all()
    red, green, blue = np.moveaxis(image, -1, 0)
    yellow = (red > 2.5 * blue) & (green > 1.5 * blue)
    assert 0.08 < yellow.mean() < 0.5
