"""Details of mesh and image files that programs get wrong; each test names the rule of the format."""

import base64
import io
import json
import struct
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import torchpt
from torchpt.core.errors import AssetError
from torchpt.images import read_texels
from torchpt.scene.meshes import load_mesh


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(bits: int, colours: int, width: int, rows: list[bytes], extra: bytes = b"") -> bytes:
    head = struct.pack(">IIBBBBB", width, len(rows), bits, colours, 0, 0, 0)
    data = zlib.compress(b"".join(b"\0" + row for row in rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def plain(*colour: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (2, 2), colour).save(file, "PNG")
    return file.getvalue()


UVS = ((0, 1), (1, 1), (1, 0), (0, 0))


def quad(
    folder: Path,
    material: dict[str, Any] | None = None,
    image: bytes | None = None,
    *,
    mode: int | None = None,
    bare: tuple[str, ...] = (),
    **attributes: Any,
) -> Path:
    """Write a unit square that faces +z; ``bare``: attributes whose accessors have no data; None leaves one out."""
    arrays = {
        "POSITION": [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)],
        "NORMAL": [(0, 0, 1)] * 4,
        "TEXCOORD_0": UVS,
        **attributes,
    }
    buffer, views, accessors, places = b"", [], [], {}

    def add(data: bytes) -> int:
        nonlocal buffer
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": len(data)})
        buffer += data + b"\0" * (-len(data) % 4)
        return len(views) - 1

    for name, value in arrays.items():
        if value is None:
            continue
        rows = np.array(value, "<f4")
        accessor = {"componentType": 5126, "count": len(rows), "type": f"VEC{rows.shape[1]}"}
        places[name] = len(accessors)
        accessors.append(accessor if name in bare else {**accessor, "bufferView": add(rows.tobytes())})
    index = np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    accessors.append({"bufferView": add(index), "componentType": 5123, "count": 6, "type": "SCALAR"})
    primitives: list[dict[str, Any]] = [{"attributes": places, "indices": len(accessors) - 1}]
    if mode is not None:
        primitives.append({"attributes": places, "mode": mode})
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "accessors": accessors,
    }
    if material is not None:
        primitives[0]["material"] = 0
        document["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0}, **material}]
    if image is not None:
        document["images"] = [{"bufferView": add(image), "mimeType": "image/png"}]
        document["textures"] = [{"source": 0}]
    data = "data:;base64," + base64.b64encode(buffer).decode()
    document |= {"bufferViews": views, "buffers": [{"byteLength": len(buffer), "uri": data}]}
    path = folder / "quad.gltf"
    path.write_text(json.dumps(document))
    return path


def mean(path: Path, z: float = 4.0) -> float:
    """Return the mean of a picture of the square, seen from ``z`` under a white sky."""
    scene = torchpt.load(
        {
            "camera": {"origin": [0.5, 0.5, z], "target": [0.5, 0.5, 0.0], "fov": 10},
            "film": {"width": 8, "height": 8},
            "shapes": {"square": {"type": "mesh", "path": str(path)}},
            "lights": {"sky": {"type": "constant"}},
        }
    )
    return float(torchpt.render(scene, spp=16).mean())


def only(path: Path) -> Any:
    (part,) = load_mesh(path)
    return part


class TestGltf:
    def test_colours_of_16_bits_are_encoded_too(self, tmp_path):
        """3.9.2: the first three channels of base colours are sRGB."""
        unlit = {
            "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
            "extensions": {"KHR_materials_unlit": {}},
        }
        deep = png(16, 2, 2, [struct.pack(">6H", *[0x8080] * 6)] * 2)
        found = [mean(quad(tmp_path, unlit, image)) for image in (plain(128, 128, 128), deep)]
        assert found == pytest.approx([0.2158, 0.2158], rel=0.02)

    def test_without_normals_it_is_flat(self, tmp_path):
        """3.7.2.1: flat normals where none are given."""
        assert only(quad(tmp_path, NORMAL=None)).flat and not only(quad(tmp_path)).flat

    def test_vertex_colours_end_at_1(self, tmp_path):
        """3.7.2.1: components of COLOR_n are clamped."""
        assert only(quad(tmp_path, {}, COLOR_0=[(3, 0.5, -1)] * 4)).colors.tolist() == [[1.0, 0.5, 0.0]] * 4

    def test_what_is_left_out_is_named(self, tmp_path):
        faint = [(1, 0, 0, 0.5)] * 4
        assert only(quad(tmp_path, {"alphaMode": "BLEND"}, COLOR_0=faint)).ignored == ("COLOR_0 (its alpha)",)
        assert only(quad(tmp_path, {}, COLOR_0=faint)).ignored == ()
        assert only(quad(tmp_path, mode=1)).ignored == ("points and lines",)  # behind the triangles
        lit = {"emissiveFactor": [1, 1, 1], "doubleSided": True}
        material = only(quad(tmp_path, lit)).material
        assert material.ignored == ("doubleSided (light leaves the front alone)",)
        bumps = {"normalTexture": {"index": 0}}
        assert only(quad(tmp_path, bumps, plain(128, 128, 255))).ignored == ()
        mirrored = only(quad(tmp_path, bumps, plain(128, 128, 255), TEXCOORD_0=UVS[::-1]))
        assert mirrored.ignored == ("normalTexture (its green channel where texture coordinates are mirrored)",)

    def test_a_cutoff_above_1_leaves_nothing(self, tmp_path):
        """3.9.4: above 1 the whole material is transparent."""
        black = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "alphaMode": "MASK"}
        assert mean(quad(tmp_path, {**black, "alphaCutoff": 2})) == pytest.approx(1.0)
        assert mean(quad(tmp_path, {**black, "alphaCutoff": 1})) < 0.1

    def test_accessors_without_data_are_zeros(self, tmp_path):
        """3.6.2.1: without a buffer view they are initialized with zeros."""
        assert only(quad(tmp_path, bare=("TEXCOORD_0",))).uvs.tolist() == [[0.0, 0.0]] * 4


