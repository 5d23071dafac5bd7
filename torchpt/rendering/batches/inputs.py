"""Read and check the arguments of a batch (scenes, cameras, parameters, samples, seeds), and name the scene in errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import AssetError, RenderError, SceneError
from torchpt.math.transforms import tensor_of
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import Params, SeedOfCall
from torchpt.spec.arguments import SceneValue

__all__ = [
    "BatchCameras",
    "Cameras",
    "Counts",
    "Seeds",
    "cameras_of",
    "naming_errors",
    "number_of",
    "params_of",
    "scenes_of",
    "values_of",
]

#: A camera block as in scene files, or a pose ``(4, 4)`` (also as lists).
Camera = Mapping[str, Any] | Tensor | np.ndarray | Sequence[Sequence[float]]
#: Cameras that scenes share, or a tensor of poses ``(C, 4, 4)``; a sequence of cameras for each scene, or ``(S, C, 4, 4)``.
Cameras = Tensor | np.ndarray | Sequence[Camera] | Sequence[Sequence[Camera]] | None
#: Samples a pixel: one number for all pictures, one for each scene, or one for each scene and camera; None: the scenes' own.
Counts = int | Sequence[int] | Sequence[Sequence[int]] | Tensor | np.ndarray | None
#: One seed for all pictures, one for each scene, or one for each scene and camera; None: a new one for each picture.
Seeds = SeedOfCall | Sequence[int] | Sequence[Sequence[int]]

#: Keys of a camera block that position it: at least one must be given.
_POSE_KEYS = frozenset({"origin", "target", "to_world", "R", "t"})


def scenes_of(scenes: Any) -> Scene | Iterable[Scene]:
    """Return the scenes of a batch; those of an iterator are not checked yet.

    Raises:
        SceneError: not a scene, a sequence or an iterator of scenes.
    """
    if isinstance(scenes, Scene):
        return scenes
    if isinstance(scenes, str | bytes | Mapping | Tensor) or not isinstance(scenes, Iterable):
        raise SceneError("scenes", scenes, "a scene from torchpt.load, or a sequence or an iterator of such scenes")
    if isinstance(scenes, Sequence):
        for s, scene in enumerate(scenes):
            as_scene(scene, f"scenes[{s}]")
    return scenes


@dataclass(frozen=True)
class BatchCameras:
    """The cameras of a batch, C for each scene.

    Attributes:
        rows: the cameras of each scene; a single row is that of all scenes. None stands for the scene's own camera.
        shared: True if all scenes have the same cameras.
    """

    rows: Sequence[Sequence[Mapping[str, Any] | Tensor | None]]
    shared: bool

    @property
    def count(self) -> int:
        """Return C, the number of cameras of a scene."""
        return len(self.rows[0])

    def of_scene(self, s: int) -> Iterator[tuple[str, Mapping[str, Any] | Tensor | None]]:
        """Yield name in errors ("" for the scene's own) and camera, for the cameras of scene ``s``.

        Raises:
            SceneError: there are cameras for fewer scenes.
        """
        if not self.shared and s >= len(self.rows):
            raise SceneError("cameras", len(self.rows), "as many as there are scenes")
        for c, camera in enumerate(self.rows[0 if self.shared else s]):
            yield "" if camera is None else f"cameras[{c}]" if self.shared else f"cameras[{s}][{c}]", camera


def cameras_of(cameras: Cameras, scenes: int | None) -> BatchCameras:
    """Return the cameras of a batch.

    Args:
        cameras: the caller's argument.
        scenes: number of scenes; None if not known.

    Raises:
        SceneError: not a sequence of blocks or poses, one of such sequences, nor a tensor of poses.
    """
    if cameras is None:
        return BatchCameras([[None]], shared=True)
    expected = (
        "a sequence of camera blocks or poses (4, 4), one of these a scene, a dense tensor (C, 4, 4) or (S, C, 4, 4)"
    )
    if isinstance(cameras, Tensor | np.ndarray):
        poses = _pose("cameras", cameras, expected)
        if poses.dim() not in (3, 4) or not poses.shape[:-2].numel():
            raise SceneError("cameras", tuple(poses.shape), expected)
        if poses.dim() == 3:
            return BatchCameras([poses.unbind()], shared=True)
        rows = [row.unbind() for row in poses.unbind()]
    elif not isinstance(cameras, Sequence) or isinstance(cameras, str) or not len(cameras):
        raise SceneError("cameras", cameras, expected)
    elif not any(map(_is_row, cameras)):
        return BatchCameras([_cameras("cameras", cameras, expected)], shared=True)
    else:
        rows = [_cameras(f"cameras[{s}]", row, expected) for s, row in enumerate(cameras)]
        for s, row in enumerate(rows):
            if len(row) != len(rows[0]):
                raise SceneError(f"cameras[{s}]", len(row), f"as many cameras as of the first scene, {len(rows[0])}")
    if scenes is not None and len(rows) != scenes:
        raise SceneError("cameras", len(rows), f"as many as there are scenes, {scenes}")
    return BatchCameras(rows, shared=False)


def _is_row(entry: Any) -> bool:
    """Return True if an entry of a sequence of cameras has the cameras of a scene: poses have numbers at the second level."""
    if isinstance(entry, Tensor | np.ndarray):
        return entry.ndim == 3
    first: Any = entry[0] if isinstance(entry, list | tuple) and entry else None
    if isinstance(first, Mapping):
        return True
    if isinstance(first, Tensor | np.ndarray):
        return first.ndim == 2
    return isinstance(first, list | tuple) and bool(first) and isinstance(first[0], list | tuple | Tensor | np.ndarray)


def _cameras(key: str, cameras: Any, expected: str) -> Sequence[Mapping[str, Any] | Tensor]:
    """Return camera blocks and poses of a sequence, or of a tensor of poses; ``key``, ``expected``: for errors."""
    if not isinstance(cameras, Sequence | Tensor | np.ndarray) or isinstance(cameras, str) or not len(cameras):
        raise SceneError(key, cameras, expected)
    found: list[Mapping[str, Any] | Tensor] = []
    for c, camera in enumerate(cameras):
        if not isinstance(camera, Mapping | Tensor | np.ndarray | list | tuple):
            raise SceneError(f"{key}[{c}]", camera, expected)
        if isinstance(camera, Mapping) and not _POSE_KEYS & camera.keys():
            expected_block = (
                "a whole camera block, with origin and target, to_world, or R and t; hand single numbers over as params"
            )
            raise SceneError(f"{key}[{c}]", dict(camera), f"{expected_block}, such as camera.fov")
        found.append(camera if isinstance(camera, Mapping) else _pose(f"{key}[{c}]", camera, "a pose (4, 4), dense"))
    return found


def _pose(key: str, value: Any, expected: str) -> Tensor:
    """Return a tensor; lists of numbers become float64. Shapes are not checked."""
    if isinstance(value, Tensor):
        if value.layout is not torch.strided:
            raise SceneError(key, f"a {value.layout} tensor", expected)
        return value
    try:
        return torch.as_tensor(value, dtype=None if isinstance(value, np.ndarray) else torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise SceneError(key, value, expected) from None


def _stacked(value: Any) -> Any:
    """Return numbers and nested lists as a tensor; other values unchanged."""
    if not isinstance(value, list | tuple | np.ndarray):
        return value
    try:
        return tensor_of(value, torch.device("cpu"))
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return value


def params_of(params: Any, scenes: Scene | Iterable[Scene]) -> Sequence[Params] | None:
    """Return the parameters of each scene of a batch; None without parameters.

    Raises:
        SceneError: no mapping to tensors with equal leading dimensions, and no sequence of mappings.
    """
    if params is None:
        return None
    if isinstance(params, Mapping):
        size: int | None = None
        params = {name: _stacked(value) for name, value in params.items()}
        for name, value in params.items():
            if not isinstance(value, Tensor) or value.dim() < 1 or not len(value):
                found = tuple(value.shape) if isinstance(value, Tensor) else value
                raise SceneError(f"params.{name}", found, "a tensor whose first dimension is the number of scenes")
            own = scenes.raw_params.get(name) if isinstance(scenes, Scene) else None
            if own is not None and value.dim() <= own.dim():
                expected = f"a first dimension that is the number of scenes, before those of {tuple(own.shape)}"
                raise SceneError(f"params.{name}", tuple(value.shape), expected)
            if value.layout is not torch.strided:
                raise SceneError(f"params.{name}", f"a {value.layout} tensor", "a dense tensor")
            size = size or len(value)
            if len(value) != size:
                raise SceneError(
                    f"params.{name}", tuple(value.shape), f"a first dimension of {size}, as the first parameter's"
                )
        if size and isinstance(scenes, Sequence) and size != len(scenes):
            expected = f"as many as there are scenes, {len(scenes)}, along the first dimension of each tensor"
            raise SceneError("params", size, expected)
        parts = {name: value.unbind() for name, value in params.items()}
        return [{name: part[s] for name, part in parts.items()} for s in range(size)] if size else None
    if isinstance(params, Sequence) and not isinstance(params, str) and params:
        for s, own in enumerate(params):
            if not isinstance(own, Mapping):
                raise SceneError(f"params[{s}]", own, "a mapping from names to values")
        if isinstance(scenes, Sequence) and len(params) != len(scenes):
            raise SceneError("params", len(params), f"as many as there are scenes, {len(scenes)}")
        return params
    raise SceneError("params", params, "a mapping to tensors with a leading dimension, or a sequence of mappings")


def values_of(key: str, given: Any, scenes: int | None, cameras: int) -> Callable[[int, int], Any]:
    """Return a function of scene ``s`` and camera ``c`` that gives the value of a picture, as ``render`` takes it.

    Args:
        key: name of the argument, for errors.
        given: the caller's argument: a value for all pictures, one for each scene, or one for each scene and camera.
        scenes: number of scenes; None if not known.
        cameras: number of cameras.

    Raises:
        SceneError: a tensor or an array of other than whole numbers, too few or too many values.
    """
    if isinstance(given, Tensor | np.ndarray) and not _is_whole(given):
        found = (tuple(given.shape), given.dtype)
        raise SceneError(key, found, "a whole number, or several of them: tensors and arrays of an integer type")
    nested = given.tolist() if isinstance(given, Tensor | np.ndarray) else given
    if nested is None or isinstance(nested, int | SceneValue):
        return lambda s, c: nested
    expected = f"a whole number, a sequence of {scenes or 'as many as there are scenes'}, or of sequences of {cameras}"
    if not isinstance(nested, Sequence) or isinstance(nested, str) or (scenes is not None and len(nested) != scenes):
        raise SceneError(key, nested, expected)
    for row in nested:
        if isinstance(row, Sequence) and (isinstance(row, str) or len(row) != cameras):
            raise SceneError(key, nested, expected)

    def value_of(s: int, c: int) -> Any:
        if s >= len(nested):
            raise SceneError(key, len(nested), "as many as there are scenes")
        row = nested[s]
        return row[c] if isinstance(row, Sequence) else row

    return value_of


def _is_whole(numbers: Tensor | np.ndarray) -> bool:
    """Return True for a tensor or an array of an integer type; bool is none."""
    if isinstance(numbers, np.ndarray):
        return numbers.dtype.kind in "iuO"  # O: integers of Python
    return not (numbers.is_floating_point() or numbers.is_complex() or numbers.dtype == torch.bool)


def number_of(given: Any) -> int | None:
    """Return the number of entries of a sequence, tensor or array; None for a single value."""
    if isinstance(given, Tensor | np.ndarray):
        return len(given) if given.ndim else None
    return len(given) if isinstance(given, Sequence) else None


@contextmanager
def naming_errors(scene: str, camera: str) -> Iterator[None]:
    """Make errors raised within name the scene of a batch and, for camera blocks, the camera.

    Args:
        scene: name such as ``scenes[3]``; "" if there is only one.
        camera: name such as ``cameras[1]``; "" for a scene's own.
    """
    try:
        yield
    except SceneError as error:
        key = error.key
        if camera and (key == "camera" or key.startswith(("camera.", "params.camera.to_world"))):
            key = f"{camera}{key.removeprefix('params.camera.to_world').removeprefix('camera')}"
        elif scene and not key.startswith(("scenes[", "params[", "cameras", "seed", "make(")):
            key = f"{scene}.{key}" if key else scene
        raise type(error)(key, error.value, error.expected, error.file) from None
    except AssetError as error:
        raise type(error)(error.file, f"{error.problem} ({scene})" if scene else error.problem) from None
    except RenderError as error:
        is_named = not scene or str(error).startswith(scene)
        raise RenderError(str(error) if is_named else f"{scene}: {error}") from None
