"""What is no camera of another library, no scene and no file is one line; what may be written otherwise is taken."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import torchpt
from torchpt import cameras
from torchpt.core.errors import SceneError

SIZE = (24, 16)
K = [[20.0, 0.0, 12.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]]
SPARSE = torch.eye(4).to_sparse()


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load({"camera": {"origin": [0, 1, 4], "target": [0, 0, 0]}, "film": {"width": 24, "height": 16}})


def refused(call: Callable[[], Any], key: str) -> None:
    with pytest.raises(SceneError, match=f"^{key}: expected") as caught:
        call()
    assert "\n" not in str(caught.value)


MATRICES = [
    None, "x", torch.eye(3), [[1, 2], [3]], {"a": 1}, torch.full((4, 4), math.nan), np.full((3, 4), np.inf),
    torch.zeros(4, 4), SPARSE, torch.eye(4, dtype=torch.complex64), torch.empty(4, 4, device="meta"),
]  # fmt: skip


@pytest.mark.parametrize("matrix", MATRICES, ids=str)
def test_no_matrix(matrix: Any) -> None:
    refused(lambda: cameras.from_opengl(matrix, 50.0), "matrix")


@pytest.mark.parametrize("fov", ["x", math.nan, -3, 0, 180, [1, 2], torch.tensor([40.0, 50.0]), 10**400], ids=repr)
def test_no_angle(fov: Any) -> None:
    refused(lambda: cameras.from_opengl(torch.eye(4), fov), "fov")


@pytest.mark.parametrize(
    ("key", "value"),
    [(key, value) for key in ("K", "R", "t", "first_pixel") for value in (None, "x", math.nan, [[1, 2], [3]], SPARSE)]
    + [
        ("K", np.full((3, 3), np.nan)),
        ("R", np.eye(4)),
        ("R", 2.0 * np.eye(3)),
        ("R", np.diag([1, 1, -1])),
        ("t", [1, 2]),
        ("t", [math.inf] * 3),
        ("size", "ab"),
    ],
)
def test_no_matrices_of_opencv(key: str, value: Any) -> None:
    given: dict[str, Any] = {"K": K, "R": np.eye(3), "t": np.zeros(3), "size": SIZE, key: value}
    refused(lambda: cameras.from_opencv(**given), key)


@pytest.mark.parametrize(
    ("key", "value"),
    [("R", None), ("R", np.full((3, 3), np.nan)), ("T", "x"), ("T", [math.nan] * 3), ("focal_length", math.nan),
     ("focal_length", None), ("principal_point", [math.inf, 0]), ("in_ndc", "x"), ("image_size", None)],
)  # fmt: skip
def test_no_numbers_of_pytorch3d(key: str, value: Any) -> None:
    given: dict[str, Any] = {"R": np.eye(3), "T": np.zeros(3), "focal_length": 1.0, "image_size": (16, 24), key: value}
    refused(lambda: cameras.from_pytorch3d(**given), key)


def test_an_axis_of_the_picture_that_there_is_not() -> None:
    wrong: list[Any] = ["z", None, 1]
    for axis in wrong:
        refused(lambda axis=axis: cameras.from_opengl(torch.eye(4), 50.0, axis), "fov_axis")


@pytest.mark.parametrize("to", [cameras.to_opencv, cameras.to_opengl, cameras.to_kornia, cameras.to_pytorch3d])
def test_no_scene_and_no_parameters(to: Callable[..., Any], scene: torchpt.Scene) -> None:
    for other in (None, "cornell_box", {"camera": {}}):
        refused(lambda other=other: to(other), "scene")
    for params in ("x", [1], 3):
        refused(lambda params=params: to(scene, params), "params")
    refused(lambda: to(scene, {None: torch.eye(4)}), "params.None")
    for dtype in (None, "float32", torch.int32):
        refused(lambda dtype=dtype: to(scene, dtype=dtype), "dtype")
    refused(lambda: to(scene, {"camera.to_world": SPARSE}), "params.camera.to_world")


def test_first_pixels_that_are_none(scene: torchpt.Scene) -> None:
    wrong: list[Any] = [None, "x", math.nan]
    for first in wrong:
        refused(lambda first=first: cameras.to_opencv(scene, first_pixel=first), "first_pixel")


def test_a_block_of_a_tensor_under_a_transform_is_made() -> None:
    def total(angle: torch.Tensor) -> torch.Tensor:
        return cameras.from_opengl(torch.eye(4) * angle.cos(), angle)["to_world"].sum()

    assert torch.isfinite(torch.func.vmap(total)(torch.tensor([0.1, 0.2]))).all()
    assert torch.isfinite(torch.func.grad(total)(torch.tensor(0.1)))


def test_pictures_of_frames_may_be_paths(scene: torchpt.Scene, tmp_path: Path) -> None:
    first = cameras.frame_of(scene, Path("images") / "0.png")
    assert first.image == "images/0.png"
    second = first._replace(image=Path("images") / "1.png")
    cameras.write_transforms(tmp_path / "transforms.json", [first, second])
    frames = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["images/0.png", "images/1.png"]
    wrong: list[Any] = [None, 3, b"0.png"]
    for image in wrong:
        refused(lambda image=image: cameras.frame_of(scene, image), "image")
    refused(lambda: cameras.write_transforms(tmp_path / "transforms.json", None), "frames")  # type: ignore[arg-type]


@pytest.mark.parametrize("path", [None, 3, b"a.png", ["a.png"], torch.eye(3), True], ids=str)
def test_no_path(path: Any, scene: torchpt.Scene) -> None:
    image = torch.zeros(2, 2, 3)
    for call in (torchpt.read_image, torchpt.read_layers, torchpt.read_header, cameras.read_transforms):
        refused(lambda call=call: call(path), "path")
    refused(lambda: torchpt.write_image(path, image), "path")
    refused(lambda: cameras.write_transforms(path, [cameras.frame_of(scene, "a.png")]), "path")