class TestStl:
    TRIANGLE = np.arange(12, dtype="<f4").tobytes() + b"\0\0"

    @pytest.mark.parametrize("rest", [b"", b"\0\0", b"more"])
    def test_binary_files_may_begin_with_solid(self, tmp_path, rest):
        path = tmp_path / "a.stl"
        path.write_bytes(b"solid x".ljust(80) + struct.pack("<I", 1) + self.TRIANGLE + rest)
        assert len(only(path).faces) == 1

    def test_names_may_have_any_words(self, tmp_path):
        path = tmp_path / "a.stl"
        corners = "".join(f"vertex {k} {k * k} 0\n" for k in range(3))
        path.write_text(
            f"solid my vertex model\nfacet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\nendsolid my vertex 1 2 3\n"
        )
        assert only(path).vertices.tolist() == [[0, 0, 0], [1, 1, 0], [2, 4, 0]]


class TestPly:
    HEAD = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {k}\n" for k in "xyz")

    def test_colours_of_floats_are_at_most_1(self, tmp_path):
        path = tmp_path / "a.ply"
        head = self.HEAD + "".join(f"property float {k}\n" for k in ("red", "green", "blue"))
        rows = "0 0 0 255 0 0\n1 0 0 1 0 0\n1 1 0 1 0 0\n3 0 1 2\n"
        path.write_text(f"{head}element face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}")
        with pytest.raises(AssetError, match="holds a colour above 1: 255; colours of floats are linear, from 0 to 1"):
            load_mesh(path)

    def test_colours_of_faces_are_named(self, tmp_path):
        path = tmp_path / "a.ply"
        face = "element face 1\nproperty list uchar int vertex_indices\n" + "".join(
            f"property uchar {k}\n" for k in ("red", "green", "blue")
        )
        path.write_text(f"{self.HEAD}{face}end_header\n0 0 0\n1 0 0\n1 1 0\n3 0 1 2 255 0 0\n")
        assert only(path).ignored == ("colours of faces",)


