"""Split-sum shading of a material model under the sky: what each model is taken for is its own :meth:`Bsdf.split_sum`."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.microfacet import fresnel_dielectric, refract
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.ibl.shading import Sky, fresnel

__all__ = ["under"]


def under(sky: Sky, model: Bsdf, parameters: Parameters, n: Tensor, v: Tensor) -> Tensor:
    """Radiance ``(3, N)`` toward unit ``v`` from materials under the sky, nothing in its way.

    Args:
        sky: its maps.
        model: one for all points.
        parameters: lane values, as prepared.
        n: unit normals ``(3, N)``, on the outside of what light passes through, else on the side of ``v``.
        v: ``(3, N)``.
    """
    return model.preview(parameters, lambda surface: _shaded(sky, surface, n, v))


def _shaded(sky: Sky, surface: SplitSumMaterial, n: Tensor, v: Tensor) -> Tensor:
    """What a surface reflects, and what passes it."""
    side = torch.copysign(torch.ones_like(n[0]), dot(n, v).detach())
    out = sky.reflected(n * side, v, surface)
    if surface.through is None:
        return out
    cosine = (dot(n, v) * side).clamp(0.0, 1.0)
    assert surface.over is not None
    on, passes = -v, 1.0 - fresnel(cosine, surface.over, surface)
    if surface.eta is not None:
        eta = torch.where(side > 0, surface.eta, 1.0 / surface.eta)
        boundary = fresnel_dielectric(cosine, eta)
        on, passes = refract(v, n * side, cosine, boundary), passes * (boundary.reflectance < 1)
    return torch.addcmul(out, surface.through * passes, sky.prefiltered(on, surface.roughness.clamp(0.0, 1.0)))
