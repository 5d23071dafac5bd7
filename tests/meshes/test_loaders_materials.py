"""Materials of mesh files: each rule of docs/reference/assets.md, as the dict a user could have written."""

from __future__ import annotations

import base64
import json
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from torchpt.core.errors import AssetError
from torchpt.images import EncodedImage
from torchpt.physics.bsdfs import KINDS
from torchpt.scene.formats.materials import check_material, read_material
from torchpt.scene.meshes import MeshPart, load_mesh


def accepted(material: dict[str, Any]) -> None:
    """A scene file may say the same."""
    check_material(read_material(material, "m", KINDS, None), "m", {}, {}, None)


# --- MTL


def mtl(folder: Path, text: str) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The material and the ignored keys of one MTL text."""
    (folder / "a.mtl").write_text(f"newmtl m\n{text}")
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    (part,) = load_mesh(folder / "a.obj")
    assert part.material is not None
    return part.material.material, part.material.ignored


def picture(folder: Path, name: str) -> str:
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_bytes(b"")
    return str(folder / name)


def roughness_of(exponent: float) -> Any:
    return pytest.approx((2 / (exponent + 2)) ** 0.25)


MTL: dict[str, tuple[str, dict[str, Any], tuple[str, ...]]] = {
    "nothing": ("", {"type": "diffuse", "reflectance": [0.5, 0.5, 0.5]}, ()),
    "diffuse": ("Ka 1 1 1\nKd .1 .2 .3\nillum 1", {"type": "diffuse", "reflectance": [0.1, 0.2, 0.3]}, ()),
    "one number is grey": ("Kd .25", {"type": "diffuse", "reflectance": [0.25] * 3}, ()),
    "no highlight asked for": ("Kd 1 1 1\nKs 1 1 1\nillum 1", {"type": "diffuse", "reflectance": [1, 1, 1]}, ("Ks",)),
    "highlight": (
        "Kd .1 .2 .3\nKs .5 .5 .5\nNs 30",
        {"type": "principled", "base_color": [0.1, 0.2, 0.3], "specular": 0.5, "roughness": roughness_of(30)},
        (),
    ),
    "hue of the highlight": (
        "Kd 0 0 0\nKs .3 .6 .9",
        {"type": "principled", "base_color": [0, 0, 0], "specular": pytest.approx(0.6), "roughness": 0.5},
        ("Ks (its hue)",),
    ),
    "mirror": ("Kd 0 0 0\nKs .9 .8 .7\nillum 5", {"type": "conductor", "reflectance": [0.9, 0.8, 0.7]}, ()),
    "glass": ("Ni 1.5\nillum 7\nd 0.2", {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, ()),
    "glass with what it does not use": (
        "Kd 1 1 1\nKs 1 1 1\nNi 1.5\nillum 7\nPm 1\nPs .5\nPc 0",
        {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0},
        ("Ks", "Pm", "Ps"),
    ),
    "rough tinted glass": (
        "Ni 1.33\nillum 6\nd 0.5\nTf .5 .6 .7\nPr .3",
        {
            "type": "roughdielectric",
            "int_ior": 1.33,
            "ext_ior": 1.0,
            "roughness": 0.3,
            "specular_transmittance": [0.5, 0.6, 0.7],
        },
        (),
    ),
    "a pane that is there in part": (
        "Kd 1 1 1\nNi 1.5\nillum 9\nd 0.25",
        {"type": "diffuse", "reflectance": [1, 1, 1], "opacity": 0.25},
        (),
    ),
    "Tr": ("Kd 1 1 1\nTr 0.25", {"type": "diffuse", "reflectance": [1, 1, 1], "opacity": 0.75}, ()),
    "Tr in the place of d": ("Kd 1 1 1\nTr 1", {"type": "diffuse", "reflectance": [1] * 3}, ("Tr 1 (taken for d 1)",)),
    "d before Tr": ("Kd 1 1 1\nTr 1\nd 1", {"type": "diffuse", "reflectance": [1, 1, 1]}, ()),
    "halo": ("Kd 1 1 1\nd -halo 0.5", {"type": "diffuse", "reflectance": [1] * 3, "opacity": 0.5}, ("d -halo",)),
    "emission": ("Kd 0 0 0\nKe 3 2 1", {"type": "diffuse", "reflectance": [0, 0, 0], "emission": [3, 2, 1]}, ()),
    "PBR": (
        "Kd .1 .2 .3\nKs 0 0 0\nPr .25\nPm 1\nPs .5\nPc .75\nPcr .1\naniso .3\nanisor .2\nNi 1.4",
        {
            "type": "principled",
            "base_color": [0.1, 0.2, 0.3],
            "roughness": 0.25,
            "metallic": 1,
            "sheen": 0.5,
            "clearcoat": 0.75,
            "clearcoat_gloss": pytest.approx(0.09 / 0.099),
            "anisotropic": 0.3,
            "eta": 1.4,
        },
        ("anisor",),
    ),
    "PBR without roughness": (
        "Kd 1 1 1\nPm .5\nKs .5 .5 .5\nNs 100",
        {"type": "principled", "base_color": [1, 1, 1], "metallic": 0.5, "roughness": roughness_of(100)},
        ("Ks",),
    ),
    "out of range": (
        "Kd 2 1 1\nPr 1.5",
        {"type": "principled", "base_color": [1, 1, 1], "roughness": 1},
        ("Pr outside 0..1", "Kd above 1"),
    ),
    "not read": (
        "Kd 1 1 1\nKs spectral a.rfl\ndisp a.png\nrefl -type sphere b.png",
        {"type": "diffuse", "reflectance": [1, 1, 1]},
        ("Ks spectral", "disp", "refl"),
    ),
}


@pytest.mark.parametrize("name", MTL)
def test_mtl_rules(name: str, tmp_path: Path) -> None:
    text, expected, ignored = MTL[name]
    found = mtl(tmp_path, text)
    assert found == (expected, ignored)
    accepted(found[0])


def test_mtl_maps(tmp_path: Path) -> None:
    color, rough, relief = (picture(tmp_path, name) for name in ("a b (1).png", "deep/r.png", "hills.png"))
    text = (
        "Kd 0 0 0\nmap_Kd a b (1).png\nmap_Pr -imfchan g -clamp on deep\\r.png\nmap_Pm C:\\elsewhere\\deep/../hills.png\n"
        "map_Ke hills.png\nbump -bm 0.3 -s 2 3 1 -o .1 hills.png\nmap_Ks -t 1 1 1 hills.png\n"
    )
    material, ignored = mtl(tmp_path, text)
    assert material == {
        "type": "principled",
        "base_color": {"type": "image", "path": color},
        "roughness": {"type": "image", "path": rough, "channel": "g", "wrap": "clamp"},
        "metallic": {"type": "image", "path": relief, "channel": "luminance"},
        "emission": {"type": "image", "path": relief},
        "bump_map": {
            "type": "image",
            "path": relief,
            "scale": 0.3,
            "channel": "luminance",
            "uv_transform": {"scale": [2, 3], "translate": [0.1, -2]},
        },
    }
    assert ignored == ("map_Ks -t", "map_Ks")


@pytest.mark.parametrize(("key", "name"), [("norm", "hills.png"), ("map_Bump", "hills_normal.png")])
def test_mtl_strength_of_normals(tmp_path: Path, key: str, name: str) -> None:
    path = picture(tmp_path, name)
    material, ignored = mtl(tmp_path, f"{key} -bm 0.3 {name}\n")
    assert material["normal_map"] == {"type": "image", "path": path} and material["normal_strength"] == 0.3
    assert ignored == ()
    accepted(material)
    material, ignored = mtl(tmp_path, f"{key} -bm -1 {name}\n")
    assert "normal_strength" not in material and ignored == (f"{key} -bm",)


def test_mtl_factors_multiply_maps(tmp_path: Path) -> None:
    file = picture(tmp_path, "a.png")
    material, _ = mtl(tmp_path, "Kd .5 .5 .5\nmap_Kd a.png\nKs .2 .2 .2\nmap_Ks a.png\nNs 0\nKe 1 2 3\nmap_Ke a.png")
    assert material == {
        "type": "principled",
        "base_color": {"type": "image", "path": file, "scale": 0.5},
        "specular": {"type": "image", "path": file, "scale": pytest.approx(0.2), "channel": "luminance"},
        "roughness": 1.0,
        "emission": {"type": "image", "path": file, "scale": [1, 2, 3]},
    }


@pytest.mark.parametrize(
    ("lines", "opacity"),
    [
        ("map_Kd leaf.png\nmap_d leaf.png", {"channel": "a"}),  # the alpha of the colours
        ("map_d leaf.png", {"channel": "luminance"}),
        ("d 0.5\nmap_d -imfchan m leaf.png", {"channel": "a", "scale": 0.5}),
        ("d 0\nmap_d leaf.png", {"channel": "luminance"}),
    ],
)
def test_mtl_opacity_maps(tmp_path: Path, lines: str, opacity: dict[str, Any]) -> None:
    file = picture(tmp_path, "leaf.png")
    (tmp_path / "leaf.png").write_bytes(png("RGBA"))
    assert mtl(tmp_path, lines)[0]["opacity"] == {"type": "image", "path": file, **opacity}


@pytest.mark.parametrize(
    ("line", "key"),
    [("norm x.png", "normal_map"), ("map_Bump x.png", "bump_map"), ("map_Bump wall_normal.png", "normal_map")],
)
def test_mtl_relief(tmp_path: Path, line: str, key: str) -> None:
    for name in ("x.png", "wall_normal.png"):
        picture(tmp_path, name)
    assert mtl(tmp_path, line)[0][key]["path"] == str(tmp_path / line.split()[1])


def test_unused_materials_need_no_pictures(tmp_path: Path) -> None:
    assert mtl(tmp_path, "Kd 1 1 1\nnewmtl other\nmap_Kd gone.png")[0]["type"] == "diffuse"


# --- glTF


def png(mode: str = "RGB") -> bytes:
    file = BytesIO()
    Image.new(mode, (2, 2)).save(file, "PNG")
    return file.getvalue()


def gltf(folder: Path, material: dict[str, Any] | None, ending: str = "gltf", **changes: Any) -> list[MeshPart]:
    """The parts of a triangle with uv and one material; `textures` 0 is a data: URI."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    uvs = np.array([[0, 0], [65535, 0], [0, 65535]], "<u2").tobytes()
    colors = bytes([255, 0, 0, 0, 51, 255, 255, 0, 0, 0, 0, 255])
    body = points + uvs + colors
    uri = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
            {"bufferView": 1, "componentType": 5123, "type": "VEC2", "count": 3, "normalized": True},
            {"bufferView": 2, "componentType": 5121, "type": "VEC4", "count": 3, "normalized": True},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "buffers": [{"byteLength": len(body)} if ending == "glb" else {"byteLength": len(body), "uri": uri}],
        "images": [{"uri": "data:image/png;base64," + base64.b64encode(png()).decode(), "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        **changes,
    }
    if material is not None:
        document["materials"] = [material]
        for primitive in document["meshes"][0]["primitives"]:
            primitive["material"] = 0
    text = json.dumps(document).encode()
    if ending == "glb":
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
        text = b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
    (folder / f"a.{ending}").write_bytes(text)
    return load_mesh(folder / f"a.{ending}")


def only(parts: list[MeshPart]) -> tuple[dict[str, Any], tuple[str, ...]]:
    (part,) = parts
    assert part.material is not None
    return part.material.material, part.material.ignored


def pbr(**keys: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": keys}


def khr(name: str, **keys: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": {f"KHR_materials_{name}": keys}}


PLAIN = {"type": "principled", "base_color": [1, 1, 1], "roughness": 1}

GLTF: dict[str, tuple[dict[str, Any], dict[str, Any], tuple[str, ...]]] = {
    "defaults": ({}, {**PLAIN, "metallic": 1}, ()),
    "factors": (
        pbr(baseColorFactor=[0.1, 0.2, 0.3, 1], metallicFactor=0.25, roughnessFactor=0.5),
        {"type": "principled", "base_color": [0.1, 0.2, 0.3], "metallic": 0.25, "roughness": 0.5},
        (),
    ),
    "emission": (
        {
            **pbr(metallicFactor=0),
            "emissiveFactor": [1, 0.5, 0],
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
        },
        {**PLAIN, "emission": [1, 0.5, 0], "emission_strength": 4},
        (),
    ),
    "mask": (
        {**pbr(metallicFactor=0, baseColorFactor=[1, 1, 1, 0.75]), "alphaMode": "MASK", "alphaCutoff": 0.3},
        {**PLAIN, "opacity": 0.75, "alpha_cutoff": 0.3},
        (),
    ),
    "blend": (
        {**pbr(metallicFactor=0, baseColorFactor=[1, 1, 1, 0.75]), "alphaMode": "BLEND", "doubleSided": True},
        {**PLAIN, "opacity": 0.75},
        (),
    ),
    "opaque": (pbr(metallicFactor=0, baseColorFactor=[1, 1, 1, 0.75]), PLAIN, ()),
    "transmission": (khr("transmission", transmissionFactor=0.9), {**PLAIN, "spec_trans": 0.9}, ()),
    "ior": (khr("ior", ior=1.33), {**PLAIN, "eta": 1.33}, ()),
    "clearcoat": (
        khr("clearcoat", clearcoatFactor=0.5, clearcoatRoughnessFactor=0.1, clearcoatNormalTexture={"index": 0}),
        {**PLAIN, "clearcoat": 0.5, "clearcoat_gloss": pytest.approx(0.09 / 0.099)},
        ("KHR_materials_clearcoat.clearcoatNormalTexture",),
    ),
    "sheen": (
        khr("sheen", sheenColorFactor=[0.8, 0.4, 0.4], sheenRoughnessFactor=0.5),
        {**PLAIN, "sheen": 0.8, "sheen_tint": 0.5},
        ("KHR_materials_sheen.sheenRoughnessFactor", "KHR_materials_sheen (its hue: that of the base colour)"),
    ),
    "specular": (khr("specular", specularFactor=0.5), {**PLAIN, "specular": pytest.approx(0.25)}, ()),
    "specular above what principled has": (
        khr("specular", specularColorFactor=[4, 4, 4]),
        {**PLAIN, "eta": pytest.approx(1.4 / 0.6)},
        (),
    ),
    "unlit": (
        khr("unlit"),
        {"type": "diffuse", "reflectance": [1, 1, 1]},
        ("KHR_materials_unlit (rendered as diffuse)",),
    ),
    "not read": (
        {**khr("iridescence", x=1), "occlusionTexture": {"index": 0}},
        PLAIN,
        ("KHR_materials_iridescence", "occlusionTexture"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GLTF)
def test_gltf_rules(name: str, tmp_path: Path) -> None:
    material, expected, ignored = GLTF[name]
    found = only(gltf(tmp_path, material))
    assert found == (expected, ignored)
    accepted(found[0])


def test_gltf_textures_multiply_factors(tmp_path: Path) -> None:
    image = {"index": 0}
    material = {
        **pbr(
            baseColorFactor=[1, 0.5, 0.5, 0.5],
            baseColorTexture=image,
            metallicRoughnessTexture=image,
            roughnessFactor=0.5,
        ),
        "normalTexture": {"index": 0, "scale": 0.7},
        "emissiveFactor": [1, 1, 1],
        "emissiveTexture": image,
        "alphaMode": "BLEND",
        "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1, "transmissionTexture": image}},
    }
    alpha = [{"uri": "data:image/png;base64," + base64.b64encode(png("RGBA")).decode()}]
    found, ignored = only(gltf(tmp_path, material, images=alpha))
    path = found["base_color"]["path"]
    assert isinstance(path, EncodedImage) and path.data == png("RGBA") and path.label.endswith("a.gltf: images 0")
    entry = {"type": "image", "path": path}
    colour = {**entry, "colorspace": "srgb"}  # whatever its number of bits
    assert found == {
        "type": "principled",
        "base_color": {**colour, "scale": [1, 0.5, 0.5]},
        "roughness": {**entry, "scale": 0.5, "channel": "g"},
        "metallic": {**entry, "channel": "b"},
        "spec_trans": {**entry, "channel": "r"},
        "normal_map": entry,
        "normal_strength": 0.7,
        "emission": colour,
        "opacity": {**entry, "scale": 0.5, "channel": "a"},
    }
    assert ignored == ()
    found, _ = only(gltf(tmp_path, material))  # a picture without alpha
    assert found["opacity"] == 0.5


def test_gltf_samplers_and_transforms(tmp_path: Path) -> None:
    moved = {"KHR_texture_transform": {"offset": [0.1, 0.2], "rotation": np.pi / 2, "scale": [2, 3]}}
    material = pbr(baseColorTexture={"index": 0, "extensions": moved}, metallicFactor=0)
    changes: dict[str, Any] = {
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}],
        "extensionsRequired": ["KHR_texture_transform"],
    }
    found, ignored = only(gltf(tmp_path, material, **changes))
    found["base_color"].pop("path")
    assert found["base_color"] == {
        "type": "image",
        "wrap": "clamp",
        "filter": "nearest",
        "colorspace": "srgb",
        "uv_transform": {"scale": [2, 3], "rotate": pytest.approx(-90), "translate": [0.1, 0.2]},
    }
    assert ignored == ("baseColorTexture: wrapT (both directions wrap as wrapS)",)


def test_gltf_pictures_that_are_not_read(tmp_path: Path) -> None:
    material = {**pbr(baseColorTexture={"index": 0, "texCoord": 1}, metallicFactor=0), "normalTexture": {"index": 1}}
    textures = [{"source": 0}, {"extensions": {"EXT_texture_webp": {"source": 0}}}]
    found, ignored = only(gltf(tmp_path, material, textures=textures))
    assert found == PLAIN
    assert ignored == (
        "baseColorTexture (its texture coordinates are not TEXCOORD_0)",
        "normalTexture (EXT_texture_webp)",
    )


def test_gltf_vertex_colours(tmp_path: Path) -> None:
    meshes = [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 2, "TEXCOORD_1": 1}}]}]
    (part,) = gltf(tmp_path, pbr(baseColorFactor=[0.5, 1, 1, 1], metallicFactor=0), meshes=meshes)
    assert part.material is not None and part.material.material["base_color"] == {"type": "vertex_color"}
    assert part.colors is not None and part.ignored == ("TEXCOORD_1",)
    np.testing.assert_allclose(part.colors, [[0.5, 0, 0], [0.1, 1, 1], [0, 0, 0]])
    del meshes[0]["primitives"][0]["material"]  # pyright: ignore[reportArgumentType]
    (part,) = gltf(tmp_path, None, meshes=meshes)
    assert part.material is not None and part.material.material["reflectance"] == {"type": "vertex_color"}


