"""Edges of several surfaces that lie on one another, as where two walls of a room meet: each counts in part.

Along such a seam both sides of one edge are seen at its own distance, and what is seen beside it ends there too. The two
surfaces are taken to stay together; where only one of them moves the derivative is the mean of those to both sides.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.film import film_places

__all__ = ["share_of"]


def share_of(bodies: Bodies, held: Held, mate: Tensor, s: Tensor, prim: Tensor, near: Tensor, step: float) -> Tensor:
    """Parts ``(N,)`` with which places of edges count.

    Args:
        bodies: detached.
        held: the places.
        mate: the other faces of the edges ``(N,)``; -1: there is none.
        s: on the film ``(2, N)``.
        prim: what is seen on both sides ``(2, N)``.
        near: whether at the edge's own distance ``(2, N)``.
        step: how far beside the edges that is, in pixels.
    """
    own = prim == held.prim
    other = torch.where(own[0], prim[1], prim[0])
    both = near.all(0) & own.any(0) & ~own.all(0)
    flat = both & (other >= 0) & (mate < 0)
    triangles, rectangles = bodies.counts[0], sum(bodies.counts[:2])
    base, copied = other, torch.zeros_like(flat)
    if bodies.copies is not None:
        copied = other >= sum(bodies.counts)
    four = (base >= triangles) & (base < rectangles)
    flat = flat & ((base < rectangles) | copied)
    safe = torch.where(flat, other, 0)
    if not bool(flat.any()):
        return torch.ones_like(s[0])
    p0, x, y, _ = bodies.place(safe)
    corners = [p0, p0 + x, torch.where(four, p0 + x + y, p0 + y), torch.where(four, p0 + y, p0)]
    places = [film_places(bodies.camera, corner) for corner in corners]
    away = torch.stack([_distance(s, a, b) for a, b in zip(places, [*places[1:], places[0]], strict=True)]).amin(0)
    return torch.where(flat & (away < 0.5 * step), 0.5, 1.0)


def _distance(s: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """From places ``(2, N)`` to segments ``a b``."""
    along = b - a
    square = (along * along).sum(0)
    share = (((s - a) * along).sum(0) / torch.where(square > 0, square, 1.0)).clamp(0.0, 1.0)
    away = s - a - along * share
    return (away * away).sum(0).sqrt()
