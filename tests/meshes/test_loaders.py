"""Mesh files: round trips in every format, the real assets, the oracle's normals, and malformed input."""

from __future__ import annotations

import json
import os
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cubes import unit_cube

from torchpt.core.errors import AssetError
from torchpt.scene.meshes import MeshPart, load_mesh, smooth_normals
from torchpt.scene.meshes.ply import load_ply_attribute

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
HEADER = "ply\nformat {}\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face {}\n"
LIST = "property list uchar int vertex_indices\nend_header\n"


def asset(name: str) -> Path:
    folder = os.environ.get("TORCHPT_ASSETS")
    if not folder or not (Path(folder) / name).is_file():
        pytest.skip(f"$TORCHPT_ASSETS has no {name}")
    return Path(folder) / name


def write(path: Path, data: str | bytes) -> Path:
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def corners(parts: list[MeshPart]) -> np.ndarray:
    """``(F, 9)`` corner positions in a canonical order of faces."""
    flat = np.concatenate([part.vertices[part.faces].reshape(-1, 9) for part in parts])
    return flat[np.lexsort(flat.T[::-1])]


def glb(document: dict[str, Any], binary: bytes = b"") -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def square_glb(**changes: Any) -> bytes:
    points, index = SQUARE.astype("<f4").tobytes(), np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"name": "sq", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 4},
            {"bufferView": 1, "componentType": 5123, "type": "SCALAR", "count": 6},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 60}],
        **changes,
    }
    return glb(document, points + index)


# --- OBJ


def test_obj_groups_polygons_and_names_with_blanks(tmp_path: Path) -> None:
    write(
        tmp_path / "my mats.mtl",
        "newmtl bright red\nKd 0.5 0.25 0.125\nillum 2\nnewmtl glow\nKe 1 2 3\n",
    )
    text = (
        "# comment\nmtllib my mats.mtl\nv 0 0 0 1.0\nv 1 0 0 # tail\nv 1 \\\n1 0\nv 0 1 0\n"
        "vt 0 0\nvt 1 0.25\nvn 0 0 2\n"
        "usemtl bright red\nf -4/1/1 -3/2/1 -2/1/1 -1/1/1\nusemtl  glow \nf 1//1 2//1 3//1\n"
        "usemtl bright red\nf 1/1/1 3/1/1 4/1/1\n"
    )
    red, glow = load_mesh(write(tmp_path / "a b.obj", text))
    assert (red.name, glow.name) == ("bright red", "glow")
    assert len(red.faces) == 3 and len(glow.faces) == 1
    assert red.material is not None and red.material.ignored == ()
    assert red.material.material == {"type": "diffuse", "reflectance": [0.5, 0.25, 0.125]}
    assert glow.material is not None and glow.material.material["emission"] == [1, 2, 3]
    assert red.uvs is not None and red.normals is not None and glow.normals is not None
    second = red.uvs[red.faces[0, 1]]
    np.testing.assert_allclose(second, (1, 0.75))  # v counts from the bottom row in the file
    np.testing.assert_allclose(red.normals, [[0, 0, 1]] * len(red.normals))
    np.testing.assert_allclose(red.vertices[red.faces[0]], SQUARE[:3])
    np.testing.assert_allclose(red.vertices[red.faces[1]], SQUARE[[0, 2, 3]])


