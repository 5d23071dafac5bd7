"""Let rays pass: surfaces that are not opaque let a ray through by chance, and shadow rays in part.

Passing is no vertex of a path: the direction, the place it was drawn from and the depth stay. Scenes without opacity have none
of this.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.core.dispatch import dispatched
from torchpt.math.vectors import rows, take
from torchpt.paths.state import StageContext, Transmission, VertexInput
from torchpt.paths.surface import opacity_map
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__ = ["beyond", "non_opaque", "opacity_at", "times_map", "transmit"]


def opacity_at(world: World, o: Tensor, d: Tensor, hit: Hit, miss: float) -> Tensor:
    """Opacity ``(N,)`` of the surfaces that rays ``o, d`` hit, textures included; ``miss`` where they hit nothing."""
    assert world.materials.opacity is not None
    missed = hit.prim < 0
    slot = world.geometry.slot(hit.prim).clamp_min(0)
    opacity = torch.where(missed, miss, take(world.materials.opacity, slot))
    if world.textures.opacity is None:
        return opacity
    textured = ~missed & (take(world.textures.opacity.nodes, slot) >= 0)
    return times_map(world, o, d, hit, opacity, textured)


@dispatched
def times_map(world: World, o: Tensor, d: Tensor, hit: Hit, opacity: Tensor, textured: Tensor) -> Tensor:
    """Multiply opacity ``(N,)`` by that of textures in the lanes ``textured (N,)``."""
    some = textured.nonzero().squeeze(1)
    at = interact(world, take(o, some), take(d, some), rows(hit, some))
    return opacity.index_copy(0, some, take(opacity, some) * opacity_map(world, at))


def beyond(world: World, o: Tensor, d: Tensor, hit: Hit) -> Tensor:
    """Origins behind the surfaces that were hit ``(3, N)``."""
    return offset_origin(world, interact(world, o, d, hit), d)


def non_opaque(world: World, prim: Tensor) -> Tensor:
    """Return which primitives ``(N,)`` may let a ray pass."""
    assert world.materials.opacity is not None
    slot = world.geometry.slot(prim).clamp_min(0)
    may_pass = take(world.materials.opacity, slot) < 1
    if world.textures.opacity is not None:
        may_pass = may_pass | (take(world.textures.opacity.nodes, slot) >= 0)
    return may_pass


def transmit(context: StageContext, vertex: VertexInput) -> Transmission:
    """Let rays pass surfaces by chance: each surface stops one with the chance of its opacity.

    The stage is asked for rays that met something which may let them pass.
    """
    world, state, hit = context.world, vertex.state, vertex.hit
    opacity = opacity_at(world, state.o, state.d, hit, 1.0)
    draws = Draws(context.plan.sampler, state.key, context.salts)
    met = draws.one(Dimension.OPACITY) < opacity.detach()
    chance = None
    if opacity.requires_grad:
        share = torch.where(met, opacity, 1.0 - opacity)
        chance = torch.where(opacity.detach() < 1, share / share.detach(), 1.0)
    with torch.no_grad():
        o = beyond(world, state.o.detach(), state.d.detach(), hit)
    return Transmission(~met, o, chance=chance)
