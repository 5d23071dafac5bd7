"""Where the primitives of one part lie: corners and normals in the world, differentiable in vertices and pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby

import torch
from torch import Tensor

from torchpt.scene.parts import Part
from torchpt.scene.space import Space
from torchpt.shapes.primitive import PRIMITIVES, Corners

__all__ = ["Corners", "corners_of", "corners_of_all"]


#: Arrays of a mesh that may be parameters.
_OWN = ("vertices", "normals", "uvs")


def corners_of(part: Part, parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype) -> Corners:
    """Place a part in the lanes' coordinates."""
    pose = space.pose(_pose_of(part, parameters))
    own = {key: parameters[f"{part.name}.{key}"] for key in _OWN if f"{part.name}.{key}" in parameters}
    return PRIMITIVES[part.kind].corners(part, pose, dtype, own)


def corners_of_all(
    parts: Sequence[Part], parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype
) -> list[Corners]:
    """Place parts, which are in the order of their kinds: those of a kind at once where that can be."""
    found: list[Corners] = []
    for kind, group in groupby(parts, lambda part: part.kind):
        own = list(group)
        many = None
        if len(own) > 1 and own[0].vertices is None:
            poses = space.pose(torch.stack([_pose_of(part, parameters) for part in own]))
            many = PRIMITIVES[kind].corners_of_many(poses, dtype)
        found += many or [corners_of(part, parameters, space, dtype) for part in own]
    return found


def _pose_of(part: Part, parameters: Mapping[str, Tensor]) -> Tensor:
    """From a part's own space to the scene's, in float64: all is folded in before anything is rounded to the lanes' dtype."""
    pose = parameters[f"{part.name}.to_world"].double()
    return pose if part.local is None else pose @ torch.from_numpy(part.local).to(pose.device)
