"""``transforms.json``: the cameras of a set of pictures, as NeRF, instant-ngp and nerfstudio keep them.

``transform_matrix`` is camera to world with OpenGL's axes (x right, y up, looks along -z). ``fl_x fl_y cx cy`` are pixels from
the picture's corner, ``w h`` its size; ``camera_angle_x`` is the full angle along x in radians. A frame may have all of them
itself, else those at the top of the file count.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchpt.cameras.conventions import from_opengl, to_opengl
from torchpt.cameras.traced import opencv_pose
from torchpt.errors import AssetError, OutputError, SceneError
from torchpt.files import read_regular

if TYPE_CHECKING:
    from torchpt.scene.scene import Scene

__all__ = ["Frame", "frame_of", "read_transforms", "write_transforms"]

_MOST = 256 * 2**20
_NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
#: What bends rays, or turns the picture otherwise: none of it is built, so it must be 0.
_BENT = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")


class Frame(NamedTuple):
    """A picture and its camera."""

    image: str  # the picture's file, as written: relative to the folder of transforms.json
    camera: dict[str, Any]  # the block of a scene
    size: tuple[int, int] | None  # width and height in pixels; None where the file does not say


def frame_of(
    scene: Scene, image: str, params: Mapping[str, Tensor] | None = None, film: Mapping[str, Any] | None = None
) -> Frame:
    """A scene's camera as a frame: as numbers, without gradients.

    Args:
        scene: whose camera.
        image: the picture's file, as it is to be written.
        params: tensors in place of the scene's.
        film: film settings in place of the scene's own.

    Raises:
        SceneError: a camera that is no pinhole's.
    """
    with torch.no_grad():
        matrix, inner, _, size = to_opengl(scene, params, film, torch.float64)
    return Frame(image, from_opengl(matrix, K=inner, size=size), size)


def read_transforms(path: str | os.PathLike[str]) -> list[Frame]:
    """The frames of a ``transforms.json``, in its order.

    ``torchpt.load({"camera": frame.camera, "film": {"width": w, "height": h}, ...})`` is a scene as a frame sees it.

    Raises:
        AssetError: a file that is missing or malformed, or a camera whose lens bends rays.
    """
    try:
        whole = json.loads(read_regular(path, _MOST))
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise AssetError(path, f"is no JSON ({error})") from None
    frames = whole.get("frames") if isinstance(whole, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise AssetError(path, "has no list of frames")
    return [_frame(path, f"frames.{number}", {**whole, **frame}) for number, frame in enumerate(frames)]


def write_transforms(path: str | os.PathLike[str], frames: Iterable[Frame]) -> None:
    """Write a ``transforms.json``; numbers that all frames share stand at its top.

    Args:
        path: of the file.
        frames: of :func:`frame_of` or :func:`read_transforms`; others need ``to_world`` or ``R`` and ``t``, and ``K`` or
            ``fov`` along x or y.

    Raises:
        SceneError: no frames, a frame without a size, or a camera in another form.
        OutputError: it cannot be written.
    """
    rows = [_row(frame, f"frames.{number}") for number, frame in enumerate(frames)]
    if not rows:
        raise SceneError("frames", [], "one frame at least")
    shared = {key: value for key, value in rows[0].items() if key in _NUMBERS}
    shared = {key: value for key, value in shared.items() if all(row.get(key) == value for row in rows)}
    kept = [{key: value for key, value in row.items() if key not in shared} for row in rows]
    text = json.dumps({"camera_model": "OPENCV", **shared, "frames": kept}, indent=1, allow_nan=False)
    beside = Path(f"{os.fspath(path)}.part")
    try:
        beside.write_text(text + "\n", encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise OutputError(path, f"cannot be written ({error.strerror})") from None


def _frame(path: Any, key: str, row: Mapping[str, Any]) -> Frame:
    def number(name: str) -> float | None:
        value = row.get(name)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise AssetError(path, f"{key}.{name}: expected a finite number, got {value!r}")
        return float(value)

    model = row.get("camera_model", _MODELS[0])
    if model not in _MODELS or row.get("is_fisheye"):
        raise AssetError(path, f"{key}: a camera of model {model!r} is not built; one of {', '.join(_MODELS)}")
    if any(number(name) for name in _BENT):
        raise AssetError(
            path, f"{key}: a lens that bends rays ({', '.join(_BENT)}) is not built; undistort the pictures"
        )
    image, matrix = row.get("file_path", ""), row.get("transform_matrix")
    if not isinstance(image, str):
        raise AssetError(path, f"{key}.file_path: expected text, got {image!r}")
    known = {name: number(name) for name in _NUMBERS}
    wide, tall, fx, fy = (known[name] for name in ("w", "h", "fl_x", "fl_y"))
    size = (int(wide), int(tall)) if wide and tall else None
    try:
        if fx or fy:
            if size is None:
                raise AssetError(path, f"{key}: w and h are missing, the size of the picture that fl_x belongs to")
            cx, cy = (0.5 * side if x is None else x for x, side in zip((known["cx"], known["cy"]), size, strict=True))
            inner = [[fx or fy, 0.0, cx], [0.0, fy or fx, cy], [0.0, 0.0, 1.0]]
            return Frame(image, from_opengl(matrix, K=inner, size=size), size)
        axis = "x" if known["camera_angle_x"] is not None else "y"
        angle = known[f"camera_angle_{axis}"]
        if angle is None:
            raise AssetError(path, f"{key}: no fl_x and no camera_angle_x")
        return Frame(image, from_opengl(matrix, math.degrees(angle), axis), size)
    except SceneError as error:
        raise AssetError(path, f"{key}.transform_matrix: expected {error.expected}") from None


def _numbers(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).detach().cpu()


def _row(frame: Frame, key: str) -> dict[str, Any]:
    """A frame as the file has it."""
    if not isinstance(frame, Frame):
        raise SceneError(key, frame, "a Frame, of frame_of(scene, image) or read_transforms")
    camera, size = frame.camera, frame.size
    if size is None:
        raise SceneError(f"{key}.size", None, "width and height of the picture in pixels")
    placed = "to_world" in camera or {"R", "t"} <= camera.keys()
    if not placed or (camera.get("K") is None) == (camera.get("fov") is None):
        raise SceneError(
            f"{key}.camera",
            sorted(camera),
            "to_world or R and t, and K or fov: as frame_of and read_transforms give them",
        )
    given = [_numbers(camera[name]) for name in ("to_world", "R", "t") if name in camera]
    pose = given[0] if len(given) == 1 else opencv_pose(*given)
    wide, tall = size
    if camera.get("K") is not None:
        inner = _numbers(camera["K"])
        scale = wide / camera.get("size", size)[0]
        (fx, fy), (cx, cy) = (inner.diagonal()[:2] * scale).tolist(), (inner[:2, 2] * scale).tolist()
    else:
        axis = camera.get("fov_axis", "x")
        if axis not in ("x", "y"):
            raise SceneError(f"{key}.camera.fov_axis", axis, "x or y")
        half = math.radians(float(_numbers(camera["fov"]))) * 0.5
        fx = fy = 0.5 * (wide if axis == "x" else tall) / math.tan(half)
        cx, cy = 0.5 * wide, 0.5 * tall
    matrix = pose * pose.new_tensor([-1.0, 1.0, -1.0, 1.0]) + 0.0  # no -0.0
    return {
        "file_path": frame.image,
        "transform_matrix": matrix.tolist(),
        "w": wide,
        "h": tall,
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "camera_angle_x": 2.0 * math.atan2(0.5 * wide, fx),
        "camera_angle_y": 2.0 * math.atan2(0.5 * tall, fy),
    }
