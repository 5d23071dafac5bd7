"""Textures opened: which numbers a slot gets of which file, what is refused, and what they are called."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import torchpt
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

CAMERA = {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 20}


def scene(materials: dict[str, Any], textures: dict[str, Any] | None = None, **more: Any) -> torchpt.Scene:
    shapes = {name: {"type": "rectangle", "material": name} for name in materials}
    return torchpt.load(
        {"camera": CAMERA, "textures": textures or {}, "materials": materials, "shapes": shapes, **more}
    )


@pytest.fixture
def png(tmp_path: Path) -> str:
    path = tmp_path / "a.png"
    values = np.random.default_rng(1).integers(0, 256, (4, 6, 4), np.uint8)
    iio.imwrite(path, values)
    return str(path)


def test_colours_are_decoded_and_numbers_are_not(png: str):
    image = {"type": "image", "path": png}
    params = scene({"m": {"type": "principled", "base_color": image, "roughness": image}}).params
    stored = iio.imread(png).astype(np.float32) / 255
    assert torch.allclose(params["materials.m.roughness"], torch.from_numpy(stored))
    decoded = torchpt.read_image(png)
    assert torch.allclose(params["materials.m.base_color"], decoded, atol=1e-6)
    assert torch.equal(params["materials.m.base_color"][..., 3], torch.from_numpy(stored[..., 3]))


def test_one_texture_for_both(png: str):
    textures = {"t": {"type": "image", "path": png}}
    material = {"type": "principled", "base_color": {"texture": "t"}, "roughness": {"texture": "t", "channel": "g"}}
    material["opacity"] = {"texture": "t", "channel": "a"}
    found = scene({"m": material}, textures)
    names = [name for name in found.params if name.startswith("textures.")]
    assert names == ["textures.t", "textures.t.stored"]


@pytest.mark.parametrize(("space", "linear"), [("srgb", False), ("linear", True)])
def test_the_space_can_be_said(png: str, space: str, linear: bool):
    image = {"type": "image", "path": png, "colorspace": space}
    params = scene({"m": {"type": "principled", "base_color": image, "roughness": image}}).params
    for key in ("base_color", "roughness"):
        assert torch.allclose(params[f"materials.m.{key}"], torchpt.read_image(png, linear=linear), atol=1e-6)


def test_sixteen_bits_are_linear(tmp_path: Path):
    values = np.random.default_rng(2).integers(0, 65536, (3, 5), np.uint16)
    iio.imwrite(tmp_path / "a.png", values)
    params = scene({"m": {"type": "diffuse", "reflectance": {"type": "image", "path": str(tmp_path / "a.png")}}}).params
    assert np.allclose(params["materials.m.reflectance"].numpy()[..., 0], values / 65535, atol=1e-6)


@pytest.mark.parametrize(
    ("material", "key", "part"),
    [
        (
            {"type": "diffuse", "reflectance": {"scale": 2}},
            "materials.m.reflectance",
            "numbers in 0..1 in the texels of",
        ),
        ({"type": "principled", "metallic": {"scale": -1}}, "materials.m.metallic", "numbers in 0..1"),
        ({"type": "dielectric", "int_ior": {"scale": 1e4}}, "materials.m.int_ior", "numbers in 0.001..1000"),
    ],
)
def test_texels_out_of_range(png: str, material: dict[str, Any], key: str, part: str):
    made = {k: {"type": "image", "path": png, **v} if isinstance(v, dict) else v for k, v in material.items()}
    with pytest.raises(torchpt.SceneError) as caught:
        scene({"m": made})
    assert caught.value.key == key and part in str(caught.value)


def test_files_that_are_not_there_or_lack_alpha(tmp_path: Path):
    with pytest.raises(torchpt.AssetError, match="no such file, named by textures.t.path"):
        scene({"m": {"type": "diffuse", "reflectance": {"texture": "t"}}}, {"t": {"type": "image", "path": "none.png"}})
    iio.imwrite(tmp_path / "a.png", np.zeros((2, 2, 3), np.uint8))
    image = {"type": "image", "path": str(tmp_path / "a.png"), "channel": "a"}
    with pytest.raises(torchpt.AssetError, match=r"has no alpha channel, asked for by materials.m.opacity"):
        scene({"m": {"type": "diffuse", "opacity": image}})
    (tmp_path / "b.png").write_text("no picture")
    bad = {"type": "image", "path": str(tmp_path / "b.png")}
    with pytest.raises(
        torchpt.AssetError, match=r"b\.png: cannot be read .*, named by materials\.m\.reflectance\.path$"
    ):
        scene({"m": {"type": "diffuse", "reflectance": bad}})


def test_info_says_what_is_read(png: str):
    image = {"type": "image", "path": png, "scale": 0.9}
    found = scene({"m": {"type": "diffuse", "reflectance": image}, "n": {"type": "diffuse"}})
    from torchpt.scene.formats.description import settings

    info = found.info(settings(found.description))
    assert info["built"]["bsdfs"] == {"diffuse, textured: reflectance": 1, "diffuse": 1}
    assert info["built"]["textures"]["reads"] == 1
    assert "normal and bump maps" in info["left_out"]
    assert not any(word.startswith("textures") for word in info["left_out"])


@pytest.mark.slow
def test_a_texture_of_one_colour_is_that_colour():
    """The same picture whether numbers or textures give it, in every slot of every model that takes a number."""
    kinds: dict[str, dict[str, Any]] = {
        "phong": {"type": "phong", "diffuse": 0.3, "specular": 0.4, "exponent": 20.0},
        "gold": {"type": "roughconductor", "eta": [0.2, 0.5, 1.3], "k": [3, 2.5, 2], "alpha": 0.3},
        "brushed": {"type": "roughconductor", "reflectance": 0.7, "alpha_u": 0.1, "alpha_v": 0.4},
        "glass": {"type": "dielectric", "int_ior": 1.4, "ext_ior": 1.1},
        "frosted": {"type": "roughdielectric", "int_ior": 1.4, "alpha": 0.2, "specular_transmittance": 0.8},
        "satin": {"type": "roughplastic", "diffuse_reflectance": 0.4, "alpha": 0.1, "int_ior": 1.6},
        "plastic": {"type": "plastic", "diffuse_reflectance": 0.4, "specular_reflectance": 0.9},
        "nonmetal": {"type": "nonmetal", "base_color": 0.4, "specular": 0.1, "roughness": 0.4},
        "microfacet": {"type": "microfacet", "diffuse": 0.4, "specular": 0.5, "roughness": 0.4, "ior": 1.6},
        "paint": {"type": "principled", "base_color": 0.5, "roughness": 0.4, "metallic": 0.3, "specular": 0.6,
                  "spec_tint": 0.2, "anisotropic": 0.5, "sheen": 0.3, "sheen_tint": 0.4, "clearcoat": 0.5,
                  "clearcoat_gloss": 0.6, "spec_trans": 0.4, "flatness": 0.2},
        "mixed": {"type": "blend", "weight": 0.3, "a": {"type": "diffuse", "reflectance": 0.6},
                  "b": {"type": "roughconductor", "material": "Au", "alpha": 0.2}},
        "veil": {"type": "diffuse", "reflectance": 0.6, "opacity": 0.4},
        "gone": {"type": "blend", "weight": 0.3, "a": {"type": "diffuse"}, "b": {"type": "null"}},
    }  # fmt: skip

    def squares(value: Any) -> Any:
        if isinstance(value, dict):
            fixed = ("alpha", "int_ior", "ext_ior") if value.get("type") == "roughplastic" else ()
            return {key: item if key in fixed else squares(item) for key, item in value.items()}
        if isinstance(value, float | int) or (isinstance(value, list) and value):
            return {"type": "checkerboard", "color0": value, "color1": value}
        return value

    for name, material in kinds.items():
        pictures = []
        for m in (material, squares(material)):
            shape = {"type": "sphere", "material": m}
            found = torchpt.load({"camera": CAMERA, "shapes": {"s": shape}, "lights": {"sky": {"type": "constant"}}})
            film = {"width": 16, "height": 16, "filter": "box"}
            keys = {"type": "path", "max_depth": 4}
            pictures.append(torchpt.render(found, spp=16, film=film, integrator=keys))
        # A ray through a texture of opacity or of a lobe's chance may round to the other side of a choice.
        assert torch.allclose(pictures[0], pictures[1], rtol=1e-3, atol=2e-3), name


def test_vertex_colours_of_surfaces_without_are_white():
    found = scene(
        {"m": {"type": "diffuse", "reflectance": {"type": "vertex_color"}}}, lights={"sky": {"type": "constant"}}
    )
    image = torchpt.render(found, spp=1, film={"width": 4, "height": 4, "filter": "box"}, integrator="aov")
    assert torch.allclose(image, torch.ones_like(image))


def test_gradients_reach_texels_and_colours(png: str):
    textures = {"t": {"type": "image", "path": png}, "c": {"type": "checkerboard", "scale": 2}}
    found = scene(
        {"m": {"type": "principled", "base_color": {"texture": "t"}, "roughness": {"texture": "c"}}},
        textures,
        lights={"sky": {"type": "constant"}},
        film={"width": 8, "height": 8, "filter": {"type": "box"}},
        integrator={"type": "path", "max_depth": 2},
    )
    texels = found.params["textures.t"].double().clamp(0.01, 0.99).requires_grad_()  # so that a step stays within 0..1
    color = found.params["textures.c.color0"].double().requires_grad_()

    def loss(texels: torch.Tensor, color: torch.Tensor) -> torch.Tensor:
        params = {"textures.t": texels, "textures.c.color0": color}
        image = torchpt.render(found, spp=32, seed=1, seed_grad=1, params=params, dtype=torch.float64, device="cpu")
        return (image * torch.linspace(0, 1, 8, dtype=torch.float64)[:, None]).sum()

    loss(texels, color).backward()
    assert texels.grad is not None and color.grad is not None
    assert float(texels.grad[..., 3].abs().max()) == 0  # alpha says nothing here
    generator = torch.Generator().manual_seed(3)
    step = torch.rand(texels.shape, generator=generator, dtype=torch.float64) * 1e-3
    with torch.no_grad():
        low, high = loss(texels - step, color), loss(texels + step, color)
    assert float((texels.grad * step).sum() * 2) == pytest.approx(
        float(high - low), rel=2e-2
    )  # which lobe is drawn moves too


def test_the_uv_layer_needs_no_texture():
    shapes = {"s": {"type": "rectangle"}}
    found = torchpt.load({"camera": {**CAMERA, "fov": 20}, "shapes": shapes})
    film = {"width": 64, "height": 64, "filter": "box", "aovs": ["uv"]}
    image = torchpt.render(found, spp=16, film=film, integrator="aov")
    across = torch.tan(torch.tensor(10 * torch.pi / 180)) * 4 * ((torch.arange(64) + 0.5) / 32 - 1)
    expected = (across + 1) / 2
    assert torch.allclose(image[..., 0], expected.expand(64, 64), atol=4e-3)
    assert torch.allclose(image[..., 1], (1 - expected)[:, None].expand(64, 64), atol=4e-3)
    assert float(image[..., 2].abs().max()) == 0


def test_images_are_capped_unless_said_otherwise(png: str, monkeypatch: pytest.MonkeyPatch):
    image = {"type": "image", "path": png}  # 6 x 4
    with pytest.raises(torchpt.AssetError, match="6 x 4 pixels.* more than 23 pixels are not read"):
        scene({"m": {"type": "diffuse", "reflectance": {**image, "max_pixels": 23}}})
    scene({"m": {"type": "diffuse", "reflectance": {**image, "max_pixels": 24}}})
    # Whatever another texture of the same file may do.
    with pytest.raises(torchpt.AssetError, match="more than 23 pixels"):
        material = {"type": "principled", "base_color": image, "roughness": {**image, "max_pixels": 23}}
        scene({"m": material})
    monkeypatch.setattr("torchpt.physics.textures.kinds.image.MAX_PIXELS", 10)
    with pytest.raises(torchpt.AssetError, match="more than 10 pixels"):
        scene({"m": {"type": "diffuse", "reflectance": image}})
    scene({"m": {"type": "diffuse", "reflectance": {**image, "max_pixels": 24}}})
    with pytest.raises(torchpt.SceneError, match=r"max_pixels: expected a whole number"):
        scene({"m": {"type": "diffuse", "reflectance": {**image, "max_pixels": 0}}})


@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0, 3.0])
def test_normal_strength(tmp_path: Path, strength: float):
    """The lean of every normal is multiplied: of ``2 c - 1`` the parts along the surface."""
    iio.imwrite(tmp_path / "n.png", np.full((2, 2, 3), (153, 102, 230), np.uint8))
    flat = {"type": "image", "path": str(tmp_path / "n.png")}
    other = {"type": "diffuse", "normal_map": flat}  # of the same group: its strength is 1
    found = scene({"a": {"type": "diffuse", "normal_map": flat, "normal_strength": strength}, "b": other})
    assert ("materials.a.normal_strength" in found.params) == (strength != 1.0)
    wish = {"film": {"width": 4, "height": 4, "aovs": ["normal"]}, "integrator": {"type": "aov"}, "render": {"spp": 1}}
    normal = render_scene(found, settings(found.description, wish)).layers["normal"][2, 2]
    x, y, z = (2 * c / 255 - 1 for c in (153, 102, 230))
    expected = torch.tensor([strength * x, strength * y, z])
    assert torch.allclose(normal, expected / expected.norm(), atol=1e-6)
