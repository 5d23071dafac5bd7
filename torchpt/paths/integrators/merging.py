"""Merges: camera paths and light paths that arrive at nearly the same point count as met.

After Georgiev, Krivanek, Davidovic and Slusallek, "Light Transport Simulation with Vertex Connection and Merging" (2012).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal
from torchpt.paths import vertex as stages
from torchpt.paths.integrators.base import Limits
from torchpt.paths.integrators.weights import Arrival, reduced, reverse_pdf, root_of_squares
from torchpt.paths.state import PathState, Photon, StageContext
from torchpt.paths.surface import Surface
from torchpt.physics.shapes.geometry import Interaction

__all__ = ["merged_light"]

#: Least cosine of a photon's arrival that is divided by.
_LEAST_COSINE = 1e-3


def merged_light(
    context: StageContext,
    model: int,
    photon: Photon,
    limits: Limits,
    *,
    state: PathState,
    at: Interaction,
    surface: Surface,
    arrival: Arrival,
) -> Tensor:
    """Return the light ``(3, n)`` of merges of camera paths with photons.

    Args:
        context: of the stage.
        model: index of the BSDF model.
        photon: one near each vertex.
        limits: depth limits of paths.
        state: the camera paths as they arrive.
        at: the surface points.
        surface: the points with their material.
        arrival: the numbers of MIS of the camera paths.
    """
    assert context.merging is not None
    w = -photon.d
    wi = surface.frame.to_local(w)
    value, pdf = context.world.materials.models[model].eval_pdf(surface.parameters, surface.wo, wi)
    share = stages.shading_weight(context.world, model, at, surface, w, wi)
    reverse = reverse_pdf(context, model, at, surface, -state.d, w)
    # The density of photons is that by area of the surface, which the value of the BSDF has a cosine for.
    scale = safe_reciprocal(dot(w, at.ng).abs().clamp_min(_LEAST_COSINE))
    ratio = root_of_squares(arrival.before(reverse), root_of_squares(photon.dvcm, photon.dvc * pdf))
    scale = scale * reduced(None, ratio * safe_reciprocal(context.merging))
    found = photon.depth > 0
    if not limits.endless:
        found = found & (photon.depth + context.depth <= limits.last)
    light = state.throughput * value * photon.value * (scale if share is None else scale * share)
    return torch.where(found, light, 0.0)
