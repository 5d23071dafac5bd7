"""Unidirectional path tracing with next event estimation, as a wavefront: lanes are grouped by BSDF model at each vertex.

``max_depth`` and ``rr_depth`` count as in Mitsuba: 1 is emission only, 2 adds direct light. The base class of the kinds
``path`` and ``direct``, and two decisions that engines take at each vertex: :func:`follows_ray` and :func:`partition`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.state import Plan
from torchpt.physics.shapes.geometry import Hit
from torchpt.physics.world import World

__all__ = ["Ends", "PathIntegrator", "follows_ray", "partition"]


class PathIntegrator(Integrator):
    """Base class of integrators that trace paths to their :attr:`limits`, vertex by vertex."""

    def to_depth(self, depth: int) -> PathIntegrator:
        """Return an integrator of the same stages that traces paths of at most so many vertices."""
        return self.but(max_depth=depth)


def follows_ray(plan: Plan, world: World, depth: int) -> bool:
    """Return True where hit points are intersected anew along their rays; see :func:`torchpt.physics.shapes.interact`.

    Where geometry is differentiated all hits follow their rays, whose directions have the derivatives. In float64 hits that
    need no derivative are intersected anew too, since the search rounds to float32: the first, and those behind delta lobes.

    Args:
        plan: static configuration of the render.
        world: the scene's tensors.
        depth: number of the vertex; 1 is the first hit.
    """
    if plan.attached:
        return True
    return plan.dtype == torch.float64 and (depth == 1 or any(model.delta for model in world.materials.models))


@dataclass(frozen=True)
class Ends:
    """Lanes whose paths gain emission: int64 indices ``(n,)`` of those that hit an emitter, and of those that hit nothing."""

    emissive: Tensor
    missed: Tensor


def partition(world: World, hit: Hit) -> tuple[Ends, list[tuple[int, Tensor]]]:
    """Group lanes by the BSDF model of their hit: one sort of small keys and one transfer of the counts.

    Returns:
        The lanes that hit an emitter or nothing; index and lanes of each model that was hit.
    """
    models = len(world.materials.models)
    # Keys: m for an emissive surface of model m, `models + m` for another surface of model m, `2 * models` for a miss. The slot
    # of a miss is -1, so it reads the table's entry 0.
    keys, order = torch.sort(take(world.materials.key, world.geometry.slot(hit.prim) + 1), stable=True)
    bounds = torch.searchsorted(keys, torch.arange(2 * models + 1, dtype=keys.dtype, device=keys.device)).tolist()
    bounds.append(len(order))  # lanes of key k: order[bounds[k] : bounds[k + 1]]
    groups = []
    for model in range(models):
        of_model = (model, models + model)
        pieces = [order[bounds[key] : bounds[key + 1]] for key in of_model if bounds[key + 1] > bounds[key]]
        if pieces:
            groups.append((model, pieces[0] if len(pieces) == 1 else torch.cat(pieces)))
    return Ends(emissive=order[: bounds[models]], missed=order[bounds[2 * models] :]), groups
