"""Edges that move across the film: silhouettes, borders and creases that the camera sees.

A picture is an integral over the film of the radiance ``L(s)``, which jumps along curves ``s(t)``. As these move, the loss
changes by the integral along them of ``C (L- - L+) n . ds``, with ``C(s)`` the worth of radiance at s and n the normal toward +
(Reynolds' transport theorem; Li, Aittala, Durand, Lehtinen, *Differentiable Monte Carlo Ray Tracing through Edge Sampling*,
2018). With ``n dt = (ds_y / dt, -ds_x / dt)`` any parameter t of the curve will do. Places are drawn along the curves by their
length on the film; the radiance on both sides is traced by the same random numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.draws import Choice, Numbers
from torchpt.edges.film import Worth, film_places, slopes
from torchpt.edges.seen import Pieces
from torchpt.edges.shared import share_of
from torchpt.edges.steps import steps_at
from torchpt.edges.traced import Traced
from torchpt.math.vectors import take
from torchpt.records import rows

__all__ = ["Along", "Primary"]

#: A place counts as hidden where a ray beside it ends before this share of the way.
_BEFORE = 1.0 - 2.0**-10
#: The same where the ray meets the edge's own surface.
_OWN = 1.0 - 2.0**-6

#: Values ``(C, N)`` that rays ``o, d (3, N)`` bring, by the numbers of their samples.
Look = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Along:
    """Samples along curves on the film: the derivative of the loss is that of ``(weight * places(held)).sum()``.

    Where what is seen is held in place, that of ``beside`` is taken away: where rays ended ``(3, M)``, or, where they met
    nothing, infinity and their directions, and weights ``(2, M)``.
    """

    held: Held
    weight: Tensor  # (2, N)
    beside: tuple[Tensor, Tensor, Tensor] | None = None

    def sum(self, bodies: Bodies) -> Tensor:
        """Differentiable in ``bodies``; of no meaning but for its derivative."""
        total = (film_places(bodies.camera, bodies.points(self.held)) * self.weight).sum()
        if self.beside is None:
            return total
        origin, away, weight = self.beside
        # What is infinitely far moves along with the camera.
        at = torch.where(torch.isfinite(origin), origin, bodies.camera.origin()) + away
        return total - (film_places(bodies.camera, at) * weight).sum()


@dataclass(frozen=True)
class Primary:
    """The estimator of one render.

    Attributes:
        bodies: detached.
        pieces: what the camera may see.
        choice: among them.
        traced: what sees.
        numbers: of samples.
    """

    bodies: Bodies
    pieces: Pieces
    choice: Choice
    traced: Traced
    numbers: Numbers

    @torch.no_grad()
    def samples(self, first: int, count: int, total: int, worth: Worth, look: Look, over: bool = False) -> Along:
        """Samples ``first .. first + count`` of ``total``: those that are seen.

        ``over``: they count as they move over what is seen on both sides, which is held in place.
        """
        number = torch.arange(first, first + count, device=self.pieces.weight.device)
        u = (number.double() + self.numbers.of(number, 0)) / total
        index, rest, chance = self.choice.draw(u)
        pieces = rows(self.pieces, index)
        t, density = pieces.place(rest)
        held, p, along = pieces.curves.moving(self.bodies, t)
        s, jacobian = slopes(self.bodies.camera, p)
        slope = (jacobian * along).sum(1)
        normal = torch.stack((slope[1], -slope[0]))
        length = (normal * normal).sum(0).sqrt()
        value = worth.at(s)
        index = ((length > 0) & (value != 0).any(0)).nonzero().squeeze(1)
        s, p, normal, length = (take(x, index) for x in (s, p, normal, length))
        unit = normal / length
        mate = take(pieces.curves.mate, index)
        step = steps_at(self.bodies, (take(held.prim, index), mate), s)
        o, d = self._beside(s, unit, step)
        share = self._share(rows(held, index), mate, p, s, step, o, d)
        seen = (share > 0).nonzero().squeeze(1)
        both = torch.cat((seen, seen + len(index)))
        o, d, index = take(o, both), take(d, both), take(index, seen)
        values = look(o, d, take(number, index).repeat(2)) if len(index) else torch.zeros(len(value), 0).to(value)
        jump = values[:, : len(index)] - values[:, len(index) :]
        worthy = (take(value, index) * jump).sum(0) * take(share, seen)
        chance, normal = take(chance * density, index) * total, take(normal, seen)
        beside = None
        if over:
            each = (take(value, index).repeat(1, 2) * values).sum(0) * (take(share, seen) / chance).repeat(2)
            each = torch.cat((each[: len(index)], -each[len(index) :]))
            t, prim = self.traced.nearest(o, d)
            met = prim >= 0
            beside = torch.where(met, o, torch.inf), torch.where(met, t, 1.0) * d, normal.repeat(1, 2) * each
        return Along(rows(held, index), normal * (worthy / chance), beside)

    def _beside(self, s: Tensor, unit: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Rays through the film a step beside places, before their curves' normals and behind: ``(3, 2 N)``."""
        places = torch.cat((s - unit * step, s + unit * step), 1)
        o, d = self.bodies.camera.rays(places[0], places[1], None)
        return o.expand_as(d), d

    def _share(self, held: Held, mate: Tensor, p: Tensor, s: Tensor, step: Tensor, o: Tensor, d: Tensor) -> Tensor:
        """Return how much of each edge counts ``(N,)``: nothing where it is hidden, a part where others lie on it."""
        n = p.shape[1]
        t, prim = self.traced.nearest(o, d)
        away = p - o[:, :n]
        reach = (away * d[:, :n]).sum(0)
        t, prim = t.view(2, n), prim.view(2, n)
        own = (prim == held.prim) | (prim == mate)  # a round surface comes forward quickly behind its outline
        seen = (t > reach * torch.where(own, _OWN, _BEFORE)).all(0)
        if self.traced.wave.context.world.materials.opacity is not None:
            seen = torch.ones_like(seen)  # what hides may let pass
        near = (t - reach).abs() < reach * 2.0**-8
        return torch.where(seen, share_of(self.bodies, held, mate, s, prim, near, step), 0.0)


def primary_of(bodies: Bodies, pieces: Pieces, traced: Traced, numbers: Numbers) -> Primary:
    """The estimator over ``pieces``."""
    return Primary(bodies, pieces, Choice(pieces.weight), traced, numbers)
