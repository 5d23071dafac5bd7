"""Read and write ``transforms.json``, the cameras of a set of images in the format of NeRF, instant-ngp and nerfstudio.

``transform_matrix`` is camera to world with OpenGL's axes (x right, y up, looks along -z). ``fl_x fl_y cx cy`` are in pixels
from the image's corner, ``w h`` is its size. ``camera_angle_x`` is the full angle along x in radians, used without ``fl_x``.
Keys of a frame override those at the top of the file. Without ``w`` and ``h`` only the angle along x is used, and pixels are
square.
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
    from torchpt.scene.settings import FilmSettings, Params

__all__ = ["Frame", "frame_of", "read_transforms", "write_transforms"]

#: Most bytes of a file that is read.
_MAX_BYTES = 256 * 2**20
#: Keys of numbers that a frame may have, or the whole file for all frames.
_NUMBERS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
#: Coefficients of lens distortion, which is not supported: they must be 0.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
#: Camera models that are read; all are pinholes where the distortion is 0.
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
# A phrase of what is accepted, and the test for it.
_FOCAL = "a number > 0", lambda x: x > 0.0
_SIDE = "a whole number in 1..16777216", lambda x: 1.0 <= x <= 2.0**24 and x.is_integer()
_ANGLE = "an angle above 0 and below pi", lambda x: 1e-30 < x < math.pi  # the tangent of a smaller one may round to 0
#: Numbers with a range: the phrase for errors, and the test.
_RANGES: dict[str, tuple[str, Callable[[float], bool]]] = {
    "fl_x": _FOCAL,
    "fl_y": _FOCAL,
    "w": _SIDE,
    "h": _SIDE,
    "camera_angle_x": _ANGLE,
    "camera_angle_y": _ANGLE,
}


class Frame(NamedTuple):
    """An image and its camera."""

    image: str  # path of the image as written, relative to the folder of transforms.json
    camera: dict[str, Any]  # camera block of a scene
    size: tuple[int, int] | None  # width and height in pixels; None where the file has none


def frame_of(
    scene: Scene,
    image: str | os.PathLike[str],
    params: Params | None = None,
    film: FilmSettings | None = None,
) -> Frame:
    """Return a scene's camera as a frame of plain numbers, without gradients.

    Args:
        scene: the scene.
        image: path of the image, as it is to be written.
        params: tensors in place of the scene's.
        film: film settings that override the scene's.

    Raises:
        SceneError: no scene or no path, wrong parameters or film settings, or a camera other than a pinhole.
    """
    name = _image_path(image, "image")
    with torch.no_grad():
        matrix, intrinsics, _, size = to_opengl(scene, params, film, torch.float64)
    return Frame(name, from_opengl(matrix, K=intrinsics, size=size), size)


def read_transforms(path: str | os.PathLike[str]) -> list[Frame]:
    """Return the frames of a ``transforms.json``, in its order.

    ``torchpt.load({"camera": frame.camera, "film": {"width": w, "height": h}, ...})`` loads a scene with a frame's camera.

    Raises:
        SceneError: ``path`` is no path.
        AssetError: a missing or malformed file, or a camera with lens distortion.
    """
    try:
        top = json.loads(read_regular(as_path(path), _MAX_BYTES))
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise AssetError(path, f"is no JSON ({error})") from None
    frames = top.get("frames") if isinstance(top, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise AssetError(path, "has no list of frames")
    return [_read_frame(path, f"frames.{number}", {**top, **frame}) for number, frame in enumerate(frames)]


def write_transforms(path: str | os.PathLike[str], frames: Iterable[Frame]) -> None:
    """Write a ``transforms.json``, with the numbers that all frames share at its top.

    Args:
        path: path of the file.
        frames: frames from :func:`frame_of` or :func:`read_transforms`, or others whose camera block has ``to_world`` or
            ``R`` and ``t``, and ``K`` or ``fov``.

    Raises:
        SceneError: ``path`` is no path, no frames, a frame without a size, or a wrong camera block.
        OutputError: the file cannot be written.
    """
    target = as_path(path)
    if not isinstance(frames, Iterable):
        raise SceneError("frames", frames, "a sequence of Frames")
    rows = [_written_frame(frame, f"frames.{number}") for number, frame in enumerate(frames)]
    if not rows:
        raise SceneError("frames", [], "one frame at least")
    shared = {key: value for key, value in rows[0].items() if key in _NUMBERS}
    shared = {key: value for key, value in shared.items() if all(row.get(key) == value for row in rows)}
    own_keys = [{key: value for key, value in row.items() if key not in shared} for row in rows]
    text = json.dumps({"camera_model": "OPENCV", **shared, "frames": own_keys}, indent=1, allow_nan=False)
    # Written beside and renamed, so that the file is never there in part.
    partial = Path(f"{target}.part")
    try:
        partial.write_text(text + "\n", encoding="utf-8")
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise OutputError(path, f"cannot be written ({error.strerror})") from None


def _number(path: Any, key: str, row: Mapping[str, Any], name: str) -> float | None:
    """Return the number ``name`` of a frame; None where it is missing. ``path`` and ``key`` name the frame in errors."""
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


def _read_frame(path: Any, key: str, row: Mapping[str, Any]) -> Frame:
    """Convert a frame of the file; ``row``: its keys merged over those at the top."""
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
    lens: dict[str, Any] = (
        {"K": _intrinsics(known, size)} if size else {"fov": math.degrees(angle or 0), "fov_axis": axis}
    )
    try:
        camera = from_opengl(matrix, **lens, size=size)
    except SceneError as error:
        raise AssetError(path, f"{key}.transform_matrix: expected {error.expected}") from None
    return Frame(image, camera, size)


def _intrinsics(known: Mapping[str, float], size: tuple[int, int]) -> list[list[float]]:
    """Return ``K`` for the numbers of a frame and the size of its image in pixels.

    The focal length along an axis is that in pixels, else that of the angle, else that of the other axis.
    """
    focal: list[float | None] = []
    for axis, side in zip("xy", size, strict=True):
        angle = known.get(f"camera_angle_{axis}")
        focal.append(known.get(f"fl_{axis}") or (None if angle is None else 0.5 * side / math.tan(0.5 * angle)))
    fx, fy = focal[0] or focal[1], focal[1] or focal[0]
    assert fx is not None and fy is not None
    return [[fx, 0.0, known.get("cx", 0.5 * size[0])], [0.0, fy, known.get("cy", 0.5 * size[1])], [0.0, 0.0, 1.0]]


def _plain(value: Any) -> Any:
    """Convert tensors and arrays to numbers and lists."""
    if isinstance(value, Tensor | np.ndarray):
        return value.tolist()
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _image_path(image: Any, key: str) -> str:
    """Return the path of an image as text, with forward slashes."""
    found = image.as_posix() if isinstance(image, PurePath) else image
    found = os.fspath(found) if isinstance(found, str | os.PathLike) else None
    if not isinstance(found, str):
        raise SceneError(key, image, "the picture's file, as text or a path")
    return found


def _written_frame(frame: Frame, key: str) -> dict[str, Any]:
    """Convert a frame to its form in the file."""
    if not isinstance(frame, Frame):
        raise SceneError(key, frame, "a Frame, of frame_of(scene, image) or read_transforms")
    wide, tall = size_of(frame.size, f"{key}.size")
    image = _image_path(frame.image, f"{key}.image")
    intrinsics, pose = _read_camera(frame.camera, (wide, tall), f"{key}.camera")
    (fx, fy), (cx, cy) = intrinsics.diagonal()[:2].tolist(), intrinsics[:2, 2].tolist()
    # From the scene's camera axes to OpenGL's; adding 0.0 turns -0.0 into 0.0.
    matrix = pose * pose.new_tensor([-1.0, 1.0, -1.0, 1.0]) + 0.0
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


def _read_camera(block: Any, size: tuple[int, int], key: str) -> tuple[Tensor, Tensor]:
    """Read a camera block as a scene does; return ``K (3, 3)`` on a film of ``size``, and camera to world ``(4, 4)``."""
    from torchpt.physics.cameras.kinds.perspective import Perspective

    if not isinstance(block, Mapping):
        raise SceneError(key, block, "the block of a camera")
    block = {name: _plain(value) for name, value in block.items() if value is not None}
    has_pose = "to_world" in block or {"R", "t"} <= block.keys()
    if not has_pose or ("K" in block) == ("fov" in block):
        expected = "to_world or R and t, and K or fov: as frame_of and read_transforms give them"
        raise SceneError(key, sorted(map(str, block)), expected)
    if "K" in block:
        block = {"size": list(size), **block}
    values = read_typed(
        "camera", {Perspective.name: Perspective}, block, key=key, file=None, default=Perspective.name
    ).values
    numbers = {
        name: torch.tensor(value, dtype=torch.float64) if isinstance(value, float) else value
        for name, value in values.items()
    }
    camera = Perspective.on(torch.tensor(values["to_world"], dtype=torch.float64), size, numbers)
    return camera.intrinsics(), camera.to_world
