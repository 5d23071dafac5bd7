"""Primitives of the world from parts: corners of triangles, copies of instances, tables by kind."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.vectors import cross, dot, normalize
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.geometry import KINDS, Geometry, Instances, Quadrics
from torchpt.physics.shapes.primitive import PRIMITIVES, Corners, Primitive
from torchpt.physics.shapes.quadrics import quadrics_of, table_of
from torchpt.scene.space import Space

__all__ = [
    "MOST_PRIMITIVES",
    "Corners",
    "Primitives",
    "copies_of",
    "copy_maps",
    "corners_of",
    "corners_of_all",
    "primitives_of",
]


# ---- Where the primitives of one part lie: corners and normals in the world, differentiable in vertices and pose


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


# ---- Instances: the maps that copy meshes, for the search and for the lanes


#: Ids of primitives are int32 in the searches.
MOST_PRIMITIVES = 2**31 - 1


def copy_maps(
    parts: Sequence[Part], sizes: list[int], copies: Sequence[Copy], parameters: Mapping[str, Tensor], space: Space
) -> Tensor:
    """Return where copies lie relative to their meshes: ``(15, I)`` float64, see :class:`Geometry`."""
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


def copies_of(maps: Tensor, copies: Sequence[Copy], dtype: torch.dtype) -> Instances:
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
    return Instances(start, first, x.to(dtype), y.to(dtype), z.to(dtype), move.to(dtype), nx, ny, nz)


# ---- All primitives of a scene in one table, from the corners of its parts


@dataclass(frozen=True)
class Primitives:
    """The P primitives, ordered by kind; see :class:`~torchpt.physics.world.World` for what has no comment."""

    kinds: tuple[type[Primitive], ...]  # those that there are
    sizes: list[int]  # how many each part has
    counts: tuple[int, int, int, int, int]
    p0: Tensor
    p1: Tensor
    p2: Tensor
    e1: Tensor
    e2: Tensor
    face: Tensor  # (3, P) cross product of the edges
    sign: Tensor  # (P,) -1 where a shape's normals are turned around
    normal: Tensor
    normals: tuple[Tensor, Tensor, Tensor] | None
    bound: Tensor
    frame: Tensor | None  # (12, Q) float64: p0 e1 e2 e3 of the quadrics
    quadrics: Quadrics | None

    def detached(self) -> Primitives:
        """The same without derivatives."""
        own = {name: getattr(self, name) for name in ("p0", "p1", "p2", "e1", "e2", "face", "sign", "normal", "bound")}
        return replace(self, **{name: value.detach() for name, value in own.items()})

    def spread(self, values: Sequence[int]) -> Tensor:
        """One value a part, and where given one a copy, as rows ``(P,)`` or ``(P + I,)`` by primitive and copy."""
        device = self.p0.device
        spans = self.sizes + [1] * (len(values) - len(self.sizes))
        return torch.repeat_interleave(
            torch.tensor(values, dtype=torch.int64, device=device),
            torch.tensor(spans, dtype=torch.int64, device=device),
        )

    def geometry(self, copies: Tensor | None) -> Geometry:
        """What the search sees."""
        # The corners themselves: rebuilt from edges, neighbours would no longer share them to the bit.
        q0, q1, q2 = (x.detach().to(torch.float32).contiguous() for x in (self.p0, self.p1, self.p2))
        table = None
        if self.quadrics is not None and self.frame is not None:
            table = table_of(self.quadrics, self.frame)
        return Geometry(q0, q1, q2, self.counts, table, None if copies is None else copies.detach())


def primitives_of(
    parts: Sequence[Part], corners: Sequence[Corners], dtype: torch.dtype, device: torch.device
) -> Primitives:
    """The primitives of ``parts``, which are ordered by kind as ``records.KINDS``."""
    sizes = [c.p0.shape[1] for c in corners]
    numbers = [sum(n for n, part in zip(sizes, parts, strict=True) if part.kind == kind) for kind in KINDS]
    counts = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])

    def joined(pieces: list[Tensor]) -> Tensor:
        return torch.cat(pieces, -1) if pieces else torch.zeros(3, 0, dtype=dtype, device=device)

    kinds = tuple(PRIMITIVES[kind] for kind, count in zip(KINDS, counts, strict=True) if count)
    flat = sum(count for kind, count in zip(KINDS, counts, strict=True) if count and PRIMITIVES[kind].flat)
    p0, p1, p2 = (joined([getattr(c, name) for c in corners]) for name in ("p0", "p1", "p2"))
    planar = (torch.arange(p0.shape[1], device=device) < flat) if flat < sum(counts) else None
    e1 = p1 - p0 if planar is None else torch.where(planar, p1 - p0, p1)
    e2 = p2 - p0 if planar is None else torch.where(planar, p2 - p0, p2)
    signs = torch.tensor([-1.0 if part.flip else 1.0 for part in parts], dtype=dtype, device=device)
    sign = torch.repeat_interleave(signs, torch.tensor(sizes, dtype=torch.int64, device=device))
    face = cross(e1, e2)
    normal = normalize(face) * sign
    normals = None
    if any(c.normals is not None for c in corners):
        faces = normal.split(sizes, 1)
        triples = [c.normals or (n, n, n) for c, n in zip(corners, faces, strict=True)]
        flips = [-1.0 if part.flip and c.normals is not None else 1.0 for part, c in zip(parts, corners, strict=True)]
        n0, n1, n2 = (
            joined([t[k] if f == 1.0 else t[k] * f for t, f in zip(triples, flips, strict=True)]) for k in range(3)
        )
        normals = (n0, n1, n2)
        # The outside is where the shading normals point, whatever way a file winds its faces.
        against = dot(normal, n0 + n1 + n2).detach() < 0
        normal = torch.where(against, -normal, normal)
    # Largest coordinate magnitudes over each primitive, its whole parallelogram or ellipse included.
    largest = (p0.abs() + e1.abs() + e2.abs()).detach()
    bound = dot(normal.detach().abs(), largest)
    if planar is not None:
        bound = torch.where(planar, bound, (p0.abs().sum(0) + 2.0 * e1[0].abs()).detach())
    frames = [c.frame for c in corners if c.frame is not None]
    frame = torch.cat(frames, 1) if frames else None
    curved = None
    if frame is not None:
        bent = [part for part in parts if part.quadric is not None]
        curved = quadrics_of(
            [part.quadric for part in bent if part.quadric], [part.flip for part in bent], frame, dtype
        )
    return Primitives(kinds, sizes, counts, p0, p1, p2, e1, e2, face, sign, normal, normals, bound, frame, curved)
