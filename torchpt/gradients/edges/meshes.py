"""Edges of meshes: which two faces meet at each, once a scene; which primitives of a scene belong to what."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.geometry import KINDS
from torchpt.scene import Scene
from torchpt.scene.prepare import scene_cache

__all__ = ["Edges", "MeshOf", "edges_of", "marked_primitives", "meshes_of", "neighbours_of", "owners_of", "starts_of"]


# ---- The edges of a mesh
#
# Vertices that lie at one place are one here, whatever a file made of them: a cube has four vertices a side, and still twelve
# edges. An edge is told by a corner of each of its faces, so that it moves as the vertices of both do.


@dataclass(frozen=True)
class Edges:
    """E edges of one mesh; corners are numbered as the mesh's own faces have them.

    Attributes:
        face: ``(2, E)`` int64 the two faces; the second is that of the first where there is none.
        first: ``(2, E)`` int64 the corner of each face at which the edge begins.
        last: ``(2, E)`` where it ends.
        other: ``(2, E)`` the corner off the edge.
        border: ``(E,)`` bool: one face alone.
        split: ``(E,)`` bool: whether the faces have vertices of their own, so that normals and texture coordinates may jump,
            and parameters may move the faces apart.
    """

    face: Tensor
    first: Tensor
    last: Tensor
    other: Tensor
    border: Tensor
    split: Tensor

    @cached_property
    def behind(self) -> Tensor:
        """Return the faces ``(3, F)`` behind the edges of faces, each at the corner off it; -1: none."""
        found = torch.full((3, int(self.face.max()) + 1), -1, dtype=torch.int64, device=self.face.device)
        inner = (~self.border).nonzero().squeeze(1)
        face, other = self.face[:, inner], self.other[:, inner]
        for k in (0, 1):
            found[other[k], face[k]] = face[1 - k]
        return found

    def of_face(self, k: int) -> Edges:
        """Return the same edges by the corners of face ``k`` alone, 0 or 1."""
        face, first, last, other = (t[k].expand(2, -1) for t in (self.face, self.first, self.last, self.other))
        return Edges(face, first, last, other, self.border, self.split)


def edges_of(part: Part, device: torch.device) -> Edges:
    """Return the edges of a mesh, on a device."""
    assert part.faces is not None and part.vertices is not None
    faces, vertices = part.faces, part.vertices
    _, welded = np.unique(vertices, axis=0, return_inverse=True)
    corners = welded.reshape(-1)[faces]  # (F, 3)
    count = len(faces)
    face = np.tile(np.arange(count), 3)
    begin, end = np.repeat(np.arange(3), count), np.repeat((1, 2, 0), count)
    a, b = corners[face, begin], corners[face, end]
    turned = a > b
    begin, end = np.where(turned, end, begin), np.where(turned, begin, end)
    key = np.minimum(a, b).astype(np.int64) * (len(vertices) + 1) + np.maximum(a, b)
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    size = np.diff(starts, append=len(order))
    # Of more than two faces at an edge each is a border of its own.
    pairs, alone = starts[size == 2], order[np.repeat(size != 2, size)]
    one, two = np.concatenate((order[pairs], alone)), np.concatenate((order[pairs + 1], alone))
    split = np.zeros(len(one), bool)
    for corner in (begin, end):
        split |= faces[face[one], corner[one]] != faces[face[two], corner[two]]

    def columns(values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.stack((values[one], values[two])).astype(np.int64)).to(device)

    border = torch.from_numpy(np.arange(len(one)) >= len(pairs)).to(device)
    other = columns(3 - begin - end)
    return Edges(columns(face), columns(begin), columns(end), other, border, torch.from_numpy(split).to(device))


# ---- Whose primitives are which


def marked_primitives(
    scene: Scene, of_part: Callable[[Part], bool], of_copy: Callable[[Copy, bool], bool] = lambda _, marked: marked
) -> Tensor:
    """Return a mask ``(P,)`` of primitives by ids of the search.

    Args:
        scene: the scene.
        of_part: whether the primitives of a part are marked.
        of_copy: whether those of a copy are, given whether those of its mesh are.
    """
    marks = [(of_part(part), part.primitive_count) for part in scene.built.parts]
    meshes = {part.name: mark for part, mark in zip(scene.built.parts, marks, strict=True)}
    for copy in scene.built.copies:
        marked, count = meshes[copy.of]
        marks.append((of_copy(copy, marked), count))
    marked, counts = (torch.tensor(column, device=scene.device) for column in zip(*marks, strict=True))
    return marked.bool().repeat_interleave(counts)


def starts_of(parts: tuple[Part, ...], bodies: Bodies) -> list[int]:
    """Return the id of the first primitive of each part."""
    starts, at = [], 0
    for part in parts:
        starts.append(at)
        at += part.primitive_count
    assert at == sum(bodies.counts)
    return starts


def owners_of(scene: Scene, part: Part, start: int, bodies: Bodies) -> list[tuple[Part | Copy, int]]:
    """Return a part and its copies, with the ids of their first primitives; ``start``: that of the part."""
    found: list[tuple[Part | Copy, int]] = [(part, start)]
    if bodies.copies is not None:
        starts = bodies.copies.start.tolist()
        found += [(copy, starts[k]) for k, copy in enumerate(scene.built.copies, 1) if copy.of == part.name]
    return found


# ---- The meshes of a scene, copies included


@dataclass(frozen=True)
class MeshOf:
    """A mesh, or a copy of one, and its edges.

    Attributes:
        owner: the mesh or the copy.
        part: the mesh.
        first: id of its first triangle.
        edges: of the mesh.
        turned: True: its triangles have their last two corners exchanged.
    """

    owner: Part | Copy
    part: Part
    first: int
    edges: Edges
    turned: bool


def meshes_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor], moves: Tensor | None = None) -> Iterator[MeshOf]:
    """Yield each mesh and each copy.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
        moves: ``(P,)`` bool on the CPU: primitives that move; those of which none does are left out. None: all are yielded.
    """
    made = scene_cache(scene).outlines
    for part, start in zip(scene.built.parts, starts_of(scene.built.parts, bodies), strict=True):
        if part.kind != KINDS[0]:
            continue
        count = part.primitive_count
        owners = owners_of(scene, part, start, bodies)
        if moves is not None:
            owners = [(owner, first) for owner, first in owners if bool(moves[first : first + count].any())]
        if not owners:
            continue
        if part.name not in made:
            made[part.name] = edges_of(part, scene.device)
        turned = bool(torch.linalg.det(poses[f"{part.name}.to_world"][:3, :3].double()) < 0)
        for owner, first in owners:
            yield MeshOf(owner, part, first, made[part.name], turned)


def neighbours_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Tensor:
    """Return the triangles ``(3, P)`` behind the edges of triangles, each at the corner off it as they are numbered; -1: none.

    Arguments are as for :func:`meshes_of`.
    """
    counts = {part.name: part.primitive_count for part in scene.built.parts}
    total = sum(bodies.counts) + sum(counts[copy.of] for copy in scene.built.copies)
    found = torch.full((3, total), -1, dtype=torch.int64, device=scene.device)
    for mesh in meshes_of(scene, bodies, poses):
        behind = mesh.edges.behind[[0, 2, 1]] if mesh.turned else mesh.edges.behind
        found[:, mesh.first : mesh.first + behind.shape[1]] = torch.where(behind >= 0, behind + mesh.first, -1)
    return found
