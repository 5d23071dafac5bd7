"""One small valid file of every format that torchpt reads, as bytes, for tests that damage files."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)


def picture_bytes(kind: str, mode: str) -> bytes:
    rows = np.random.default_rng(5).integers(0, 256, (23, 17, len(mode)), dtype=np.uint8)
    file = io.BytesIO()
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


def serialized_bytes(meshes: list[dict[str, Any]], version: int = 4, *, double: bool = False) -> bytes:
    """Write Mitsuba's serialized format: ``vertices faces`` and, where given, ``normals uvs colors name flat`` of each mesh."""
    real, body, starts = "<f8" if double else "<f4", b"", []
    for mesh in meshes:
        arrays = [("vertices", 0), ("normals", 0x1), ("uvs", 0x2), ("colors", 0x8)]
        given = [(np.asarray(mesh[name]), flag) for name, flag in arrays if name in mesh]
        flags = sum(flag for _, flag in given) + (0x2000 if double else 0x1000) + (0x10 if mesh.get("flat") else 0)
        content = struct.pack("<I", flags) + (mesh.get("name", "mesh").encode() + b"\0" if version == 4 else b"")
        content += struct.pack("<QQ", len(mesh["vertices"]), len(mesh["faces"]))
        content += b"".join(values.astype(real).tobytes() for values, _ in given)
        content += np.asarray(mesh["faces"]).astype("<u4").tobytes()
        starts.append(len(body))
        body += struct.pack("<HH", 0x041C, version) + zlib.compress(content)
    return body + struct.pack(f"<{len(starts)}{'Q' if version == 4 else 'I'}I", *starts, len(starts))


def serialized_square(version: int = 4, *, double: bool = False) -> bytes:
    """Return a file of two squares: one with all attributes, and a bare one of face normals."""
    whole = {
        "vertices": SQUARE,
        "faces": [[0, 1, 2], [0, 2, 3]],
        "normals": np.tile([0.0, 0.6, 0.8], (4, 1)),
        "uvs": SQUARE[:, :2] * 0.5,
        "colors": np.linspace(0.1, 1.2, 12).reshape(4, 3),
        "name": "größe",
    }
    bare = {"vertices": np.add(SQUARE, [0.0, 0.0, 1.0]), "faces": [[2, 1, 0]], "flat": True}
    return serialized_bytes([whole, bare], version, double=double)


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


def sixteen_bits(folder: Path) -> bytes:
    import OpenImageIO as oiio

    file = str(folder / "whole.png")
    out = oiio.ImageOutput.create(file)
    assert out is not None
    out.open(file, oiio.ImageSpec(9, 11, 3, "uint16"))
    out.write_image(np.random.default_rng(7).integers(0, 65536, (11, 9, 3)).astype(np.uint16))
    out.close()
    return Path(file).read_bytes()


XAML = """<Viewport3D xmlns="http://schemas.microsoft.com/winfx/2006/xaml/presentation"><ModelVisual3D><GeometryModel3D>
<GeometryModel3D.Material><DiffuseMaterial><DiffuseMaterial.Brush><SolidColorBrush Color="#FF8000" Opacity="1"/>
</DiffuseMaterial.Brush></DiffuseMaterial></GeometryModel3D.Material><GeometryModel3D.Geometry>
<MeshGeometry3D Positions="0,0,0 1,0,0 1,1,0" Normals="0,0,1 0,0,1 0,0,1" TriangleIndices="0 1 2"/>
</GeometryModel3D.Geometry></GeometryModel3D></ModelVisual3D></Viewport3D>"""

DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created><modified>2020-01-01T00:00:00</modified></asset>
<library_images><image id="img"><init_from>wood.png</init_from></image></library_images>
<library_effects><effect id="fx"><profile_COMMON>
<newparam sid="surf"><surface type="2D"><init_from>img</init_from></surface></newparam>
<newparam sid="samp"><sampler2D><source>surf</source></sampler2D></newparam>
<technique sid="common"><lambert><diffuse><texture texture="samp" texcoord="UV"/></diffuse></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="mat"><instance_effect url="#fx"/></material></library_materials>
<library_geometries><geometry id="geo"><mesh>
<source id="p"><float_array id="pa" count="9">0 0 0 1 0 0 1 1 0</float_array><technique_common>
<accessor source="#pa" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<source id="t"><float_array id="ta" count="6">0 0 1 0 1 0.75</float_array><technique_common>
<accessor source="#ta" count="3" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1" material="m"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#t" offset="1"/><p>0 0 1 1 2 2</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>0 0 5</translate><instance_geometry url="#geo"><bind_material>
<technique_common><instance_material symbol="m" target="#mat"/></technique_common></bind_material></instance_geometry>
</node></visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def zipped(**members: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_", "."), content)
    return data.getvalue()
