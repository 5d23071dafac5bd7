"""The BRDF table of split-sum shading: reflectance of a rough mirror with Schlick's Fresnel, ``F0 scale + bias``."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math import microfacet
from torchpt.math.vectors import dot
from torchpt.physics.ibl.points import hammersley

__all__ = ["brdf_table"]


def brdf_table(size: int = 64, samples: int = 1024) -> Tensor:
    """Return ``(scale, bias)`` of ``integral f cos = F0 scale + bias``, with the GGX and masking of ``roughconductor``.

    Args:
        size: number of entries along both axes.
        samples: number of visible normals for each entry, at Hammersley's points.

    Returns:
        ``(size, size, 2)`` float64: entry ``[i, j]`` is for roughness ``i / (size - 1)`` and ``n . v = j / (size - 1)``.
    """
    for key, value, least in (("size", size, 2), ("samples", samples, 1)):
        if not isinstance(value, int) or value < least:
            raise SceneError(key, value, f"an integer, at least {least}")
    return _table(size, samples).clone()


@lru_cache(maxsize=4)
def _table(size: int, samples: int) -> Tensor:
    steps = torch.linspace(0.0, 1.0, size, dtype=torch.float64)
    z = steps.repeat_interleave(samples)
    wo = torch.stack(((1.0 - z * z).clamp_min(0.0).sqrt(), torch.zeros_like(z), z))
    u = (hammersley(samples) + 0.5 / samples).repeat(1, size)
    return torch.stack([_row(wo, u, microfacet.roughness(r * r), samples) for r in steps])


def _row(wo: Tensor, u: Tensor, alpha: Tensor, samples: int) -> Tensor:
    """Return a row ``(size, 2)``; with visible normals ``f cos / pdf`` is the Fresnel term times the masking of ``wi``."""
    alphas = alpha.expand(wo.shape[1])
    m = microfacet.sample_normal(wo, alphas, alphas, u)
    cos = dot(wo, m).clamp(0.0, 1.0)
    wi = microfacet.reflect(wo, m, cos)
    seen = microfacet.masking(wi[2].clamp_min(0.0), microfacet.stretched_length(wi, alphas, alphas))
    rest = 1.0 - cos
    schlick = (rest * rest) * (rest * rest) * rest
    both = torch.stack((seen * (1.0 - schlick), seen * schlick), 1)
    return both.view(-1, samples, 2).mean(1)
