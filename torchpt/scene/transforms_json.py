"""``transforms.json``: the cameras of a set of pictures, as NeRF, instant-ngp and nerfstudio keep them.

``transform_matrix`` is camera to world with OpenGL's axes (x right, y up, looks along -z). ``fl_x fl_y cx cy`` are pixels from
the picture's corner, ``w h`` its size; ``camera_angle_x`` is the full angle along x in radians, and counts where there is no
``fl_x``. A frame may have all of them itself, else those at the top of the file count. Without ``w`` and ``h`` there are angles
alone, and the one along x counts: pixels are squares.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import AssetError, OutputError, SceneError
from torchpt.core.files import as_path, read_regular
from torchpt.scene.conventions import from_opengl, size_of, to_opengl
from torchpt.spec import Refused, reading
from torchpt.spec.schema import read_typed

if TYPE_CHECKING:
    from torchpt.scene.scene import Scene

__all__ = ["Frame", "frame_of", "read_transforms", "write_transforms"]

_MOST = 256 * 2**20
_NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
#: What bends rays, or turns the picture otherwise: none of it is built, so it must be 0.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
_FOCAL = "a number > 0", lambda x: x > 0.0
_SIDE = "a whole number in 1..16777216", lambda x: 1.0 <= x <= 2.0**24 and x.is_integer()
_ANGLE = "an angle above 0 and below pi", lambda x: 1e-30 < x < math.pi
#: What is accepted of numbers that have ends.
_RANGES: dict[str, tuple[str, Callable[[float], bool]]] = {
    "fl_x": _FOCAL,
    "fl_y": _FOCAL,
    "w": _SIDE,
    "h": _SIDE,
    "camera_angle_x": _ANGLE,
    "camera_angle_y": _ANGLE,
}


class Frame(NamedTuple):
    """A picture and its camera."""

    image: str  # the picture's file, as written: relative to the folder of transforms.json
    camera: dict[str, Any]  # the block of a scene
    size: tuple[int, int] | None  # width and height in pixels; None where the file does not say


def frame_of(
    scene: Scene,
    image: str | os.PathLike[str],
    params: Mapping[str, Tensor] | None = None,
    film: Mapping[str, Any] | None = None,
) -> Frame:
    """A scene's camera as a frame: as numbers, without gradients.

    Args:
        scene: whose camera.
        image: the picture's file, as it is to be written: text or a path.
        params: tensors in place of the scene's.
        film: film settings in place of the scene's own.

    Raises:
        SceneError: no scene or no file's name, parameters or film settings that are wrong, or a camera that is no pinhole's.
    """
    name = _file(image, "image")
    with torch.no_grad():
        matrix, inner, _, size = to_opengl(scene, params, film, torch.float64)
    return Frame(name, from_opengl(matrix, K=inner, size=size), size)


def read_transforms(path: str | os.PathLike[str]) -> list[Frame]:
    """The frames of a ``transforms.json``, in its order.

    ``torchpt.load({"camera": frame.camera, "film": {"width": w, "height": h}, ...})`` is a scene as a frame sees it.

    Raises:
        SceneError: ``path`` is none.
        AssetError: a file that is missing or malformed, or a camera whose lens bends rays.
    """
    try:
        whole = json.loads(read_regular(as_path(path), _MOST))
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
        frames: of :func:`frame_of` or :func:`read_transforms`; others may have a path as ``image``, and need ``to_world`` or
            ``R`` and ``t``, and ``K`` or ``fov`` with what may stand beside it.

    Raises:
        SceneError: ``path`` is none, no frames, a frame without a size, a camera in another form, or one that no scene could
            have.
        OutputError: it cannot be written.
    """
    place = as_path(path)
    if not isinstance(frames, Iterable):
        raise SceneError("frames", frames, "a sequence of Frames")
    rows = [_row(frame, f"frames.{number}") for number, frame in enumerate(frames)]
    if not rows:
        raise SceneError("frames", [], "one frame at least")
    shared = {key: value for key, value in rows[0].items() if key in _NUMBERS}
    shared = {key: value for key, value in shared.items() if all(row.get(key) == value for row in rows)}
    kept = [{key: value for key, value in row.items() if key not in shared} for row in rows]
    text = json.dumps({"camera_model": "OPENCV", **shared, "frames": kept}, indent=1, allow_nan=False)
    beside = Path(f"{place}.part")
    try:
        beside.write_text(text + "\n", encoding="utf-8")
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise OutputError(path, f"cannot be written ({error.strerror})") from None


def _number(path: Any, key: str, row: Mapping[str, Any], name: str) -> float | None:
    """A number of a frame, where it has it."""
    value = row.get(name)
    if value is None:
        return None
    expected, fits = _RANGES.get(name, ("a finite number", lambda _: True))
    try:
        found = reading.number(value)
    except Refused:
        raise AssetError(path, f"{key}.{name}: expected a finite number, got {value!r}") from None
    if not fits(found):
        raise AssetError(path, f"{key}.{name}: expected {expected}, got {value!r}")
    return found


