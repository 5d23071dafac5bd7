"""Opacity: rays of paths pass a surface with probability ``1 - opacity``; shadow rays are weakened by that factor.

Passing a surface is no vertex of a path: direction, depth, and the vertex that the direction was sampled at stay the same.
Scenes in which everything is opaque run none of this. Engines call :func:`transmit` until no ray passes any more, and weaken
shadow rays by :func:`opacity_at`. A *slot* is the index of a primitive, or of an instance after all primitives, by which
materials and opacities are looked up.
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

__all__ = ["non_opaque", "opacity_at", "origins_behind", "times_opacity_map", "transmit"]


def opacity_at(world: World, o: Tensor, d: Tensor, hit: Hit, miss: float) -> Tensor:
    """Return the opacity ``(N,)`` of the surfaces that rays ``o, d (3, N)`` hit, textures included; ``miss`` where none is."""
    assert world.materials.opacity is not None
    missed = hit.prim < 0
    slot = world.geometry.slot(hit.prim).clamp_min(0)
    opacity = torch.where(missed, miss, take(world.materials.opacity, slot))
    if world.textures.opacity is None:
        return opacity
    textured = ~missed & (take(world.textures.opacity.nodes, slot) >= 0)
    return times_opacity_map(world, o, d, hit, opacity, textured)


@dispatched
def times_opacity_map(world: World, o: Tensor, d: Tensor, hit: Hit, opacity: Tensor, textured: Tensor) -> Tensor:
    """Multiply ``opacity (N,)`` by the opacity texture in the lanes where the mask ``textured (N,)`` is True.

    Traced kernels cannot list lanes: they run another implementation (:mod:`torchpt.engines.dispatch`).
    """
    lanes = textured.nonzero().squeeze(1)
    # As surfaces and rays move, points slide along the rays.
    moves = torch.is_grad_enabled() and any(x.requires_grad for x in (o, d, world.geometry.p0))
    at = interact(world, take(o, lanes), take(d, lanes), rows(hit, lanes), follow_ray=moves)
    return opacity.index_copy(0, lanes, take(opacity, lanes) * opacity_map(world, at))


def origins_behind(world: World, o: Tensor, d: Tensor, hit: Hit) -> Tensor:
    """Return ray origins ``(3, N)`` just behind the surfaces that were hit, off them by their rounding bound.

    They move as places of the ray do, not as the surfaces.
    """
    with torch.no_grad():
        behind = offset_origin(world, interact(world, o, d, hit), d)
    if not (torch.is_grad_enabled() and (o.requires_grad or d.requires_grad)):
        return behind
    on_ray = o + d * hit.t.detach()
    return behind + (on_ray - on_ray.detach())


def non_opaque(world: World, prim: Tensor) -> Tensor:
    """Return True ``(N,)`` where primitives ``prim (N,)``, ids of the search, may let a ray pass."""
    assert world.materials.opacity is not None
    slot = world.geometry.slot(prim).clamp_min(0)
    may_pass = take(world.materials.opacity, slot) < 1
    if world.textures.opacity is not None:
        may_pass = may_pass | (take(world.textures.opacity.nodes, slot) >= 0)
    return may_pass


def transmit(context: StageContext, vertex: VertexInput) -> Transmission:
    """Stop each ray at its hit with the probability of the opacity there; let the others pass.

    A stage: engines run it for rays whose hit is :func:`non_opaque`.
    """
    world, state, hit = context.world, vertex.state, vertex.hit
    opacity = opacity_at(world, state.o, state.d, hit, miss=1.0)
    draws = Draws(context.plan.sampler, state.key, context.salts)
    stops = draws.one(Dimension.OPACITY) < opacity.detach()
    chance = None
    if opacity.requires_grad:
        probability = torch.where(stops, opacity, 1.0 - opacity)
        # Of value 1, with the derivative of the logarithm of the probability. An opacity of 1 has none: 1 - opacity is 0.
        chance = torch.where(opacity.detach() < 1, probability / probability.detach(), 1.0)
    return Transmission(on=~stops, o=origins_behind(world, state.o, state.d, hit), chance=chance)
