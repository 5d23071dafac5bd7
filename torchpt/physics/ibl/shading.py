"""Shading by split sum: what a sky sends back off a surface, as two look-ups and a table, without shadows.

Karis, *Real Shading in Unreal Engine 4*, 2013. The sky's part of the reflection integral is taken apart: a mean of the sky
(prefiltered about the mirror direction) by what the surface would reflect of a white sky.
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

#: Reflectance at normal incidence of what is no metal.
F0 = 0.04


@dataclass(frozen=True)
class IblMaps:
    """What split-sum shading looks up.

    Attributes:
        irradiance: ``(H, W, 3)``, ``E(n) / pi``, by normals.
        specular: ``(H_l, W_l, 3)`` each, by mirror directions; level l of L is for roughness ``l / (L - 1)``.
        brdf: ``(R, R, 2)``, scale and bias, by roughness and ``n . v``.
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
    """The maps of a sky ``(H, W, 3)``, differentiable in it; see :mod:`torchpt.physics.ibl.equirect` for where directions lie.

    Args:
        map: radiance, at least 0 and finite.
        levels: roughnesses of the specular chain.
        samples: directions for each of its texels.
        method: of :func:`torchpt.ibl.irradiance_map`.
        sizes: of :func:`torchpt.ibl.prefiltered`.
    """
    return IblMaps(
        irradiance_map(map, method=method),
        tuple(prefiltered(map, levels, sizes, samples)),
        brdf_table().to(map.device, map.dtype),
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
    """Radiance toward the eye of surfaces under the sky, nothing in its way.

    ``kD = (1 - F_r)(1 - metallic)`` with ``F_r = F0 + (max(1 - roughness, F0) - F0)(1 - n . v)^5``; diffuse ``kD base_color
    E / pi``, specular ``prefiltered(r, roughness) (F0 scale + bias)``. Differentiable in all of its arguments.

    Args:
        maps: of :func:`maps`.
        n: unit normals ``(..., 3)``.
        v: unit directions toward the eye ``(..., 3)``; what lies behind a surface counts as grazing.
        base_color: ``(..., 3)``.
        roughness: ``(...)``, from 0 (a mirror) to 1.
        metallic: ``(...)``, from 0 to 1.
        f0: reflectance at normal incidence where metallic is 0, ``(...)`` or ``(..., 3)``.

    Returns:
        ``(..., 3)``.
    """
    for key, value in (("n", n), ("v", v), ("base_color", base_color)):
        if not isinstance(value, Tensor) or value.dim() < 1 or value.shape[-1] != 3:
            raise SceneError(key, getattr(value, "shape", value), "a tensor of shape (..., 3)")
    shape = torch.broadcast_shapes(n.shape, v.shape, base_color.shape)

    def lanes(value: Tensor) -> Tensor:
        return value.expand(shape).reshape(-1, 3).T

    def numbers(key: str, value: Tensor | float) -> Tensor:
        given = torch.as_tensor(value, dtype=n.dtype, device=n.device)
        try:
            return given.expand(shape[:-1]).reshape(-1)
        except RuntimeError:
            raise SceneError(key, tuple(given.shape), f"a number, or the shape {tuple(shape[:-1])}") from None

    rough, metal = numbers("roughness", roughness), numbers("metallic", metallic)
    base = lanes(base_color)
    coloured = isinstance(f0, Tensor) and f0.dim() > 0 and f0.shape[-1] == 3 and f0.dim() in (1, len(shape))
    clear = lanes(f0) if coloured and isinstance(f0, Tensor) else numbers("f0", f0)
    color = clear + (base - clear) * metal
    surface = SplitSumMaterial(base * (1.0 - metal), color, torch.ones_like(rough), rough, color)
    out = Sky.of(maps).reflected(lanes(n), lanes(v), surface)
    return out.T.reshape(shape)


def fresnel(cosine: Tensor, f0: Tensor, surface: SplitSumMaterial) -> Tensor:
    """Schlick's ``F0 + (max((1 - roughness) F90, F0) - F0)(1 - cosine)^5``: rough surfaces rise less toward grazing."""
    grazing = 1.0 - cosine
    weight = (grazing * grazing) * (grazing * grazing) * grazing
    end = torch.maximum(*torch.broadcast_tensors((1.0 - surface.roughness) * surface.f90, f0))
    return f0 + (end - f0) * weight


@dataclass(frozen=True)
class Sky:
    """The maps as lanes read them: all texels of one kind in one table.

    Attributes:
        irradiance: ``(3, H W)``.
        size: H and W of it.
        specular: ``(3, T)``, the levels one after another.
        levels: ``(3, L)`` int64: first texel, rows, columns.
        brdf: ``(2, R R)``.
        entries: R.
    """

    irradiance: Tensor
    size: tuple[int, int]
    specular: Tensor
    levels: Tensor
    brdf: Tensor
    entries: int

    @staticmethod
    def of(maps: IblMaps) -> Sky:
        """The tables of ``maps``."""
        places, first = [], 0
        for level in maps.specular:
            places.append((first, *level.shape[:2]))
            first += level.shape[0] * level.shape[1]
        height, width, _ = maps.irradiance.shape
        return Sky(
            maps.irradiance.reshape(-1, 3).T.contiguous(),
            (height, width),
            torch.cat([level.reshape(-1, 3) for level in maps.specular]).T.contiguous(),
            torch.tensor(places, dtype=torch.int64, device=maps.irradiance.device).T.contiguous(),
            maps.brdf.reshape(-1, 2).T.contiguous(),
            len(maps.brdf),
        )

    def reflected(self, n: Tensor, v: Tensor, surface: SplitSumMaterial) -> Tensor:
        """Radiance ``(3, N)`` toward unit ``v (3, N)`` off surfaces with unit normals ``n (3, N)``."""
        cosine = dot(n, v)
        mirrored = torch.addcmul(-v, n, 2.0 * cosine)
        cosine = cosine.clamp(0.0, 1.0)
        roughness = surface.roughness.clamp(0.0, 1.0)
        scale, bias = self.reflectance(cosine, roughness)
        color = (surface.f0 * scale + surface.f90 * bias).expand(3, -1)
        base = surface.diffuse * self.diffuse(n)
        if surface.over is not None:
            base = base * (1.0 - fresnel(cosine, surface.over, surface))
        return torch.addcmul(base, self.prefiltered(mirrored, roughness), color)

    def diffuse(self, n: Tensor) -> Tensor:
        """``E / pi (3, N)`` of normals ``(3, N)``."""
        height, width = self.size
        index, weight = corners(*coordinates(n), height, width)
        value = take(self.irradiance, index[0]) * weight[0]
        for k, w in zip(index[1:], weight[1:], strict=True):
            value = torch.addcmul(value, take(self.irradiance, k), w)
        return value

    def prefiltered(self, d: Tensor, roughness: Tensor) -> Tensor:
        """The sky ``(3, N)`` seen in mirrors of some roughness ``(N,)``, along unit ``d (3, N)``; linear between levels."""
        last = self.levels.shape[1] - 1
        place = roughness * last
        low = place.detach().floor().clamp_max(last - 1)
        uv = coordinates(d)
        below = low.to(torch.int64)
        a, b = self._level(uv, below), self._level(uv, below + 1)
        return torch.addcmul(a, b - a, place - low)

    def _level(self, uv: tuple[Tensor, Tensor], level: Tensor) -> Tensor:
        first, height, width = take(self.levels, level)
        index, weight = corners(*uv, height, width)
        value = take(self.specular, first + index[0]) * weight[0]
        for k, w in zip(index[1:], weight[1:], strict=True):
            value = torch.addcmul(value, take(self.specular, first + k), w)
        return value

    def reflectance(self, cosine: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
        """Scale and bias ``(N,)`` of the table at cosines and roughnesses ``(N,)`` in ``[0, 1]``."""
        last = self.entries - 1
        x, y = cosine * last, roughness * last
        j, i = (a.detach().floor().clamp_max(last - 1) for a in (x, y))
        fx, fy = x - j, y - i
        corner = i.to(torch.int64) * self.entries + j.to(torch.int64)
        a, b = take(self.brdf, corner), take(self.brdf, corner + 1)
        c, d = take(self.brdf, corner + self.entries), take(self.brdf, corner + self.entries + 1)
        top, bottom = torch.addcmul(a, b - a, fx), torch.addcmul(c, d - c, fx)
        both = torch.addcmul(top, bottom - top, fy)
        return both[0], both[1]
