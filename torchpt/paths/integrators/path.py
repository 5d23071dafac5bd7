"""Unidirectional path tracing with next event estimation, as a wavefront: how lanes are told apart at a vertex.

``max_depth`` and ``rr_depth`` count as Mitsuba's: 1 is emission only, 2 direct light.
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

__all__ = ["Ends", "PathIntegrator", "follows_shape", "partition"]


class PathIntegrator(Integrator):
    """Integrators that follow paths to their :attr:`limits`, vertex by vertex."""


def follows_shape(plan: Plan, world: World, depth: int) -> bool:
    """Return True where points at a vertex slide along their rays; see :func:`torchpt.physics.shapes.interact`.

    Under derivatives the camera's own point slides along its ray; later ones are held on their surface. In float64 the camera's
    point is found anew, since the search rounds it to float32. Where a delta sends a ray on, its next point slides along it as
    the camera's does.
    """
    exact = plan.attached or plan.dtype == torch.float64
    return exact and (depth == 1 or any(model.delta for model in world.materials.models))


@dataclass(frozen=True)
class Ends:
    """Lanes ``(n,)`` whose paths meet light by chance."""

    emissive: Tensor
    missed: Tensor


def partition(world: World, hit: Hit) -> tuple[Ends, list[tuple[int, Tensor]]]:
    """Sort lanes by what they hit; one sort of small keys and one transfer of the counts.

    Returns:
        Which lanes hit an emitter or nothing, and for each model present its number and lanes.
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
