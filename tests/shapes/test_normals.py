"""Smooth vertex normals: by angle, robust on slivers, equal to Mitsuba's on a real mesh."""

from __future__ import annotations

import importlib
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from cubes import unit_cube

import torchpt
from torchpt.physics.shapes.normals import smooth_normals
from torchpt.scene.meshes import load_mesh

BUNNY = Path(os.environ.get("TORCHPT_ASSETS", "")) / "bunny.ply"


def test_a_cubes_corners_point_along_its_diagonals():
    """By angle, not by triangle: a corner's two triangles of one face count as one face."""
    cube = unit_cube()
    points, index = np.unique(cube.vertices, axis=0, return_inverse=True)
    faces = torch.from_numpy(index.reshape(-1)[cube.faces])
    vertices = torch.from_numpy(points).T
    torch.testing.assert_close(smooth_normals(vertices, faces), vertices / 3**0.5)
    torch.testing.assert_close(smooth_normals(vertices, faces.flip(1)), -vertices / 3**0.5)


def test_scale_does_not_matter_and_degenerate_faces_do_nothing():
    vertices = torch.tensor([[0.0, 1, 0, 0, 2, 5], [0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0]], dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 0, 1], [3, 4, 5]])  # one good, one with a corner twice, one a line
    plain = smooth_normals(vertices, faces)
    assert torch.equal(plain[:, :3], torch.tensor([[0.0], [0], [1]], dtype=torch.float64).expand(3, 3))
    assert not plain[:, 4:].any()
    for scale in (1e-30, 1e30):
        torch.testing.assert_close(smooth_normals(vertices * scale, faces), plain)
    # A sliver of aspect 1e-9 keeps its plane.
    sliver = torch.tensor([[0.0, 1, 0.5], [0, 0, 1e-9], [0, 0, 0]], dtype=torch.float64)
    normal = smooth_normals(sliver, torch.tensor([[0, 1, 2]]))
    torch.testing.assert_close(normal, torch.tensor([[0.0], [0], [1]], dtype=torch.float64).expand(3, 3))


def test_gradients_pass():
    vertices = torch.tensor([[0.0, 1, 0, 0.3], [0, 0, 1, 0.2], [0.1, 0, 0, 1]], dtype=torch.float64, requires_grad=True)
    faces = torch.tensor([[0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert torch.autograd.gradcheck(lambda v: smooth_normals(v, faces), vertices)


@pytest.mark.mitsuba
@pytest.mark.skipif(not BUNNY.is_file(), reason="$TORCHPT_ASSETS/bunny.ply is not there")
def test_the_bunnys_normals_are_mitsubas():
    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    (piece,) = load_mesh(BUNNY)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bare.ply"
        _write(file, piece.vertices, piece.faces)
        mesh = mitsuba.load_dict({"type": "ply", "filename": str(file)})
        theirs = np.array(mitsuba.traverse(mesh)["vertex_normals"]).reshape(-1, 3)
    vertices = torch.from_numpy(piece.vertices.astype(np.float32)).double().T
    ours = smooth_normals(vertices, torch.from_numpy(piece.faces).long()).T.numpy()
    used = np.unique(piece.faces)
    cosine = (ours[used] * theirs[used]).sum(1) / np.linalg.norm(theirs[used], axis=1)
    assert np.median(1 - cosine) < 1e-6
    assert (cosine > 0.99999).mean() > 0.999


def _write(file: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    lines = [
        "ply\nformat ascii 1.0",
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z",
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header",
        *(" ".join(f"{float(x):.9g}" for x in row) for row in vertices),
        *(f"3 {a} {b} {c}" for a, b, c in faces),
    ]
    file.write_text("\n".join(lines) + "\n")


def test_normals_of_a_mesh_turn_against_its_stretch() -> None:
    """Those that a mesh brings along go by the inverse transpose: a plane stays one whose normal is at right angles to it."""
    slope = torch.tensor([0.0, 1.0, 1.0]) / 2**0.5
    mesh = {
        "type": "mesh",
        "vertices": [[-9, -3, 3], [9, -3, 3], [9, 3, -3], [-9, 3, -3]],
        "faces": [[0, 1, 2], [0, 2, 3]],
        "normals": [slope.tolist()] * 4,
        "transform": [{"scale": [1, 1, 3]}],
    }
    scene = torchpt.load(
        {"camera": {"origin": [0, 0, 50], "target": [0, 0, 0], "fov": 3}, "shapes": {"m": mesh}}, "cpu"
    )
    film = {"width": 4, "height": 4, "aovs": ["normal"]}
    normal = torchpt.render(scene, spp=1, film=film, integrator="aov", full=True)["normal"]
    expected = torch.tensor([0.0, 3.0, 1.0]) / 10**0.5
    assert float((normal - expected).abs().amax()) < 1e-5
