"""Split-sum shading: radiance of surfaces under an environment map by three look-ups, without shadows.

Karis, *Real Shading in Unreal Engine 4*, 2013. The reflection integral is approximated by a product: the map prefiltered about
the mirror direction, times the reflectance of the surface under a white sky (the BRDF table). The diffuse part looks the
irradiance map up by normal. :func:`maps` and :func:`shade` are public; the integrator ``ibl`` uses :class:`Sky` on lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.vectors import dot, take
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.ibl.convolve import irradiance_map, prefiltered
from torchpt.physics.ibl.equirect import coordinates, corners
from torchpt.physics.ibl.table import brdf_table

__all__ = ["F0", "IblMaps", "Sky", "SplitSumMaterial", "fresnel", "maps", "shade"]

#: Reflectance at normal incidence of dielectrics: that of an index of refraction of 1.5.
F0 = 0.04


@dataclass(frozen=True)
class IblMaps:
    """The maps of split-sum shading.

    Attributes:
        irradiance: ``(H, W, 3)``, ``E(n) / pi`` by normal.
        specular: ``(H_l, W_l, 3)`` each, radiance by mirror direction; level l of L is for roughness ``l / (L - 1)``.
        brdf: ``(R, R, 2)``, scale and bias by roughness and ``n . v``, see :func:`torchpt.ibl.brdf_table`.
    """

    irradiance: Tensor
    specular: tuple[Tensor, ...]
    brdf: Tensor


def maps(
    map: Tensor,
    levels: int = 6,
    samples: int = 1024,
    method: str = "importance",
    sizes: Sequence[tuple[int, int]] | None = None,
) -> IblMaps:
    """Compute the maps of split-sum shading for an environment map; differentiable in it.

    Args:
        map: radiance ``(H, W, 3)``, finite, at least 0, in the layout of :mod:`torchpt.physics.ibl.equirect`.
        levels: number of roughnesses of the prefiltered map.
        samples: number of directions for each of its texels.
        method: see :func:`torchpt.ibl.irradiance_map`.
        sizes: see :func:`torchpt.ibl.prefiltered`.
    """
    return IblMaps(
        irradiance=irradiance_map(map, method=method),
        specular=tuple(prefiltered(map, levels, sizes, samples)),
        brdf=brdf_table().to(map.device, map.dtype),
    )


def shade(
    maps: IblMaps,
    n: Tensor,
    v: Tensor,
    base_color: Tensor,
    roughness: Tensor | float,
    metallic: Tensor | float = 0.0,
    f0: Tensor | float = F0,
) -> Tensor:
    """Return the radiance of surfaces under an environment map, without shadows.

    ``kD = (1 - F_r)(1 - metallic)`` with ``F_r = F0 + (max(1 - roughness, F0) - F0)(1 - n . v)^5``; diffuse ``kD base_color
    E / pi``, specular ``prefiltered(r, roughness) (F0 scale + bias)``. Differentiable in all of its arguments.

    Args:
        maps: from :func:`maps`.
        n: unit normals ``(..., 3)``.
        v: unit directions toward the viewer ``(..., 3)``; below the surface they count as grazing.
        base_color: ``(..., 3)``.
        roughness: ``(...)``, from 0 (a mirror) to 1.
        metallic: ``(...)``, from 0 to 1.
        f0: reflectance at normal incidence where metallic is 0, ``(...)`` or ``(..., 3)``.

    Returns:
        Radiance ``(..., 3)``.
    """
    for key, value in (("n", n), ("v", v), ("base_color", base_color)):
        if not isinstance(value, Tensor) or value.dim() < 1 or value.shape[-1] != 3:
            raise SceneError(key, getattr(value, "shape", value), "a tensor of shape (..., 3)")
    shape = torch.broadcast_shapes(n.shape, v.shape, base_color.shape)

    def lanes(value: Tensor) -> Tensor:
        """Return vectors ``(..., 3)`` as ``(3, N)``."""
        return value.expand(shape).reshape(-1, 3).T

    def numbers(key: str, value: Tensor | float) -> Tensor:
        """Return numbers ``()`` or ``(...)`` as ``(N,)``."""
        tensor = torch.as_tensor(value, dtype=n.dtype, device=n.device)
        try:
            return tensor.expand(shape[:-1]).reshape(-1)
        except RuntimeError:
            raise SceneError(key, tuple(tensor.shape), f"a number, or the shape {tuple(shape[:-1])}") from None

    rough, metal = numbers("roughness", roughness), numbers("metallic", metallic)
    base = lanes(base_color)
    # f0 is a colour if its last axis is RGB: a single one, or one a surface. Else (3,) would be three numbers.
    is_colour = isinstance(f0, Tensor) and f0.dim() > 0 and f0.shape[-1] == 3 and f0.dim() in (1, len(shape))
    dielectric_f0 = lanes(f0) if is_colour and isinstance(f0, Tensor) else numbers("f0", f0)
    mixed_f0 = dielectric_f0 + (base - dielectric_f0) * metal
    surface = SplitSumMaterial(
        diffuse=base * (1.0 - metal), f0=mixed_f0, f90=torch.ones_like(rough), roughness=rough, over=mixed_f0
    )
    out = Sky.of(maps).reflected(lanes(n), lanes(v), surface)
    return out.T.reshape(shape)


def fresnel(cosine: Tensor, f0: Tensor, surface: SplitSumMaterial) -> Tensor:
    """Return Schlick's reflectance with roughness: ``F0 + (max((1 - roughness) F90, F0) - F0)(1 - cosine)^5``.

    Args:
        cosine: ``(N,)`` of normal and viewer, 0 to 1.
        f0: reflectance at normal incidence, ``(N,)`` or ``(3, N)``.
        surface: gives roughness and F90.
    """
    grazing = 1.0 - cosine
    weight = (grazing * grazing) * (grazing * grazing) * grazing
    at_grazing = torch.maximum(*torch.broadcast_tensors((1.0 - surface.roughness) * surface.f90, f0))
    return f0 + (at_grazing - f0) * weight


@dataclass(frozen=True)
class Sky:
    """The maps of split-sum shading as flat tables, for look-ups on lanes.

    Attributes:
        irradiance: ``(3, H W)``.
        size: H and W of ``irradiance``.
        specular: ``(3, T)``, all levels.
        levels: ``(3, L)`` int64: first texel, number of rows, number of columns of each level.
        brdf: ``(2, R R)``, scale and bias.
        entries: R, entries of the table along each axis.
    """

    irradiance: Tensor
    size: tuple[int, int]
    specular: Tensor
    levels: Tensor
    brdf: Tensor
    entries: int

    @staticmethod
    def of(maps: IblMaps) -> Sky:
        """Return the tables of ``maps``."""
        levels, first = [], 0
        for level in maps.specular:
            rows, columns, _ = level.shape
            levels.append((first, rows, columns))
            first += rows * columns
        height, width, _ = maps.irradiance.shape
        return Sky(
            irradiance=maps.irradiance.reshape(-1, 3).T.contiguous(),
            size=(height, width),
            specular=torch.cat([level.reshape(-1, 3) for level in maps.specular]).T.contiguous(),
            levels=torch.tensor(levels, dtype=torch.int64, device=maps.irradiance.device).T.contiguous(),
            brdf=maps.brdf.reshape(-1, 2).T.contiguous(),
            entries=len(maps.brdf),
        )

    def reflected(self, n: Tensor, v: Tensor, surface: SplitSumMaterial) -> Tensor:
        """Return radiance ``(3, N)`` toward unit ``v (3, N)`` from surfaces with unit normals ``n (3, N)``."""
        cosine = dot(n, v)
        mirrored = torch.addcmul(-v, n, 2.0 * cosine)
        cosine = cosine.clamp(0.0, 1.0)
        roughness = surface.roughness.clamp(0.0, 1.0)
        scale, bias = self.reflectance(cosine, roughness)
        color = (surface.f0 * scale + surface.f90 * bias).expand(3, -1)
        base = surface.diffuse * self.diffuse(n)
        if surface.over is not None:  # the diffuse base loses what the layer above it reflects
            base = base * (1.0 - fresnel(cosine, surface.over, surface))
        return torch.addcmul(base, self.prefiltered(mirrored, roughness), color)

    def diffuse(self, n: Tensor) -> Tensor:
        """Return ``E / pi`` ``(3, N)`` for normals ``(3, N)``."""
        height, width = self.size
        (texel, *texels), (weight, *weights) = corners(*coordinates(n), height, width)
        value = take(self.irradiance, texel) * weight
        for texel, weight in zip(texels, weights, strict=True):
            value = torch.addcmul(value, take(self.irradiance, texel), weight)
        return value

    def prefiltered(self, d: Tensor, roughness: Tensor) -> Tensor:
        """Return prefiltered radiance ``(3, N)`` along unit ``d (3, N)`` for ``roughness (N,)``; linear between levels."""
        last = self.levels.shape[1] - 1
        position = roughness * last  # in levels
        low = position.detach().floor().clamp_max(last - 1)
        uv = coordinates(d)
        below = low.to(torch.int64)
        sharper, blurrier = self._look_up_level(uv, below), self._look_up_level(uv, below + 1)
        return torch.addcmul(sharper, blurrier - sharper, position - low)

    def _look_up_level(self, uv: tuple[Tensor, Tensor], level: Tensor) -> Tensor:
        """Return radiance ``(3, N)`` of prefiltered levels ``(N,)`` at ``u, v``, bilinear."""
        first, height, width = take(self.levels, level)
        (texel, *texels), (weight, *weights) = corners(*uv, height, width)
        value = take(self.specular, first + texel) * weight
        for texel, weight in zip(texels, weights, strict=True):
            value = torch.addcmul(value, take(self.specular, first + texel), weight)
        return value

    def reflectance(self, cosine: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
        """Return scale and bias ``(N,)`` of the BRDF table at cosines and roughnesses ``(N,)`` in ``[0, 1]``."""
        last = self.entries - 1
        x, y = cosine * last, roughness * last
        j, i = (position.detach().floor().clamp_max(last - 1) for position in (x, y))
        fx, fy = x - j, y - i
        corner = i.to(torch.int64) * self.entries + j.to(torch.int64)
        a, b = take(self.brdf, corner), take(self.brdf, corner + 1)
        c, d = take(self.brdf, corner + self.entries), take(self.brdf, corner + self.entries + 1)
        top, bottom = torch.addcmul(a, b - a, fx), torch.addcmul(c, d - c, fx)
        scale, bias = torch.addcmul(top, bottom - top, fy)
        return scale, bias
