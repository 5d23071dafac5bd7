"""Derivatives that once were wrong without a word: by the camera before a sphere, by maps of mirrors, by vertex colours."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt


def agree(value: Callable[[Tensor, int], Tensor], start: Tensor, direction: Tensor, step: float, rel: float) -> None:
    """Compare the derivative along a direction with a central difference by the same random numbers.

    Args:
        value: of the parameter and the samples a pixel.
        start: the parameter.
        direction: of its shape.
        step: of the difference, in units of the direction.
        rel: largest difference of both, of their size.
    """
    leaf = start.double().clone().requires_grad_()
    value(leaf, 128).backward()
    assert leaf.grad is not None
    found = float((leaf.grad * direction).sum())
    with torch.no_grad():
        after, before = (float(value(start.double() + sign * step * direction, 1024)) for sign in (1, -1))
    assert found == pytest.approx((after - before) / (2.0 * step), rel=rel)


@pytest.mark.parametrize("axis", [1, 2])
def test_the_camera_before_a_sphere(axis: int) -> None:
    """What the camera sees of a sphere stays where it is as the camera moves."""
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 1, 4], "target": [0, 0, 0], "fov": 40},
            "film": {"width": 16, "height": 16, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "lights": {"bulb": {"type": "point", "position": [1, 2, 3], "intensity": 10.0}},
            "shapes": {"ball": {"type": "sphere", "radius": 0.9}},
        },
        "cpu",
    )
    rows = torch.linspace(0.0, 1.0, 16, dtype=torch.float64)[:, None, None]
    weight = torch.sin(4.0 * rows + 1.0) * (1.0 + rows.transpose(0, 1))

    def value(pose: Tensor, spp: int) -> Tensor:
        return (torchpt.render(scene, params={"camera.to_world": pose}, spp=spp, seed=0).double() * weight).mean()

    direction = torch.zeros(4, 4, dtype=torch.float64)
    direction[axis, 3] = 1.0
    agree(value, scene.params["camera.to_world"], direction, 0.02, 0.03)


@pytest.mark.parametrize("filter", ["box", "gaussian"])
def test_the_camera_before_samples_that_are_clamped(filter: str) -> None:
    """How much of the film a point covers does not count for the clamp."""
    floor = {"type": "rectangle", "transform": [{"scale": 9}]}
    scene = torchpt.load(
        {
            "camera": {"origin": [0, -2, 3], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40},
            "film": {"width": 12, "height": 12, "filter": filter},
            "integrator": {"type": "path", "max_depth": 2, "clamp": 0.8},
            "lights": {"bulb": {"type": "point", "position": [0.2, 0.3, 0.8], "intensity": 8.0}},
            "shapes": {"floor": floor},
        },
        "cpu",
    )
    weight = torch.linspace(-1.0, 2.0, 12, dtype=torch.float64)[:, None, None]

    def value(pose: Tensor, spp: int) -> Tensor:
        return (torchpt.render(scene, params={"camera.to_world": pose}, spp=spp, seed=0).double() * weight).mean()

    direction = torch.zeros(4, 4, dtype=torch.float64)
    direction[2, 3] = 1.0
    agree(value, scene.params["camera.to_world"], direction, 0.02, 0.01)


@pytest.mark.filterwarnings("ignore:the gradient leaves out some edges. those seen in mirrors")
@pytest.mark.parametrize("material", [{"type": "conductor"}, {"type": "plastic", "diffuse_reflectance": 0.0}])
@pytest.mark.parametrize("key", ["normal_map", "bump_map"])
def test_maps_of_mirrors_turn_rays(material: dict[str, Any], key: str) -> None:
    random = torch.Generator().manual_seed(3)
    colours = 0.5 + 0.1 * (torch.rand(6, 6, 3, generator=random) - 0.5)
    colours[..., 2] = 0.9
    image = {"type": "image", "data": colours if key == "normal_map" else 0.05 * colours[..., :1], "wrap": "repeat"}
    floor = {
        "type": "rectangle",
        "material": {**material, key: image},
        "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
    }
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 2, 3], "target": [0, 0, 0], "fov": 40},
            "film": {"width": 8, "height": 8, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "lights": {"around": {"type": "envmap", "data": torch.rand(8, 16, 3, generator=random)}},
            "shapes": {"floor": floor},
        },
        "cpu",
    )
    name = f"shapes.floor.material.{key}"

    def value(texels: Tensor, spp: int) -> Tensor:
        return torchpt.render(scene, params={name: texels}, spp=spp, seed=0).double()[2:6, 2:6].mean()

    start = scene.params[name]
    direction = torch.randn(start.shape, generator=random, dtype=torch.float64)
    agree(value, start, direction * (0.02 if key == "normal_map" else 0.001), 0.25, 0.12)


def colored(colors: Any, **more: Any) -> dict[str, Any]:
    mesh = {
        "type": "mesh",
        "vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]],
        "faces": [[0, 1, 2], [0, 2, 3]],
        "colors": colors,
        "material": {"type": "diffuse", "reflectance": {"type": "vertex_color"}},
    }
    return {
        "camera": {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0], "width": 2.2},
        "film": {"width": 8, "height": 8},
        "integrator": {"type": "path", "max_depth": 2},
        "lights": {"sky": {"type": "constant"}},
        "shapes": {"it": {**mesh, **more}},
    }


COLORS = [[0.1, 0.2, 0.3], [0.9, 0.2, 0.3], [0.1, 0.8, 0.3], [0.5, 0.5, 0.5]]


def test_vertex_colours() -> None:
    scene = torchpt.load(colored(COLORS), "cpu")
    name = "shapes.it.colors"
    assert scene.params[name].tolist() == torch.tensor(COLORS).tolist()

    def value(colors: Tensor, spp: int) -> Tensor:
        return torchpt.render(scene, params={name: colors}, spp=spp, seed=0).double()[2:5].mean()

    direction = torch.rand(4, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    agree(value, scene.params[name], direction, 0.01, 0.01)


def test_vertex_colours_of_a_dict_carry_gradients() -> None:
    colors = torch.tensor(COLORS, requires_grad=True)
    torchpt.render(torchpt.load(colored(colors), "cpu"), spp=4).mean().backward()
    assert colors.grad is not None and bool((colors.grad > 0).all())


@pytest.mark.parametrize(
    ("colors", "key", "said"),
    [
        (COLORS[:3], "shapes.it.colors", "one row for each of the 4 vertices"),
        ([*COLORS[:3], [0, -1, 0]], "shapes.it.colors.3", "numbers >= 0"),
    ],
)
def test_vertex_colours_are_checked(colors: Any, key: str, said: str) -> None:
    with pytest.raises(torchpt.SceneError, match=said) as raised:
        torchpt.load(colored(colors), "cpu")
    assert raised.value.key == key


def test_vertex_colours_stay_reflectances() -> None:
    scene = torchpt.load(colored(COLORS), "cpu")
    with pytest.raises(torchpt.SceneError, match=r"in 0\.\.1"):
        torchpt.render(scene, params={"shapes.it.colors": torch.full((4, 3), 1.5)}, spp=1)


@pytest.mark.parametrize("axis", [0, 2])
def test_textures_of_opacity_move_with_their_card(axis: int) -> None:
    """The sun throws the shadow of a card of changing opacity, which is 0 at its border."""
    holes = torch.rand(4, 4, 1, generator=torch.Generator().manual_seed(2)) * 0.8 + 0.1
    holes = torch.nn.functional.pad(holes.permute(2, 0, 1), (1, 1, 1, 1)).permute(1, 2, 0).contiguous()
    veil = {"type": "diffuse", "reflectance": 0.0, "opacity": {"type": "image", "data": holes, "wrap": "clamp"}}
    scene = torchpt.load(
        {
            "camera": {"type": "orthographic", "origin": [0, 0, 0.5], "target": [0, 0, 0], "up": [0, 1, 0], "width": 3},
            "film": {"width": 12, "height": 12, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "lights": {"sun": {"type": "directional", "direction": [-0.3, 0.1, -1], "irradiance": [3, 3, 3]}},
            "shapes": {
                "card": {
                    "type": "rectangle",
                    "material": veil,
                    "transform": [{"scale": 0.8}, {"translate": [0.1, 0, 1]}],
                },
                "floor": {"type": "rectangle", "transform": [{"scale": 3}]},
            },
        },
        "cpu",
    )
    along = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64)[None, :, None]
    weight = along**3 + torch.linspace(0.0, 1.0, 12, dtype=torch.float64)[:, None, None] ** 2
    name = "shapes.card.to_world"

    def value(pose: Tensor, spp: int) -> Tensor:
        return (torchpt.render(scene, params={name: pose}, spp=spp, seed=0).double() * weight).mean()

    direction = torch.zeros(4, 4, dtype=torch.float64)
    direction[axis, 3] = 1.0
    agree(value, scene.params[name], direction, 0.02, 0.02)
