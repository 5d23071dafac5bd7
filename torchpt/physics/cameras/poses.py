"""Where a camera stands: by a point that it looks at, by a matrix, or by OpenCV's world-to-camera rotation and translation."""

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

#: What is up where a camera does not say.
UP = (0.0, 1.0, 0.0)
#: The keys that together say a pose.
_WAYS = {"to_world": ("to_world",), "origin, target and up": ("origin", "target", "up"), "R and t": ("R", "t")}
_POINT = "a point [x, y, z] (a camera needs origin and target, or to_world, or R and t)"
#: Those without which a way says none, and what is said then.
_REQUIRED = {
    "to_world": {},
    "origin, target and up": {"origin": _POINT, "target": _POINT},
    "R and t": {
        "R": "a rotation (R and t go together)",
        "t": "a translation [x, y, z] (R and t go together)",
    },
}


class _UntracedPoint(Point):
    """Three numbers that say where the camera stands: no tensor of the scene, the pose made of them is."""

    differentiable: ClassVar[bool] = False
    place: ClassVar[bool] = False


#: What every camera declares.
POSES: Mapping[str, Spec] = {
    "origin": _UntracedPoint(None, doc="where it stands"),
    "target": _UntracedPoint(None, doc="a point that it looks at"),
    "up": _UntracedPoint(
        None, doc="what is up in the picture, any direction but the viewing direction; [0, 1, 0] by default"
    ),
    "to_world": Pose(
        None,
        rigid=True,
        operations=False,
        doc="in place of these: from its own space (it looks along +z, +y is up, +x left in the picture) to the world",
    ),
    "R": Custom(
        None,
        reader=opencv.rotation,
        words="three rows of a rotation",
        doc="in place of these, with `t`: OpenCV's rotation from the world to the camera (+x right, +y down, +z ahead)",
    ),
    "t": Custom(
        None,
        reader=opencv.translation,
        words="three finite numbers [x, y, z]",
        doc="where the world's origin lies in the camera's space, a point `X` of the world at `R X + t`",
    ),
}


def posed(values: Mapping[str, Any], device: torch.device | None = None) -> Any:
    """Return camera to world ``(4, 4)`` of a block that says one pose, and a right one.

    Args:
        values: of the parameters by name, as read; with a device as written, tensors among them.
        device: None: an array; else a float64 tensor there, on their tape.
    """
    known = {name: value for name, value in values.items() if name in POSES and value is not None}
    if "to_world" not in known and "R" not in known:
        return look_at(known["origin"], known["target"], known.get("up", UP), "", device)
    if device is not None:
        known = {name: tensor_of(value, device) for name, value in known.items()}
    if "R" in known:
        return opencv.pose(known["R"], known["t"])
    return affine(known["to_world"][:3, :3], known["to_world"][:3, 3])


def pose_of(values: Mapping[str, Any], given: frozenset[str], sized_by: str = "") -> NDArray[np.float64]:
    """Camera to world ``(4, 4)``, from what a file states.

    Args:
        values: of the parameters by name.
        given: names of those that the file states.
        sized_by: what an error says where the pose has a scale.

    Raises:
        Refused: no pose, two of them, or one that is no rotation and translation.
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
