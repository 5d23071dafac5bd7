"""Cameras as other libraries have them: one picture from all of them, round trips, gradients, and where a point is seen."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchpt
from torchpt import cameras
from torchpt.errors import AssetError, OutputError, SceneError

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torchpt.EdgeWarning")
WIDTH, HEIGHT = 24, 16
SIZE = (WIDTH, HEIGHT)
POINT = (0.3, 0.5, -0.2)
SCENE: dict[str, Any] = {
    "film": {"width": WIDTH, "height": HEIGHT, "filter": "box"},
    "render": {"spp": 16, "threads": 1},
    "shapes": {
        "spark": {"type": "sphere", "center": list(POINT), "radius": 0.08, "emission": 50.0},
        "floor": {
            "type": "mesh",
            "vertices": [[-2, -1, -2], [2, -1, -2], [0, -1, 2]],
            "faces": [[0, 2, 1]],
            "emission": 0.5,
        },
    },
}
#: An uneven camera: no symmetry hides a sign.
AIMED = {"origin": [1.0, 1.2, 3.0], "target": [0.2, 0.1, 0.0], "up": [0.2, 1.0, 0.1], "fov": 44.0,
         "principal_point_offset_x": 0.06, "principal_point_offset_y": -0.04, "pixel_aspect": 1.1}  # fmt: skip


def loaded(camera: dict[str, Any], **more: Any) -> torchpt.Scene:
    return torchpt.load({**SCENE, "camera": camera, **more}, "cpu")


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return loaded(AIMED)


def _opengl(scene: torchpt.Scene, **more: Any) -> dict[str, Any]:
    found = cameras.to_opengl(scene, dtype=torch.float64, **more)
    return cameras.from_opengl(found.matrix, K=found.K, size=found.size)


#: There and back, by whose camera.
WAYS: dict[str, Callable[..., dict[str, Any]]] = {
    "opencv": lambda s, **m: cameras.from_opencv(*cameras.to_opencv(s, dtype=torch.float64, **m), SIZE),
    "cv2": lambda s, **m: cameras.from_opencv(
        *cameras.to_opencv(s, dtype=torch.float64, first_pixel=0.0, **m), SIZE, 0.0
    ),
    "opengl": _opengl,
    "kornia": lambda s, **m: cameras.from_kornia(cameras.to_kornia(s, dtype=torch.float64, **m)),
    "pytorch3d": lambda s, **m: cameras.from_pytorch3d(**cameras.to_pytorch3d(s, dtype=torch.float64, **m)),
}


@pytest.mark.parametrize("way", WAYS)
def test_there_and_back_is_the_same_camera(way: str, scene: torchpt.Scene) -> None:
    again = loaded(WAYS[way](scene))
    for ours, theirs in zip(again.pinhole(dtype=torch.float64), scene.pinhole(dtype=torch.float64), strict=True):
        assert torch.allclose(ours, theirs, atol=2e-6 * float(theirs.abs().max()))
    picture, first = torchpt.render(again), torchpt.render(scene)
    assert first.max() > 1.0 and torch.allclose(picture, first, atol=0.02 * float(first.max()))
    assert (picture - first).abs().mean() < 1e-3 * first.mean()


@pytest.mark.parametrize("way", WAYS)
def test_gradients_go_there_and_back(way: str, scene: torchpt.Scene) -> None:
    names = ["camera.to_world", "camera.fov", "camera.principal_point_offset_y"]
    leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
    again = loaded(WAYS[way](scene, params=leaves))
    weights = torch.linspace(0.3, 1.1, 16)
    total = (again.params["camera.to_world"].reshape(-1) * weights)[:12].sum()
    total = total + again.params["camera.fov"] + again.params["camera.principal_point_offset_y"]
    gradients = torch.autograd.grad(total, list(leaves.values()))
    assert torch.allclose(gradients[1], torch.ones(()), atol=1e-4)
    assert torch.allclose(gradients[2], torch.ones(()), atol=1e-4)
    # Of a pose: along what keeps it one, a turn about its own y and a move.
    pose = scene.params["camera.to_world"].double()
    turn = torch.zeros(4, 4, dtype=torch.float64)
    turn[0, 2], turn[2, 0] = 1.0, -1.0
    way_of_turn = (pose @ turn).float()
    expected = (way_of_turn.reshape(-1) * weights)[:12].sum()
    assert torch.isclose((gradients[0] * way_of_turn).sum(), expected, rtol=1e-4, atol=1e-5)
    assert torch.allclose(gradients[0][:3, 3], weights.reshape(4, 4)[:3, 3], atol=1e-5)


def test_a_picture_gives_gradients_to_a_camera_of_another_convention(scene: torchpt.Scene) -> None:
    found = cameras.to_opengl(scene, dtype=torch.float64)
    matrix, inner = found.matrix.requires_grad_(), found.K.requires_grad_()
    made = loaded(cameras.from_opengl(matrix, K=inner, size=found.size))
    torchpt.render(made, spp=4, edges=False).square().sum().backward()
    assert matrix.grad is not None and matrix.grad[:3].any() and inner.grad is not None and inner.grad[:2].any()


def _seen(picture: Tensor) -> tuple[float, float]:
    """The middle of what is bright, as column and row."""
    bright = torch.where(picture.mean(2) > 2.0, picture.mean(2), 0.0).double()
    columns, rows = torch.arange(WIDTH, dtype=torch.float64), torch.arange(HEIGHT, dtype=torch.float64)
    return float((bright.sum(0) * columns).sum() / bright.sum()), float((bright.sum(1) * rows).sum() / bright.sum())


def test_a_point_is_seen_where_others_project_it(scene: torchpt.Scene) -> None:
    column, row = _seen(torchpt.render(scene, spp=64))
    point = torch.tensor(POINT, dtype=torch.float64)
    found = {"kornia": cameras.to_kornia(scene, dtype=torch.float64).project(point[None, None])[0, 0]}
    gl = cameras.to_opengl(scene, dtype=torch.float64)
    x, y, z = torch.linalg.inv(gl.matrix)[:3] @ torch.cat((point, torch.ones(1, dtype=torch.float64)))
    found["opengl"] = torch.stack((gl.K[0, 0] * x / -z + gl.K[0, 2], gl.K[1, 1] * -y / -z + gl.K[1, 2])) - 0.5
    p3d = cameras.to_pytorch3d(scene, dtype=torch.float64)
    x, y, z = point @ p3d["R"][0] + p3d["T"][0]
    ndc = p3d["focal_length"][0] * torch.stack((x, y)) / z + p3d["principal_point"][0]
    half, middle = 0.5 * HEIGHT, torch.tensor([WIDTH, HEIGHT]) * 0.5
    found["pytorch3d"] = middle - half * ndc - 0.5  # its screen: from the corner, +x of NDC to the left, +y up
    for whose, (x, y) in found.items():
        assert abs(x - column) < 0.15 and abs(y - row) < 0.15, (whose, x, y, column, row)
    assert 2 < column < WIDTH - 3 and 2 < row < HEIGHT - 3


def test_gltf_and_blender_and_nerf_by_hand() -> None:
    """A camera without a turn looks along -z; glTF says the angle along y, NeRF along x."""
    matrix = np.eye(4)
    matrix[:3, 3] = [0.5, 0.25, 3.0]
    plain = loaded({"origin": [0.5, 0.25, 3.0], "target": [0.5, 0.25, 0.0], "fov": 50.0, "fov_axis": "y"})
    gltf = loaded(cameras.from_opengl(2.0 * matrix @ np.diag([1, 1, 1, 0.5]), 50.0, "y"))
    assert torch.allclose(gltf.params["camera.to_world"][:3, :3], plain.params["camera.to_world"][:3, :3])
    unscaled = loaded(cameras.from_opengl(matrix, 50.0, "y"))
    assert torch.allclose(unscaled.params["camera.to_world"], plain.params["camera.to_world"])
    angle = 2.0 * math.atan(math.tan(math.radians(25.0)) * WIDTH / HEIGHT)
    nerf = loaded(cameras.from_opengl(matrix[:3].tolist(), math.degrees(angle)))
    assert torch.allclose(nerf.pinhole().K, plain.pinhole().K, rtol=1e-5)
    assert torch.allclose(cameras.to_opengl(plain).fov, torch.tensor([math.degrees(angle), 50.0]), rtol=1e-5)
    assert torch.allclose(cameras.to_opengl(plain).matrix, torch.from_numpy(matrix).float(), atol=1e-6)


def test_pytorch3d_counts_in_pixels_too(scene: torchpt.Scene) -> None:
    found = cameras.to_pytorch3d(scene, dtype=torch.float64)
    inner = scene.pinhole(dtype=torch.float64).K
    found |= {"focal_length": inner.diagonal()[None, :2], "principal_point": inner[None, :2, 2], "in_ndc": False}
    assert torch.allclose(cameras.from_pytorch3d(**found)["K"], inner)


def test_transforms_are_written_and_read(tmp_path: Any, scene: torchpt.Scene) -> None:
    other = loaded({**AIMED, "origin": [-1.0, 0.5, 2.0]})
    wider = loaded({**AIMED, "fov": 60.0})
    path = tmp_path / "transforms.json"
    for scenes in ([scene, other], [scene, wider]):
        cameras.write_transforms(path, [cameras.frame_of(s, f"images/{n}.png") for n, s in enumerate(scenes)])
        written = json.loads(path.read_text())
        shared = scenes[1] is other
        assert ("fl_x" in written) is shared and ("fl_x" in written["frames"][0]) is not shared
        frames = cameras.read_transforms(path)
        assert [frame.image for frame in frames] == ["images/0.png", "images/1.png"] and frames[0].size == SIZE
        for frame, before in zip(frames, scenes, strict=True):
            for ours, theirs in zip(loaded(frame.camera).pinhole(), before.pinhole(), strict=True):
                assert torch.allclose(ours, theirs, atol=1e-4)
        again = tmp_path / "again.json"
        cameras.write_transforms(again, frames)
        assert _alike(json.loads(again.read_text()), written)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["again.json", "transforms.json"]


def _alike(a: Any, b: Any) -> bool:
    """The same but for rounding."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(_alike, a, b))
    return a == b if isinstance(a, str) else math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-9)


