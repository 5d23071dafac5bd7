"""Where a camera stands: by a point that it looks at, by a matrix, or by OpenCV's world-to-camera rotation and translation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from torchpt.cameras import opencv
from torchpt.errors import SceneError
from torchpt.math.transforms import is_rigid, is_usable, look_at
from torchpt.spec import Other, Point, Pose, Refused, Spec

__all__ = ["POSES", "UP", "pose_of"]

#: What is up where a camera does not say.
UP = (0.0, 1.0, 0.0)
#: The keys that together say a pose; of each way the first ones are required.
_WAYS = {"to_world": ("to_world",), "origin, target and up": ("origin", "target", "up"), "R and t": ("R", "t")}


class _Told(Point):
    """Three numbers that say where the camera stands: no tensor of the scene, the pose made of them is."""

    traced: ClassVar[bool] = False
    place: ClassVar[bool] = False


#: What every camera declares.
POSES: Mapping[str, Spec] = {
    "origin": _Told(None, doc="where it stands"),
    "target": _Told(None, doc="a point that it looks at"),
    "up": _Told(None, doc="what is up in the picture, any direction but the viewing direction; [0, 1, 0] by default"),
    "to_world": Pose(
        None,
        rigid=True,
        operations=False,
        doc="in place of these: from its own space (it looks along +z, +y is up, +x left in the picture) to the world",
    ),
    "R": Other(
        None,
        reader=opencv.rotation,
        words="three rows of a rotation",
        doc="in place of these, with `t`: OpenCV's rotation from the world to the camera (+x right, +y down, +z ahead)",
    ),
    "t": Other(
        None,
        reader=opencv.translation,
        words="three finite numbers [x, y, z]",
        doc="where the world's origin lies in the camera's space, a point `X` of the world at `R X + t`",
    ),
}


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
    if ways == ["to_world"]:
        if not is_rigid(values["to_world"]):
            hint = f" ({sized_by})" if sized_by else ""
            raise Refused(f"a pose without scale or shear{hint}", values["to_world"].tolist(), ("to_world",))
        return values["to_world"]
    if ways == ["R and t"]:
        for name, what in (("R", "a rotation"), ("t", "a translation [x, y, z]")):
            if values[name] is None:
                raise Refused(f"{what} (R and t go together)", None, (name,))
        pose = opencv.pose(values["R"], values["t"])
        if not is_usable(pose):
            raise Refused("a translation that is finite in float32", values["t"].tolist(), ("t",))
        return pose
    for name in ("origin", "target"):
        if values[name] is None:
            raise Refused(
                "a point [x, y, z] (a camera needs origin and target, or to_world, or R and t)", None, (name,)
            )
    try:
        return look_at(values["origin"], values["target"], values["up"] or UP, key="")
    except SceneError as error:
        raise Refused(error.expected, error.value, (error.key,)) from None
