"""Normal and bump maps: the perturbed shading frame, and the shadowing of the relief that a map stands for.

Called where a surface point's material is resolved (:mod:`torchpt.paths.surface`); the shadowing multiplies light samples and
BSDF samples there (:mod:`torchpt.paths.vertex`).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import Frame, affine, cross, dot, normalize, take
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.textures import MaterialTextures

__all__ = ["PerturbedNormal", "perturb_normal"]

#: Lower bound of squared cosines that are divided by, so that quotients stay finite.
_LEAST_SQUARE = 1e-12
#: Lower bound of the z component of a map's normals, which must point out of the surface.
_LEAST_Z = 1e-3


@dataclass(frozen=True)
class PerturbedNormal:
    """The shading normal before a normal or bump map, and the roughness of a surface whose facets tilt as the map does."""

    normal: Tensor  # (3, N) shading normal without the map, on the same side as the frame
    alpha2: Tensor  # (N,) squared roughness for the shadowing term

    def shadowing(self, w: Tensor) -> Tensor:
        """Return the shadowing factor ``(N,)``, 0 to 1, of light from unit directions ``w (3, N)``.

        Smith's masking function in place of the hard edge between the horizons of the two normals (Conty Estevez, Lecocq,
        Stein, *A Microfacet-Based Shadowing Function to Solve the Bump Terminator Problem*, Ray Tracing Gems, 2019).
        """
        # cos^2 of the angle to the normal; (1 - square) / square is tan^2.
        square = dot(w, self.normal).square().clamp_min(_LEAST_SQUARE)
        return 2.0 / (1.0 + (1.0 + self.alpha2 * (1.0 - square).clamp_min(0.0) / square).sqrt())


def perturb_normal(
    textures: MaterialTextures,
    row: Tensor,
    colour: Tensor | None,
    slope: tuple[Tensor, Tensor] | None,
    d: Tensor,
    at: Interaction,
    side: Tensor | None,
    mirrored: bool = False,
) -> tuple[Frame, PerturbedNormal]:
    """Return the shading frame about the normal of a normal or bump map, and the unperturbed normal.

    The vectors of a normal map are relative to the tangent along texture coordinate u, the cross product of the shading normal
    with this tangent, and the shading normal.
    The heights of a bump map displace the surface along its normal (Blinn, *Simulation of Wrinkled Surfaces*, 1978). The back
    of a surface shows the mirror image. Where light passes, and if ``mirrored``, a perturbed normal that faces away from the
    viewer is mirrored about the unperturbed one (after Schuessler, Heitz, Hanika, Dachsbacher, *Microfacet-based Normal
    Mapping*, 2017), as in Mitsuba's ``normalmap`` and ``bumpmap``. The picture jumps where mirroring begins, at no edge of
    the geometry, and gradients miss that.

    Args:
        textures: textures of the model.
        row: ``(N,)`` rows of the materials in the tables of that model.
        colour: ``(3, N)`` colours of the normal map, 0 to 1; None for a bump map.
        slope: derivatives of the bump map's height with respect to u and v, ``(N,)`` each; None for a normal map.
        d: ``(3, N)`` directions of the incoming rays.
        at: the surface points.
        side: ``(N,)`` -1 where the shading normal is flipped, on the back, else 1; None where the model transmits.
        mirrored: whether perturbed normals that face away are mirrored where the model transmits nothing.
    """
    assert at.tangent is not None
    base = Frame.along(at.ns, at.tangent)  # s along the tangent, t across, n the shading normal
    if colour is not None:
        vector = colour * 2.0 - 1.0  # colours 0 to 1 to components -1 to 1
        x, y, z = vector[0], vector[1], vector[2].clamp_min(_LEAST_Z)
        if textures.strength is not None:
            strength = take(textures.strength, row)
            x, y = x * strength, y * strength
    else:
        assert slope is not None and at.bitangent is not None
        du, dv = slope
        # Derivatives of the displaced surface by u and v; their cross product is its normal.
        along = torch.addcmul(at.tangent, at.ns, du - dot(at.ns, at.tangent))
        across = torch.addcmul(at.bitangent, at.ns, dv - dot(at.ns, at.bitangent))
        x, y, z = base.to_local(cross(along, across))  # not unit yet
        # A mirrored chart of texture coordinates gives the normal of the other side.
        sign = torch.copysign(torch.ones_like(z), z.detach())
        x, y, z = x * sign, y * sign, z * sign
    n = at.ns if side is None else at.ns * side
    normal = normalize(affine(base.s * x, base.t, y, n, z))  # x s + y t + z n
    if side is None or mirrored:
        away = (dot(d, n) * dot(d, normal) <= 0).detach()  # the ray meets the two normals from different sides
        normal = torch.where(away, normalize(affine(base.s * -x, base.t, -y, n, z)), normal)
    flat = dot(normal, normal) == 0  # no texture coordinates, so no slope
    normal = torch.where(flat, n, normal)
    square = dot(normal, n).square().clamp_min(_LEAST_SQUARE)
    # alpha^2 of the tilt, tan^2 / 8, as in the paper at `shadowing`.
    alpha2 = (0.125 * (1.0 - square).clamp_min(0.0) / square).clamp_max(1.0)
    # By the tangent of the frame before, not by that of the face: as Mitsuba turns anisotropic lobes under a normal map.
    return Frame.along(normal, base.s), PerturbedNormal(normal=n, alpha2=alpha2)
