"""Build the primitives of the world: corners of triangles, instances, tables by kind.

:func:`torchpt.scene.world.assemble.assemble` calls these functions; :mod:`torchpt.gradients.edges.bodies` does in float64. All
are differentiable in the parameters. A scene has P primitives, Q of them quadrics, and I instances (copies of parts, which
share the part's triangles). Coordinates are those of lanes (:class:`~torchpt.scene.space.Space`): the *world*.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.core.tree import leaves
from torchpt.math.vectors import cross, dot, normalize, side_by_side
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


# ---- Primitives of one part: corners and normals in the world, differentiable in vertices and pose


#: Arrays of a mesh that may be parameters.
_MESH_PARAMS = ("vertices", "normals", "uvs", "colors")


def corners_of(part: Part, parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype) -> Corners:
    """Return the corners of a part in the coordinates of lanes."""
    pose = space.pose(_pose_of(part, parameters))
    mesh_params = {key: parameters[f"{part.name}.{key}"] for key in _MESH_PARAMS if f"{part.name}.{key}" in parameters}
    return PRIMITIVES[part.kind].corners(part, pose, dtype, mesh_params)


def corners_of_all(
    parts: Sequence[Part], parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype
) -> list[Corners]:
    """Return the corners of parts, which are ordered by kind; parts of a kind are computed at once where possible."""
    found: list[Corners] = []
    for kind, group in groupby(parts, lambda part: part.kind):
        alike = list(group)
        batched = None  # None too where the kind computes its parts one by one
        if len(alike) > 1 and alike[0].vertices is None:
            poses = space.pose(torch.stack([_pose_of(part, parameters) for part in alike]))
            batched = PRIMITIVES[kind].corners_of_many(poses, dtype)
        found += batched or [corners_of(part, parameters, space, dtype) for part in alike]
    return found


def _pose_of(part: Part, parameters: Mapping[str, Tensor]) -> Tensor:
    """Return the pose of a part to the scene in float64, so that only the final product is rounded to the lanes' dtype."""
    pose = parameters[f"{part.name}.to_world"].double()
    return pose if part.part_to_shape is None else pose @ torch.from_numpy(part.part_to_shape).to(pose.device)


# ---- Instances: transforms of copied meshes, for the search and for lanes


#: Searches have int32 ids of primitives.
MOST_PRIMITIVES = 2**31 - 1


def copy_maps(
    parts: Sequence[Part], sizes: list[int], copies: Sequence[Copy], parameters: Mapping[str, Tensor], space: Space
) -> Tensor:
    """Return the transforms of copies relative to their meshes: ``(15, I)`` float64, as ``Geometry.copies``.

    Rows 0 to 11 are the ``(3, 4)`` map from the mesh, in world coordinates, to its copy; row 12 is the id of the mesh's first
    triangle, row 13 its number of triangles, row 14 the id of the copy's first primitive: those of copies follow the P stored
    ones.

    Args:
        parts: the parts; ``copy.of`` is the name of the part that a copy repeats.
        sizes: number of primitives of each part.
        copies: the copies.
        parameters: every tensor by dotted name.
        space: the coordinates of lanes.

    Raises:
        SceneError: more than :data:`MOST_PRIMITIVES` primitives.
    """
    spans, next_id = {}, 0  # first primitive and number of primitives of each part, by name
    for part, size in zip(parts, sizes, strict=True):
        spans[part.name], next_id = (next_id, size), next_id + size
    total = next_id + sum(size for _, size in (spans[copy.of] for copy in copies))
    if total > MOST_PRIMITIVES:
        raise SceneError("shapes", total, "at most 2^31 - 1 primitives, copies included")
    from_scene = {
        name: torch.linalg.inv(parameters[f"{name}.to_world"].double()) for name in {copy.of for copy in copies}
    }
    lanes_to_scene = space.matrix()
    scene_to_lanes = torch.linalg.inv(lanes_to_scene)
    columns = []
    for copy in copies:
        start, size = spans[copy.of]
        pose = parameters[f"{copy.name}.to_world"].double()
        # Read from the right: lanes to scene, to the mesh's own space, to the copy in the scene, back to lanes.
        matrix = (scene_to_lanes @ pose @ from_scene[copy.of] @ lanes_to_scene)[:3]
        columns.append(torch.cat((matrix.reshape(-1), matrix.new_tensor([start, size, next_id]))))
        next_id += size
    return torch.stack(columns, 1)