@pytest.mark.parametrize("ending", ["gltf", "glb"])
def test_gltf_files_beside_it_and_inside_it(tmp_path: Path, ending: str) -> None:
    (tmp_path / "the colours.png").write_bytes(png())
    found, _ = only(gltf(tmp_path, pbr(baseColorTexture={"index": 0}), ending, images=[{"uri": "the%20colours.png"}]))
    file = str(tmp_path / "the colours.png")
    assert found["base_color"] == {"type": "image", "path": file, "colorspace": "srgb"}
    with pytest.raises(AssetError, match="images 0: the file 'gone.png' is missing"):
        gltf(tmp_path, pbr(baseColorTexture={"index": 0}), ending, images=[{"uri": "gone.png"}])


def test_gltf_normalized_coordinates(tmp_path: Path) -> None:
    (part,) = gltf(tmp_path, None)
    np.testing.assert_array_equal(part.uvs, [[0, 0], [1, 0], [0, 1]])
    assert part.material is None


def test_gltf_sparse_accessors(tmp_path: Path) -> None:
    """The second vertex of three is moved, then all three come from sparse rows alone."""
    index, points = np.array([1, 0], "<u2").tobytes(), np.array([[9, 8, 7], [1, 2, 3]], "<f4").tobytes()
    uri = "data:;base64," + base64.b64encode(np.eye(3, dtype="<f4").tobytes() + index + points).decode()
    changes: dict[str, Any] = {
        "buffers": [{"byteLength": 64, "uri": uri}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 4},
            {"buffer": 0, "byteOffset": 40, "byteLength": 24},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    }
    rows = {"indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 2}}
    base = {"componentType": 5126, "type": "VEC3", "count": 3, "sparse": {"count": 1, **rows}}
    (part,) = gltf(tmp_path, None, accessors=[{**base, "bufferView": 0}], **changes)
    np.testing.assert_array_equal(part.vertices, [[1, 0, 0], [9, 8, 7], [0, 0, 1]])
    (part,) = gltf(tmp_path, None, accessors=[{**base, "sparse": {"count": 2, **rows}}], **changes)
    np.testing.assert_array_equal(part.vertices, [[1, 2, 3], [9, 8, 7], [0, 0, 0]])
    bad = {**base, "bufferView": 0, "count": 1}
    with pytest.raises(AssetError, match="sparse has an index outside 0..0"):
        gltf(tmp_path, None, accessors=[bad], **changes)


def test_gltf_extensions_are_named_or_refused(tmp_path: Path) -> None:
    (part,) = gltf(tmp_path, {}, extensionsUsed=["KHR_xmp_json_ld", "KHR_materials_ior"], cameras=[{}])
    assert part.ignored == ("cameras", "KHR_xmp_json_ld")
    with pytest.raises(AssetError, match="a.gltf: requires the extension KHR_xmp_json_ld, which is not read"):
        gltf(tmp_path, {}, extensionsRequired=["KHR_xmp_json_ld"])


@pytest.mark.parametrize(
    ("material", "problem"),
    [
        (pbr(baseColorFactor=[2, 0, 0, 1]), "materials 0: baseColorFactor '2' is no number in 0..1"),
        (pbr(baseColorFactor=[1, 1, 1]), "materials 0: baseColorFactor .* is not 4 numbers"),
        (pbr(roughnessFactor="rough"), "materials 0: roughnessFactor 'rough' is no number"),
        (pbr(baseColorTexture={"index": 7}), "textures 7 does not exist"),
        (pbr(baseColorTexture=3), r"materials\[0\].pbrMetallicRoughness.baseColorTexture: expected an object, got 3"),
        ({"alphaMode": "SOLID"}, "materials 0: alphaMode 'SOLID'"),
        ({"emissiveFactor": [float("nan"), 0, 0]}, "emissiveFactor 'nan' is no number"),
    ],
)
def test_gltf_malformed_materials(tmp_path: Path, material: dict[str, Any], problem: str) -> None:
    with pytest.raises(AssetError, match=problem) as caught:
        gltf(tmp_path, material)
    assert "\n" not in str(caught.value)


# --- PLY


@pytest.mark.parametrize(("kind", "row"), [("uchar", "255 51 0"), ("float", "1 0.2 0")])
@pytest.mark.parametrize("names", ["u v", "s t", "texture_u texture_v"])
def test_ply_colours_and_coordinates(tmp_path: Path, kind: str, row: str, names: str) -> None:
    u, v = names.split()
    header = "".join(f"property float {name}\n" for name in ("x", "y", "z", u, v))
    header += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    text = f"ply\nformat ascii 1.0\nelement vertex 3\n{header}element face 1\nproperty list uchar int vertex_indices\n"
    rows = "".join(f"{point} {row}\n" for point in ("0 0 0 0 0", "1 0 0 1 0", "0 1 0 0 0.5"))
    (tmp_path / "a.ply").write_text(f"{text}end_header\n{rows}3 0 1 2\n")
    (part,) = load_mesh(tmp_path / "a.ply")
    assert part.colors is not None and part.uvs is not None
    np.testing.assert_allclose(part.colors, [[1, 0.2, 0]] * 3)
    np.testing.assert_allclose(part.uvs, [[0, 0], [1, 0], [0, 0.5]])
    assert part.material is not None
    assert part.material.material == {"type": "diffuse", "reflectance": {"type": "vertex_color"}}
