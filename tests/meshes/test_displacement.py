"""Displacement: where vertices go, what their normals are, and that nothing tears."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cubes import unit_cube

import torchpt
from torchpt.scene.meshes import MeshPart
from torchpt.scene.meshes.mesh import displaced, subdivided

CAMERA = {"origin": [0, 0, 4], "target": [0, 0, 0]}
SQUARE: dict[str, Any] = {
    "type": "mesh",
    "vertices": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
    "uvs": [[0, 0], [1, 0], [1, 1], [0, 1]],
    "faces": [[0, 1, 2, 3]],
}


def test_subdivision_keeps_the_shape():
    mesh = unit_cube()
    finer = subdivided(subdivided(mesh))
    assert len(finer.faces) == 16 * len(mesh.faces)

    def area(part: MeshPart) -> float:
        a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    assert area(finer) == pytest.approx(area(mesh))
    assert np.abs(finer.vertices).max() == 1 and finer.uvs is not None and len(finer.uvs) == len(finer.vertices)
    # Euler: the vertices of each of the six faces, which share none, are a grid of 5 x 5.
    assert len(finer.vertices) == 6 * 25


def test_heights_of_a_known_function():
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    part = MeshPart("", np.array(SQUARE["vertices"], float), faces, uvs=np.array(SQUARE["uvs"], float))
    found = displaced(part, lambda uv: 0.1 * np.sin(2 * np.pi * uv[:, 0]), 5)
    assert found.uvs is not None and found.normals is not None
    assert np.allclose(found.vertices[:, :2], found.uvs)
    assert np.allclose(found.vertices[:, 2], 0.1 * np.sin(2 * np.pi * found.uvs[:, 0]))
    slope = 0.2 * np.pi * np.cos(2 * np.pi * found.uvs[:, 0])
    expected = np.stack([-slope, 0 * slope, 0 * slope + 1], 1) / np.sqrt(1 + slope[:, None] ** 2)
    inner = (found.uvs[:, 0] > 0.01) & (found.uvs[:, 0] < 0.99)
    assert np.abs(found.normals - expected)[inner].max() < 0.02


def test_a_cube_does_not_tear():
    """Six faces with texture coordinates and normals of their own: they must still meet at the edges."""
    found = displaced(unit_cube(), lambda uv: 0.3 * uv[:, 0] + 0.1 * uv[:, 1], 3)
    _, group = np.unique(np.round(found.vertices, 9), axis=0, return_inverse=True)
    faces = group.reshape(-1)[found.faces]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()


def test_in_a_scene(tmp_path: Path):
    torchpt.write_image(tmp_path / "h.exr", torch.full((4, 4, 3), 0.5))
    image = {"type": "image", "path": str(tmp_path / "h.exr")}
    shape = {**SQUARE, "displacement": {"texture": image, "scale": 0.4, "subdivisions": 2}}
    scene = torchpt.load({"camera": CAMERA, "shapes": {"s": shape}})
    vertices = scene.params["shapes.s.vertices"]
    assert torch.allclose(vertices[:, 2], torch.tensor(0.2)) and len(vertices) == 25
    assert not any("displacement" in name for name in scene.params)
    named = {**SQUARE, "displacement": {"texture": "h", "scale": 0.4}}
    other = torchpt.load({"camera": CAMERA, "textures": {"h": image}, "shapes": {"s": named}})
    assert torch.allclose(other.params["shapes.s.vertices"][:, 2], torch.tensor(0.2))


@pytest.mark.parametrize(
    ("displacement", "key", "part"),
    [
        ({"scale": 1}, "displacement.texture", "required"),
        ({"texture": "t"}, "displacement.texture", "none is defined"),
        ({"texture": {"type": "checkerboard"}, "subdivisions": 13}, "displacement.subdivisions", "0..12"),
        (
            {"texture": {"type": "checkerboard"}, "subdivisions": 12},
            "displacement.subdivisions",
            "at most 20,000,000 faces",
        ),
        ({"texture": {"type": "checkerboard"}, "depth": 1}, "displacement.depth", "a known key"),
        (3, "displacement", "a mapping"),
    ],
)
def test_what_is_wrong(displacement: Any, key: str, part: str):
    with pytest.raises(torchpt.SceneError) as caught:
        torchpt.load({"camera": CAMERA, "shapes": {"s": {**SQUARE, "displacement": displacement}}})
    assert caught.value.key == f"shapes.s.{key}" and part in str(caught.value)


def test_a_mesh_without_coordinates():
    shape = {k: v for k, v in SQUARE.items() if k != "uvs"} | {"displacement": {"texture": {"type": "checkerboard"}}}
    with pytest.raises(torchpt.SceneError, match=r"shapes.s.displacement: expected a?\s?.*uvs"):
        torchpt.load({"camera": CAMERA, "shapes": {"s": shape}})