def copies_of(maps: Tensor, copies: Sequence[Copy], dtype: torch.dtype) -> Instances:
    """Return the transforms of copies for lanes, the identity first; ``maps (15, I)`` as :func:`copy_maps` returns them."""
    identity = torch.eye(3, 4, dtype=torch.float64, device=maps.device).reshape(-1)
    maps = torch.cat((torch.cat((identity, identity.new_zeros(3)))[:, None], maps), 1)
    # Row-major (3, 4) matrices: every fourth row from k on is column k. x y z are the linear map, move the translation.
    x, y, z, move = (maps[k:12:4] for k in range(4))
    faces = [cross(y, z), cross(z, x), cross(x, y)]  # columns of the cofactor matrix, which transforms normals
    front = torch.tensor([1.0] + [-1.0 if copy.flip else 1.0 for copy in copies], dtype=x.dtype, device=x.device)
    front = front * torch.sign(dot(x, faces[0]).detach())  # x . (y cross z) is the determinant: -1 for mirrored copies
    scale = torch.stack(faces).detach().abs().amax((0, 1))
    nx, ny, nz = ((n * (front / scale)).to(dtype) for n in faces)
    mesh_first, copy_first = maps[12].detach().to(torch.int64), maps[14].detach().to(torch.int64)
    return Instances(
        start=copy_first,
        first=mesh_first,
        x=x.to(dtype),
        y=y.to(dtype),
        z=z.to(dtype),
        move=move.to(dtype),
        nx=nx,
        ny=ny,
        nz=nz,
    )


# ---- Table of all primitives of a scene, from the corners of its parts


@dataclass(frozen=True)
class Primitives:
    """The P primitives of a scene, ordered by kind. Fields without a comment are those of ``LaneGeometry``."""

    kinds: tuple[type[Primitive], ...]  # those that occur
    sizes: list[int]  # number of primitives of each part
    taped: list[bool]  # whether each part requires gradients
    counts: tuple[int, int, int, int, int]
    p0: Tensor  # (3, P) first corner or centre
    p1: Tensor  # (3, P) as in Geometry
    p2: Tensor
    e1: Tensor  # (3, P) edges from p0; the first two axes of a sphere or quadric
    e2: Tensor
    sign: Tensor  # (P,) -1 where a shape's normals are flipped
    normal: Tensor
    normals: tuple[Tensor, Tensor, Tensor] | None
    bound: Tensor
    frame: Tensor | None  # (12, Q) float64: p0 e1 e2 e3 of the quadrics
    quadrics: Quadrics | None

    def detached(self) -> Primitives:
        """Return detached primitives."""
        tensors = {name: getattr(self, name) for name in ("p0", "p1", "p2", "e1", "e2", "sign", "normal", "bound")}
        return replace(self, **{name: value.detach() for name, value in tensors.items()})

    def spread(self, values: Sequence[int]) -> Tensor:
        """Repeat one value per part for each of its primitives: ``(P,)``; with further values, one per copy: ``(P + I,)``."""
        device = self.p0.device
        repeats = self.sizes + [1] * (len(values) - len(self.sizes))
        return torch.repeat_interleave(
            torch.tensor(values, dtype=torch.int64, device=device),
            torch.tensor(repeats, dtype=torch.int64, device=device),
            output_size=sum(repeats),
        )

    def geometry(self, copies: Tensor | None) -> Geometry:
        """Return the geometry for the search; ``copies``: transforms of :func:`copy_maps`, or None."""
        # The corners themselves: recomputed from edges, neighbours would not share them to the bit.
        q0, q1, q2 = (x.detach().to(torch.float32).contiguous() for x in (self.p0, self.p1, self.p2))
        table = None
        if self.quadrics is not None and self.frame is not None:
            table = table_of(self.quadrics, self.frame)
        return Geometry(
            p0=q0, p1=q1, p2=q2, counts=self.counts, quadrics=table, copies=None if copies is None else copies.detach()
        )


