"""The curves of a scene that may throw shadows, to be drawn from before it is known where the light comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.curves import Curves, View, generator, joined, round_outline, straight
from torchpt.edges.draws import Choice
from torchpt.edges.sets import Rounds, folds_of, plain_of, rounds_of
from torchpt.math.vectors import cross, dot, take
from torchpt.records import rows
from torchpt.scene import Scene
from torchpt.shapes.quadrics import Form

__all__ = ["Occluders", "Passed", "occluders_of"]

#: Least weight of an edge between faces that almost lie in one plane, against a border of the same length.
_LEAST = 0.01


@dataclass(frozen=True)
class Passed:
    """Places of curves that light passes, N lanes.

    Attributes:
        lane: ``(N,)`` of those that were asked for: where there is no outline there is no place.
        held: the places.
        mate: the other face at each, -1 where there is none.
        p: where they are ``(3, N)``.
        along: how ``p`` changes with the curve's parameter.
        density: of the draw in that parameter.
    """

    lane: Tensor
    held: Held
    mate: Tensor
    p: Tensor
    along: Tensor
    density: Tensor


@dataclass(frozen=True)
class Occluders:
    """K curves and round surfaces.

    Attributes:
        bodies: detached.
        curves: what is not known before the light is (an outline) has its primitive alone.
        others: corners off the edges, of both faces.
        folded: ``(K,)`` bool: edges of two faces, which throw a shadow only where both lie to one side of it.
        form: ``(K,)`` -1 where the curve is known, 0 for outlines of spheres, from 1 on of ``forms``.
        forms: of cylinders and cones.
        choice: among them.
    """

    bodies: Bodies
    curves: Curves
    others: tuple[Held, Held]
    folded: Tensor
    form: Tensor
    forms: list[Form]
    choice: Choice

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Curves ``(N,)``, what is left of ``u``, and their chances."""
        return self.choice.draw(u)

    def place(self, index: Tensor, rest: Tensor, chance: Tensor, coin: Tensor, view: View) -> Passed:
        """Places on drawn curves as they are seen from ``view``.

        Args:
            index: curves ``(N,)``.
            rest: in [0, 1), where on them.
            chance: of the curves.
            coin: in [0, 1): which of two lines.
            view: ``N`` places or directions.
        """
        curves, form = rows(self.curves, index), take(self.form, index)
        some, chance = torch.ones_like(form, dtype=torch.bool), chance.clone()
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
        one, two = (dot(across, self.bodies.points(rows(other, index)) - p) for other in self.others)
        some &= ~take(self.folded, index) | (one * two >= 0)
        some &= dot(across, across) > 0
        passed = Passed(torch.arange(len(index), device=index.device), held, curves.mate, p, along, chance / span)
        return rows(passed, some.nonzero().squeeze(1))


def occluders_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Occluders | None:
    """All curves, by their length and the chance to be an outline; None where there are none."""
    curves, firsts, seconds, folded, weights, forms = [], [], [], [], [], []
    for folds in folds_of(scene, bodies, poses):
        _, _, along = folds.curves.moving(bodies, torch.zeros_like(folds.curves.low))
        cosine = dot(*folds.normals).abs().clamp_max(1.0)
        # Of directions around an edge this share has both faces on one side, whichever way the normals point.
        share = torch.where(folds.border, 1.0, (torch.acos(cosine) / math.pi).clamp_min(_LEAST))
        curves.append(folds.curves)
        firsts.append(folds.others[0])
        seconds.append(folds.others[1])
        folded.append(~folds.border)
        weights.append(dot(along, along).sqrt() * share)
        forms.append(torch.full_like(folds.curves.prim, -1))
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        _, _, along = fixed.moving(bodies, fixed.low)
        curves.append(fixed)
        weights.append(dot(along, along).sqrt() * (fixed.high - fixed.low))
        forms.append(torch.full_like(fixed.prim, -1))
    kinds: list[Form] = []
    for rounds in rounds_of(scene, bodies):
        weight, number = _round_weight(bodies, rounds), 0
        if rounds.form is not None:
            kinds.append(rounds.form)
            number = len(kinds)
        zero = torch.zeros(3, len(rounds.prim), dtype=torch.float64, device=scene.device)
        curves.append(straight(rounds.prim, zero, zero))
        weights.append(weight)
        forms.append(torch.full_like(rounds.prim, number))
    for k, part in enumerate(curves):
        if k >= len(firsts):
            held = Held(part.prim, part.a)
            firsts.append(held)
            seconds.append(held)
            folded.append(torch.zeros_like(part.prim, dtype=torch.bool))
    if not curves or not bool((torch.cat(weights) > 0).any()):
        return None
    others = [Held(torch.cat([h.prim for h in x]), torch.cat([h.a for h in x], 1)) for x in (firsts, seconds)]
    choice = Choice(torch.cat(weights))
    return Occluders(bodies, joined(curves), (others[0], others[1]), torch.cat(folded), torch.cat(forms), kinds, choice)


def _round_weight(bodies: Bodies, rounds: Rounds) -> Tensor:
    """About the lengths of outlines ``(N,)``."""
    _, x, y, z = bodies.place(rounds.prim)
    long = [dot(axis, axis).sqrt() for axis in (x, y, z)]
    return 2.0 * long[2] if rounds.form is not None else (2.0 * math.pi / 3.0) * (long[0] + long[1] + long[2])
