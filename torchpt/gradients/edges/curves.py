"""Curves along which visibility may jump: edges of meshes, outlines of smooth bodies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchpt.core.tree import map_leaves
from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.meshes import Edges, MeshOf, marked_primitives, meshes_of, owners_of, starts_of
from torchpt.gradients.edges.seams import lies_on_seams, seams_within
from torchpt.math.vectors import concatenate_lanes, cross, dot, largest, rows, take
from torchpt.physics.shapes.quadrics import Form
from torchpt.scene import Scene

__all__ = [
    "SEAM",
    "Curves",
    "Folds",
    "Rounds",
    "View",
    "corners",
    "folds_of",
    "generator",
    "joined",
    "known",
    "mesh_edges",
    "own_view",
    "parts_of",
    "plain_of",
    "rims",
    "round_outline",
    "rounds_of",
    "seams_of",
    "smooth_faces",
    "straight",
]


# ---- Curves on primitives along which visibility may jump: borders, edges of meshes, rims, and outlines of round surfaces
#
# A curve is written in the numbers of its primitive (:mod:`torchpt.gradients.edges.bodies`): straight, ``a + t b``, or round,
# ``a + cos(t) b + sin(t) c``. Where it is seen from is a homogeneous place ``(e, w)``: from a point ``p`` it lies toward
# ``e - w p``; ``w`` is 1 for a place and 0 for a direction.


#: Numbers of a triangle's corners.
_CORNERS = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class View:
    """Where curves are seen from: ``e (3, N)`` or ``(3, 1)``, and ``w``, 1 for places, 0 for directions."""

    e: Tensor
    w: Tensor | float

    def toward(self, p: Tensor) -> Tensor:
        """Return vectors from points ``(3, N)`` to where they are seen from; of no particular length."""
        return self.e - p * self.w


@dataclass(frozen=True)
class Curves:
    """N curves, or N pieces of some."""

    prim: Tensor  # (N,) int64
    mate: Tensor  # (N,) int64 the other face at an edge; -1: there is none
    a: Tensor  # (3, N)
    b: Tensor  # (3, N)
    c: Tensor  # (3, N)
    round: Tensor  # (N,) bool
    low: Tensor  # (N,) from where t runs
    high: Tensor  # (N,) to where
    cut: Tensor  # (N,) bool: the primitive and its mate cut there (:mod:`torchpt.gradients.edges.cuts`)
    bent: Tensor  # (N,) bool: the outline of a round surface; all of them are convex, so that none hides its own

    def within(self, low: Tensor, high: Tensor) -> Curves:
        """Return the same from ``low`` to ``high``."""
        return replace(self, low=low, high=high)

    def move(self, moves: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of the curves that move, given that of primitives ``(P,)``."""
        return take(moves, self.prim) | ((self.mate >= 0) & take(moves, self.mate.clamp_min(0)))

    def at(self, t: Tensor) -> tuple[Held, Tensor]:
        """Return points at ``t (N,)``, and how their numbers change with it ``(3, N)``."""
        if not bool(self.round.any()):
            return Held(self.prim, torch.addcmul(self.a, t, self.b)), self.b
        cos, sin = torch.cos(t), torch.sin(t)
        bent, slope = self.a + cos * self.b + sin * self.c, cos * self.c - sin * self.b
        a = torch.where(self.round, bent, self.a + t * self.b)
        return Held(self.prim, a), torch.where(self.round, slope, self.b)

    def moving(self, bodies: Bodies, t: Tensor) -> tuple[Held, Tensor, Tensor]:
        """Return points at ``t (N,)``: held, where they are ``(3, N)``, and how that changes with ``t`` ``(3, N)``."""
        held, slope = self.at(t)
        p0, *axes = bodies.place(held.prim)
        return held, p0 + bodies.vectors(axes, held.a), bodies.vectors(axes, slope)