def _frame(path: Any, key: str, row: Mapping[str, Any]) -> Frame:
    """A frame of the file, of its own keys and those at the top."""
    model = row.get("camera_model", _MODELS[0])
    if model not in _MODELS or row.get("is_fisheye"):
        raise AssetError(path, f"{key}: a camera of model {model!r} is not built; one of {', '.join(_MODELS)}")
    if any(_number(path, key, row, name) for name in _DISTORTION):
        raise AssetError(
            path, f"{key}: a lens that bends rays ({', '.join(_DISTORTION)}) is not built; undistort the pictures"
        )
    image, matrix = row.get("file_path", ""), row.get("transform_matrix")
    if not isinstance(image, str):
        raise AssetError(path, f"{key}.file_path: expected text, got {image!r}")
    known = {name: found for name in _NUMBERS if (found := _number(path, key, row, name)) is not None}
    if ("w" in known) != ("h" in known):
        raise AssetError(path, f"{key}: w and h belong together, the size of the picture; one of them is missing")
    size = (int(known["w"]), int(known["h"])) if "w" in known else None
    pixels = [name for name in ("fl_x", "fl_y", "cx", "cy") if name in known]
    if size is None and pixels:
        raise AssetError(path, f"{key}: w and h are missing, the size of the picture that {pixels[0]} belongs to")
    axis = "x" if "camera_angle_x" in known else "y"
    angle = known.get(f"camera_angle_{axis}")
    if angle is None and not {"fl_x", "fl_y"} & known.keys():
        raise AssetError(path, f"{key}: no fl_x and no camera_angle_x")
    lens: dict[str, Any] = {"K": _inner(known, size)} if size else {"fov": math.degrees(angle or 0), "fov_axis": axis}
    try:
        camera = from_opengl(matrix, **lens, size=size)
    except SceneError as error:
        raise AssetError(path, f"{key}.transform_matrix: expected {error.expected}") from None
    return Frame(image, camera, size)


def _inner(known: Mapping[str, float], size: tuple[int, int]) -> list[list[float]]:
    """``K``: along each axis what is said of it, in pixels, as an angle, or along the other axis."""
    focal: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        angle = known.get(f"camera_angle_{axis}")
        focal.append(known.get(f"fl_{axis}") or (None if angle is None else 0.5 * side / math.tan(0.5 * angle)))
    fx, fy = focal[0] or focal[1], focal[1] or focal[0]
    assert fx is not None and fy is not None
    return [[fx, 0.0, known.get("cx", 0.5 * size[0])], [0.0, fy, known.get("cy", 0.5 * size[1])], [0.0, 0.0, 1.0]]


def _plain(value: Any) -> Any:
    """Tensors and arrays as numbers and lists of them."""
    if isinstance(value, Tensor | np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _file(image: Any, key: str) -> str:
    """A picture's file as it is written: with slashes, whatever the system has."""
    found = image.as_posix() if isinstance(image, PurePath) else image
    found = os.fspath(found) if isinstance(found, str | os.PathLike) else None
    if not isinstance(found, str):
        raise SceneError(key, image, "the picture's file, as text or a path")
    return found


def _row(frame: Frame, key: str) -> dict[str, Any]:
    """A frame as the file has it."""
    if not isinstance(frame, Frame):
        raise SceneError(key, frame, "a Frame, of frame_of(scene, image) or read_transforms")
    wide, tall = size_of(frame.size, f"{key}.size")
    image = _file(frame.image, f"{key}.image")
    inner, pose = _seen(frame.camera, (wide, tall), f"{key}.camera")
    (fx, fy), (cx, cy) = inner.diagonal()[:2].tolist(), inner[:2, 2].tolist()
    matrix = pose * pose.new_tensor([-1.0, 1.0, -1.0, 1.0]) + 0.0  # no -0.0
    return {
        "file_path": image,
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


def _seen(block: Any, size: tuple[int, int], key: str) -> tuple[Tensor, Tensor]:
    """``K (3, 3)`` on a film of ``size`` and camera to world ``(4, 4)`` of a block, read as a scene reads it."""
    from torchpt.physics.cameras.kinds.perspective import Perspective

    if not isinstance(block, Mapping):
        raise SceneError(key, block, "the block of a camera")
    block = {name: _plain(value) for name, value in block.items() if value is not None}
    placed = "to_world" in block or {"R", "t"} <= block.keys()
    if not placed or ("K" in block) == ("fov" in block):
        expected = "to_world or R and t, and K or fov: as frame_of and read_transforms give them"
        raise SceneError(key, sorted(map(str, block)), expected)
    if "K" in block:
        block = {"size": list(size), **block}
    values = read_typed("camera", {Perspective.name: Perspective}, block, key, None, Perspective.name).values
    numbers = {
        name: torch.tensor(value, dtype=torch.float64) if isinstance(value, float) else value
        for name, value in values.items()
    }
    camera = Perspective.on(torch.tensor(values["to_world"], dtype=torch.float64), size, numbers)
    return camera.intrinsics(), camera.to_world
