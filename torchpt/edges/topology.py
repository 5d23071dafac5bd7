"""The edges of a mesh: which two faces meet at each, once a scene.

Vertices that lie at one place are one here, whatever a file made of them: a cube has four vertices a side, and still twelve
edges. An edge is told by a corner of each of its faces, so that it moves as the vertices of both do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchpt.scene.parts import Part

__all__ = ["Edges", "edges_of"]


@dataclass(frozen=True)
class Edges:
    """E edges of one mesh; corners are numbered as the mesh's own faces have them.

    Attributes:
        face: ``(2, E)`` int64 the two faces; the second is that of the first where there is none.
        first: ``(2, E)`` int64 the corner of each face at which the edge begins.
        last: ``(2, E)`` where it ends.
        other: ``(2, E)`` the corner off the edge.
        border: ``(E,)`` bool: one face alone.
        split: ``(E,)`` bool: whether the faces have vertices of their own, so that normals and texture coordinates may jump.
    """

    face: Tensor
    first: Tensor
    last: Tensor
    other: Tensor
    border: Tensor
    split: Tensor


def edges_of(part: Part, device: torch.device) -> Edges:
    """The edges of a mesh, on a device."""
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
