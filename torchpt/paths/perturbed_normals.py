"""Normal and bump maps: the frame that they tilt, and how much light the relief that they stand for lets through."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import Frame, affine, cross, dot, normalize, take
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.textures import MaterialTextures

__all__ = ["PerturbedNormal", "perturb_normal"]


@dataclass(frozen=True)
class PerturbedNormal:
    """What a normal or bump map did to the shading normal."""

    normal: Tensor  # (3, N) without the map, turned as the frame is
    alpha2: Tensor  # (N,) squared roughness of a surface whose facets lean as the map does

    def shadowing(self, w: Tensor) -> Tensor:
        """How much of the light from unit directions ``w (3, N)`` the relief lets through ``(N,)``.

        Smith's masking by the facets that the tilt stands for, which takes the place of the hard edge where mapped and true
        horizon differ (Conty Estevez, Lecocq, Stein, *A Microfacet-Based Shadowing Function to Solve the Bump Terminator
        Problem*, Ray Tracing Gems, 2019).
        """
        square = dot(w, self.normal).square().clamp_min(1e-12)
        return 2.0 / (1.0 + (1.0 + self.alpha2 * (1.0 - square).clamp_min(0.0) / square).sqrt())


def perturb_normal(
    textures: MaterialTextures,
    row: Tensor,
    local: Tensor | None,
    slope: tuple[Tensor, Tensor] | None,
    d: Tensor,
    at: Interaction,
    side: Tensor | None,
) -> tuple[Frame, PerturbedNormal]:
    """The frame about the normal of a normal or bump map, and what the map did.

    A normal map's vectors are relative to the shading normal, the tangent along u, and their cross product. A bump map's
    heights move the surface along its normal (Blinn, *Simulation of Wrinkled Surfaces*, 1978). What is seen from behind is
    the mirror image. A normal that turns from the eye is mirrored about the surface's own (after Schuessler, Heitz,
    Hanika, Dachsbacher, *Microfacet-based Normal Mapping*, 2017): all as Mitsuba's ``normalmap`` and ``bumpmap``.

    Args:
        textures: of the model.
        row: of the materials in it.
        local: what a normal map holds there ``(3, N)``; None where there is a bump map.
        slope: of a bump map's heights with respect to u and v ``(N,)``; None where there is a normal map.
        d: directions of the rays that came.
        at: the points.
        side: see :class:`torchpt.paths.surface.Surface`.
    """
    assert at.tangent is not None
    base = Frame.along(at.ns, at.tangent)
    if local is not None:
        local = local * 2.0 - 1.0
        x, y, z = local[0], local[1], local[2].clamp_min(1e-3)
        if textures.strength is not None:
            strength = take(textures.strength, row)
            x, y = x * strength, y * strength
    else:
        assert slope is not None and at.bitangent is not None
        du, dv = slope
        along = torch.addcmul(at.tangent, at.ns, du - dot(at.ns, at.tangent))
        across = torch.addcmul(at.bitangent, at.ns, dv - dot(at.ns, at.bitangent))
        x, y, z = base.to_local(cross(along, across))
        sign = torch.copysign(torch.ones_like(z), z.detach())
        x, y, z = x * sign, y * sign, z * sign
    n = at.ns if side is None else at.ns * side
    normal = normalize(affine(base.s * x, base.t, y, n, z))
    away = (dot(d, n) * dot(d, normal) <= 0).detach()
    normal = torch.where(away, normalize(affine(base.s * -x, base.t, -y, n, z)), normal)
    flat = dot(normal, normal) == 0  # no texture coordinates, so no slope
    normal = torch.where(flat, n, normal)
    square = dot(normal, n).square().clamp_min(1e-12)
    alpha2 = (0.125 * (1.0 - square).clamp_min(0.0) / square).clamp_max(1.0)
    return Frame.along(normal, at.tangent), PerturbedNormal(n, alpha2)
