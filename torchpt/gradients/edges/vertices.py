"""Scattering of light that edges send to surfaces: the same materials as a render's, forward only, from any to any direction.

Light is followed from its source toward the camera. What a forward path weighs by the shading normal on the side of the light
and by area on the other is weighed alike here: a factor of ``cos_s / cos_g`` at each vertex (Veach, *Robust Monte Carlo
Methods*, 1997, section 5.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.traced import Passing, Traced
from torchpt.math.sampling import uniform_hemisphere
from torchpt.math.vectors import Frame, cross, dot, lanes_of, rows, take
from torchpt.paths.integrators.path import partition
from torchpt.paths.state import Drawn, Plan
from torchpt.paths.surface import Surface, surface_at
from torchpt.paths.vertex import has_shading_normals, sample_bsdf, shading_weight
from torchpt.physics.bsdfs import Bsdf
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit, Interaction

__all__ = ["TILT", "Spot", "met"]

#: Fraction of directions that are even over the plane of a face that is shaded smooth.
_EVEN = 0.25
#: Rays along the plane of a face are tilted by so much to the side that counts.
TILT = 1e-5


@dataclass(frozen=True)
class Spot:
    """Points of surfaces that rays met, N lanes of the traced dtype.

    Attributes:
        traced: what sees.
        o, d: the rays ``(3, N)``, ``d`` of unit length.
        hit: what they met; a miss has -1.
        p: the points ``(3, N)``.
        n: geometric normals ``(3, N)``.
    """

    traced: Traced
    o: Tensor
    d: Tensor
    hit: Hit
    p: Tensor
    n: Tensor

    def taken(self, index: Tensor | None) -> Spot:
        """Return some of the lanes; None: all."""
        return self if index is None else Spot(self.traced, *rows((self.o, self.d, self.hit, self.p, self.n), index))

    def held(self, bodies: Bodies) -> Held:
        """Return the points held on their surfaces; any point in lanes that missed."""
        prim = self.hit.prim.clamp_min(0)
        a = torch.stack((self.hit.u, self.hit.v, torch.zeros_like(self.hit.u))).double()
        if bodies.counts[3] or bodies.counts[4]:
            bent = ((prim >= bodies.first_sphere) & (prim < sum(bodies.counts))).nonzero().squeeze(1)
            p0, *axes = bodies.place(take(prim, bent))
            faces = [cross(axes[1], axes[2]), cross(axes[2], axes[0]), cross(axes[0], axes[1])]
            away, det = take(self.p, bent).double() - p0, dot(axes[0], faces[0])
            a[:, bent] = torch.stack([dot(face, away) / det for face in faces])
        return Held(prim, a)

    def _each(self, found: list[Tensor], make: Callable[[int, Tensor | None, Interaction], list[Tensor]]) -> None:
        """Fill in what each model makes of its lanes."""
        world = self.traced.wave.context.world
        if len(world.materials.models) == 1 and bool((self.hit.prim >= 0).all()):
            for into, value in zip(found, make(0, None, interact(world, self.o, self.d, self.hit)), strict=True):
                into.copy_(value)
            return
        _, groups = partition(world, self.hit)
        for model, index in groups:
            at = interact(world, take(self.o, index), take(self.d, index), rows(self.hit, index))
            for into, value in zip(found, make(model, index, at), strict=True):
                into.index_copy_(into.dim() - 1, index, value.to(into.dtype))

    def sent(self, wo: Tensor, wi: Tensor, side: Tensor | None = None) -> Tensor:
        """Return ``f cos_s(wi) / cos_g(wi)`` ``(3, N)`` of light from ``wi`` that leaves along ``wo``; deltas give nothing.

        ``side``: ``(N,)`` of 1 and -1: ``wi`` lies in the plane of the geometric normal. Then it is ``f cos_s(wi)``, and 0
        where light that leaves along ``wo`` comes from the other side of that plane. None: ``wi`` lies beside the plane.
        """
        out = torch.zeros_like(wo)

        def make(model: int, index: Tensor | None, at: Interaction) -> list[Tensor]:
            own = None if side is None else take(side, index)
            return [self._weighed(model, at, take(wo, index), take(wi, index), own)]

        self._each([out], make)
        return out

    def _seen_from(self, w: Tensor, model: int, at: Interaction) -> Surface:
        context = self.traced.wave.context
        return surface_at(context.world, model, -w, at, context.pixel, dark_rims=context.plan.dark_rims)

    def _weighed(self, model: int, at: Interaction, wo: Tensor, wi: Tensor, side: Tensor | None) -> Tensor:
        world = self.traced.wave.context.world
        kind = world.materials.models[model]
        if kind.smooth:
            return torch.zeros_like(wo)
        surface = self._seen_from(wo, model, at)
        local = surface.frame.to_local(wi)
        if side is not None:
            counts = torch.sign(local[2]) * (side if surface.side is None else side * surface.side) > 0
            value = kind.eval(surface.parameters, surface.wo, local) * counts
            value = value if surface.front_mask is None else value * surface.front_mask
            return value if surface.perturbed_normal is None else value * surface.perturbed_normal.shadowing(wi)
        cosine = dot(wi, at.ng).abs()
        weight, share = 1.0 / cosine.clamp_min(1e-6), shading_weight(world, model, at, surface, wi, local)
        weight = weight if share is None else weight * share
        return kind.eval(surface.parameters, surface.wo, local) * weight

    def scattered(
        self, wi: Tensor, key: Tensor, depth: int, side: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return rays by which light from ``wi`` goes on: origins, unit directions, ``f cos_s / cos_g |cos_g(wo)| / pdf``.

        ``side``: as for :meth:`sent`.
        """
        o, d, weight = torch.zeros_like(wi), wi.clone(), torch.zeros_like(wi)
        context = self.traced.wave.context
        world = context.world

        def make(model: int, index: Tensor | None, at: Interaction) -> list[Tensor]:
            kind, back = world.materials.models[model], take(wi, index)
            if kind.smooth:
                return [torch.zeros_like(at.p), back, torch.zeros_like(back)]
            own = None if side is None else take(side, index)
            n = at.ng * (torch.sign(dot(back, at.ng)) if own is None else own)
            # Where light arrives in the plane of the normal, its side is not known by the direction.
            surface = self._seen_from(back if own is None else back + n * TILT, model, at)
            draws = self.traced.draws(take(key, index), depth)
            drawn = sample_bsdf(context, model, at, surface, draws)
            if has_shading_normals(world, model) and not kind.transmits:
                drawn = _with_even_directions(context.plan, kind, n, surface, drawn, draws)
            usable = (drawn.pdf > 0) & torch.isfinite(drawn.pdf)
            factor = dot(drawn.d, at.ng).abs() / torch.where(usable, drawn.pdf, 1.0)
            value = self._weighed(model, at, drawn.d, back, own) * factor
            return [offset_origin(world, at, drawn.d), drawn.d, torch.where(usable, value, 0.0)]

        self._each([o, d, weight], make)
        return o, d, weight


