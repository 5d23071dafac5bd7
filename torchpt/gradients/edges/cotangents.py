"""Cotangents of all that samples of edges let move, which are pulled back to the bodies in one go.

What samples bring is linear in how points, rays and lights move, and the factors are known when the samples are. So no tape
records how samples were computed: each adds its factors here, and the tape begins with where points are.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.math.vectors import rows, take

__all__ = ["Cotangents"]


class Cotangents:
    """Cotangents of points held on their primitives, of rays of the camera, and of lights.

    Args:
        moves: ``(P,)`` bool by ids of the search: primitives that move. Cotangents of others are dropped.
    """

    def __init__(self, moves: Tensor) -> None:
        self._moves = moves
        self._points: list[tuple[Held, Tensor]] = []
        self._rays: list[tuple[Tensor, Tensor | None, Tensor, Tensor]] = []
        self._lights: list[tuple[Tensor, Tensor]] = []

    def add_points(self, held: Held, cotangent: Tensor) -> None:
        """Add a cotangent ``(3, N)`` of where points are."""
        index = take(self._moves, held.prim).nonzero().squeeze(1)
        if len(index):
            self._points.append(rows((held, cotangent), index))

    def add_rays(self, place: Tensor, lens: Tensor | None, o: Tensor, d: Tensor) -> None:
        """Add cotangents ``o`` and ``d (3, N)`` of the camera's rays through places ``(2, N)`` of film and lens."""
        self._rays.append((place, lens, o, d))

    def add_lights(self, column: Tensor, cotangent: Tensor) -> None:
        """Add a cotangent ``(3, N)`` of columns ``(N,)`` of :attr:`Bodies.lights`."""
        self._lights.append((column, cotangent))

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``, of no meaning but for its derivative, the sum of the cotangents."""
        value = torch.zeros((), dtype=torch.float64, device=self._moves.device)
        if self._points:
            prim, a, cotangent = (
                torch.cat(parts, -1) for parts in zip(*((h.prim, h.a, c) for h, c in self._points), strict=True)
            )
            value = value + (bodies.points(Held(prim, a)) * cotangent).sum()
        for place, lens, to_o, to_d in self._rays:
            o, d = bodies.camera.rays(place[0], place[1], lens)
            value = value + (o * to_o).sum() + (d * to_d).sum()
        for column, cotangent in self._lights:
            value = value + (take(bodies.lights, column) * cotangent).sum()
        return value
