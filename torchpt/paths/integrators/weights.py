"""MIS weights over the strategies of bidirectional paths, by numbers that are carried along a path.

A path of camera, surfaces and light may be found in several ways: a camera path meets the light, a light sample ends it, a
light path is joined to the camera, two inner vertices are connected, or a camera path and a light path that arrive at nearly
the same point are merged there. Each has a density (with several samples, times their number), and the power heuristic weights
a sample of one of them by::

    1 / (1 + sum of (p_other / p_own)^2)

``p_other / p_own`` is a product over the vertices of the path. ``dvcm`` and ``dvc`` are the parts of it that are known at a
vertex: ``dvcm`` of the strategy that joins the edge to the vertex, ``dvc`` of all those before it, where the density with which
the BSDF samples the way back is still missing (Georgiev, *Implementing Vertex Connection and Merging*, 2012; van Antwerpen,
*Recursive MIS Computation for Streaming BDPT on the GPU*, 2011). Both are kept as the root of a sum of squares, so that float32
holds them.

Cosines are those of geometric normals, since densities are by area of the surface as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal
from torchpt.paths.state import Field, StageContext
from torchpt.paths.surface import Surface, surface_at
from torchpt.physics.shapes.geometry import Interaction

__all__ = ["FIELDS", "Arrival", "leaving_dvc", "leaving_dvcm", "reduced", "reverse_pdf", "root_of_squares", "seen_from"]

#: The fields of a path that its weights need; see above.
FIELDS = (Field("dvcm"), Field("dvc"))
#: Bound of ratios of densities: its square is still a float32, and its weight 0.
_MOST = 2.0**60
#: Least cosine that is divided by: rays along a surface meet it at no point.
_LEAST_COSINE = 1e-7


@dataclass(frozen=True)
class Arrival:
    """``dvcm`` and ``dvc`` at a vertex, with the cosine at which the path arrives; ``(N,)`` each.

    ``merging``: ``(1,)`` ratio of densities of a merge at this vertex; None: the vertex is not merged.
    """

    dvcm: Tensor
    dvc: Tensor
    cosine: Tensor
    merging: Tensor | None = None

    @staticmethod
    def cosine_of(d: Tensor, at: Interaction) -> Tensor:
        """Return the cosines ``(N,)`` at which rays ``d (3, N)`` arrive."""
        return dot(d, at.ng).abs().clamp_min(_LEAST_COSINE)

    def others(self, reverse: Tensor) -> Tensor:
        """Return ``p_other / p_own`` of all strategies up to the vertex, where ``reverse (N,)`` samples the way back."""
        before = self.before(reverse)
        return before if self.merging is None else root_of_squares(before, self.merging)

    def before(self, reverse: Tensor) -> Tensor:
        """Return the same without a merge at the vertex itself."""
        return root_of_squares(self.dvcm, self.dvc * reverse)


def root_of_squares(a: Tensor, b: Tensor) -> Tensor:
    """Return ``sqrt(a^2 + b^2)`` of numbers that are not negative, ``(N,)`` each, whose squares may overflow."""
    most = torch.maximum(a, b)
    ratio = torch.minimum(a, b) * safe_reciprocal(most)
    return most * (1.0 + ratio * ratio).sqrt()


def reduced(weight: Tensor | None, other: Tensor) -> Tensor:
    """Return the factor ``(N,)`` by which a weight falls where one more strategy finds the path.

    Args:
        weight: the weight ``(N,)`` without it; None: 1.
        other: density of that strategy over the own one ``(N,)``.
    """
    other = other.clamp_max(_MOST)
    square = other * other
    return 1.0 / (1.0 + (square if weight is None else weight * square))


def seen_from(context: StageContext, model: int, at: Interaction, surface: Surface, w: Tensor) -> Surface:
    """Return surface points as they are seen from unit directions ``w (3, N)`` on the same side.

    Only perturbed normals may differ, which may be mirrored where they face away from the viewer.
    """
    opaque = surface.outward is not None
    if surface.perturbed_normal is None or (opaque and not context.plan.dark_rims):
        return surface
    return surface_at(context.world, model, -w, at, context.pixel, dark_rims=context.plan.dark_rims)


def reverse_pdf(context: StageContext, model: int, at: Interaction, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
    """Return the density ``(N,)`` with which a path that comes the other way, from ``wi``, goes on along ``wo``.

    Args:
        context: of the stage.
        model: index of the BSDF model.
        at: the surface points.
        surface: the points with their material, as seen from ``wo``.
        wo: unit directions ``(3, N)`` in the world.
        wi: likewise.
    """
    kind, other = context.world.materials.models[model], seen_from(context, model, at, surface, wi)
    return kind.pdf(other.parameters, other.local_wo(wi), other.frame.to_local(wo))


def leaving_dvcm(pdf: Tensor, smooth: bool, number: float) -> Tensor:
    """Return ``dvcm (N,)`` of the rays that leave a vertex: of a connection of this vertex with the next one.

    It lacks the factor by which the density of the ray becomes one of points, which is known at the next vertex.

    Args:
        pdf: density ``(N,)`` of the rays; inf for a delta lobe, which no connection can replace.
        smooth: whether the surface has delta lobes alone.
        number: number of connections for each sample; 0: there are none.
    """
    if smooth or not number:
        return torch.zeros_like(pdf)
    return (number * safe_reciprocal(pdf)).clamp_max(_MOST)  # 0 for a delta lobe


def leaving_dvc(
    context: StageContext,
    model: int,
    at: Interaction,
    surface: Surface,
    arrival: Arrival,
    d: Tensor,
    pdf: Tensor,
    eta: Tensor | None,
    reverse: Tensor | None,
) -> Tensor:
    """Return ``dvc (N,)`` of the rays that leave a vertex.

    Args:
        context: of the stage.
        model: index of the BSDF model.
        at: the surface points.
        surface: the points with their material, as seen from where the path comes from.
        arrival: of the path at the vertex.
        d: unit directions ``(3, N)`` of the rays that leave.
        pdf: density ``(N,)`` of these; inf for a delta lobe.
        eta: index of refraction behind the vertex over that before it ``(N,)``; None: nothing refracts.
        reverse: density ``(N,)`` with which a path the other way is sampled; None for a model of delta lobes alone.
    """
    kind = context.world.materials.models[model]
    cosine = dot(d, at.ng).abs()
    rough = None
    if reverse is not None:
        rough = cosine * safe_reciprocal(torch.where(torch.isinf(pdf), 0.0, pdf)) * arrival.others(reverse)
        rough = rough.clamp_max(_MOST)
    if not kind.delta:
        assert rough is not None
        return rough
    # Both ways choose a delta lobe alike. No strategy joins the vertex, so its `dvcm` is left out.
    sharp = arrival.dvc * arrival.cosine
    if eta is not None:
        sharp = sharp / (eta * eta)
    if surface.perturbed_normal is not None:  # the other way meets another normal, and does not come back
        other = seen_from(context, model, at, surface, d)
        sharp = torch.where(dot(other.frame.n, surface.frame.n) > 1.0 - 1e-4, sharp, 0.0)
    return sharp if rough is None else torch.where(torch.isinf(pdf), sharp, rough)
