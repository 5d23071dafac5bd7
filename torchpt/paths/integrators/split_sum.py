"""Split-sum shading of materials under an environment map; :meth:`Bsdf.preview` approximates each model for it.

The split-sum approximation (Karis, *Real Shading in Unreal Engine 4*, 2013) reads the reflected radiance from maps that are
prefiltered by roughness. The integrator ``ibl`` shades with it; all vectors here are in the space of the maps.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.microfacet import fresnel_dielectric, refract
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.ibl.shading import Sky, fresnel

__all__ = ["shade_under"]


def shade_under(sky: Sky, model: Bsdf, parameters: Parameters, n: Tensor, v: Tensor) -> Tensor:
    """Return the unshadowed radiance ``(3, N)`` that materials reflect and transmit toward unit ``v`` under the environment.

    Args:
        sky: prefiltered maps of the environment.
        model: BSDF model of all points.
        parameters: parameters of the BSDF at each lane, textures included.
        n: unit normals ``(3, N)``: on the outside of models that transmit, else on the side of ``v``.
        v: unit directions ``(3, N)`` to the viewer.
    """
    return model.preview(parameters, lambda surface: _shaded(sky, surface, n, v))


def _shaded(sky: Sky, surface: SplitSumMaterial, n: Tensor, v: Tensor) -> Tensor:
    """Return the radiance ``(3, N)`` that a surface reflects, plus what it transmits."""
    side = torch.copysign(torch.ones_like(n[0]), dot(n, v).detach())  # -1 where the viewer is inside
    radiance = sky.reflected(n * side, v, surface)
    if surface.through is None:  # the colour of transmitted light; None: opaque
        return radiance
    cosine = (dot(n, v) * side).clamp(0.0, 1.0)
    assert surface.over is not None
    # The direction from which transmitted light comes, and the fraction that passes the boundary.
    d, passes = -v, 1.0 - fresnel(cosine, surface.over, surface)
    if surface.eta is not None:
        eta = torch.where(side > 0, surface.eta, 1.0 / surface.eta)
        boundary = fresnel_dielectric(cosine, eta)
        d, passes = refract(v, n * side, cosine, boundary), passes * (boundary.reflectance < 1)  # 1: total reflection
    return torch.addcmul(radiance, surface.through * passes, sky.prefiltered(d, surface.roughness.clamp(0.0, 1.0)))