def test_a_file_of_nerf_is_read(tmp_path: Any) -> None:
    """Blender's of the first NeRF: an angle and poses, nothing else."""
    matrix = [[1.0, 0, 0, 0.5], [0, 0, -1, -3], [0, 1, 0, 0.25], [0, 0, 0, 1]]  # z is up, it looks along +y
    path = tmp_path / "transforms_train.json"
    path.write_text(
        json.dumps({"camera_angle_x": 0.69, "frames": [{"file_path": "./r_0", "transform_matrix": matrix}]})
    )
    (frame,) = cameras.read_transforms(path)
    assert frame.size is None and frame.image == "./r_0"
    aimed = loaded({"origin": [0.5, -3, 0.25], "target": [0.5, 0, 0.25], "up": [0, 0, 1], "fov": math.degrees(0.69)})
    made = loaded(frame.camera)
    for name in ("camera.to_world", "camera.fov"):
        assert torch.allclose(made.params[name], aimed.params[name], atol=1e-6)
    with pytest.raises(SceneError, match="frames.0.size"):
        cameras.write_transforms(tmp_path / "out.json", [frame])
    blocks = [frame.camera, WAYS["opencv"](aimed), {key: AIMED[key] for key in ("origin", "target", "fov")}]
    cameras.write_transforms(tmp_path / "out.json", [cameras.Frame("a.png", block, SIZE) for block in blocks[:2]])
    first, second = cameras.read_transforms(tmp_path / "out.json")
    for ours, theirs in zip(loaded(first.camera).pinhole(), loaded(second.camera).pinhole(), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-4)
    with pytest.raises(SceneError, match="frames.0.camera: expected to_world"):
        cameras.write_transforms(tmp_path / "out.json", [cameras.Frame("a.png", blocks[2], SIZE)])
    with pytest.raises(OutputError, match="cannot be written"):
        cameras.write_transforms(tmp_path / "none" / "out.json", [cameras.Frame("a.png", blocks[0], SIZE)])