def test_obj_groups_meet_without_a_crease(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 0\nusemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n"
    a, b = load_mesh(write(tmp_path / "a.obj", text))
    assert a.normals is not None and b.normals is not None
    np.testing.assert_allclose(a.normals[a.faces[0, 0]], b.normals[b.faces[0, 0]])
    assert a.material is not None and a.material.ignored == ("not defined in an MTL file",)


def test_obj_vertex_colours_are_named(tmp_path: Path) -> None:
    rows = "".join(f"v {x} {y} {z} 1 0 0\n" for x, y, z in SQUARE)
    (part,) = load_mesh(write(tmp_path / "a.obj", rows + "f 1 2 3\nl 1 2\n"))
    assert part.ignored == ("l", "v x y z r g b (colours)")


def test_obj_without_its_materials(tmp_path: Path) -> None:
    file = write(tmp_path / "a.obj", "mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl x\nf 1 2 3\n")
    assert load_mesh(file, materials=False)[0].material is None
    (part,) = load_mesh(file)
    assert part.ignored == ("mtllib gone.mtl (no such file)",)
    assert part.material is not None and part.material.ignored == ("not defined in an MTL file",)


# --- PLY


def test_ply_in_three_formats(tmp_path: Path) -> None:
    faces = [(0, 1, 2), (0, 1, 2, 3)]
    ascii_rows = "\n".join(" ".join(map(str, row)) for row in SQUARE) + "\n3 0 1 2\n4 0 1 2 3\n"
    found = [load_mesh(write(tmp_path / "a.ply", HEADER.format("ascii 1.0", 2) + LIST + ascii_rows))]
    for order, name in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        body = SQUARE.astype(order + "f4").tobytes()
        body += b"".join(struct.pack(f"{order}B{len(face)}i", len(face), *face) for face in faces)
        found.append(
            load_mesh(write(tmp_path / f"{name}.ply", (HEADER.format(f"{name} 1.0", 2) + LIST).encode() + body))
        )
    for parts in found:
        assert parts[0].normals is None and parts[0].uvs is None
        np.testing.assert_array_equal(parts[0].faces, [[0, 1, 2], [0, 1, 2], [0, 2, 3]])
        np.testing.assert_array_equal(parts[0].vertices, SQUARE)


def test_ply_steps_over_other_elements_and_reads_normals(tmp_path: Path) -> None:
    text = (
        "ply\nformat ascii 1.0\nelement tag 1\nproperty list uchar float w\nproperty int z\nelement vertex 3\n"
        + "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t"))
        + "property uchar red\nelement face 1\n" + LIST
        + "2 0.5 0.5 7\n0 0 0 0 0 3 0 0 255\n1 0 0 0 0 0 0.5 0 255\n0 1 0 0 0 3 nan 1 255\n3 0 1 2\n"
    )  # fmt: skip
    (part,) = load_mesh(write(tmp_path / "a.ply", text))
    assert part.normals is not None and part.uvs is not None and part.colors is None  # red alone is no colour
    np.testing.assert_allclose(part.normals, [[0, 0, 1]] * 3)  # made unit, the zero one replaced
    np.testing.assert_allclose(part.uvs, [[0, 0], [0.5, 0], [0, 1]])  # the NaN is 0


# --- STL


def test_stl_binary_and_ascii_are_welded(tmp_path: Path) -> None:
    triangles = SQUARE[[[0, 1, 2], [0, 2, 3]]]
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *corner.ravel(), 0) for corner in triangles)
    binary = load_mesh(write(tmp_path / "b.stl", b"solid looks like text".ljust(80) + struct.pack("<I", 2) + body))
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corner)
        + "endloop\nendfacet\n"
        for corner in triangles
    )
    text = load_mesh(write(tmp_path / "a.stl", f"solid a\n{facets}endsolid a\n"))
    mixed_case = load_mesh(write(tmp_path / "c.stl", f"Solid a\n{facets.replace('vertex', 'Vertex')}EndSolid a\n"))
    for parts in (binary, text, mixed_case):
        assert parts[0].vertices.shape == (4, 3)
        np.testing.assert_array_equal(corners(parts), corners([MeshPart("", SQUARE, np.array([[0, 1, 2], [0, 2, 3]]))]))


# --- GLB


def test_glb_accumulates_node_transforms_and_reads_materials(tmp_path: Path) -> None:
    nodes = [
        {"children": [1], "translation": [1, 0, 0], "scale": [2, 2, 2]},
        {"mesh": 0, "rotation": [0, 0, 0.7071067811865476, 0.7071067811865476]},
    ]
    primitives = [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]
    material = {
        "name": "m",
        "pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1], "metallicFactor": 0},
    }
    data = square_glb(nodes=nodes, meshes=[{"name": "sq", "primitives": primitives}], materials=[material])
    (part,) = load_mesh(write(tmp_path / "a.glb", data))
    expected = 2 * np.stack([-SQUARE[:, 1], SQUARE[:, 0], SQUARE[:, 2]], axis=1) + (1, 0, 0)
    np.testing.assert_allclose(part.vertices, expected, atol=1e-12)
    assert part.material is not None and part.material.name == "m"


def test_glb_mirror_keeps_the_front_outside(tmp_path: Path) -> None:
    (part,) = load_mesh(write(tmp_path / "a.glb", square_glb(nodes=[{"mesh": 0, "scale": [1, 1, -1]}])))
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a)[2] < 0  # the front looked along +z, mirrored along -z


@pytest.mark.parametrize(("mode", "expected"), [(5, [[0, 1, 2], [1, 3, 2]]), (6, [[1, 2, 0], [2, 3, 0]])])
def test_glb_strips_and_fans(tmp_path: Path, mode: int, expected: list[list[int]]) -> None:
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "mode": mode}]}]
    (part,) = load_mesh(write(tmp_path / "a.glb", square_glb(meshes=meshes)))
    np.testing.assert_array_equal(part.faces, expected)


