"""Unidirectional path tracing with next event estimation, as a wavefront.

camera rays -> intersect -> emission with MIS -> sort by BSDF and compact -> light sampling with shadow rays -> BSDF sampling
-> Russian roulette -> next. ``max_depth`` and ``rr_depth`` count as Mitsuba's: 1 is emission only, 2 direct light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from torchpt import lights
from torchpt.accel import Accel
from torchpt.integrators.base import Integrator, Limits
from torchpt.integrators.plan import Plan
from torchpt.integrators.search import Search
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.tally import Tally
from torchpt.math.vectors import take
from torchpt.records import Hit, PathState, World, joined
from torchpt.samplers import salts

__all__ = ["ENDLESS", "Limits", "PathIntegrator", "gather_light", "partition", "slides", "trace"]

#: Where ``max_depth`` is -1 roulette ends the paths; after this many vertices they are ended, and counted. Of a million million
#: paths that lose nothing none comes so far (``DEEP_CAP``): only those are cut that roulette was told to leave alone.
ENDLESS = 1 << 15


class PathIntegrator(Integrator):
    """Integrators that follow paths to their :attr:`limits`, vertex by vertex, in the stage ``bounce``."""

    looped = True

    def radiance(self, stages: Stages, accel: Accel, state: PathState, first: None, tally: Tally) -> Tensor:
        """See :class:`Integrator`."""
        return trace(stages, self.limits, accel, state, tally)


def trace(
    stages: Stages,
    limits: Limits,
    accel: Accel,
    state: PathState,
    tally: Tally,
    lanes: int | None = None,
    depth: int = 1,
    hit: Hit | None = None,
) -> Tensor:
    """Radiance ``(3, N)`` carried back along camera rays ``state``; ``tally`` counts what it took.

    ``lanes, depth, hit``: of paths that go on from a vertex: of how many camera rays they are, the vertex, and what they met.
    """
    plan, world = stages.plan, stages.world
    n = len(state.lane)
    gathered = state.radiance.new_zeros(3, n if lanes is None else lanes)

    search = Search(accel, world, plan.sampler, plan.dtype)
    if depth == 1 and any(model.refracts for model in world.materials.models):
        state = replace(state, eta=torch.ones_like(state.t_max))
    if depth == 1 and lights.local(world.lights):
        state = replace(state, p=state.o.clone(), n=torch.zeros_like(state.o))

    def retire(index: Tensor) -> None:
        if len(index):
            lanes = take(state.lane, index)
            gathered.scatter_(1, lanes.expand(3, -1), take(state.radiance, index))

    last = limits.max_depth if limits.max_depth >= 0 else ENDLESS
    while n and depth <= last:
        tally.rays += len(state.lane)
        if hit is None:
            hit = search.nearest(state, depth)
        if stages.met(depth, state, hit):
            break
        slide = slides(plan, world, depth)
        ends, groups = partition(world, hit)
        gather_light(stages, state, hit, ends, slide)
        retire(ends.missed)
        if depth == last:
            for _, index in groups:
                retire(index)
                if limits.max_depth < 0:
                    tally.truncated += len(index)
        if depth == last or not groups:
            break
        salt = salts(depth, state.lane.device)
        following = partial(search.nearest, depth=depth + 1)
        parts = []
        for model, index in groups:
            after, found, shadow = stages.bounce(
                model, limits.roulette(depth), slide, following, state, hit, index, salt
            )
            if shadow is not None:
                tally.rays += len(index)
                clear = search.clear(shadow)
                stages.cleared(clear)
                after = replace(after, radiance=torch.addcmul(after.radiance, shadow.radiance, clear))
            parts.append((after, found))
        state = joined([after for after, _ in parts])
        hit = joined([found for _, found in parts if found is not None]) if plan.attached else None
        depth += 1
    return gathered


def slides(plan: Plan, world: World, depth: int) -> bool:
    """Whether points at a vertex slide along their rays; see :func:`torchpt.shapes.interact`.

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


def gather_light(stages: Stages, state: PathState, hit: Hit, ends: Ends, slide: bool) -> None:
    """Add to ``state.radiance`` what the lanes gather from emitters they hit and from the environment."""
    table = stages.world.lights
    if table is None:
        return
    if len(ends.emissive):
        state.radiance.scatter_add_(1, ends.emissive.expand(3, -1), stages.emit(state, hit, ends.emissive, slide))
    if table.environment is not None and len(ends.missed):
        state.radiance.scatter_add_(1, ends.missed.expand(3, -1), stages.escape(state, hit, ends.missed))
