"""Edges that a camera sees through a lens."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few

import torchpt

PLACE = {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 30}
FILM = {"width": 8, "height": 8, "filter": "box"}
BOX = {"type": "cube", "transform": [{"scale": 0.4}, {"rotate": {"axis": [1, 1, 0], "angle": 30}}]}


def painted() -> dict[str, Any]:
    """Return a flat mesh, dark to the left and bright to the right of a border at which its texture coordinates jump."""
    x = [-3, 0.1, 0.1, -3, 0.1, 3, 3, 0.1]
    vertices = [[a, b, 0] for a, b in zip(x, [-3, -3, 3, 3] * 2, strict=True)]
    paint = {"type": "image", "data": [[[0.1] * 3, [0.9] * 3]]}
    return {
        "type": "mesh",
        "vertices": vertices,
        "faces": [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]],
        "face_normals": True,
        "uvs": [[0.1, 0.5]] * 4 + [[0.9, 0.5]] * 4,
        "material": {"type": "diffuse", "reflectance": paint},
    }


#: Shapes, and the entry of the first row of their pose that is changed: 0 is their width, 3 their place.
SHAPES: dict[str, tuple[dict[str, Any], int]] = {
    "box": (BOX, 0),
    "ball": ({"type": "sphere", "radius": 0.6}, 0),
    "cone": ({"type": "cone", "apex": [0, 0.5, 0], "height": -1, "slope": 0.5}, 0),
    "a border of texture coordinates": (painted(), 3),
}


def by_pose(camera: dict[str, Any], shape: dict[str, Any], entry: int, seed: int) -> torch.Tensor:
    """Return the derivative of a weighted sum of pixels by an entry of a pose."""
    name = "shapes.it.to_world"
    sun = {"type": "directional", "direction": [-0.2, -0.3, -1], "irradiance": 3}
    described = {"camera": {**PLACE, **camera}, "film": FILM, "integrator": {"max_depth": 2}, "lights": {"sun": sun}}
    scene = torchpt.load({**described, "shapes": {"it": shape}}, "cpu")
    leaf = scene.params[name].double().requires_grad_()
    picture = torchpt.render(scene, params={name: leaf}, spp=16, edge_spp=64, seed=seed).double()
    (picture * torch.linspace(0.5, 1, 8, dtype=torch.float64)[None, :, None]).sum().backward()
    assert leaf.grad is not None
    return leaf.grad[0, entry]


@pytest.mark.parametrize("shape", few(SHAPES, 2))
def test_a_lens_of_no_radius_is_a_pinhole(shape: str) -> None:
    lens = {"type": "thinlens", "aperture_radius": 0.0, "focus_distance": 4}
    described, entry = SHAPES[shape]
    found = [
        torch.stack([by_pose(camera, described, entry, seed) for seed in range(4)])
        for camera in ({"type": "perspective"}, lens)
    ]
    error = math.sqrt(sum(float(each.var()) / len(each) for each in found))
    off = abs(float(found[0].mean() - found[1].mean()))
    assert off < 4.5 * error + 1e-9
    assert error < 0.1 * abs(float(found[0].mean()))


@pytest.mark.parametrize(("name", "step"), [("aperture_radius", 0.03), ("focus_distance", 0.1)])
def test_blur_by_the_lens_itself(name: str, step: float) -> None:
    """A lamp out of focus takes light from its middle as the lens grows: as central differences say."""
    lamp = {"type": "disk", "emission": 1, "transform": [{"scale": 0.4}]}
    camera = {**PLACE, "type": "thinlens", "aperture_radius": 0.3, "focus_distance": 3}
    described = {"camera": camera, "film": FILM, "integrator": {"max_depth": 1}, "shapes": {"lamp": lamp}}
    scene = torchpt.load(described, "cpu")
    base = scene.params[f"camera.{name}"].double()

    def middle(value: torch.Tensor, **wish: Any) -> torch.Tensor:
        picture = torchpt.render(scene, params={f"camera.{name}": value}, **wish)
        return picture.double()[3:5, 3:5].sum()

    leaf = base.clone().requires_grad_()
    middle(leaf, spp=16, edge_spp=2048).backward()
    low, high = (float(middle(base + sign * step, spp=1 << 14)) for sign in (-1, 1))
    assert leaf.grad is not None
    assert float(leaf.grad) == pytest.approx((high - low) / (2 * step), rel=0.04)


def test_a_disk_out_of_focus_brightens_what_it_grows_over() -> None:
    """However a lens blurs a lamp, all its light falls on a film that is wide enough: the gradient by size is known."""
    disk = {"type": "disk", "emission": 1, "material": {"type": "diffuse", "reflectance": 0}}
    camera = {**PLACE, "type": "thinlens", "aperture_radius": 0.3, "focus_distance": 3}
    described = {"camera": camera, "film": FILM, "integrator": {"max_depth": 1}}
    scene = torchpt.load({**described, "shapes": {"it": {**disk, "transform": [{"scale": 0.4}]}}}, "cpu")
    name = "shapes.it.to_world"
    leaf = scene.params[name].double().requires_grad_()
    torchpt.render(scene, params={name: leaf}, spp=16, edge_spp=512).double().sum().backward()
    assert leaf.grad is not None
    size = 8 / (2 * 4 * math.tan(math.radians(15)))  # pixels for a unit of length
    # The area of the ellipse is pi x y; three channels.
    assert float(leaf.grad[0, 0]) == pytest.approx(3 * math.pi * 0.4 * size**2, rel=0.03)
    assert float(leaf.grad[1, 1]) == pytest.approx(3 * math.pi * 0.4 * size**2, rel=0.03)
