"""What a gradient leaves out is found on any device."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch

import torchpt
from torchpt.core.tree import map_leaves
from torchpt.gradients.edges import left_out
from torchpt.physics.cameras import Camera
from torchpt.scene.formats.description import settings


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_camera_is_asked_about_points_on_its_own_device(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on `meta` are refused beside those of another device, as on CUDA."""
    camera = {"type": kind, "origin": [0, 0, 4], "target": [0, 0, 0]}
    scene = torchpt.load({"camera": camera, "lights": {"sky": {"type": "constant"}}}, "cpu")
    wish = settings(scene.description)
    expected, made = left_out(scene, wish), scene.camera

    def away(*args: Any) -> Camera:
        return map_leaves(lambda tensor: tensor.to("meta"), made(*args))

    monkeypatch.setattr(scene, "camera", away)
    monkeypatch.setattr(scene, "device", torch.device("meta"))
    assert left_out(scene, wish) == expected


def warned(material: dict[str, Any], name: str) -> str:
    """Return what the warning says of a gradient by a parameter of a ball, nothing where there is none."""
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0]},
            "film": {"width": 2, "height": 2},
            "lights": {"sky": {"type": "constant"}},
            "shapes": {"ball": {"type": "sphere", "material": material}},
        },
        "cpu",
    )
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always", torchpt.EdgeWarning)
        torchpt.gradient(scene, lambda picture: picture.mean(), [name], spp=1)
    return "".join(str(one.message) for one in found)


def test_edges_that_rays_through_glass_move_are_named() -> None:
    assert "seen in mirrors and clear glass" in warned({"type": "dielectric"}, "shapes.ball.material.int_ior")
    assert warned({"type": "diffuse"}, "shapes.ball.material.reflectance") == ""


@pytest.mark.parametrize(
    ("turned", "named"), [({}, False), ({"scale": 3}, False), ({"scale": 2.5}, True), ({"rotate": 30}, True)]
)
def test_where_textures_of_round_surfaces_begin_anew_is_named(turned: dict[str, Any], named: bool) -> None:
    image = {
        "type": "image",
        "data": torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(1)),
        "uv_transform": turned,
    }
    image = image if turned else {key: image[key] for key in ("type", "data")}
    assert ("begin anew" in warned({"type": "diffuse", "reflectance": image}, "shapes.ball.radius")) == named
