"""Cameras as other libraries have them: one picture from all of them, round trips, gradients, and where a point is seen."""

# pyright: reportArgumentType=false
# Wrong arguments are among what is handed over here.

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
from torchpt.core.errors import AssetError, OutputError, SceneError

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


def _one_frame(path: Any, **numbers: Any) -> cameras.Frame:
    path.write_text(json.dumps({**numbers, "frames": [{"file_path": "a.png", "transform_matrix": POSE}]}))
    return cameras.read_transforms(path)[0]


def test_angles_of_a_picture_whose_size_is_known_are_lengths_in_pixels(tmp_path: Any) -> None:
    """Each along its own axis, and nothing beside them is lost."""
    path = tmp_path / "transforms.json"
    wide, tall = (0.5 * side / math.tan(0.5 * angle) for side, angle in ((24, 0.8), (16, 0.6)))
    lengths: dict[str, Any] = {"w": 24, "h": 16, "cx": 10.0, "cy": 9.5}
    angles = {"camera_angle_x": 0.8, "camera_angle_y": 0.6}
    for numbers, fx, fy in (
        (angles, wide, tall),
        ({"camera_angle_x": 0.8}, wide, wide),
        ({"camera_angle_y": 0.6}, tall, tall),
        ({"fl_x": 30, **angles}, 30.0, tall),
        ({"fl_x": 30, "camera_angle_x": 0.8}, 30.0, 30.0),
        ({"fl_y": 30, "fl_x": 20, **angles}, 20.0, 30.0),
    ):
        frame = _one_frame(path, **lengths, **numbers)
        expected = torch.tensor([[fx, 0, 10], [0, fy, 9.5], [0, 0, 1]], dtype=torch.float64)
        assert torch.allclose(frame.camera["K"], expected) and frame.size == SIZE
        assert torch.allclose(loaded(frame.camera).pinhole().K.double(), expected, rtol=1e-5)


#: Beside ``to_world``: what a block may say of its lens.
LENSES: list[dict[str, Any]] = [
    {"fov": 44.0, "principal_point_offset_x": 0.06, "principal_point_offset_y": -0.04, "pixel_aspect": 1.1},
    {"fov": torch.tensor(44.0), "fov_axis": "diagonal", "pixel_aspect": torch.tensor(0.8)},
    {"fov": 30.0, "fov_axis": "larger"},
    {"fov": 30.0, "fov_axis": "y", "type": "perspective"},
    {"K": np.array([[20.0, 0, 11], [0, 21.0, 9], [0, 0, 1]])},
    {"K": [[20.0, 0, 11], [0, 21.0, 9], [0, 0, 1]], "size": [30, 30]},
]


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: ", ".join(lens))
def test_all_of_a_lens_is_written(lens: dict[str, Any], tmp_path: Any, scene: torchpt.Scene) -> None:
    block = {"to_world": scene.params["camera.to_world"], **lens}
    path = tmp_path / "transforms.json"
    cameras.write_transforms(path, [cameras.Frame("a.png", block, SIZE)])
    (frame,) = cameras.read_transforms(path)
    for ours, theirs in zip(loaded(frame.camera).pinhole(), loaded(block).pinhole(), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-5, atol=1e-4)


POSE = np.eye(4).tolist()
UNWRITTEN: dict[str, tuple[cameras.Frame, str]] = {
    key: (cameras.Frame("a.png", {"to_world": POSE, **block}, size), said)
    for key, block, size, said in (
        ("no angle", {"fov": 0}, SIZE, "camera.fov: expected"),
        ("a word", {"fov": "x"}, SIZE, "camera.fov: expected"),
        ("a NaN", {"fov": math.nan}, SIZE, "camera.fov: expected"),
        ("a pose of NaN", {"fov": 40, "to_world": torch.full((4, 4), math.nan)}, SIZE, "camera.to_world"),
        ("a K without a length", {"K": np.diag([0.0, 1.0, 1.0])}, SIZE, "camera.K.* expected"),
        (
            "a lens",
            {"fov": 40, "type": "thinlens", "aperture_radius": 0.1},
            SIZE,
            "camera.type: expected .*perspective",
        ),
        ("an unknown key", {"fov": 40, "aperture_radius": 0.1}, SIZE, "camera.aperture_radius: expected a known key"),
        ("both", {"fov": 40, "K": np.eye(3)}, SIZE, "camera: expected to_world or R and t, and K or fov"),
        ("another size", {"fov": 40}, (24,), "size: expected .width, height. in pixels"),
        ("no size", {"fov": 40}, (0, 5), "size: expected .width, height. in pixels"),
    )
} | {
    "no block": (cameras.Frame("a.png", 3, SIZE), "camera: expected the block"),
    "no name": (cameras.Frame(3, {}, SIZE), "image: expected the picture's file"),
}


def test_sizes_of_frames_are_whole_numbers_in_any_form(tmp_path: Any) -> None:
    sizes: list[Any] = [SIZE, np.array(SIZE), torch.tensor(SIZE), tuple(map(float, SIZE))]
    for size in sizes:
        cameras.write_transforms(tmp_path / "out.json", [cameras.Frame("a.png", {"to_world": POSE, "fov": 40}, size)])
        assert cameras.read_transforms(tmp_path / "out.json")[0].size == SIZE


