"""Curves along which light may jump, drawn before the light is known: edges, and outlines of round bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.curves import (
    SEAM,
    Curves,
    Rounds,
    View,
    folds_of,
    generator,
    joined,
    parts_of,
    plain_of,
    round_outline,
    rounds_of,
    seams_of,
    straight,
)
from torchpt.gradients.edges.cuts import Cuts
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import concatenate_lanes, cross, dot, rows, take
from torchpt.physics.shapes.quadrics import Form
from torchpt.scene import Scene

__all__ = ["EdgePoints", "Occluders", "OutlinePoints", "occluders_of"]

#: Least weight of an edge between faces that almost lie in one plane, as an outline, against a border of the same length.
_LEAST_OUTLINE = 0.01
#: The same as a crease.
_LEAST_CREASE = 0.1
#: Weight of curves that do not move, against those that do: only what is behind and before them moves.
_STATIC = 0.3
#: They count by their length so near what moves, in radii of that, and this part of them by all of it.
_NEAR, _EVEN = 4.0, 0.1
#: Square of the sine at which a face is seen along its plane.
_ALONG = 1e-18


@dataclass(frozen=True)
class EdgePoints:
    """Points of curves, N lanes.

    Attributes:
        lane: ``(N,)`` of those that were asked for: where there is no outline there is no point.
        held: the points.
        mate: the other face at each; -1: there is none.
        cut: ``(N,)`` bool: the two cut there.
        bent: ``(N,)`` bool: the curve is the outline of a round surface.
        p: where they are ``(3, N)``.
        along: how ``p`` changes with the curve's parameter.
        density: of the draw in that parameter.
    """

    lane: Tensor
    held: Held
    mate: Tensor
    cut: Tensor
    bent: Tensor
    p: Tensor
    along: Tensor
    density: Tensor


@dataclass(frozen=True)
class OutlinePoints(EdgePoints):
    """Points of curves that are seen from somewhere, N lanes.

    Attributes:
        outline: ``(N,)`` bool: no crease, as seen from there.
        part: with which the curve counts, where others lie on it.
    """

    outline: Tensor
    part: Tensor


@dataclass(frozen=True)
class Occluders:
    """K curves and round surfaces.

    Attributes:
        bodies: detached.
        curves: what is not known before the light is (an outline) has its primitive alone.
        others: corners off the edges, of both faces.
        folded: ``(K,)`` bool: edges of two faces.
        part: ``(K,)`` with which curves count where others lie on them.
        form: ``(K,)`` -1 where the curve is known, 0 for outlines of spheres and ellipsoids, from 1 on of ``forms``.
        forms: of cylinders and cones.
        outlines: choice of a curve, by length and the share of directions from which it is an outline.
        seen: choice of a curve that moves, by length and by how much radiance may jump there; None: none moves.
        creases: choice of a curve, by length and the angle between its faces.
    """

    bodies: Bodies
    curves: Curves
    others: tuple[Held, Held]
    folded: Tensor
    part: Tensor
    form: Tensor
    forms: list[Form]
    outlines: Distribution1D
    seen: Distribution1D | None
    creases: Distribution1D

    def points(self, choice: Distribution1D, u: Tensor, coin: Tensor, view: View) -> OutlinePoints:
        """Return points of curves, those of round surfaces as they are seen from ``view``.

        Args:
            choice: :attr:`outlines` or :attr:`seen`.
            u: ``(N,)`` in [0, 1), which curves and where on them.
            coin: ``(N,)`` in [0, 1): which of two lines.
            view: ``N`` places or directions.
        """
        index, rest = choice.draw(u)
        chance = take(choice.pmf, index)
        curves, form = rows(self.curves, index), take(self.form, index)
        some = torch.ones_like(form, dtype=torch.bool)
        for number in range(len(self.forms) + 1):
            mine = (form == number).nonzero().squeeze(1)
            if not len(mine):
                continue
            part, prim = rows(view, mine), take(curves.prim, mine)
            if number == 0:
                found, there = round_outline(self.bodies, prim, part)
            else:
                side = torch.where(take(coin, mine) < 0.5, -1.0, 1.0).double()
                found, there = generator(self.bodies, prim, self.forms[number - 1], part, side)
                chance[mine] *= 0.5
            some[mine] = there
            for f in fields(Curves):
                getattr(curves, f.name)[..., mine] = getattr(found, f.name)
        span = curves.high - curves.low
        held, p, along = curves.moving(self.bodies, curves.low + rest * span)
        across = cross(along, view.toward(p))
        square = dot(across, across)
        sides = []
        for other in self.others:
            corner = self.bodies.points(rows(other, index)) - p
            beside = dot(across, corner)
            # A face that is seen along its plane lies on both sides: what rays meet there tells which of its edges counts.
            sides.append(torch.where(beside * beside > square * dot(corner, corner) * _ALONG, beside, 0.0))
        outline = ~take(self.folded, index) | (sides[0] * sides[1] >= 0)
        some &= square > 0
        lane, part = torch.arange(len(index), device=index.device), take(self.part, index)
        drawn = OutlinePoints(lane, held, curves.mate, curves.cut, curves.bent, p, along, chance / span, outline, part)
        return rows(drawn, some.nonzero().squeeze(1))


def occluders_of(
    scene: Scene, bodies: Bodies, poses: dict[str, Tensor], moves: Tensor, cuts: Cuts | None, *, lights_move: bool
) -> Occluders | None:
    """Return all curves of a scene that may hide light; None where there are none.

    Args:
        scene: the scene.
        bodies: detached.
        poses: the parameters.
        moves: ``(P,)`` bool: primitives that move.
        cuts: the curves where surfaces cut.
        lights_move: True: lights do.
    """
    curves: list[Curves] = []
    firsts: list[Held] = []
    seconds: list[Held] = []
    columns: list[Tensor] = []  # of each part: length, weights as outline, as crease and for the camera, folded, form

    def add(part: Curves, length: Tensor, others: tuple[Held, Held], *column: Tensor | float) -> None:
        curves.append(part)
        firsts.append(others[0])
        seconds.append(others[1])
        columns.append(torch.stack([length, *(torch.as_tensor(x).to(length).expand_as(length) for x in column)]))

    for folds in folds_of(scene, bodies, poses):
        _, _, along = folds.curves.moving(bodies, torch.zeros_like(folds.curves.low))
        cosine = dot(*folds.normals).abs().clamp_max(1.0)
        # Of directions around an edge this share has both faces on one side, whichever way the normals point.
        outline = torch.where(folds.border, 1.0, (torch.acos(cosine) / math.pi).clamp_min(_LEAST_OUTLINE))
        crease = torch.where(folds.bend > 0, folds.bend.clamp(_LEAST_CREASE, 1.0), 0.0)
        crease = torch.where(folds.seam, crease.clamp_min(SEAM), crease)
        crease = torch.where(folds.border, 1.0, crease)
        jumps = (folds.bend > 0) | folds.border
        seen = torch.maximum(torch.where(jumps, outline, 0.0), folds.crease)
        add(folds.curves, dot(along, along).sqrt(), folds.others, outline, crease, seen, ~folds.border, -1.0)
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        _, _, along = fixed.moving(bodies, fixed.low)
        own = Held(fixed.prim, fixed.a)
        add(fixed, dot(along, along).sqrt() * (fixed.high - fixed.low), (own, own), 1.0, 1.0, 1.0, 0.0, -1.0)
    if cuts is not None:  # which hide nothing that the surfaces do not
        own = Held(cuts[0].prim, cuts[0].a)
        add(cuts[0], cuts[1], (own, own), 0.0, 1.0, 1.0, 0.0, -1.0)
    seams = seams_of(scene, bodies, poses)
    if seams is not None:
        _, _, along = seams.moving(bodies, seams.low)
        own = Held(seams.prim, seams.a)
        add(seams, dot(along, along).sqrt(), (own, own), 0.0, SEAM, SEAM, 0.0, -1.0)
    forms: list[Form] = []
    for rounds in rounds_of(scene, bodies):
        if rounds.form is not None:
            forms.append(rounds.form)
        zero = torch.zeros(3, len(rounds.prim), dtype=torch.float64, device=scene.device)
        own, number = Held(rounds.prim, zero), 0.0 if rounds.form is None else float(len(forms))
        add(straight(rounds.prim, zero, zero), _outline_length(bodies, rounds), (own, own), 1.0, 1.0, 1.0, 0.0, number)
    if not curves:
        return None
    every = joined(curves)
    length, outline, crease, seen, folded, form = torch.cat(columns, 1)
    if not bool((length > 0).any()):
        return None
    moving = every.move(moves)
    seen = length * seen * moving
    still = _still(bodies, every, length, moves)

    def choice(weight: Tensor, all_move: bool) -> Distribution1D:
        own = length * weight
        if not all_move:
            other = torch.where(moving, 0.0, still * weight)
            most = torch.where(moving, own, 0.0).sum() / other.sum().clamp_min(torch.finfo(own.dtype).tiny)
            own = torch.where(moving, own, other * most.clamp_max(_STATIC) if bool(most > 0) else other)
        return Distribution1D.of(own, torch.float64, even=0.0)

    known = ((form < 0) & (crease > 0)).nonzero().squeeze(1)
    return Occluders(
        bodies,
        every,
        (concatenate_lanes(firsts), concatenate_lanes(seconds)),
        folded > 0,
        torch.ones_like(length).index_copy(0, known, parts_of(bodies, rows(every, known))),
        form.long(),
        forms,
        choice(outline, lights_move),
        Distribution1D.of(seen, torch.float64, even=0.0) if bool((seen > 0).any()) else None,
        choice(crease, False),
    )


def _still(bodies: Bodies, curves: Curves, length: Tensor, moves: Tensor) -> Tensor:
    """Return the lengths ``(N,)`` with which curves that do not move count.

    What moves, of radius s, is seen from d away within an angle that falls with the square of d. So it is the integral of
    ``1 / (1 + (d / s)²)`` along the chord, on large floors a small part of the length.

    Args:
        bodies: detached.
        curves: all.
        length: theirs.
        moves: ``(P,)`` bool: primitives that move.
    """
    prim = moves.nonzero().squeeze(1)
    if not len(prim):
        return length
    low, high = bodies.boxes(prim)
    low, high = low.amin(1, keepdim=True), high.amax(1, keepdim=True)
    centre, size = 0.5 * (low + high), 0.5 * _NEAR * (high - low).square().sum().sqrt()
    _, begin, _ = curves.moving(bodies, curves.low)
    _, end, _ = curves.moving(bodies, torch.where(curves.round, 0.5 * (curves.low + curves.high), curves.high))
    chord, start = end - begin, begin - centre
    long = dot(chord, chord).sqrt()
    straight_ = long > 0
    unit = chord / torch.where(straight_, long, 1.0)
    first = dot(unit, start)
    beside = (dot(start, start) - first * first).clamp_min(0.0)
    reach = (size * size + beside).sqrt()
    along = torch.atan((first + long) / reach) - torch.atan(first / reach)
    share = torch.where(straight_, along * reach / torch.where(straight_, long, 1.0), 1.0) * (size / reach).square()
    near = length * share
    return (1.0 - _EVEN) * near + _EVEN * length * (near.sum() / length.sum())


def _outline_length(bodies: Bodies, rounds: Rounds) -> Tensor:
    """Return about the lengths of outlines ``(N,)``."""
    _, x, y, z = bodies.place(rounds.prim)
    long = [dot(axis, axis).sqrt() for axis in (x, y, z)]
    return 2.0 * long[2] if rounds.form is not None else (2.0 * math.pi / 3.0) * (long[0] + long[1] + long[2])
