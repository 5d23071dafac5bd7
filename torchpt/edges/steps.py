"""How far beside a curve of the film rays are traced, so that they meet what lies along it and nothing beyond."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies
from torchpt.edges.film import film_places

__all__ = ["distance_to", "is_flat", "outline_of", "step_of", "steps_at"]

#: Of the film's longer side at a slope of 1.
_STEP = 2.0**-16
#: Where a face is narrow: a share of what is left of it beside its edge, but not less than this share of a whole step, which is
#: still some roundings of a ray's direction.
_SHARE, _LEAST = 0.25, 2.0**-6


def step_of(bodies: Bodies) -> float:
    """A whole step, in pixels: a few hundred roundings of a ray's direction."""
    width = float(max(bodies.camera.resolution))
    spread = float(bodies.camera.pixel()[4]) * width  # of the film at distance 1
    narrow = max(1.0, 1.0 / spread) if float(bodies.camera.pixel()[3]) else 1.0
    return _STEP * width * narrow


def steps_at(bodies: Bodies, faces: tuple[Tensor, Tensor], s: Tensor) -> Tensor:
    """Steps ``(N,)`` in pixels: shorter where a ray a whole step beside an edge would pass the whole of a narrow face.

    Args:
        bodies: detached.
        faces: the two faces of each edge ``(N,)``; -1: there is none.
        s: places of the edges on the film ``(2, N)``.
    """
    whole = step_of(bodies)
    room = torch.full_like(s[0], whole / _SHARE)
    for prim in faces:
        some = is_flat(bodies, prim).nonzero().squeeze(1)
        if len(some):
            corners = outline_of(bodies, prim[some])
            away = torch.stack([distance_to(s[:, some], a, b) for a, b in corners])
            # The nearest is the edge itself.
            room[some] = torch.minimum(room[some], away.sort(0).values[1])
    return (_SHARE * room).clamp(_LEAST * whole, whole)


def outline_of(bodies: Bodies, prim: Tensor) -> list[tuple[Tensor, Tensor]]:
    """The four sides of parallelograms ``(N,)`` on the film, from ``(2, N)`` to ``(2, N)``; a triangle's last has no length."""
    triangles, rectangles = bodies.counts[0], sum(bodies.counts[:2])
    four = (prim >= triangles) & (prim < rectangles)
    p0, x, y, _ = bodies.place(prim)
    corners = [p0, p0 + x, torch.where(four, p0 + x + y, p0 + y), torch.where(four, p0 + y, p0)]
    places = [film_places(bodies.camera, corner) for corner in corners]
    return list(zip(places, [*places[1:], places[0]], strict=True))


def is_flat(bodies: Bodies, prim: Tensor) -> Tensor:
    """Which primitives ``(N,)`` are triangles or parallelograms; copies are of meshes."""
    return (prim >= 0) & ((prim < sum(bodies.counts[:2])) | (prim >= sum(bodies.counts)))


def distance_to(s: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """From places ``(2, N)`` to segments ``a b``."""
    along = b - a
    square = (along * along).sum(0)
    share = (((s - a) * along).sum(0) / torch.where(square > 0, square, 1.0)).clamp(0.0, 1.0)
    away = s - a - along * share
    return (away * away).sum(0).sqrt()
