"""Textures filtered by the pixel's footprint: less noise at few samples, the same light, nothing near the camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.images import write_image
from torchpt.physics.textures.atlas import Atlas
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings

FILM = {"width": 48, "height": 48, "filter": "box"}


def floor(reflectance: dict[str, Any], **material: Any) -> dict[str, Any]:
    """A floor that reaches to the horizon, in even light."""
    return {
        "camera": {"origin": [0, 1, 0], "target": [0, 0.7, -3], "fov": 60},
        "film": FILM,
        "integrator": {"type": "path", "max_depth": 2},
        "shapes": {
            "floor": {
                "type": "rectangle",
                "transform": [{"scale": 60}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
                "material": {"type": "diffuse", "reflectance": reflectance, **material},
            }
        },
        "lights": {"sky": {"type": "constant", "radiance": 1}},
    }


def squares(filter: str) -> dict[str, Any]:
    return {"type": "checkerboard", "color0": 0.9, "color1": 0.1, "scale": 500, "filter": filter}


def deviation(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt())


def test_a_floor_to_the_horizon():
    truth = torchpt.render(torchpt.load(floor(squares("nearest"))), spp=256)
    noisy, smooth = (
        torchpt.render(torchpt.load(floor(squares(filter))), spp=1, seed=5) for filter in ("nearest", "trilinear")
    )
    far, near = slice(24, 30), slice(44, 48)  # rows: squares smaller than a pixel, and larger
    assert deviation(smooth[far], truth[far]) < 0.45 * deviation(noisy[far], truth[far])
    assert torch.equal(smooth[near], noisy[near])
    # No light comes or goes: what is averaged is the texture.
    many = torchpt.render(torchpt.load(floor(squares("trilinear"))), spp=64, seed=6)
    assert float(many.mean()) == pytest.approx(float(truth.mean()), rel=1e-3)
    assert float(many[far].mean()) == pytest.approx(float(truth[far].mean()), rel=5e-3)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("texture") / "noise.exr"
    texels = torch.rand(33, 64, 3, generator=torch.Generator().manual_seed(1)) * 0.8 + 0.1
    write_image(path, texels)
    return str(path)


def picture(image: str, filter: str, repeats: float = 20) -> dict[str, Any]:
    return {"type": "image", "path": image, "filter": filter, "uv_transform": {"scale": repeats}}


def test_gradients_to_texels(image: str):
    """In float64 against differences: texels near and far, through all sizes of the image."""
    scene = torchpt.load(floor(picture(image, "trilinear", 100)))
    name = "shapes.floor.material.reflectance"
    texels = scene.params[name].double()
    film = {"width": 16, "height": 16, "filter": "box"}

    def value(texels: Tensor) -> Tensor:
        return torchpt.render(
            scene, params={name: texels}, spp=2, film=film, dtype=torch.float64, seed_grad=0, spp_grad=2
        ).sum()

    leaf = texels.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    assert float(gradient.abs().min()) > 0  # the smallest sizes hold all of them
    along = torch.rand(texels.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    with torch.no_grad():
        difference = (value(texels + 1e-5 * along) - value(texels - 1e-5 * along)) / 2e-5
    assert float((gradient * along).sum()) == pytest.approx(float(difference), rel=1e-7)


def test_normal_and_bump_maps_flatten_out(tmp_path: Path):
    """Far away a map's mean is left: of normals about the surface's own, or of heights, the plain surface."""
    noise = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    write_image(tmp_path / "maps.exr", torch.tensor([0.5, 0.5, 0.9]) + noise * torch.tensor([0.8, 0.8, 0.1]))
    for key, scale in (("normal_map", 1.0), ("bump_map", 0.05)):
        tilts = []
        for filter in ("bilinear", "trilinear"):
            map_ = {**picture(str(tmp_path / "maps.exr"), filter), "scale": scale}
            scene = torchpt.load(floor({"type": "checkerboard"}, **{key: map_}))
            wish = {"film": {**FILM, "aovs": ["normal"]}, "integrator": {"type": "aov"}, "render": {"spp": 1}}
            normals = render_scene(scene, settings(scene.description, wish)).layers["normal"]
            tilts.append(float((normals[22:25] - torch.tensor([0.0, 1.0, 0.0])).norm(dim=-1).mean()))
        assert tilts[1] < 0.3 * tilts[0]


def test_sizes_of_shapes_and_copies_count(image: str):
    """The same surface as a rectangle, a mesh and a large copy of a small mesh."""
    corners, uvs = [[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], [[0, 0], [1, 0], [1, 1], [0, 1]]
    mesh = {"type": "mesh", "vertices": corners, "uvs": uvs, "faces": [[0, 1, 2], [0, 2, 3]], "face_normals": True}
    material = {"type": "diffuse", "reflectance": picture(image, "trilinear")}
    scene = floor(picture(image, "trilinear"))
    expected = torchpt.render(torchpt.load(scene), spp=1)
    ways = {
        "mesh": {"floor": {**mesh, "material": material, "transform": [{"scale": 60}]}},
        "copy": {
            "small": {**mesh, "transform": [{"scale": 0.5}, {"translate": [0, -5, 0]}]},
            "floor": {"type": "instance", "of": "small", "material": material, "transform": [{"scale": 60}]},
        },
    }
    for name, shapes in ways.items():
        found = torchpt.render(torchpt.load({**scene, "shapes": shapes}), spp=1)
        close = torch.isclose(found, expected, atol=2e-3).all(-1).float().mean()
        assert close > 0.99, name


@pytest.mark.parametrize("slot", ["opacity", "emission"])
def test_what_is_read_at_points_says_so(slot: str, image: str):
    scene = floor({"type": "checkerboard"}, **{slot: picture(image, "trilinear")})
    with pytest.raises(SceneError, match=rf"{slot}\.filter.*read at points"):
        torchpt.load(scene)
    named = {**scene, "textures": {"noise": picture(image, "trilinear")}}
    named["shapes"] = {
        "floor": {**scene["shapes"]["floor"], "material": {"type": "diffuse", slot: {"texture": "noise"}}}
    }
    loaded = torchpt.load(named)
    world, _ = loaded.world(torch.float32)
    assert not world.textures.filtered and world.geometry.bitangents is None


def test_nothing_is_built_without_it(image: str):
    world, _ = torchpt.load(floor(picture(image, "bilinear"))).world(torch.float32)
    (atlas,) = world.textures.tables
    assert isinstance(atlas, Atlas) and atlas.mipmaps is None and world.geometry.tangents is None
    assert atlas.texels.numel() == 3 * 33 * 64
    world, _ = torchpt.load(floor(picture(image, "trilinear"))).world(torch.float32)
    (atlas,) = world.textures.tables
    assert isinstance(atlas, Atlas)
    assert atlas.texels.numel() == 3 * (33 * 64 + 16 * 32 + 8 * 16 + 4 * 8 + 2 * 4 + 1 * 2 + 1)
    assert np.isfinite(atlas.texels.numpy()).all()
