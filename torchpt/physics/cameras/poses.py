"""Poses of cameras: by origin and target, by a matrix, or by OpenCV's rotation and translation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.core.errors import SceneError
from torchpt.math.transforms import affine, is_rigid, is_usable, look_at, tensor_of
from torchpt.physics.cameras import opencv
from torchpt.spec import Custom, Point, Pose, Refused, Spec

__all__ = ["POSES", "UP", "pose_of", "posed"]

#: The default of ``up``.
UP = (0.0, 1.0, 0.0)
#: The ways to give a pose, with their keys.
_WAYS = {"to_world": ("to_world",), "origin, target and up": ("origin", "target", "up"), "R and t": ("R", "t")}
_POINT = "a point [x, y, z] (a camera needs origin and target, or to_world, or R and t)"
#: Required keys of each way, with the expectation for errors.
_REQUIRED = {
    "to_world": {},
    "origin, target and up": {"origin": _POINT, "target": _POINT},
    "R and t": {
        "R": "a rotation (R and t go together)",
        "t": "a translation [x, y, z] (R and t go together)",
    },
}


class _UntracedPoint(Point):
    """Spec of a vector from which the pose is computed. It is no parameter tensor; ``to_world`` is."""

    differentiable: ClassVar[bool] = False
    place: ClassVar[bool] = False  # as no tensor holds it, none has to stay in float64


#: Specs of the pose, which every camera has.
POSES: Mapping[str, Spec] = {
    "origin": _UntracedPoint(None, doc="position"),
    "target": _UntracedPoint(None, doc="point at which the camera is aimed"),
    "up": _UntracedPoint(
        None, doc="upward direction of the picture, not parallel to the viewing direction; [0, 1, 0] by default"
    ),
    "to_world": Pose(
        None,
        rigid=True,
        operations=False,
        doc="in place of the above: from camera space (viewing direction +z, up +y, left in the picture +x) to the world",
    ),
    "R": Custom(
        None,
        reader=opencv.rotation,
        words="three rows of a rotation",
        doc="in place of the above, with `t`: OpenCV's rotation from world to camera (+x right, +y down, +z ahead)",
    ),
    "t": Custom(
        None,
        reader=opencv.translation,
        words="three finite numbers [x, y, z]",
        doc="translation: a point `X` of the world is `R X + t` in camera space",
    ),
}


def posed(values: Mapping[str, Any], device: torch.device | None = None) -> Any:
    """Return the pose ``(4, 4)`` from camera to world of parameters that are known to be valid.

    Args:
        values: values of the parameters by name, as read; with a device as written, which may be tensors.
        device: None for an array; else the result is a float64 tensor on it, differentiable in tensors among the values.
    """
    known = {name: value for name, value in values.items() if name in POSES and value is not None}
    if "to_world" not in known and "R" not in known:
        # Errors of `look_at` name `origin`, `target` or `up` after `key`, here without a prefix.
        return look_at(known["origin"], known["target"], known.get("up", UP), key="", device=device)
    if device is not None:
        known = {name: tensor_of(value, device) for name, value in known.items()}
    if "R" in known:
        return opencv.pose(known["R"], known["t"])
    return affine(known["to_world"][:3, :3], known["to_world"][:3, 3])


def pose_of(values: Mapping[str, Any], given: frozenset[str], sized_by: str = "") -> NDArray[np.float64]:
    """Return the pose ``(4, 4)`` from camera to world, from the parameters of a scene file.

    Args:
        values: values of the parameters by name.
        given: names of the parameters that the file sets.
        sized_by: hint for the error about a pose with a scale; "": none.

    Raises:
        Refused: no pose, two poses, or a pose that is no rotation and translation.
    """
    ways = [words for words, keys in _WAYS.items() if given.intersection(keys)]
    if len(ways) > 1:
        name = next(key for key in _WAYS[ways[1]] if key in given)
        raise Refused(f"either {ways[0]} or {ways[1]}, not both", values[name], (name,))
    way = ways[0] if ways else "origin, target and up"
    if way == "to_world" and not is_rigid(values["to_world"]):
        hint = f" ({sized_by})" if sized_by else ""
        raise Refused(f"a pose without scale or shear{hint}", values["to_world"].tolist(), ("to_world",))
    for name, expected in _REQUIRED[way].items():
        if values[name] is None:
            raise Refused(expected, None, (name,))
    try:
        pose = posed({name: values[name] for name in _WAYS[way]})
    except SceneError as error:
        raise Refused(error.expected, error.value, (error.key,)) from None
    if way == "R and t" and not is_usable(pose):
        raise Refused("a translation that is finite in float32", values["t"].tolist(), ("t",))
    return pose