def test_obj_of_many_small_groups_takes_no_time(tmp_path):
    """Time goes with faces, not with faces times groups."""
    path, times = tmp_path / "a.obj", []
    for count in (8_000, 32_000):
        corners = "".join(f"v {k} 0 0\nv {k} 1 0\nv {k} 0 1\n" for k in range(count))
        groups = "".join(f"usemtl m{k}\nf {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(count))
        path.write_text(corners + groups)
        start = time.process_time()
        parts = load_mesh(path)
        times.append(time.process_time() - start)
        assert len(parts) == count and parts[7].vertices.tolist() == [[7, 0, 0], [7, 1, 0], [7, 0, 1]]
    assert times[1] < 6.0 * times[0]  # 4; with faces times groups 8


@pytest.mark.parametrize("channels", [3, 4])
def test_mtl_takes_alpha_of_exr_files(tmp_path, channels):
    torchpt.write_image(tmp_path / "t.exr", torch.full((2, 2, channels), 0.5))
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd t.exr\nmap_d t.exr\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    opacity = only(tmp_path / "a.obj").material.material["opacity"]
    assert opacity["channel"] == ("a" if channels == 4 else "luminance")


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA"])
def test_mtl_takes_alpha_where_there_is_some(tmp_path, mode):
    """`map_d` of the image of the colour: its alpha, or what it shows."""
    Image.new(mode, (2, 2)).save(tmp_path / "t.png")
    (tmp_path / "a.mtl").write_text("newmtl a\nmap_Kd t.png\nmap_d t.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n"
    )
    opacity = only(tmp_path / "a.obj").material.material["opacity"]
    assert opacity["channel"] == ("a" if mode == "RGBA" else "luminance")
    assert mean(tmp_path / "a.obj") > 0


@pytest.mark.parametrize(
    ("bits", "row", "transparent", "alpha"),
    [
        (1, bytes([0b10100000]), 1, [0, 1, 0, 1]),
        (2, bytes([0b00011011]), 3, [1, 1, 1, 0]),
        (4, bytes([0x0F, 0x81]), 8, [1, 1, 0, 1]),
        (8, bytes([0, 100, 200, 255]), 100, [1, 0, 1, 1]),
        (16, struct.pack(">4H", 0, 1000, 2, 65535), 1000, [1, 0, 1, 1]),
    ],
)
def test_transparent_grey_of_any_depth(tmp_path, bits, row, transparent, alpha):
    """PNG, 11.3.2.1: the value of tRNS is in the file's number of bits."""
    path = tmp_path / "a.png"
    path.write_bytes(png(bits, 0, 4, [row], chunk(b"tRNS", struct.pack(">H", transparent))))
    values = read_texels(path).values
    assert values[0, :, 1].tolist() == alpha and values.shape == (1, 4, 2)
    white = (1 << bits) - 1
    digits = "".join(f"{byte:08b}" for byte in row)
    expected = [int(digits[k * bits : (k + 1) * bits], 2) / white for k in range(4)]
    np.testing.assert_allclose(values[0, :, 0], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("order", "turned"),
    [
        (b"-Y 2 +X 2", lambda x: x),
        (b"+Y 2 +X 2", lambda x: x.flip(0)),
        (b"-Y 2 -X 2", lambda x: x.flip(1)),
        (b"+Y 2 -X 2", lambda x: x.flip(0, 1)),
        (b"+X 2 -Y 2", lambda x: x.transpose(0, 1)),
    ],
)
def test_radiance_files_in_any_order(tmp_path, order, turned):
    """`+Y` counts rows from the bottom, `-X` columns from the right; X first: columns one after the other."""
    path, pixels = tmp_path / "a.hdr", [[128, 0, 0, 129], [0, 128, 0, 129], [0, 0, 128, 129], [128, 128, 128, 129]]
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + order + b"\n" + b"".join(map(bytes, pixels)))
    stored = torch.tensor(pixels, dtype=torch.float32).view(2, 2, 4)[..., :3] / 128
    assert torch.equal(torchpt.read_image(path), turned(stored))


@pytest.mark.parametrize(
    ("names", "values"),
    [
        (("r", "g", "b"), [1, 2, 3]),
        (("Red", "Green", "Blue", "Alpha"), [1, 2, 3, 4]),
        (("beauty.R", "beauty.G", "beauty.B", "A"), [1, 2, 3]),
        (("R", "G", "B", "red"), [1, 2, 3]),
        (("Z", "Y"), [2]),
    ],
)
def test_the_picture_of_an_exr(tmp_path, names, values):
    """Its channels in another spelling; alpha alone is no picture."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(1, 1, len(names), "float")
    spec.channelnames = names
    file = oiio.ImageOutput.create("a.exr")
    assert file is not None
    file.open(str(tmp_path / "a.exr"), spec)
    file.write_image(np.arange(1, len(names) + 1, dtype=np.float32).reshape(1, 1, -1))
    file.close()
    assert torchpt.read_image(tmp_path / "a.exr").flatten().tolist() == values