def _with_even_directions(plan: Plan, kind: Bsdf, n: Tensor, surface: Surface, drawn: Drawn, draws: Draws) -> Drawn:
    """Return BSDF samples of which some are replaced by directions that are even over the plane of normals ``n (3, N)``.

    Surfaces are seen from below their shading normal too, along directions that the BSDF never samples.
    """
    other = draws.one(Dimension.LIGHT_DIGITS) < _EVEN
    even = Frame.about(n).to_world(uniform_hemisphere(draws.two(Dimension.LIGHT).to(n.dtype)))
    d = torch.where(other, even, drawn.d)
    local = surface.frame.to_local(d)
    if plan.strategy == "uniform" and not kind.delta:  # as BSDF samples are drawn
        pdf = (0.5 / math.pi) * (local[2] > 0)
    else:
        pdf = torch.where(other, kind.pdf(surface.parameters, surface.wo, local), drawn.pdf)
    mixed = (1.0 - _EVEN) * pdf + (_EVEN * 0.5 / math.pi) * (dot(d, n) > 0)
    # A failed sample of the BSDF has a direction, but no density.
    return replace(drawn, d=d, pdf=torch.where(other | (drawn.pdf > 0), mixed, 0.0))


def met(traced: Traced, o: Tensor, d: Tensor, passing: Passing | None = None) -> Spot:
    """Return where rays ``(3, N)`` meet surfaces.

    Args:
        traced: what sees.
        o: origins.
        d: directions, of any length.
        passing: decides which surfaces rays pass by their opacity; its distances are in the lanes' unit of length. None: none.
    """
    world, dtype = traced.wave.context.world, traced.dtype
    o, d = o.to(dtype), (d / (d * d).sum(0).sqrt()).to(dtype)
    hit = traced.intersect(o, d, passing)
    hit = Hit(hit.t.to(dtype), hit.prim, hit.u.to(dtype), hit.v.to(dtype))
    some = lanes_of(hit.prim >= 0)
    at = interact(world, take(o, some), take(d, some), rows(hit, some))
    if some is None:
        return Spot(traced, o, d, hit, at.p, at.ng)
    p, n = torch.zeros_like(d), torch.zeros_like(d)
    return Spot(traced, o, d, hit, p.index_copy(1, some, at.p), n.index_copy(1, some, at.ng))