@pytest.mark.parametrize("case", UNWRITTEN)
def test_what_is_not_written_is_one_line(case: str, tmp_path: Any) -> None:
    frame, said = UNWRITTEN[case]
    with pytest.raises(SceneError, match=f"^frames.0.{said}") as error:
        cameras.write_transforms(tmp_path / "out.json", [frame])
    assert "\n" not in str(error.value) and not list(tmp_path.iterdir())


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
    json.dumps(
        {"camera_angle_x": 10**400, "frames": [{"transform_matrix": POSE}]}
    ): "camera_angle_x: expected a finite",
    json.dumps(
        {"camera_angle_x": 0, "frames": [{"transform_matrix": POSE}]}
    ): "camera_angle_x: expected an angle above 0",
    json.dumps(
        {"camera_angle_y": 3.2, "frames": [{"transform_matrix": POSE}]}
    ): "camera_angle_y: expected an angle above 0",
    json.dumps(
        {"camera_angle_x": 0.5, "cx": 3, "frames": [{"transform_matrix": POSE}]}
    ): "w and h are missing.* cx belongs",
    json.dumps(
        {"fl_x": -3, "w": 5, "h": 5, "frames": [{"transform_matrix": POSE}]}
    ): "frames.0.fl_x: expected a number > 0",
    json.dumps(
        {"fl_x": 3, "w": -5, "h": 5, "frames": [{"transform_matrix": POSE}]}
    ): "frames.0.w: expected a whole number",
    json.dumps(
        {"fl_x": 3, "w": 5, "h": 5.5, "frames": [{"transform_matrix": POSE}]}
    ): "frames.0.h: expected a whole number",
    json.dumps({"fl_x": 3, "w": 5, "h": 1e300, "frames": [{"transform_matrix": POSE}]}): "frames.0.h: expected a",
    json.dumps(
        {"camera_angle_x": 0.5, "frames": [{"transform_matrix": [[math.nan] * 4] * 3}]}
    ): "_matrix: expected finite",
    json.dumps({"camera_angle_x": 0.5, "frames": [{"transform_matrix": [[0] * 4] * 3}]}): "_matrix: expected finite",
    json.dumps(
        {"camera_angle_x": 0.5, "frames": [{"transform_matrix": [[10**400] * 4] * 3}]}
    ): "transform_matrix: expected a matrix",
    json.dumps({"camera_angle_x": 0.5, "w": 5, "frames": [{"transform_matrix": POSE}]}): "w and h belong together",
    json.dumps(
        {
            "camera_angle_x": 0.5,
            "frames": [{"transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]}],
        }
    ): "transform_matrix: expected a matrix whose last row",
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


def _two_of_kornia() -> Any:
    one = cameras.to_kornia(loaded(AIMED))
    parts = (one.intrinsics, one.extrinsics, one.height, one.width)
    return type(one)(*(torch.cat((part, part)) for part in parts))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: cameras.from_opengl(POSE), "fov: expected an angle"),
        (lambda: cameras.from_opengl(POSE, 40.0, K=np.eye(3), size=SIZE), "fov: expected an angle"),
        (lambda: cameras.from_opengl(POSE, K=np.eye(3)), "size: expected"),
        (lambda: cameras.from_opengl("a matrix", 40.0), "matrix: expected a matrix"),
        (lambda: cameras.from_opencv(np.eye(3), np.eye(4), np.zeros(3), SIZE), r"R: expected numbers of shape \(3, 3\)"),
        (lambda: cameras.from_opencv(np.eye(3), np.eye(3), np.zeros(3), None), "size: expected .width, height. in pixels"),
        (lambda: cameras.from_opencv(np.eye(3), np.eye(3), np.zeros(3), (24,)), "size: expected .width, height. in pixels"),
        (lambda: cameras.from_opencv(np.eye(3), np.eye(3), np.zeros(3), "24"), "size: expected .width, height. in pixels"),
        (lambda: cameras.from_opengl(2.0 * np.eye(4), 40.0), "matrix: expected a matrix whose last row is 0 0 0 1"),
        (lambda: cameras.from_opengl(POSE, K=np.eye(3), size=(True, True)), "size: expected .width, height. in pixels"),
        (lambda: cameras.from_opengl(POSE, K=np.eye(3), size=(-2, 3)), "size: expected .width, height. in pixels"),
        (lambda: cameras.from_opengl([[10**400] * 4] * 3, 40.0), "matrix: expected a matrix"),
        (lambda: cameras.from_kornia(_two_of_kornia(), 5), "index: expected a whole number below 2, .* got 5"),
        (lambda: cameras.from_kornia(_two_of_kornia(), -3), "index: expected a whole number below 2, .* got -3"),
        (lambda: cameras.from_kornia(_two_of_kornia(), "x"), "index: expected a whole number below 2, .* got 'x'"),
        (lambda: cameras.from_pytorch3d(np.eye(3), np.zeros(3), [1.0, 2.0, 3.0], image_size=(4, 4)),
         "focal_length: expected one number, or two"),
        (lambda: cameras.from_pytorch3d(np.eye(3), np.zeros(3), [], image_size=(4, 4)), "focal_length: expected one number"),
        (lambda: cameras.from_pytorch3d(np.eye(3), np.zeros(3), 1.0, image_size=(0, 4)), "image_size: expected .height, width"),
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
