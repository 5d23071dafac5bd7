"""One scene as a dict, YAML text, a file, an open file: the same picture; what is none of these is told."""

from __future__ import annotations

import io
import re

import pytest

import torchpt
from torchpt.errors import SceneError

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
    from torchpt.format.yaml_file import parse_yaml

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
