"""Instances: the maps that copy meshes, for the search and for the lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from torchpt.errors import SceneError
from torchpt.math.vectors import cross, dot
from torchpt.records import Copies
from torchpt.scene.parts import Copy, Part
from torchpt.scene.space import Space

__all__ = ["MOST_PRIMITIVES", "copies_of", "copy_maps"]


#: Ids of primitives are int32 in the searches.
MOST_PRIMITIVES = 2**31 - 1


def copy_maps(
    parts: Sequence[Part], sizes: list[int], copies: Sequence[Copy], parameters: Mapping[str, Tensor], space: Space
) -> Tensor:
    """Where copies lie relative to their meshes: ``(15, I)`` float64, see :class:`~torchpt.records.Geometry`."""
    first, at = {}, 0
    for part, n in zip(parts, sizes, strict=True):
        first[part.name], at = (at, n), at + n
    if at + sum(first[copy.of][1] for copy in copies) > MOST_PRIMITIVES:
        raise SceneError(
            "shapes", at + sum(first[c.of][1] for c in copies), "at most 2^31 - 1 primitives, copies included"
        )
    back = {name: torch.linalg.inv(parameters[f"{name}.to_world"].double()) for name in {copy.of for copy in copies}}
    shift = space.matrix()
    columns = []
    for copy in copies:
        start, n = first[copy.of]
        pose = parameters[f"{copy.name}.to_world"].double()
        matrix = (torch.linalg.inv(shift) @ pose @ back[copy.of] @ shift)[:3]
        columns.append(torch.cat((matrix.reshape(-1), matrix.new_tensor([start, n, at]))))
        at += n
    return torch.stack(columns, 1)


def copies_of(maps: Tensor, copies: Sequence[Copy], dtype: torch.dtype) -> Copies:
    """What lanes need of copies, the identity first."""
    same = torch.eye(3, 4, dtype=torch.float64, device=maps.device).reshape(-1)
    maps = torch.cat((torch.cat((same, same.new_zeros(3)))[:, None], maps), 1)
    x, y, z, move = (maps[k:12:4] for k in range(4))
    faces = [cross(y, z), cross(z, x), cross(x, y)]
    front = torch.tensor([1.0] + [-1.0 if copy.flip else 1.0 for copy in copies], dtype=x.dtype, device=x.device)
    front = front * torch.sign(dot(x, faces[0]).detach())
    scale = torch.stack(faces).detach().abs().amax((0, 1))
    nx, ny, nz = ((n * (front / scale)).to(dtype) for n in faces)
    first, start = maps[12].detach().to(torch.int64), maps[14].detach().to(torch.int64)
    return Copies(start, first, x.to(dtype), y.to(dtype), z.to(dtype), move.to(dtype), nx, ny, nz)
