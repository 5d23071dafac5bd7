"""The BRDF table of split-sum shading: reflectance of a rough mirror with Schlick's Fresnel, ``F0 scale + bias``.

Under a white sky a rough mirror reflects ``F0 scale + bias``, where F0 is its reflectance at normal incidence; the table has
both numbers by roughness and viewing angle (Karis, *Real Shading in Unreal Engine 4*, 2013).
"""

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
    for key, value, minimum in (("size", size, 2), ("samples", samples, 1)):
        if not isinstance(value, int) or value < minimum:
            raise SceneError(key, value, f"an integer, at least {minimum}")
    return _table(size, samples).clone()  # the cached table stays as it is, whatever the caller does


@lru_cache(maxsize=4)
def _table(size: int, samples: int) -> Tensor:
    """Return the table of :func:`brdf_table`, computed once for the same arguments."""
    steps = torch.linspace(0.0, 1.0, size, dtype=torch.float64)
    z = steps.repeat_interleave(samples)
    wo = torch.stack(((1.0 - z * z).clamp_min(0.0).sqrt(), torch.zeros_like(z), z))
    u = (hammersley(samples) + 0.5 / samples).repeat(1, size)
    return torch.stack([_row(wo, u, microfacet.clamp_alpha(step * step), samples) for step in steps])


def _row(wo: Tensor, u: Tensor, alpha: Tensor, samples: int) -> Tensor:
    """Return the row ``(size, 2)`` of the table for one roughness.

    With visible normals ``f cos / pdf`` is the Fresnel term times the masking of ``wi``.

    Args:
        wo: ``(3, size samples)``: the direction of each entry, ``samples`` times.
        u: ``(2, size samples)`` in [0, 1).
        alpha: ``()`` GGX alpha.
        samples: number of visible normals for each entry.
    """
    alphas = alpha.expand(wo.shape[1])
    m = microfacet.sample_normal(wo, alphas, alphas, u)
    cos = dot(wo, m).clamp(0.0, 1.0)
    wi = microfacet.reflect(wo, m, cos)
    # Smith's G1 of `wi`, from its cosine and its stretched length.
    visible = microfacet.masking(wi[2].clamp_min(0.0), microfacet.stretched_length(wi, alphas, alphas))
    grazing = 1.0 - cos
    schlick = (grazing * grazing) * (grazing * grazing) * grazing
    # Schlick's F0 + (1 - F0) schlick, sorted by F0: F0 (1 - schlick) + schlick.
    scale_and_bias = torch.stack((visible * (1.0 - schlick), visible * schlick), 1)
    return scale_and_bias.view(-1, samples, 2).mean(1)
