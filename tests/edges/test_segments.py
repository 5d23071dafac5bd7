"""Segments in reflected light: places and directions are drawn with the densities that they are weighed by."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

import torchpt
from torchpt.gradients.edges.bodies import bodies_of
from torchpt.gradients.edges.occluders import occluders_of
from torchpt.gradients.edges.segments import SegmentRays, SegmentSampler, smooth_of
from torchpt.math.vectors import dot
from torchpt.scene.formats.description import settings

COUNT = 40_000


def drawn(shape: dict[str, Any]) -> tuple[SegmentRays, float]:
    """Draw points and directions on the edges of a shape; return them, and the unit of length of the lanes."""
    described = {
        "camera": {"origin": [0, 0, 5], "target": [0, 0, 0]},
        "shapes": {"it": shape} if "type" in shape else shape,
    }
    scene = torchpt.load(described, "cpu")
    bodies = bodies_of(scene, settings(scene.description, {}).film, {})
    moves = torch.ones(sum(bodies.counts), dtype=torch.bool)
    occluders = occluders_of(scene, bodies, scene.merged({}), moves, None, lights_move=False)
    assert occluders is not None
    sampler = SegmentSampler(occluders, smooth_of(scene, bodies))
    g = torch.Generator().manual_seed(4)
    numbers = torch.rand(7, COUNT, generator=g, dtype=torch.float64)
    u = (torch.arange(COUNT) + numbers[0]) / COUNT
    return sampler.draw(u, numbers[1:3], numbers[3:5], numbers[5:7]), float(scene.space.unit)


SHAPES: dict[str, tuple[dict[str, Any], float]] = {
    "cube": ({"type": "cube", "transform": [{"scale": [0.5, 1.0, 1.5]}]}, 4 * (1 + 2 + 3)),
    "rectangle": ({"type": "rectangle"}, 8.0),
    "turned rectangle": (
        {
            "type": "rectangle",
            "transform": [{"rotate": {"axis": [1, 2, 0.5], "angle": 37}}, {"translate": [0.3, 0.7, 0.2]}],
        },
        8.0,
    ),
    "disk": ({"type": "disk", "transform": [{"scale": 0.5}]}, math.pi),
    # two triangles that meet at an angle, in one mesh, and apart
    "roof": (
        {
            "type": "mesh",
            "vertices": [[0, 0, 0], [1, 0, 0], [0, 1, 0.4], [0, -1, 0.2]],
            "faces": [[0, 1, 2], [1, 0, 3]],
            "face_normals": True,
        },
        1 + math.sqrt(1.16) + math.sqrt(2.16) + math.sqrt(1.04) + math.sqrt(2.04),
    ),
    "box of rectangles": (
        {
            "a": {"type": "rectangle", "transform": [{"translate": [0, 0, 1]}]},
            "b": {
                "type": "rectangle",
                "transform": [{"rotate": {"axis": [0, 1, 0], "angle": 90}}, {"translate": [1, 0, 0]}],
            },
        },
        14.0,
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_edges_count_by_length_and_directions_by_solid_angle(name: str):
    shape, length = SHAPES[name]
    rays, unit = drawn(shape)
    # The integral of the sine of the angle with the edge, over all directions, is pi^2.
    assert float((rays.weight / rays.density).mean()) * unit == pytest.approx(math.pi**2 * length, rel=0.02)
    assert (dot(rays.omega, rays.omega) - 1).abs().max() < 1e-9
    # Integrals over the sphere of 1 and of components squared, each along and across the edge.
    assert float((1 / rays.density).mean()) == pytest.approx(4 * math.pi, rel=0.03)
    for k in range(3):
        part = rays.omega[k].square() / rays.density
        assert float(part.mean()) == pytest.approx(4 * math.pi / 3, rel=0.05)


ROUND: dict[str, tuple[dict[str, Any], float]] = {
    "sphere": ({"type": "sphere", "radius": 0.7}, 8 * math.pi**2 * 0.7),
    # curvature cos^2 / R of directions at an angle to the ring
    "cylinder": ({"type": "cylinder", "radius": 0.4, "height": 1.3}, 2 * math.pi**2 * 1.3),
    # curvature of the ring 1 / (r sqrt 2) in the normal's plane, side length sqrt 2: the integral of 2 pi r / (r sqrt 2) pi dl
    "cone": ({"type": "cone", "apex": [0, 1, 0], "height": -1, "slope": 1.0}, 2 * math.pi**2),
}


@pytest.mark.parametrize("name", ROUND)
def test_outlines_of_round_bodies_count_by_curvature(name: str):
    shape, integral = ROUND[name]
    rays, unit = drawn(shape)
    bent = rays.curvature > 0
    total = float(torch.where(bent, rays.weight / rays.density, 0.0).mean()) * unit
    assert total == pytest.approx(integral, rel=0.03)
    out = rays.out[:, bent]
    assert dot(out, rays.omega[:, bent]).abs().max() < 1e-9 and (dot(out, out) - 1).abs().max() < 1e-9
