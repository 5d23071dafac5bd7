"""Rays beside an edge meet its faces, however narrow these are."""

from __future__ import annotations

import torch

import torchpt
from torchpt.gradients.edges.bodies import bodies_of
from torchpt.gradients.edges.primary import step_of, steps_at
from torchpt.scene.formats.description import settings


def test_steps_are_shorter_beside_narrow_faces() -> None:
    """A sliver under a wide triangle: they share the edge along x, and the sliver is some whole steps wide at most."""
    width = 2e-4
    mesh = {
        "type": "mesh",
        "vertices": [[-1, 0, 0], [1, 0, 0], [-1, 1, 0], [-1, -width, 0]],
        "faces": [[0, 1, 2], [1, 0, 3]],
    }
    described = {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
        "film": {"width": 32, "height": 32},
        "shapes": {"it": mesh},
        "lights": {"sky": {"type": "constant"}},
    }
    scene = torchpt.load(described, "cpu")
    bodies = bodies_of(scene, settings(scene.description, {}).film, {})
    x = torch.linspace(-0.95, 0.95, 20, dtype=torch.float64)
    p = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)))
    seen = bodies.camera.film_of(p)
    assert seen is not None
    s = seen[:2] / seen[2]
    wide, sliver = (torch.full((20,), face) for face in (0, 1))
    whole = step_of(bodies)
    assert bool((steps_at(bodies, (wide, torch.full_like(wide, -1)), s, None) == whole).all())
    found = steps_at(bodies, (wide, sliver), s, None)
    pixel = float(seen[0, 1] / seen[2, 1] - seen[0, 0] / seen[2, 0]) / float(x[1] - x[0])  # of a unit of the world
    room = 0.5 * (1 - x) * width * abs(pixel)
    assert bool((found <= torch.maximum(0.26 * room, torch.tensor(whole / 64))).all())
    assert bool((found < whole).any()) and bool((found > 0).all())
