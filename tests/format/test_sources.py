"""One scene as a dict, YAML text, a file, an open file: the same picture; what is none of these is told."""

from __future__ import annotations

import io
import json
import re

import pytest

import torchpt
from torchpt.core.errors import SceneError

TEXT = """
camera: {type: perspective, origin: [0, 0, 4], target: [0, 0, 0], fov: 40}
film: {width: 8, height: 6}
render: {spp: 2, threads: 1}
shapes: {ball: {type: mesh, path: ball.ply}}
lights: {sky: {type: constant, radiance: 0.5}}
"""
BALL = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n-1 -1 0\n1 -1 0\n0 1 0\n3 0 1 2\n"
)


def test_all_forms_give_one_picture(tmp_path, monkeypatch):
    from torchpt.scene.formats.yaml import parse_yaml

    (tmp_path / "ball.ply").write_text(BALL)
    (tmp_path / "s.yaml").write_text(TEXT)
    elsewhere = [tmp_path / "s.yaml", str(tmp_path / "s.yaml")]
    pictures = [torchpt.render(torchpt.load(source, "cpu")) for source in elsewhere]
    for mode in ("r", "rb"):
        with (tmp_path / "s.yaml").open(mode) as file:  # its folder is where paths start
            pictures.append(torchpt.render(torchpt.load(file, "cpu")))
    monkeypatch.chdir(tmp_path)
    here = [TEXT, parse_yaml(TEXT), io.StringIO(TEXT), io.BytesIO(TEXT.encode())]
    pictures += [torchpt.render(torchpt.load(source, "cpu")) for source in here]
    assert all(picture.equal(pictures[0]) for picture in pictures)
    assert pictures[0].amax() > 0


def test_errors_name_the_file_where_there_is_one(tmp_path):
    (tmp_path / "s.yaml").write_text(TEXT.replace("radiance", "radience"))
    with (
        (tmp_path / "s.yaml").open() as file,
        pytest.raises(SceneError, match=re.escape(f"{tmp_path / 's.yaml'}: lights.sky.radience")),
    ):
        torchpt.load(file, "cpu")
    with pytest.raises(SceneError, match="^lights.sky.radience"):
        torchpt.load(TEXT.replace("radiance", "radience"), "cpu")


@pytest.mark.parametrize("source", [3, None, ["a"], io.StringIO("a: [1,\n"), "a: {\n", "no_such_scene", object()])
def test_what_is_no_scene_is_told_in_a_line(source):
    with pytest.raises(SceneError) as error:
        torchpt.load(source, "cpu")
    assert "\n" not in str(error.value)


def test_a_closed_file_is_told(tmp_path):
    (tmp_path / "s.yaml").write_text(TEXT)
    with (tmp_path / "s.yaml").open() as file:
        pass
    with pytest.raises(SceneError, match="closed file"):
        torchpt.load(file, "cpu")


def test_one_mesh_by_every_way_gives_one_picture(tmp_path):
    """Written out, as arrays, as tensors, as a file, as objects of trimesh: the same triangles, the same bits."""
    import numpy as np
    import torch
    import trimesh

    vertices = [[-1.0, -1.0, 0.25], [1.0, -1.0, 0.0], [0.5, 1.0, -0.5], [-0.75, 0.5, 0.5]]
    faces = [[0, 1, 2], [0, 2, 3]]
    blocks = {
        "camera": {"type": "perspective", "origin": [0.25, 0.5, 4], "target": [0, 0, 0], "fov": 40},
        "film": {"width": 8, "height": 6},
        "render": {"spp": 2, "threads": 1},
        "lights": {"sky": {"type": "constant", "radiance": [0.5, 0.25, 0.125]}},
    }
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    corners = "".join(f"{x} {y} {z}\n" for x, y, z in vertices)
    (tmp_path / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 2\nproperty list uchar int vertex_indices\nend_header\n{corners}3 0 1 2\n3 0 2 3\n"
    )
    shapes = [
        {"vertices": vertices, "faces": faces},
        {"vertices": np.array(vertices, np.float32), "faces": np.array(faces, np.int32)},
        {"vertices": torch.tensor(vertices), "faces": torch.tensor(faces)},
        {"vertices": [torch.tensor(row, dtype=torch.float64) for row in vertices], "faces": faces},
        {"vertices": vertices, "faces": faces, "transform": torch.eye(4)},
        {"path": str(tmp_path / "mesh.ply")},
        {"mesh": mesh},
    ]
    scenes = [torchpt.load({**blocks, "shapes": {"mesh": {"type": "mesh", **shape}}}, "cpu") for shape in shapes]
    scenes += [torchpt.from_trimesh(source, **blocks, device="cpu") for source in (mesh, trimesh.Scene({"mesh": mesh}))]
    text = f"{json.dumps({**blocks, 'shapes': {'mesh': {'type': 'mesh', **shapes[0]}}}, indent=1)}\n"
    (tmp_path / "s.yaml").write_text(text)
    scenes += [torchpt.load(source, "cpu") for source in (text, tmp_path / "s.yaml")]
    of_tensors = {key: torch.tensor(value) for key, value in blocks["camera"].items() if key != "type"}
    scenes.append(
        torchpt.load({**blocks, "camera": of_tensors, "shapes": {"mesh": {"type": "mesh", **shapes[0]}}}, "cpu")
    )
    pictures = [torchpt.render(scene) for scene in scenes]
    assert pictures[0].std() > 0.01
    assert [index for index, picture in enumerate(pictures) if not picture.equal(pictures[0])] == []
