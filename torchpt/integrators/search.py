"""What the next ray meets. Surfaces that are not opaque let a ray through by chance, and shadow rays in part.

Passing is no vertex of a path: the direction, the place it was drawn from and the depth stay. Scenes without opacity go
straight to the search.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.accel import Accel
from torchpt.integrators.surfaces import opacity_map
from torchpt.lanes.tracing import tracing
from torchpt.math.vectors import take
from torchpt.records import Hit, PathState, Shadow, World, rows
from torchpt.samplers import Dimension, Draws, Points, salts
from torchpt.shapes import interact, offset_origin

__all__ = ["PASSES", "Search", "beyond", "opacity_at"]

#: Beyond the depth of any path: names the numbers for the second, third, ... surface that a ray passes.
PASSES = 1 << 13


def opacity_at(world: World, o: Tensor, d: Tensor, hit: Hit, miss: float) -> Tensor:
    """Opacity ``(N,)`` of the surfaces that rays ``o, d`` hit, textures included; ``miss`` where they hit nothing."""
    assert world.materials.opacity is not None
    missed = hit.prim < 0
    slot = world.geometry.slot(hit.prim).clamp_min(0)
    opacity = torch.where(missed, miss, take(world.materials.opacity, slot))
    if world.textures.opacity is None:
        return opacity
    textured = ~missed & (take(world.textures.opacity.nodes, slot) >= 0)
    if tracing():  # in a loop over lanes each lane takes the same steps
        return torch.where(textured, opacity * opacity_map(world, interact(world, o, d, hit)), opacity)
    some = textured.nonzero().squeeze(1)
    at = interact(world, take(o, some), take(d, some), rows(hit, some))
    return opacity.index_copy(0, some, take(opacity, some) * opacity_map(world, at))


def beyond(world: World, o: Tensor, d: Tensor, hit: Hit) -> Tensor:
    """Origins behind the surfaces that were hit ``(3, N)``."""
    return offset_origin(world, interact(world, o, d, hit), d)


class Search:
    """The search of one wave.

    Args:
        accel: finds the nearest hit.
        world: the scene's tensors.
        sampler: where numbers come from.
        dtype: of the lanes.
    """

    def __init__(self, accel: Accel, world: World, sampler: Points, dtype: torch.dtype) -> None:
        self._accel, self._world, self._sampler, self._dtype = accel, world, sampler, dtype

    def nearest(self, state: PathState, depth: int) -> Hit:
        """Where the rays of ``state`` meet a surface, at path vertex ``depth``."""
        hit = self._trace(state.o, state.d, state.t_max)
        return hit if self._world.materials.opacity is None else self._stopped(state, hit, depth)

    def clear(self, shadow: Shadow) -> Tensor:
        """How much of the light gets through ``(N,)``: 0 or 1 where all surfaces are opaque."""
        if self._world.materials.opacity is None:
            return (~self._accel.occluded(shadow.o, shadow.d, shadow.t_max)).to(self._dtype)
        return self._transmittance(shadow)

    def _trace(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hit:
        t, prim, u, v = self._accel.intersect(o, d, t_max)
        return Hit(t.to(self._dtype), prim.to(torch.int64), u.to(self._dtype), v.to(self._dtype))

    @torch.no_grad()
    def _beyond(self, o: Tensor, d: Tensor, hit: Hit) -> Tensor:
        return beyond(self._world, o, d, hit)

    def _stopped(self, state: PathState, hit: Hit, depth: int) -> Hit:
        """Where rays are stopped: each surface stops one with the chance of its opacity, else the ray goes on behind it."""
        opacity = opacity_at(self._world, state.o, state.d, hit, 1.0)
        chance = torch.ones_like(hit.t) if opacity.requires_grad else None
        t, prim, u, v = hit.t, hit.prim, hit.u, hit.v
        step, lanes = 0, (opacity.detach() < 1).nonzero().squeeze(1)
        opacity = take(opacity, lanes)
        while len(lanes):
            draws = Draws(self._sampler, take(state.key, lanes), salts(depth + step * PASSES, lanes.device))
            met = draws.one(Dimension.OPACITY) < opacity.detach()
            if chance is not None:
                share = torch.where(met, opacity, 1.0 - opacity)
                chance = chance.index_copy(0, lanes, take(chance, lanes) * (share / share.detach()))
            lanes = take(lanes, (~met).nonzero().squeeze(1))
            passed = Hit(take(t, lanes), take(prim, lanes), take(u, lanes), take(v, lanes))
            o, d = take(state.o.detach(), lanes), take(state.d.detach(), lanes)
            o = self._beyond(o, d, passed)
            behind = self._trace(o, d, take(state.t_max, lanes))
            # Distances are counted from where the ray began; the step over the surface is below their rounding.
            t, prim = t.index_copy(0, lanes, behind.t + passed.t), prim.index_copy(0, lanes, behind.prim)
            u, v = u.index_copy(0, lanes, behind.u), v.index_copy(0, lanes, behind.v)
            opacity = opacity_at(self._world, o, d, behind, 1.0)
            again = (opacity.detach() < 1).nonzero().squeeze(1)
            lanes, opacity, step = take(lanes, again), take(opacity, again), step + 1
        return Hit(t, prim, u, v, chance)

    def _transmittance(self, shadow: Shadow) -> Tensor:
        """The product of ``1 - opacity`` over all surfaces between the ends of the rays."""
        clear = torch.ones_like(shadow.t_max)
        o, d, t_max = shadow.o.detach(), shadow.d.detach(), shadow.t_max
        lanes = torch.arange(len(t_max), device=t_max.device)
        while len(lanes):
            hit = self._trace(o, d, t_max)
            opacity = opacity_at(self._world, o, d, hit, 0.0)
            clear = clear.index_copy(0, lanes, take(clear, lanes) * (1.0 - opacity))
            on = ((hit.prim >= 0) & (opacity.detach() < 1)).nonzero().squeeze(1)
            passed, o, d = rows(hit, on), take(o, on), take(d, on)
            lanes, t_max = take(lanes, on), (take(t_max, on) - passed.t).clamp_min(0.0)
            if len(lanes):
                o = self._beyond(o, d, passed)
        return clear