# --- real files


@pytest.mark.parametrize(
    ("name", "triangles"),
    [("bunny.ply", 69451), ("teapot.ply", 2256), ("fuze.obj", 1000), ("Duck.glb", 4212), ("BoxTextured.glb", 12)],
)
def test_assets(name: str, triangles: int) -> None:
    assert sum(len(part.faces) for part in load_mesh(asset(name))) == triangles


def test_a_large_obj_is_quick(tmp_path: Path) -> None:
    side = 186
    grid = np.arange(side * side).reshape(side, side) + 1
    a, b, c, d = (x.ravel().tolist() for x in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    text = "".join(f"v {i / 7:.6f} {i / 9:.6f} {i / 11:.6f}\n" for i in range(side * side))
    text += "".join(f"f {i} {j} {k}\nf {i} {k} {m}\n" for i, j, k, m in zip(a, b, c, d, strict=True))
    file = write(tmp_path / "a.obj", text)
    start = time.process_time()
    (part,) = load_mesh(file)
    assert time.process_time() - start < 3.0  # about 0.5 s
    assert len(part.faces) == 2 * (side - 1) ** 2


# --- normals and the cube, against the oracle


@pytest.mark.mitsuba
def test_smooth_normals_are_mitsubas() -> None:
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    file = asset("bunny.ply")
    (part,) = load_mesh(file)
    params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(file)}))
    oracle = np.array(params["vertex_normals"]).reshape(-1, 3)
    used = np.unique(part.faces)
    np.testing.assert_allclose(smooth_normals(part.vertices, part.faces)[used], oracle[used], atol=1e-6)


@pytest.mark.mitsuba
def test_cube_is_mitsubas() -> None:
    import mitsuba as mi  # pyright: ignore[reportMissingImports]

    mi.set_variant("scalar_rgb")
    params, cube = mi.traverse(mi.load_dict({"type": "cube"})), unit_cube()
    assert cube.normals is not None and cube.uvs is not None
    np.testing.assert_array_equal(np.array(params["faces"]).reshape(-1, 3), cube.faces)
    np.testing.assert_allclose(np.array(params["vertex_positions"]).reshape(-1, 3), cube.vertices)
    np.testing.assert_allclose(np.array(params["vertex_normals"]).reshape(-1, 3), cube.normals)
    np.testing.assert_allclose(np.array(params["vertex_texcoords"]).reshape(-1, 2), cube.uvs)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_smooth_normals_of_degenerate_faces_are_finite(size: float) -> None:
    vertices = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [5, 5, 5]], dtype=np.float64)
    normals = smooth_normals(vertices, np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]]))
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 5)


def test_smooth_normals_where_faces_face_each_other_are_those_of_no_face() -> None:
    vertices = np.array([[0.1, 0.2, 0.3], [1.3, 0.1, 0.7], [0.2, 0.9, -0.4], [2.0, 1.0, 1.0]])
    normals = smooth_normals(vertices, np.array([[0, 1, 2], [0, 2, 1], [0, 0, 3]]))
    np.testing.assert_array_equal(normals, [[0, 0, 1]] * 4)


# --- malformed files

VERTICES = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
ROWS = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"


def ply(faces: int | str, body: str, layout: str = "ascii 1.0") -> str:
    return HEADER.format(layout, faces) + LIST + body


