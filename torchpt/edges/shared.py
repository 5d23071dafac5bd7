"""Edges of several surfaces that lie on one another, as where two walls of a room meet: each counts in part.

Along such a seam both sides of one edge are seen at its own distance, and what is seen beside it ends there too. The two
surfaces are taken to stay together; where only one of them moves the derivative is the mean of those to both sides.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.steps import distance_to, is_flat, outline_of

__all__ = ["share_of"]


def share_of(bodies: Bodies, held: Held, mate: Tensor, s: Tensor, prim: Tensor, near: Tensor, step: Tensor) -> Tensor:
    """Parts ``(N,)`` with which places of edges count.

    Args:
        bodies: detached.
        held: the places.
        mate: the other faces of the edges ``(N,)``; -1: there is none.
        s: on the film ``(2, N)``.
        prim: what is seen on both sides ``(2, N)``.
        near: whether at the edge's own distance ``(2, N)``.
        step: how far beside the edges that is ``(N,)``, in pixels.
    """
    own = prim == held.prim
    other = torch.where(own[0], prim[1], prim[0])
    both = near.all(0) & own.any(0) & ~own.all(0)
    flat = both & (other >= 0) & (mate < 0)
    flat = flat & is_flat(bodies, other)
    safe = torch.where(flat, other, 0)
    if not bool(flat.any()):
        return torch.ones_like(s[0])
    away = torch.stack([distance_to(s, a, b) for a, b in outline_of(bodies, safe)]).amin(0)
    return torch.where(flat & (away < 0.5 * step), 0.5, 1.0)