POSE = np.eye(4).tolist()
BAD = {
    "{": "is no JSON",
    '{"frames": 3}': "no list of frames",
    json.dumps({"frames": [{"transform_matrix": POSE}]}): "frames.0: no fl_x and no camera_angle_x",
    json.dumps({"fl_x": 30, "frames": [{"transform_matrix": POSE}]}): "w and h are missing",
    json.dumps({"camera_angle_x": 0.5, "frames": [{}]}): "transform_matrix: expected a matrix",
    json.dumps(
        {"camera_angle_x": 0.5, "frames": [{"transform_matrix": [[1, 2]]}]}
    ): "transform_matrix: expected a matrix",
    json.dumps({"camera_angle_x": "wide", "frames": [{"transform_matrix": POSE}]}): "camera_angle_x: expected a finite",
    json.dumps({"camera_angle_x": 0.5, "k1": 0.1, "frames": [{"transform_matrix": POSE}]}): "undistort",
    json.dumps({"camera_angle_x": 0.5, "camera_model": "OPENCV_FISHEYE", "frames": [{}]}): "OPENCV_FISHEYE",
}


@pytest.mark.parametrize("text", BAD)
def test_what_is_wrong_with_a_file_is_one_line(text: str, tmp_path: Any) -> None:
    path = tmp_path / "transforms.json"
    path.write_text(text)
    with pytest.raises(AssetError, match=BAD[text]) as error:
        cameras.read_transforms(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    with pytest.raises(AssetError, match="cannot be read"):
        cameras.read_transforms(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cameras.from_opengl(POSE), "fov: expected an angle"),
        (lambda: cameras.from_opengl(POSE, 40.0, K=np.eye(3), size=SIZE), "fov: expected an angle"),
        (lambda: cameras.from_opengl(POSE, K=np.eye(3)), "size: expected"),
        (lambda: cameras.from_opengl("a matrix", 40.0), "matrix: expected a matrix"),
        (lambda: cameras.from_opencv(np.eye(3), np.eye(4), np.zeros(3), SIZE), r"R: expected numbers of shape \(3, 3\)"),
        (lambda: cameras.to_kornia(loaded({"type": "orthographic", "origin": [0, 0, 3], "target": [0, 0, 0]})),
         "camera.type: expected a camera with an angle"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_camera_is_one_line(make: Callable[[], Any], words: str) -> None:
    with pytest.raises(SceneError, match=words) as error:
        make()
    assert "\n" not in str(error.value)


def test_everything_is_found_by_its_public_name() -> None:
    assert torchpt.cameras is cameras and set(cameras.__all__) <= set(dir(cameras))
