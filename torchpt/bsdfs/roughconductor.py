"""A rough metal: GGX microfacets of a conductor, reflected once, or with the energy of further reflections given back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.bsdfs.conductor import metal, metal_colour
from torchpt.bsdfs.lobes import weighed, with_delta
from torchpt.math import microfacet
from torchpt.math.vectors import dot
from torchpt.records import BsdfSample

__all__ = ["RoughConductor", "alphas", "rough"]


def rough(values: Parameters, anisotropic: bool) -> Parameters:
    """Roughnesses of a material: ``alpha_u``, ``alpha_v`` (None where isotropic), and whether it is ``smooth``.

    Args:
        values: ``alpha``, or ``roughness`` (its square root), or ``alpha_u`` and ``alpha_v``.
        anisotropic: whether the two may differ.
    """
    alpha = values["roughness"].square() if "roughness" in values else values.get("alpha")
    u, v = values.get("alpha_u", alpha), values.get("alpha_v", alpha)
    assert u is not None and v is not None
    smooth = microfacet.is_smooth(torch.maximum(u, v))
    return {
        "alpha_u": microfacet.roughness(u),
        "alpha_v": microfacet.roughness(v) if anisotropic else None,
        "smooth": smooth,
    }


def alphas(parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Both roughnesses, from what :func:`rough` gave."""
    u, v = parameters["alpha_u"], parameters["alpha_v"]
    return u, u if v is None else v


@dataclass(frozen=True)
class RoughConductor(Bsdf):
    """A rough mirror. A row with both roughnesses below ``1e-4`` is a smooth one: a delta lobe.

    Attributes:
        schlick: its colour is given as ``reflectance`` at normal incidence rather than as ``eta`` and ``k``.
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
    """

    name = "roughconductor"
    parameters = {  # noqa: RUF012
        "eta": (0.0, 0.0, 0.0),
        "k": (1.0, 1.0, 1.0),
        "reflectance": (1.0, 1.0, 1.0),
        "specular_reflectance": (1.0, 1.0, 1.0),
        "alpha": 0.1,
        "alpha_u": 0.1,
        "alpha_v": 0.1,
    }
    delta = True

    schlick: bool = False
    anisotropic: bool = False

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        return {**metal(values), **rough(values, self.anisotropic)}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        at = microfacet.reflection(wo, wi, *alphas(parameters), bounded=microfacet.BOUNDED)
        on = (~parameters["smooth"]).to(wo.dtype)
        return self._colour(parameters, at.cos_m) * (at.value * on), at.pdf * on

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at a visible normal; at the surface's own where it is smooth."""
        m = microfacet.sample_normal(wo, *alphas(parameters), u, microfacet.BOUNDED)
        drawn = weighed(self, parameters, wo, microfacet.reflect(wo, m, dot(wo, m)))
        mirrored = torch.stack((-wo[0], -wo[1], wo[2]))
        return with_delta(drawn, parameters["smooth"] & (wo[2] > 0), mirrored, self._colour(parameters, wo[2]))

    def albedo(self, parameters: Parameters) -> Tensor:
        """The colour at normal incidence."""
        return self._colour(parameters, torch.ones_like(parameters["alpha_u"]))

    def _colour(self, parameters: Parameters, cos: Tensor) -> Tensor:
        colour = metal_colour(parameters, cos)
        return colour if parameters["specular_reflectance"] is None else colour * parameters["specular_reflectance"]
