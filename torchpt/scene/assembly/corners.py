"""Where the primitives of one part lie: corners and normals in the world, differentiable in vertices and pose."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchpt.scene.parts import Part
from torchpt.scene.space import Space
from torchpt.shapes.primitive import PRIMITIVES, Corners

__all__ = ["Corners", "corners_of"]


#: Arrays of a mesh that may be parameters.
_OWN = ("vertices", "normals", "uvs")


def corners_of(part: Part, parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype) -> Corners:
    """Place a part in the lanes' coordinates."""
    # They are folded into the pose in float64, before anything is rounded to the lanes' dtype.
    pose = parameters[f"{part.name}.to_world"].double()
    if part.local is not None:
        pose = pose @ torch.from_numpy(part.local).to(pose.device)
    own = {key: parameters[f"{part.name}.{key}"] for key in _OWN if f"{part.name}.{key}" in parameters}
    return PRIMITIVES[part.kind].corners(part, space.pose(pose), dtype, own)
