"""What of a scene's curves the camera may see: pieces of them on the film, with their lengths there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies
from torchpt.edges.curves import Curves, View, generator, joined, round_outline
from torchpt.edges.film import film_places
from torchpt.edges.sets import Folds, folds_of, plain_of, rounds_of
from torchpt.math.vectors import cross, dot, take
from torchpt.records import rows
from torchpt.scene import Scene

__all__ = ["Pieces", "pieces_of", "view_of"]

#: Pieces that a round curve is cut into.
_CUTS = 64
#: Least weight of a crease against a silhouette of the same length: most creases jump less.
_CREASE = 0.05

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Pieces:
    """N pieces of curves to draw places from, evenly by what they weigh.

    Attributes:
        curves: pieces; of straight ones ``t`` runs evenly on the film, not in space.
        near: ``(2, N)`` how ``t`` runs: ``h`` of the film at both ends, see :meth:`torchpt.cameras.Camera.film_of`.
        weight: ``(N,)`` length on the film times importance.
    """

    curves: Curves
    near: Tensor
    weight: Tensor

    def place(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """``t (N,)`` of places ``u`` in [0, 1) along each piece on the film, and ``du / dt``."""
        a, b = self.near
        span = self.curves.high - self.curves.low
        share = u * a / (u * a + (1.0 - u) * b)
        across = share * b + (1.0 - share) * a
        return self.curves.low + share * span, a * b / (across * across * span)


def view_of(bodies: Bodies) -> View:
    """The camera as a place or a direction."""
    pixel = bodies.camera.pixel().detach()
    return View(pixel[:3, None], float(pixel[3]))


def pieces_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor], bounds: Bounds) -> Pieces | None:
    """All that may be seen within ``bounds`` of the film; None where nothing may.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
        bounds: least and greatest x, then y.
    """
    view = view_of(bodies)
    found = [_lines(bodies, *_silhouettes(bodies, folds, view), bounds) for folds in folds_of(scene, bodies, poses)]
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        for mine, cut in ((fixed.round, _arcs), (~fixed.round, _lines)):
            some = rows(fixed, mine.nonzero().squeeze(1))
            found.append(cut(bodies, some, torch.ones_like(some.low), bounds))
    for rounds in rounds_of(scene, bodies):
        if rounds.form is None:
            curves, some = round_outline(bodies, rounds.prim, view)
            found.append(_arcs(bodies, curves, some.double(), bounds))
            continue
        for side in (1.0, -1.0):
            curves, some = generator(bodies, rounds.prim, rounds.form, view, torch.full_like(rounds.prim, side))
            found.append(_lines(bodies, curves, some.double(), bounds))
    found = [pieces for pieces in found if len(pieces.weight)]
    if not found:
        return None
    near, weight = torch.cat([p.near for p in found], 1), torch.cat([p.weight for p in found])
    return Pieces(joined([p.curves for p in found]), near, weight)


def _silhouettes(bodies: Bodies, folds: Folds, view: View) -> tuple[Curves, Tensor]:
    """Edges that are seen as outlines or creases, and their importance."""
    _held, p, along = folds.curves.moving(bodies, torch.zeros_like(folds.curves.low))
    across = cross(along, view.toward(p))
    one, two = (dot(across, bodies.points(other) - p) for other in folds.others)
    outline = folds.border | (one * two >= 0)
    apart = folds.normals[0] - folds.normals[1]
    importance = (dot(apart, apart).sqrt() * 0.5).clamp(_CREASE, 1.0)
    importance = torch.where(outline, 1.0, torch.where(folds.crease, importance, 0.0))
    index = (importance > 0).nonzero().squeeze(1)
    return rows(folds.curves, index), take(importance, index)


def _lines(bodies: Bodies, curves: Curves, importance: Tensor, bounds: Bounds) -> Pieces:
    """Straight curves clipped to the film; on homogeneous places, since they may run behind the camera."""
    low, high = torch.zeros_like(curves.low), torch.ones_like(curves.low)
    ends = []
    for t in (low, high):
        _, p, _ = curves.moving(bodies, t)
        seen = bodies.camera.film_of(p)
        assert seen is not None
        ends.append(seen)
    begin, end = ends
    x0, x1, y0, y1 = bounds

    def inside(s: Tensor) -> list[Tensor]:
        return [s[0] - x0 * s[2], x1 * s[2] - s[0], s[1] - y0 * s[2], y1 * s[2] - s[1], s[3]]

    for a, b in zip(inside(begin), inside(end), strict=True):
        slope = b - a
        zero = -a / torch.where(slope == 0, 1.0, slope)
        low = torch.where((slope > 0) & (zero > low), zero, low)
        high = torch.where((slope < 0) & (zero < high), zero, high)
        high = torch.where((slope == 0) & (a < 0), -1.0, high)
    first, last = begin + (end - begin) * low, begin + (end - begin) * high
    length = _apart(first, last)
    index = ((high > low) & (first[2] > 0) & (last[2] > 0) & (length * importance > 0)).nonzero().squeeze(1)
    cut = rows(curves.within(low, high), index)
    return Pieces(cut, torch.stack((take(first[2], index), take(last[2], index))), take(length * importance, index))


def _apart(first: Tensor, last: Tensor) -> Tensor:
    """Distances on the film between homogeneous places of it ``(4, N)``."""
    a, b = (s[:2] / torch.where(s[2] > 0, s[2], 1.0) for s in (first, last))
    return ((a - b) * (a - b)).sum(0).sqrt()


def _arcs(bodies: Bodies, curves: Curves, importance: Tensor, bounds: Bounds) -> Pieces:
    """Round curves in pieces that may lie on the film; one that comes near the camera weighs as much as the film is wide."""
    some = (importance > 0).nonzero().squeeze(1)
    curves, importance = rows(curves, some), take(importance, some)
    many = torch.arange(len(some), device=some.device).repeat_interleave(_CUTS)
    step = 2.0 * math.pi / _CUTS
    low = torch.arange(_CUTS, dtype=torch.float64, device=some.device).repeat(len(some)) * step
    cut = rows(curves, many).within(low, low + step)
    ends = [bodies.camera.film_of(cut.moving(bodies, t)[1]) for t in (cut.low, cut.high)]
    first, last = ends
    assert first is not None and last is not None
    x0, x1, y0, y1 = bounds
    whole = math.hypot(x1 - x0, y1 - y0)
    front = (torch.minimum(first[2], last[2]) > 0) & (torch.minimum(first[3], last[3]) > 0)
    behind = (torch.maximum(first[2], last[2]) <= 0) | (torch.maximum(first[3], last[3]) <= 0)
    length = torch.where(front, _apart(first, last), whole)
    a, b = (film_places(bodies.camera, cut.moving(bodies, t)[1]) for t in (cut.low, cut.high))
    near = torch.minimum(a, b) - length, torch.maximum(a, b) + length  # no arc leaves its chord by more than that
    outside = (near[0][0] > x1) | (near[1][0] < x0) | (near[0][1] > y1) | (near[1][1] < y0)
    weight = torch.where(behind | (front & outside), 0.0, length.clamp_max(whole)) * take(importance, many)
    index = (weight > 0).nonzero().squeeze(1)
    one = torch.ones(2, len(index), dtype=torch.float64, device=index.device)
    return Pieces(rows(cut, index), one, take(weight, index))
