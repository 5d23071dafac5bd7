"""Read and check the arguments of a batch (scenes, cameras, parameters, seeds), and name the scene in errors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import AssetError, NotBuiltError, RenderError, SceneError
from torchpt.math.transforms import tensor_of
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.settings import Params, SeedOfCall
from torchpt.spec.arguments import SceneValue

__all__ = ["Cameras", "Seeds", "cameras_of", "naming_errors", "params_of", "scenes_of", "seeds_of"]

#: Camera blocks as in scene files, poses ``(4, 4)`` (also as lists), or a tensor of poses ``(C, 4, 4)``.
Cameras = Tensor | Sequence[Mapping[str, Any] | Tensor] | None
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


def cameras_of(cameras: Cameras) -> Sequence[Mapping[str, Any] | Tensor | None]:
    """Return the cameras of a batch as a sequence; None stands for each scene's own.

    Raises:
        SceneError: not a sequence of blocks or poses, nor a tensor of poses.
    """
    if cameras is None:
        return [None]
    expected = "a sequence of camera blocks or poses (4, 4), or a dense tensor (C, 4, 4)"
    if isinstance(cameras, Tensor | np.ndarray):
        poses = _pose("cameras", cameras, expected)
        if poses.dim() != 3 or not len(poses):
            raise SceneError("cameras", tuple(poses.shape), expected)
        return list(poses.unbind())
    if not isinstance(cameras, Sequence) or isinstance(cameras, str) or not cameras:
        raise SceneError("cameras", cameras, expected)
    found: list[Mapping[str, Any] | Tensor] = []
    for c, camera in enumerate(cameras):
        if not isinstance(camera, Mapping | Tensor | np.ndarray | list | tuple):
            raise SceneError(f"cameras[{c}]", camera, expected)
        if isinstance(camera, Mapping) and not _POSE_KEYS & camera.keys():
            expected_block = (
                "a whole camera block, with origin and target, to_world, or R and t; hand single numbers over as params"
            )
            raise SceneError(f"cameras[{c}]", dict(camera), f"{expected_block}, such as camera.fov")
        found.append(camera if isinstance(camera, Mapping) else _pose(f"cameras[{c}]", camera, "a pose (4, 4), dense"))
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
            own = scenes.params.get(name) if isinstance(scenes, Scene) else None
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


def seeds_of(seed: Seeds, scenes: int | None, cameras: int) -> Callable[[int, int], Any]:
    """Return a function of scene ``s`` and camera ``c`` that gives the seed as ``render`` takes it.

    Args:
        seed: the caller's argument.
        scenes: number of scenes; None if not known.
        cameras: number of cameras.

    Raises:
        SceneError: too few or too many seeds.
    """
    nested = seed.tolist() if isinstance(seed, Tensor | np.ndarray) else seed
    if nested is None or isinstance(nested, int | SceneValue):
        return lambda s, c: nested
    expected = f"a whole number, a sequence of {scenes or 'as many as there are scenes'}, or of sequences of {cameras}"
    if not isinstance(nested, Sequence) or isinstance(nested, str) or (scenes is not None and len(nested) != scenes):
        raise SceneError("seed", nested, expected)
    for row in nested:
        if isinstance(row, Sequence) and (isinstance(row, str) or len(row) != cameras):
            raise SceneError("seed", nested, expected)

    def seed_of(s: int, c: int) -> Any:
        if s >= len(nested):
            raise SceneError("seed", len(nested), "as many as there are scenes")
        row = nested[s]
        return row[c] if isinstance(row, Sequence) else row

    return seed_of


@contextmanager
def naming_errors(scene: str, camera: int | None) -> Iterator[None]:
    """Make errors raised within name the scene of a batch and, for camera blocks, the camera.

    Args:
        scene: name such as ``scenes[3]``; "" if there is only one.
        camera: index of the camera; None for a scene's own.
    """
    try:
        yield
    except SceneError as error:
        key = error.key
        if camera is not None and key.startswith(("camera", "params.camera.to_world")):
            key = f"cameras[{camera}]{key.removeprefix('params.camera.to_world').removeprefix('camera')}"
        elif scene and not key.startswith(("scenes[", "params[", "cameras[", "seed")):
            key = f"{scene}.{key}"
        error_type = NotBuiltError if isinstance(error, NotBuiltError) else SceneError
        raise error_type(key, error.value, error.expected, error.file) from None
    except AssetError as error:
        raise AssetError(error.file, f"{error.problem} ({scene})" if scene else error.problem) from None
    except RenderError as error:
        is_named = not scene or str(error).startswith(scene)
        raise RenderError(str(error) if is_named else f"{scene}: {error}") from None
