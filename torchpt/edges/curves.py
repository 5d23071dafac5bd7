"""Curves on primitives along which visibility may jump: borders, edges of meshes, rims, and outlines of round surfaces.

A curve is written in the numbers of its primitive (:mod:`torchpt.edges.bodies`): straight, ``a + t b``, or round,
``a + cos(t) b + sin(t) c``. Where it is seen from is a homogeneous place ``(e, w)``: from a point ``p`` it lies toward
``e - w p``; ``w`` is 1 for a place and 0 for a direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.core.tree import map_leaves
from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.topology import Edges
from torchpt.math.vectors import cross, dot, take
from torchpt.shapes.quadrics import Form

__all__ = ["Curves", "View", "generator", "joined", "mesh_edges", "own_view", "rims", "round_outline", "straight"]

#: Numbers of a triangle's corners.
_CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


@dataclass(frozen=True)
class View:
    """Where curves are seen from: ``e (3, N)`` or ``(3, 1)``, and ``w``, 1 for places, 0 for directions."""

    e: Tensor
    w: Tensor | float

    def toward(self, p: Tensor) -> Tensor:
        """From points ``(3, N)`` to where they are seen from; of no particular length."""
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

    def within(self, low: Tensor, high: Tensor) -> Curves:
        """The same from ``low`` to ``high``."""
        return replace(self, low=low, high=high)

    def at(self, t: Tensor) -> tuple[Held, Tensor]:
        """Points at ``t (N,)``, and how their numbers change with it ``(3, N)``."""
        cos, sin = torch.cos(t), torch.sin(t)
        bent, slope = self.a + cos * self.b + sin * self.c, cos * self.c - sin * self.b
        a = torch.where(self.round, bent, self.a + t * self.b)
        return Held(self.prim, a), torch.where(self.round, slope, self.b)

    def moving(self, bodies: Bodies, t: Tensor) -> tuple[Held, Tensor, Tensor]:
        """Points at ``t (N,)``: held, where they are ``(3, N)``, and how that changes with ``t`` ``(3, N)``."""
        held, slope = self.at(t)
        p0, x, y, z = bodies.place(held.prim)
        along = x * slope[0] + y * slope[1] + z * slope[2]
        return held, p0 + x * held.a[0] + y * held.a[1] + z * held.a[2], along


def joined(parts: list[Curves]) -> Curves:
    """Return curves one after another."""
    return map_leaves(lambda *same: torch.cat(same, -1), *parts)


def straight(prim: Tensor, begin: Tensor, end: Tensor, mate: Tensor | None = None) -> Curves:
    """Segments between numbers ``(3, N)``, ``t`` from 0 to 1."""
    zero, one = torch.zeros_like(begin[0]), torch.ones_like(begin[0])
    mate = torch.full_like(prim, -1) if mate is None else mate
    return Curves(prim, mate, begin, end - begin, torch.zeros_like(begin), zero.bool(), zero, one)


def circles(prim: Tensor, middle: Tensor, b: Tensor, c: Tensor) -> Curves:
    """Whole circles, ``t`` from 0 to 2 pi."""
    zero = torch.zeros_like(middle[0])
    return Curves(prim, torch.full_like(prim, -1), middle, b, c, zero == 0, zero, zero + 2.0 * math.pi)


def mesh_edges(edges: Edges, index: Tensor, first: int, turned: bool) -> tuple[Curves, tuple[Held, Held]]:
    """Some edges of a mesh, and the corners of both faces that lie off them.

    Args:
        edges: of the mesh.
        index: which ``(N,)``.
        first: id of the mesh's, or copy's, first triangle.
        turned: whether its triangles have their last two corners exchanged.
    """
    table = torch.tensor([(*corner, 0.0) for corner in _CORNERS], dtype=torch.float64, device=index.device).T
    table = table[:, [0, 2, 1]] if turned else table

    def numbers(corner: Tensor) -> Tensor:
        return take(table, take(corner, index))

    one, two = (take(edges.face[k], index) + first for k in range(2))
    mate = torch.where(take(edges.border, index), -1, two)
    curves = straight(one, numbers(edges.first[0]), numbers(edges.last[0]), mate)
    return curves, (Held(one, numbers(edges.other[0])), Held(two, numbers(edges.other[1])))


def borders(prim: Tensor) -> Curves:
    """The four borders of parallelograms ``prim (N,)``: ``4 N`` curves."""
    around = torch.tensor(
        [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)], dtype=torch.float64, device=prim.device
    ).T
    n = len(prim)
    begin, end = around.repeat_interleave(n, 1), around.roll(-1, 1).repeat_interleave(n, 1)
    return straight(prim.repeat(4), begin, end)


def rims(prim: Tensor, height: float = 0.0, radius: float = 1.0) -> Curves:
    """Circles about the third axis of disks and quadrics ``prim (N,)``."""
    zero = torch.zeros(3, len(prim), dtype=torch.float64, device=prim.device)
    middle, b, c = zero.clone(), zero.clone(), zero.clone()
    middle[2], b[0], c[1] = height, radius, radius
    return circles(prim, middle, b, c)


def own_view(bodies: Bodies, prim: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Where primitives ``(N,)`` are seen from in their own space: ``(3, N)`` and ``(N,)``."""
    p0, x, y, z = bodies.place(prim)
    faces = cross(y, z), cross(z, x), cross(x, y)
    away = view.toward(p0)
    inverse = 1.0 / dot(x, faces[0])
    w = torch.as_tensor(view.w, dtype=p0.dtype, device=p0.device).expand(p0.shape[1])
    return torch.stack([dot(face, away) * inverse for face in faces]), w


def round_outline(bodies: Bodies, prim: Tensor, view: View) -> tuple[Curves, Tensor]:
    """Outlines of spheres and ellipsoids ``prim (N,)``, and where there is one ``(N,)``: not as seen from within.

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
    return circles(prim, c * (w / far), b * radius, cross(axis, b) * radius), some


def _unit(like: Tensor, k: int) -> Tensor:
    unit = torch.zeros_like(like)
    unit[k] = 1.0
    return unit


def generator(bodies: Bodies, prim: Tensor, form: Form, view: View, side: Tensor) -> tuple[Curves, Tensor]:
    """One of the two lines of a cylinder's or cone's outline, by ``side (N,)`` of 1 or -1; and where there is one.

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
    return straight(prim, low, high), some
