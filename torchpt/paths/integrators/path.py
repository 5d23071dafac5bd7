"""Unidirectional path tracing with next event estimation, as a wavefront: lanes are grouped by BSDF model at each vertex.

``max_depth`` and ``rr_depth`` count as in Mitsuba: 1 is emission only, 2 adds direct light.
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


def follows_ray(plan: Plan, world: World, depth: int) -> bool:
    """Return True where hit points are intersected anew along their rays; see :func:`torchpt.physics.shapes.interact`.

    Where geometry is differentiated, the first hit follows the camera ray, and so do hits behind delta lobes; all others keep
    their place on the primitive. In float64 hits are intersected anew, since the search rounds to float32.
    """
    exact = plan.attached or plan.dtype == torch.float64
    return exact and (depth == 1 or any(model.delta for model in world.materials.models))


@dataclass(frozen=True)
class Ends:
    """Lanes ``(n,)`` of paths that hit an emitter, and of paths that hit nothing."""

    emissive: Tensor
    missed: Tensor


def partition(world: World, hit: Hit) -> tuple[Ends, list[tuple[int, Tensor]]]:
    """Group lanes by the BSDF model of their hit: one sort of small keys and one transfer of the counts.

    Returns:
        The lanes that hit an emitter or nothing; index and lanes of each model that was hit.
    """
    models = len(world.materials.models)
    keys, order = torch.sort(take(world.materials.key, world.geometry.slot(hit.prim) + 1), stable=True)
    bounds = torch.searchsorted(keys, torch.arange(2 * models + 1, dtype=keys.dtype, device=keys.device)).tolist()
    bounds.append(len(order))
    groups = []
    for m in range(models):
        pieces = [order[bounds[k] : bounds[k + 1]] for k in (m, models + m) if bounds[k + 1] > bounds[k]]
        if pieces:
            groups.append((m, pieces[0] if len(pieces) == 1 else torch.cat(pieces)))
    return Ends(order[: bounds[models]], order[bounds[2 * models] :]), groups
