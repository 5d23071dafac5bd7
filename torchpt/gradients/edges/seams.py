"""Lines on flat surfaces along which textures jump: borders of texels that are not interpolated, squares of checkerboards.

They hide nothing. As a surface or the camera moves they move over the picture, as creases do.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchpt.gradients.edges.meshes import MeshOf
from torchpt.math.vectors import take
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.primitive import PRIMITIVES
from torchpt.physics.textures import Node
from torchpt.physics.textures.atlas import ImageNode
from torchpt.scene import Scene
from torchpt.scene.world.primitives import corners_of

__all__ = ["jumps_elsewhere", "jumps_where_u_begins", "lies_on_seams", "seams_within"]

#: Kinds of primitives whose texture coordinates are affine in their own numbers.
_FLAT = ("triangle", "rectangle")
#: Most lines of a surface; textures of more are left out.
MOST = 1 << 17
#: Texels: what is closer to the border of one lies on it.
_ON = 1e-6
#: Lines whose ends are the same after rounding to one over this are one.
_SAME = 2.0**20


@dataclass(frozen=True)
class _Lines:
    """Coordinates of which each whole number is a line: of an axis of one texture, at the corners of P primitives.

    Attributes:
        at: ``(K, P)`` float64 at the corners of each primitive, in order around it.
        least: the first line; -inf without an end.
        most: the last line.
    """

    at: Tensor
    least: float
    most: float


def _jumping(owner: Part | Copy) -> set[Node]:
    """Return the textures of a part or a copy that jump."""
    nodes = {node for node in owner.material.textures() if getattr(node, "nearest", False)}
    emission = owner.emission_texture if isinstance(owner, Part) else None
    return nodes | ({emission} if emission is not None and getattr(emission, "nearest", False) else set())


def _lines_of(scene: Scene, owner: Part | Copy, part: Part, params: Mapping[str, Tensor]) -> list[_Lines]:
    """Return the lines of a part, or of a copy of it; none where these are more than :data:`MOST`."""
    nodes = [node for node in _jumping(owner) if isinstance(node, ImageNode)]
    if not nodes or part.kind not in _FLAT:
        return []
    with torch.no_grad():
        corners = corners_of(part, params, scene.space, torch.float64)
        a, b, c = (x.double() for x in PRIMITIVES[part.kind].uvs(part, corners))
        around = torch.stack((a, b, c) if part.kind == "triangle" else (a, b, b + c - a, c))  # (K, 2, P)
        found: dict[tuple[object, ...], _Lines] = {}  # textures of one size share lines
        for node in nodes:
            height, width = node.image(params).shape[:2]
            for row, size in zip(node.transform, (width, height), strict=True):
                ends = (1.0, size - 1.0) if node.wrap == "clamp" else (-math.inf, math.inf)
                at = (around[:, 0] * row[0] + around[:, 1] * row[1] + row[2]) * size
                found[row, size, ends] = _Lines(at, *ends)
    lines = list(found.values())
    return lines if sum(int(_counts(x)[1].sum()) for x in lines) <= MOST else []


def _counts(lines: _Lines) -> tuple[Tensor, Tensor]:
    """Return the first line that crosses each primitive within, and how many do: ``(P,)`` float64 and int64."""
    first = (torch.floor(lines.at.amin(0) + _ON) + 1.0).clamp_min(lines.least)
    last = (torch.ceil(lines.at.amax(0) - _ON) - 1.0).clamp_max(lines.most)
    return first, (last - first + 1.0).clamp_min(0.0).long()


def seams_within(
    scene: Scene, owner: Part | Copy, part: Part, params: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return primitives of a part ``(N,)``, and where lines within them begin and end ``(3, N)``, in their own numbers.

    A line of several textures is there once. None: there are no lines.

    Args:
        scene: the scene.
        owner: the part or a copy of it, whose material counts.
        part: the part.
        params: the parameters.
    """
    found = []
    for lines in _lines_of(scene, owner, part, params):
        first, count = _counts(lines)
        prim = torch.arange(len(count), device=count.device).repeat_interleave(count)
        before = count.cumsum(0) - count
        line = take(first, prim) + (torch.arange(len(prim), device=prim.device) - take(before, prim)).double()
        found.append(torch.cat((prim[None].double(), *_across(take(lines.at, prim) - line))))
    if not sum(part.shape[1] for part in found):
        return None
    every = torch.cat(found, 1)  # (7, N)
    _, same = torch.unique(torch.round(every * _SAME), dim=1, return_inverse=True)
    one = torch.full((int(same.max()) + 1,), len(same), device=same.device)
    every = every[:, one.scatter_reduce(0, same, torch.arange(len(same), device=same.device), "amin")]
    return every[0].long(), every[1:4], every[4:]