def joined(parts: list[Curves]) -> Curves:
    """Return curves one after another."""
    return map_leaves(lambda *same: torch.cat(same, -1), *parts)


def straight(prim: Tensor, begin: Tensor, end: Tensor, mate: Tensor | None = None) -> Curves:
    """Return segments between numbers ``(3, N)``, ``t`` from 0 to 1."""
    zero, one = torch.zeros_like(begin[0]), torch.ones_like(begin[0])
    mate = torch.full_like(prim, -1) if mate is None else mate
    return Curves(
        prim, mate, begin, end - begin, torch.zeros_like(begin), zero.bool(), zero, one, zero.bool(), zero.bool()
    )


def circles(prim: Tensor, middle: Tensor, b: Tensor, c: Tensor) -> Curves:
    """Return whole circles, ``t`` from 0 to 2 pi."""
    zero = torch.zeros_like(middle[0])
    none = torch.full_like(prim, -1)
    return Curves(prim, none, middle, b, c, zero == 0, zero, zero + 2.0 * math.pi, zero.bool(), zero.bool())


def corners(corner: Tensor, turned: bool = False) -> Tensor:
    """Return numbers ``(3, N)`` of triangles' corners ``(N,)``; ``turned``: the last two are exchanged."""
    numbers = _CORNERS[0], *(_CORNERS[:0:-1] if turned else _CORNERS[1:])
    table = torch.tensor(numbers, dtype=torch.float64, device=corner.device).T
    return take(table.contiguous(), corner)


def mesh_edges(edges: Edges, index: Tensor | None, first: int, turned: bool) -> tuple[Curves, tuple[Held, Held]]:
    """Return some edges of a mesh, and the corners of both faces that lie off them.

    Args:
        edges: of the mesh.
        index: which ``(N,)``; None: all.
        first: id of the mesh's, or copy's, first triangle.
        turned: whether its triangles have their last two corners exchanged.
    """

    def numbers(corner: Tensor) -> Tensor:
        return corners(take(corner, index), turned)

    one, two = (take(edges.face[k], index) + first for k in range(2))
    mate = torch.where(take(edges.border, index), -1, two)
    curves = straight(one, numbers(edges.first[0]), numbers(edges.last[0]), mate)
    return curves, (Held(one, numbers(edges.other[0])), Held(two, numbers(edges.other[1])))


def borders(prim: Tensor) -> Curves:
    """Return the four borders of parallelograms ``prim (N,)``: ``4 N`` curves."""
    around = torch.tensor(
        [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)], dtype=torch.float64, device=prim.device
    ).T
    n = len(prim)
    begin, end = around.repeat_interleave(n, 1), around.roll(-1, 1).repeat_interleave(n, 1)
    return straight(prim.repeat(4), begin, end)


def rims(prim: Tensor, height: float = 0.0, radius: float = 1.0) -> Curves:
    """Return circles about the third axis of disks and quadrics ``prim (N,)``."""
    zero = torch.zeros(3, len(prim), dtype=torch.float64, device=prim.device)
    middle, b, c = zero.clone(), zero.clone(), zero.clone()
    middle[2], b[0], c[1] = height, radius, radius
    return circles(prim, middle, b, c)


