"""Where points lie on the film, and what places of it are worth."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch

import torchpt
from torchpt.gradients.edges.film import FilmMap, Worth
from torchpt.physics.cameras import Camera
from torchpt.scene.formats.description import settings

PLACE = {"origin": [1, 2, 3], "target": [0, 0.5, 0], "up": [0, 1, 0.2]}
CAMERAS: dict[str, dict[str, Any]] = {
    "perspective": {"fov": 50},
    "of height": {"fov": 50, "fov_axis": "y"},
    "off its axis": {"principal_point_offset_x": 0.2, "principal_point_offset_y": -0.1, "pixel_aspect": 1.3},
    "orthographic": {"type": "orthographic", "width": 3},
    "lens": {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 2, "principal_point_offset_x": 0.1},
    "lens of blades": {"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 5, "blades": 5},
}


def lens_of(camera: Camera) -> torch.Tensor | None:
    """Return 50 samples of a lens."""
    u = torch.rand(2, 50, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return u if camera.lens else None


def scene_of(camera: dict[str, Any], **film: Any) -> torchpt.Scene:
    shapes = {"ball": {"type": "sphere"}}
    camera = {"type": "perspective", **PLACE, **camera}
    return torchpt.load({"camera": camera, "film": {"width": 24, "height": 16, **film}, "shapes": shapes}, "cpu")


@pytest.mark.parametrize("name", CAMERAS)
def test_points_of_rays_lie_where_the_rays_do(name: str) -> None:
    scene = scene_of(CAMERAS[name])
    camera = scene.camera(settings(scene.description).film, scene.params, torch.float64)
    generator = torch.Generator().manual_seed(1)
    s = torch.rand(2, 50, generator=generator, dtype=torch.float64) * torch.tensor([[24.0], [16.0]])
    lens = lens_of(camera)
    o, d = camera.rays(s[0], s[1], lens)
    far = torch.rand(50, generator=generator, dtype=torch.float64) + 0.1
    film = FilmMap(camera)
    torch.testing.assert_close(film.places(o + d * far, lens), s, rtol=0, atol=1e-5)  # axes are float32
    torch.testing.assert_close(film.rays(s, lens), (o, d), rtol=0, atol=1e-7)
    behind = film.of(o - d * far, lens)
    torch.testing.assert_close(behind, camera.film_of(o - d * far, lens))
    assert bool((torch.minimum(behind[2], behind[3]) < 0).all())


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian", "mitchell"])
def test_worth_is_what_samples_bring(filter: str) -> None:
    """Of a cotangent, the mean over samples drawn by the filter of a function is the integral of the function's worth."""
    film = settings(scene_of({}, filter=filter, crop=[3, 2, 12, 9]).description).film
    kind = film.filter.kind(film.filter.values, torch.device("cpu"))
    cotangent = torch.rand(1, 9, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    worth = Worth(cotangent, kind, (3, 2, 12, 9))

    def function(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.exp(torch.complex(0.1 * x, 0.5 * y))  # of a sum of places the product

    steps = torch.arange(400, dtype=torch.float64) / 400 + 1 / 800
    u = torch.cartesian_prod(steps, steps).T.float()
    offset, weight = kind.offset(u).double(), kind.weight(u).double()
    row, column = torch.meshgrid(torch.arange(9.0).double(), torch.arange(12.0).double(), indexing="ij")
    brought = function(column + 3.5, row + 2.5) * (function(offset[0], offset[1]) * weight).mean()
    summed = float((cotangent[0] * brought).sum().real)
    low_x, high_x, low_y, high_y = worth.bounds()
    x = low_x + (high_x - low_x) * steps
    y = low_y + (high_y - low_y) * steps
    s = torch.cartesian_prod(x, y).T
    area = (high_x - low_x) * (high_y - low_y) / len(s[0])
    assert float((worth.at(s)[0] * function(s[0], s[1])).sum().real * area) == pytest.approx(summed, rel=2e-3)


@pytest.mark.parametrize("name", CAMERAS)
def test_slopes_are_derivatives_of_places(name: str) -> None:
    scene = scene_of(CAMERAS[name])
    made = scene.camera(settings(scene.description).film, scene.params, torch.float64)
    p = 2 * torch.randn(3, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)  # some behind
    lens = lens_of(made)
    film = FilmMap(made)
    s, found = film.slopes(p, lens)
    expected = torch.autograd.functional.jacobian(lambda q: film.places(q, lens).sum(1), p)
    torch.testing.assert_close(s, film.places(p, lens))
    torch.testing.assert_close(found, expected)
    n = torch.randn(3, 50, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    front = film.of(p, lens)[2] > 0
    area = (torch.linalg.cross(found[0], found[1], dim=0) * n).sum(0).abs()
    torch.testing.assert_close(film.area(p, n, lens)[front], area[front])


@pytest.mark.parametrize("light", [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
def test_outlines_of_round_surfaces_are_of_the_light_at_the_very_outline(light: list[float]) -> None:
    """Radiance falls with the root of the distance to an outline: a step away, it is another."""
    radius, width, size = 0.8, 2.0, 24
    described = {
        "camera": {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "width": width},
        "film": {"width": size, "height": size},
        "integrator": {"type": "path", "max_depth": 2},
        "lights": {"sun": {"type": "directional", "direction": [-x for x in light], "irradiance": 1.0}},
        "shapes": {"ball": {"type": "sphere", "radius": radius, "material": {"type": "diffuse", "reflectance": 0.5}}},
    }
    scene, name = torchpt.load(described, "cpu"), "shapes.ball.radius"

    def derivative(**wish: Any) -> float:
        found = torchpt.gradient(scene, lambda picture: picture.double().sum(), [name], spp=16, seed=1, **wish)
        return float(found.gradients[name])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", torchpt.EdgeWarning)
        found = derivative(edge_spp=256) - derivative(edges=False)
    # The integral of the radiance around the outline, 3 channels of pixels.
    scale = 3 * (size / width) ** 2 * 0.5 / math.pi * radius
    sine = light[0] / math.hypot(*light)
    assert found == pytest.approx(2.0 * sine * scale, abs=0.006 * scale)