SPARSE = {"count": 0, "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 0}}
MALFORMED: dict[str, tuple[str, str | bytes, str]] = {
    "unknown ending": ("a.fbx", "", r"\.obj, \.ply, \.stl, \.glb, \.gltf"),
    "obj without faces": ("a.obj", VERTICES, "empty"),
    "obj NaN vertex": ("a.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0 is not finite"),
    "obj infinite vertex": ("a.obj", "v 0 0 1e60\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "vertex 0 is not finite"),
    "obj bad number": ("a.obj", "v 0 0 zero\n", "line 1: expected v and 3 numbers"),
    "obj short vertex": ("a.obj", "v 0 0 0\nv 0 0\n", "line 2: expected v and 3 numbers"),
    "obj index out of range": (
        "a.obj",
        VERTICES + "f 1 2 3\nf 1 2 9\n",
        "line 5: corner '9' has an index out of range",
    ),
    "obj index zero": ("a.obj", VERTICES + "f 0 1 2\n", "line 4: corner '0'"),
    "obj counts back too far": ("a.obj", VERTICES + "f -1 -2 -4\n", "line 4: corner '-4' counts back"),
    "obj texture index": ("a.obj", VERTICES + "f 1/1 2/1 3/1\n", "0 vt"),
    "obj face of two": ("a.obj", VERTICES + "f 1 2\n", "line 4: a face needs three or more"),
    "obj face with words": ("a.obj", VERTICES + "f a b c\n", "line 4: 'a' is no corner"),
    "obj corner of four": ("a.obj", VERTICES + "f 1/1/1/1 2 3\n", "line 4"),
    "obj binary": ("a.obj", bytes(range(256)) * 4, "empty"),
    "ply no header": ("a.ply", "hello", "does not start with ply"),
    "ply unknown format": ("a.ply", ply(1, ROWS, "utf 1.0"), "unknown format"),
    "ply header garbage": ("a.ply", "ply\nformat ascii 1.0\nelement vertex x\nend_header\n", "element vertex x"),
    "ply huge count": (
        "a.ply",
        "ply\nformat ascii 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n1\n",
        "truncated",
    ),
    "ply huge binary": (
        "a.ply",
        ply(999_999_999_999, "", "binary_little_endian 1.0"),
        "truncated: 4 of element vertex",
    ),
    "ply huge list": (
        "a.ply",
        ply(1, ROWS + "2000000000 0 1\n"),
        r"line 14: face 0 has 3 values, the properties in the header come to 2000000001",
    ),
    "ply truncated": ("a.ply", ply(2, ROWS + "3 0 1 2\n"), "truncated"),
    "ply index": ("a.ply", ply(2, ROWS + "3 0 1 2\n3 0 1 4\n"), r"face 1 has an index outside 0\.\.3"),
    "ply negative index": ("a.ply", ply(1, ROWS + "3 0 1 -2\n"), "face 0 has an index"),
    "ply NaN": ("a.ply", ply(1, ROWS.replace("1 1", "1 nan") + "3 0 1 2\n"), "vertex 3 is not finite"),
    "ply words": (
        "a.ply",
        ply(1, ROWS.replace("1 1", "1 x") + "3 0 1 2\n"),
        "element vertex holds .x., expected a number",
    ),
    "ply face of two": ("a.ply", ply(1, ROWS + "2 0 1\n"), "face 0 has 2 corners"),
    "ply empty": ("a.ply", ply(0, ROWS), "empty"),
    "ply no vertex": ("a.ply", "ply\nformat ascii 1.0\nend_header\n", "no element vertex"),
    "ply no z": ("a.ply", "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "no property y"),
    "stl truncated": ("a.stl", b"\0" * 80 + struct.pack("<I", 4_000_000_000) + b"\0" * 50, "truncated"),
    "stl short": ("a.stl", b"\0" * 10, "truncated"),
    "stl empty": ("a.stl", b"\0" * 84, "empty"),
    "stl NaN": ("a.stl", b"\0" * 80 + struct.pack("<I12fH", 1, *[float("nan")] * 12, 0), "not finite"),
    "stl cut text": ("a.stl", "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "truncated"),
    "glb no magic": ("a.glb", b"glXF" + b"\0" * 30, "no GLB"),
    "glb truncated": ("a.glb", square_glb()[:-20], "truncated"),
    "glb bad json": ("a.glb", square_glb().replace(b'{"asset"', b'["asset"'), "JSON"),
    "glb accessor": ("a.glb", square_glb(accessors=[]), "accessors 0 does not exist"),
    "glb count": (
        "a.glb",
        square_glb(accessors=[{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 10**12}] * 2),
        "accessors 0 reaches beyond its bufferView",
    ),
    "glb sparse": (
        "a.glb",
        square_glb(accessors=[{"componentType": 5126, "type": "VEC3", "count": 4, "sparse": {}}] * 2),
        r"malformed glTF: accessors\[0\].sparse: count is missing",
    ),
    "glb zeros": (
        "a.glb",
        square_glb(accessors=[{"componentType": 5126, "type": "VEC3", "count": 10**9, "sparse": SPARSE}] * 2),
        "declares 1000000000 rows without data",
    ),
    "glb draco": ("a.glb", square_glb(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
    "glb unread buffer": ("a.glb", square_glb(buffers=[{"byteLength": 60, "uri": "no.bin"}]), "'no.bin' is missing"),
    "gltf remote": (
        "a.gltf",
        '{"buffers": [{"uri": "http://x/y"}], "bufferViews": [{"buffer": 0, "byteLength": 1}], '
        '"accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 1}], "nodes": [{"mesh": 0}], '
        '"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}',
        "only files and data: URIs",
    ),
    "gltf no json": ("a.gltf", "{", "JSON is missing or malformed"),
    "glb cycle": ("a.glb", square_glb(nodes=[{"children": [0]}]), "two parents"),
    "glb missing node": ("a.glb", square_glb(nodes=[]), "nodes 0 does not exist"),
    "glb wrong types": ("a.glb", square_glb(meshes=[3]), r"malformed glTF: meshes\[0\]: expected an object, got 3"),
    "glb wrong type inside": (
        "a.glb",
        square_glb(meshes=[{"primitives": 3}]),
        r"meshes\[0\].primitives: expected a list",
    ),
    "glb empty": ("a.glb", square_glb(scenes=[{}]), "empty"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_malformed_files_are_one_line(name: str, tmp_path: Path) -> None:
    ending, data, problem = MALFORMED[name]
    file = write(tmp_path / ending, data)
    with pytest.raises(AssetError, match=problem) as caught:
        load_mesh(file)
    assert str(caught.value).startswith(f"{file}: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("mtl", "problem"),
    [
        ("newmtl a\nKd 1 2\n", "line 2: expected Kd"),
        ("newmtl a\nKe -1 0 0\n", "line 2: expected Ke"),
        ("newmtl\n", "name"),
        ("newmtl a\nNs nan\n", "line 2: expected Ns"),
        ("newmtl a\nPr red\n", "line 2: expected Pr"),
        ("newmtl a\nmap_Kd\n", "line 2: expected map_Kd and the name of a file"),
        ("newmtl a\nmap_Bump -bm x a.png\n", "line 2: expected -bm and numbers"),
        ("newmtl x\nmap_Kd gone.png\n", "line 2: the image file 'gone.png' is missing"),
    ],
)
def test_malformed_mtl(tmp_path: Path, mtl: str, problem: str) -> None:
    write(tmp_path / "a.mtl", mtl)
    with pytest.raises(AssetError, match=problem) as caught:
        load_mesh(write(tmp_path / "a.obj", f"mtllib a.mtl\n{VERTICES}usemtl x\nf 1 2 3\n"))
    assert caught.value.file.endswith("a.mtl")


# ---- Attributes of PLY as Mitsuba names them

ATTRIBUTES = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar r
property uchar g
property uchar b
property float foo_r
property float foo_g
property float foo_b
property float bar_0
element face 2
property list uchar int vertex_indices
property float red
property float green
property float blue
end_header
0 0 0 255 0 51 0.1 0.2 0.3 0.5
1 0 0 0 255 51 0.4 0.5 0.6 0.25
1 1 0 0 0 51 0.7 0.8 0.9 0.125
0 1 1 0 0 0 1 2 3 4
4 0 1 2 3 0.9 0.5 0.1
3 0 1 3 0.2 0.3 0.4
"""


@pytest.mark.parametrize(
    ("name", "first"),
    [("color", [1, 0, 0.2]), ("foo", [0.1, 0.2, 0.3]), ("foo_color", [0.1, 0.2, 0.3]), ("bar", [0.5, 0.5, 0.5])],
)
def test_vertex_attributes_of_ply_are_colours(tmp_path: Path, name: str, first: list[float]) -> None:
    part = load_ply_attribute(write(tmp_path / "a.ply", ATTRIBUTES), f"vertex_{name}")
    assert part is not None and part.colors is not None and part.colors.shape == (4, 3) and part.faces.shape == (3, 3)
    np.testing.assert_allclose(part.colors[0], first)


def test_face_attributes_of_ply_split_the_vertices_and_keep_smooth_normals(tmp_path: Path) -> None:
    file = write(tmp_path / "a.ply", ATTRIBUTES)
    (whole,) = load_mesh(file)
    part = load_ply_attribute(file, "face_color")
    assert part is not None and part.colors is not None and part.normals is not None
    np.testing.assert_array_equal(
        part.colors, np.repeat([[0.9, 0.5, 0.1], [0.9, 0.5, 0.1], [0.2, 0.3, 0.4]], 3, axis=0)
    )
    np.testing.assert_array_equal(part.vertices[part.faces], whole.vertices[whole.faces])
    smooth = smooth_normals(whole.vertices, whole.faces)
    np.testing.assert_allclose(part.normals[part.faces], smooth[whole.faces], atol=1e-12)


@pytest.mark.parametrize("name", ["vertex_baz", "face_foo", "vertex_", "foo", ""])
def test_attributes_that_ply_lacks_are_none(tmp_path: Path, name: str) -> None:
    assert load_ply_attribute(write(tmp_path / "a.ply", ATTRIBUTES), name) is None