def own_view(bodies: Bodies, prim: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Return where primitives ``(N,)`` are seen from in their own space: ``(3, N)`` and ``(N,)``."""
    p0, x, y, z = bodies.place(prim)
    faces = cross(y, z), cross(z, x), cross(x, y)
    away = view.toward(p0)
    inverse = 1.0 / dot(x, faces[0])
    w = torch.as_tensor(view.w, dtype=p0.dtype, device=p0.device).expand(p0.shape[1])
    return torch.stack([dot(face, away) * inverse for face in faces]), w


def round_outline(bodies: Bodies, prim: Tensor, view: View) -> tuple[Curves, Tensor]:
    """Return outlines of spheres and ellipsoids ``prim (N,)``, and where there is one ``(N,)``: not seen from within.

    On the unit sphere the normal is the point: ``q . c = w``, a circle.
    """
    c, w = own_view(bodies, prim, view)
    far = dot(c, c)
    some = far > w * w * (1.0 + 1e-12)
    far = torch.where(some, far, 1.0)
    axis = c / far.sqrt()
    aside = torch.where(axis[0:1].abs() < 0.6, _unit(axis, 0), _unit(axis, 1))
    b = cross(axis, aside)
    b = b / dot(b, b).sqrt()
    radius = (1.0 - w * w / far).clamp_min(0.0).sqrt()
    return _outline(circles(prim, c * (w / far), b * radius, cross(axis, b) * radius)), some


def _outline(curves: Curves) -> Curves:
    return replace(curves, bent=torch.ones_like(curves.bent))


def _unit(like: Tensor, k: int) -> Tensor:
    unit = torch.zeros_like(like)
    unit[k] = 1.0
    return unit


def generator(bodies: Bodies, prim: Tensor, form: Form, view: View, side: Tensor) -> tuple[Curves, Tensor]:
    """Return one of the two lines of a cylinder's or cone's outline, by ``side (N,)`` of 1 or -1; and where there is one.

    With ``(x, y)`` the radius times ``(cos t, sin t)`` the tangent plane holds the place where ``x c0 + y c1 = w`` on a
    cylinder, ``w - c2`` on a cone whose tip is at 1.
    """
    c, w = own_view(bodies, prim, view)
    pointed = form.bend < 0
    wanted = w - c[2] if pointed else w
    far = (c[0] * c[0] + c[1] * c[1]).sqrt()
    some = far > wanted.abs() * (1.0 + 1e-12)
    t = torch.atan2(c[1], c[0]) + side * torch.acos((wanted / torch.where(some, far, 1.0)).clamp(-1.0, 1.0))
    zero = torch.zeros_like(t)
    low = torch.stack((torch.cos(t), torch.sin(t), zero))
    high = torch.stack((zero, zero, zero + 1.0)) if pointed else torch.stack((low[0], low[1], zero + 1.0))
    return _outline(straight(prim, low, high)), some


# ---- The curves of a scene, owner by owner: those that are there anyway, and round ones, whose outlines depend on the place


#: Faces whose unit normals differ by less make no crease.
_FLAT = 1e-6
#: Weight of lines along which textures jump, and least weight of creases there.
SEAM = 0.25
#: Least weight of a crease at which shading or texture coordinates may jump: most creases jump less than outlines.
_CREASE = 0.05
#: Points that are closer, against their coordinates, are one; of edges that are longer than so many times that.
_SAME, _LONG = 2.0**-20, 16.0
#: Corners of two faces that are closer, against their coordinates, are together: parameters are of float32.
_TOGETHER = 2.0**-22
#: Odd multipliers that make one number of three, any constants.
_MIX = 0x9E3779B97F4A7C1, 0x5851F42D4C957F2D, 0x2545F4914F6CDD1D


@dataclass(frozen=True)
class Folds:
    """Edges of one mesh, or of one of its copies."""

    curves: Curves
    others: tuple[Held, Held]  # corners of the two faces off the edge
    border: Tensor  # (N,) bool
    crease: Tensor  # (N,) from 0 to 1: how much radiance may jump where both faces are seen, beside an outline
    normals: tuple[Tensor, Tensor]  # (3, N) unit, of the two faces
    bend: Tensor  # (N,) distance of the normals; 0 where the faces lie in one plane
    seam: Tensor  # (N,) bool: a texture jumps there


@dataclass(frozen=True)
class Rounds:
    """Round surfaces of one kind."""

    prim: Tensor  # (N,)
    form: Form | None  # of cylinders and cones; None: spheres and ellipsoids


def known(form: Form) -> bool:
    """Return True if the outline of a quadric is known: of ellipsoids, cylinders and cones."""
    return form.around or (form.half == 0 and (form.bend == 0 or (form.bend < 0 and form.level == 0)))


def smooth_faces(scene: Scene, bodies: Bodies) -> tuple[Tensor, Tensor]:
    """Return the faces that are shaded smooth, those of copies too, by ids of the search, and their areas: ``(F,)`` each."""
    prim = marked_primitives(scene, lambda part: part.kind == "triangle" and part.smooth).nonzero().squeeze(1)
    _, x, y, _ = bodies.place(prim)
    n = cross(x, y)
    return prim, 0.5 * dot(n, n).sqrt()


def folds_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor], moves: Tensor | None = None) -> Iterator[Folds]:
    """Yield the edges of each mesh, and of each copy; arguments: see :func:`torchpt.gradients.edges.meshes.meshes_of`."""
    for mesh in meshes_of(scene, bodies, poses, moves):
        edges, part = mesh.edges, mesh.part
        curves, others = mesh_edges(edges, None, mesh.first, mesh.turned)
        faces = torch.arange(mesh.first, mesh.first + part.primitive_count, device=scene.device)
        one, two = edges.face
        of_face = _normal(bodies, faces)
        normals = take(of_face, one), take(of_face, two)
        apart = normals[0] - normals[1]
        bend = dot(apart, apart).sqrt()
        bend = torch.where(bend > _FLAT, bend, 0.0)
        jumps = edges.split if part.smooth else ~edges.border  # the shading
        # Where faces are shaded smooth one side lacks the light below its face: of an angle, near the horizon.
        crease = torch.where(jumps & (bend > 0), (0.5 * bend).clamp(_CREASE, 1.0), 0.25 * bend * bend)
        if part.uvs is not None:
            crease = torch.where(edges.split, crease.clamp_min(_CREASE), crease)
        seam = ~edges.border & lies_on_seams(scene, mesh, poses)
        crease = torch.where(seam, crease.clamp_min(SEAM), crease)
        folds = Folds(curves, others, edges.border, torch.where(edges.border, 0.0, crease), normals, bend, seam)
        yield _opened(bodies, folds, mesh) if bool(edges.split.any()) else folds


def _opened(bodies: Bodies, folds: Folds, mesh: MeshOf) -> Folds:
    """Return edges with those as borders of either face whose faces have vertices of their own that are no longer together."""
    some = (mesh.edges.split & ~mesh.edges.border).nonzero().squeeze(1)
    one, two = (mesh_edges(mesh.edges.of_face(k), some, mesh.first, mesh.turned)[0] for k in (0, 1))
    open_ = torch.zeros_like(one.round)
    for a, b in ((one.a, two.a), (one.a + one.b, two.a + two.b)):
        p, q = bodies.points(Held(one.prim, a)), bodies.points(Held(two.prim, b))
        open_ |= largest((p - q).abs()) > largest(p.abs()) * _TOGETHER
    index = open_.nonzero().squeeze(1)
    if not len(index):
        return folds
    lone = torch.full_like(index, -1)
    parted = some[index]
    kept = torch.ones_like(folds.border)
    kept[parted] = False
    both = [rows(folds, kept.nonzero().squeeze(1))]
    for side, curves in enumerate((one, two)):
        own = rows(folds, parted)
        held, n = own.others[side], own.normals[side]
        both.append(
            Folds(
                replace(rows(curves, index), mate=lone),
                (held, held),
                torch.ones_like(own.border),
                torch.zeros_like(own.crease),
                (n, n),
                torch.zeros_like(own.bend),
                torch.zeros_like(own.seam),
            )
        )
    return concatenate_lanes(both)


def _normal(bodies: Bodies, prim: Tensor) -> Tensor:
    _, x, y, _ = bodies.place(prim)
    n = cross(x, y)
    return n / dot(n, n).clamp_min(torch.finfo(n.dtype).tiny).sqrt()


def parts_of(bodies: Bodies, curves: Curves) -> Tensor:
    """Return the parts ``(N,)`` with which curves count: 1 over the number of straight ones between the same two points."""
    if not len(curves.prim):
        return torch.ones_like(curves.low)
    ends = torch.stack([bodies.points(curves.at(t)[0]) for t in (curves.low, curves.high)])  # (2, 3, N)
    # Powers of two, so that curves between the same points have the same one.
    size = ends.abs().amax((0, 1)).clamp_min(torch.finfo(ends.dtype).tiny)
    grid = torch.exp2(torch.log2(size).ceil()) * _SAME
    parts = torch.ones_like(curves.low)
    for shift in (0.0, 0.5):  # points on the border of two cells of one grid lie within a cell of the other
        cells = torch.floor(ends / grid + shift).long()
        code = (
            cells[:, 0] * _MIX[0] + cells[:, 1] * _MIX[1] + cells[:, 2] * _MIX[2]
        )  # (2, N), a point each; it may overflow
        pair = torch.minimum(*code) + torch.maximum(*code) * _MIX[2]
        in_order = np.sort(pair.cpu().numpy())  # several times faster than torch's
        if (in_order[1:] != in_order[:-1]).all():
            continue
        _, group, count = torch.unique(pair, return_inverse=True, return_counts=True)
        parts = torch.minimum(parts, 1.0 / take(count.double(), group))
    length = (ends[1] - ends[0]).square().sum(0).sqrt()
    return torch.where(curves.round | (length < _LONG * grid), 1.0, parts)


def plain_of(scene: Scene, bodies: Bodies) -> Curves | None:
    """Return borders of rectangles, rims of disks, and the open ends of cylinders and cones; None where there are none.

    The rim of a closed one is that of its disk.
    """
    found: list[Curves] = []
    ends = torch.tensor((0, *bodies.counts)).cumsum(0).tolist()

    def ids(low: int, high: int) -> Tensor:
        return torch.arange(low, high, device=scene.device)

    if bodies.counts[1]:
        found.append(borders(ids(ends[1], ends[2])))
    parts = scene.built.parts
    starts = starts_of(parts, bodies)
    if bodies.counts[2]:
        sides = {part.name: start for part, start in zip(parts, starts, strict=True) if part.quadric is not None}
        mates = [sides.get(part.name, -1) for part in parts if part.kind == "disk"]
        closed = rims(ids(ends[2], ends[3]))
        found.append(replace(closed, mate=torch.tensor(mates, device=scene.device)))
    for part, start in zip(parts, starts, strict=True):
        if part.quadric is None or part.piece or part.quadric.form.around or not known(part.quadric.form):
            continue
        found.append(rims(ids(start, start + 1)))
        if part.quadric.form.bend == 0:
            found.append(rims(ids(start, start + 1), height=1.0))
    return joined(found) if found else None


def seams_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Curves | None:
    """Return the lines within flat surfaces along which textures jump; None where there are none.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
    """
    parts = scene.built.parts
    found = []
    for part, start in zip(parts, starts_of(parts, bodies), strict=True):
        for owner, first in owners_of(scene, part, start, bodies):
            seams = seams_within(scene, owner, part, poses)
            if seams is not None:
                prim, begin, end = seams
                found.append(straight(prim + first, begin, end))
    return joined(found) if found else None


def rounds_of(scene: Scene, bodies: Bodies) -> list[Rounds]:
    """Return the surfaces that have outlines."""
    parts, found = scene.built.parts, []
    forms: dict[Form | None, list[int]] = {}
    for part, start in zip(parts, starts_of(parts, bodies), strict=True):
        if part.kind == "sphere":
            forms.setdefault(None, []).append(start)
        elif part.quadric is not None and known(part.quadric.form):
            forms.setdefault(None if part.quadric.form.around else part.quadric.form, []).append(start)
    for form, prims in forms.items():
        found.append(Rounds(torch.tensor(prims, device=scene.device), form))
    return found
