"""The curves of a scene, owner by owner: those that are there anyway, and round ones, whose outlines depend on the place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.curves import Curves, borders, joined, mesh_edges, rims
from torchpt.edges.topology import Edges, edges_of
from torchpt.forward import kept
from torchpt.math.vectors import cross, dot
from torchpt.records import KINDS
from torchpt.scene import Scene
from torchpt.scene.parts import Part
from torchpt.shapes.quadrics import Form

__all__ = ["Folds", "Rounds", "folds_of", "known", "plain_of", "rounds_of"]

#: Faces whose unit normals differ by less make no crease.
_FLAT = 1e-6


@dataclass(frozen=True)
class Folds:
    """Edges of one mesh, or of one of its copies."""

    curves: Curves
    others: tuple[Held, Held]  # corners of the two faces off the edge
    border: Tensor  # (N,) bool
    crease: Tensor  # (N,) bool: where both faces are seen what is seen may jump
    normals: tuple[Tensor, Tensor]  # (3, N) unit, of the two faces


@dataclass(frozen=True)
class Rounds:
    """Round surfaces of one kind."""

    prim: Tensor  # (N,)
    form: Form | None  # of cylinders and cones; None: spheres and ellipsoids


def known(form: Form) -> bool:
    """Whether the outline of a quadric is known: ellipsoids, cylinders and cones."""
    return form.around or (form.half == 0 and (form.bend == 0 or (form.bend < 0 and form.level == 0)))


def _starts(parts: tuple[Part, ...], bodies: Bodies) -> list[int]:
    """The id of the first primitive of each part."""
    starts, at = [], 0
    for part in parts:
        starts.append(at)
        at += len(part.faces) if part.faces is not None else 1
    assert at == sum(bodies.counts)
    return starts


def _topology(scene: Scene, part: Part) -> Edges:
    made = kept(scene).outlines
    if part.name not in made:
        made[part.name] = edges_of(part, scene.device)
    return made[part.name]


def folds_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Iterator[Folds]:
    """The edges of each mesh, and of each copy.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
    """
    parts = scene.built.parts
    starts = dict(zip((part.name for part in parts), _starts(parts, bodies), strict=True))
    for part in parts:
        if part.kind != KINDS[0]:
            continue
        edges = _topology(scene, part)
        turned = bool(torch.linalg.det(poses[f"{part.name}.to_world"][:3, :3].double()) < 0)
        firsts = [starts[part.name]]
        if bodies.copies is not None:
            mine = [k for k, copy in enumerate(scene.built.copies, 1) if copy.of == part.name]
            firsts += bodies.copies.start[mine].tolist()
        every = torch.arange(len(edges.border), device=scene.device)
        for first in firsts:
            curves, others = mesh_edges(edges, every, first, turned)
            normals = (_normal(bodies, others[0].prim), _normal(bodies, others[1].prim))
            bent = dot(normals[0] - normals[1], normals[0] - normals[1]) > _FLAT**2
            crease = edges.split & (bent | (part.uvs is not None)) if part.smooth else bent
            yield Folds(curves, others, edges.border, crease & ~edges.border, normals)


def _normal(bodies: Bodies, prim: Tensor) -> Tensor:
    _, x, y, _ = bodies.place(prim)
    n = cross(x, y)
    return n / dot(n, n).clamp_min(torch.finfo(n.dtype).tiny).sqrt()


def plain_of(scene: Scene, bodies: Bodies) -> Curves | None:
    """Borders of rectangles, rims of disks, and the open ends of cylinders and cones; None where there are none.

    The rim of a closed one is that of its disk.
    """
    found: list[Curves] = []
    ends = torch.tensor((0, *bodies.counts)).cumsum(0).tolist()

    def ids(low: int, high: int) -> Tensor:
        return torch.arange(low, high, device=scene.device)

    if bodies.counts[1]:
        found.append(borders(ids(ends[1], ends[2])))
    if bodies.counts[2]:
        found.append(rims(ids(ends[2], ends[3])))
    parts = scene.built.parts
    for part, start in zip(parts, _starts(parts, bodies), strict=True):
        if part.quadric is None or part.piece or part.quadric.form.around or not known(part.quadric.form):
            continue
        found.append(rims(ids(start, start + 1)))
        if part.quadric.form.bend == 0:
            found.append(rims(ids(start, start + 1), height=1.0))
    return joined(found) if found else None


def rounds_of(scene: Scene, bodies: Bodies) -> list[Rounds]:
    """The surfaces that have outlines."""
    parts, found = scene.built.parts, []
    forms: dict[Form | None, list[int]] = {}
    for part, start in zip(parts, _starts(parts, bodies), strict=True):
        if part.kind == "sphere":
            forms.setdefault(None, []).append(start)
        elif part.quadric is not None and known(part.quadric.form):
            forms.setdefault(None if part.quadric.form.around else part.quadric.form, []).append(start)
    for form, prims in forms.items():
        found.append(Rounds(torch.tensor(prims, device=scene.device), form))
    return found