def _across(beside: Tensor) -> tuple[Tensor, Tensor]:
    """Return where lines cross the outlines of primitives, ``(3, N)`` each, in their own numbers.

    ``beside``: how far their corners ``(K, N)`` lie beside the lines, some of them on either side.
    """
    places = _around(len(beside), beside.device)
    after = beside.roll(-1, 0)
    crossed = (beside >= 0) != (after >= 0)
    share = beside / torch.where(crossed, beside - after, 1.0)
    at = places[:, :, None] + (places.roll(-1, 0) - places)[:, :, None] * share[:, None]  # (K, 3, N)
    two = torch.argsort((~crossed).to(torch.int8), dim=0, stable=True)[:2]  # an outline without dents is crossed twice
    begin, end = at.gather(0, two[:, None].expand(2, 3, -1))
    return begin, end


@lru_cache
def _around(corners: int, device: torch.device) -> Tensor:
    """Return the own numbers ``(K, 3)`` of the corners of triangles or rectangles, in order around them."""
    places = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]
    if corners == 4:
        places.insert(2, (1.0, 1.0, 0.0))
    return torch.tensor(places, dtype=torch.float64, device=device)


def lies_on_seams(scene: Scene, mesh: MeshOf, params: Mapping[str, Tensor]) -> Tensor:
    """Return a mask ``(E,)`` of the edges of a mesh, or a copy of one, that lie on lines; ``params``: the parameters."""
    edges = mesh.edges
    found = torch.zeros_like(edges.border)
    swap = torch.tensor((0, 2, 1) if mesh.turned else (0, 1, 2), device=found.device)
    for lines in _lines_of(scene, mesh.owner, mesh.part, params):
        a, b = (lines.at[swap[corner[0]], edges.face[0]] for corner in (edges.first, edges.last))
        line = torch.round(a)
        on = ((a - line).abs() < _ON) & ((b - line).abs() < _ON)
        found |= on & (line >= lines.least) & (line <= lines.most)
    return found


def jumps_where_u_begins(scene: Scene) -> bool:
    """Return True if a texture jumps where u of a round surface goes on from 1 to 0."""

    def jumps(node: Node) -> bool:
        turns = [row[0] for row in getattr(node, "transform", ())]
        wrap = getattr(node, "wrap", "repeat")
        return any(turns) if wrap == "clamp" else any(turn % (2.0 if wrap == "mirror" else 1.0) for turn in turns)

    return any(jumps(node) for part in scene.built.parts if part.kind not in _FLAT for node in part.material.textures())


def jumps_elsewhere(scene: Scene) -> bool:
    """Return True if textures jump along curves that are not known: on round surfaces, of kinds of one's own, or too many."""
    parts = {part.name: part for part in scene.built.parts}
    for owner in (*scene.built.parts, *scene.built.copies):
        nodes = _jumping(owner)
        if not nodes:
            continue
        part = parts[owner.of] if isinstance(owner, Copy) else owner
        known = part.kind in _FLAT and all(isinstance(node, ImageNode) for node in nodes)
        if not known or not _lines_of(scene, owner, part, scene.merged(None)):
            return True
    return False