def primitives_of(
    parts: Sequence[Part], corners: Sequence[Corners], dtype: torch.dtype, device: torch.device
) -> Primitives:
    """Build the primitives of ``parts``, which are ordered by kind as ``geometry.KINDS``, from their ``corners``."""
    sizes = [c.p0.shape[1] for c in corners]  # c: the corners of one part
    numbers = [sum(n for n, part in zip(sizes, parts, strict=True) if part.kind == kind) for kind in KINDS]
    counts = (numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])  # spelled out for the type checker

    def joined(pieces: list[Tensor]) -> Tensor:
        return torch.cat(pieces, -1) if pieces else torch.zeros(3, 0, dtype=dtype, device=device)

    kinds = tuple(PRIMITIVES[kind] for kind, count in zip(KINDS, counts, strict=True) if count)
    # Planar kinds come first in KINDS: these are the primitives 0 to flat_count - 1.
    flat_count = sum(count for kind, count in zip(KINDS, counts, strict=True) if count and PRIMITIVES[kind].flat)
    p0, p1, p2 = (joined([getattr(c, name) for c in corners]) for name in ("p0", "p1", "p2"))
    planar = None  # (P,) bool; None where all are
    if flat_count < sum(counts):
        planar = torch.arange(p0.shape[1], device=device) < flat_count
    # Curved primitives have vectors in p1 and p2, not points.
    e1 = p1 - p0 if planar is None else torch.where(planar, p1 - p0, p1)
    e2 = p2 - p0 if planar is None else torch.where(planar, p2 - p0, p2)
    signs = torch.tensor([-1.0 if part.flip else 1.0 for part in parts], dtype=dtype, device=device)
    sign = torch.repeat_interleave(signs, torch.tensor(sizes, dtype=torch.int64, device=device))
    normal = normalize(cross(e1, e2)) * sign
    normals = None
    if any(c.normals is not None for c in corners):
        faces = normal.split(sizes, 1)
        triples = [c.normals or (n, n, n) for c, n in zip(corners, faces, strict=True)]
        # Computed normals are those of faces, which have the sign already.
        flips = [-1.0 if part.flip and c.normals is not None else 1.0 for part, c in zip(parts, corners, strict=True)]
        n0, n1, n2 = (
            joined(
                [triple[k] if flip == 1.0 else triple[k] * flip for triple, flip in zip(triples, flips, strict=True)]
            )
            for k in range(3)
        )
        normals = (n0, n1, n2)
        # The outside is the side of the shading normals, whatever the winding of faces.
        against = dot(normal, n0 + n1 + n2).detach() < 0
        normal = torch.where(against, -normal, normal)
    # Largest coordinate magnitudes over each primitive, including its whole parallelogram or ellipse.
    largest = (p0.abs() + e1.abs() + e2.abs()).detach()
    bound = dot(normal.detach().abs(), largest)
    # A sphere has its radius in e1[0]. Quadrics are bounded at each point of theirs (`Interaction.bound`): these are not read.
    if planar is not None:
        bound = torch.where(planar, bound, (p0.abs().sum(0) + 2.0 * e1[0].abs()).detach())
    frames = [c.frame for c in corners if c.frame is not None]
    frame = torch.cat(frames, 1) if frames else None
    quadrics = None
    if frame is not None:
        quadric_parts = [part for part in parts if part.quadric is not None]
        quadrics = quadrics_of(
            [part.quadric for part in quadric_parts if part.quadric],
            [part.flip for part in quadric_parts],
            frame,
            dtype,
        )
    return Primitives(
        kinds=kinds,
        sizes=sizes,
        taped=[any(tensor.requires_grad for tensor in leaves(of_part)) for of_part in corners],
        counts=counts,
        p0=p0,
        p1=p1,
        p2=p2,
        e1=side_by_side(e1),
        e2=side_by_side(e2),
        sign=sign,
        normal=side_by_side(normal),
        normals=normals and (side_by_side(normals[0]), side_by_side(normals[1]), side_by_side(normals[2])),
        bound=bound,
        frame=frame,
        quadrics=quadrics,
    )
