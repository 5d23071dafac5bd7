"""A rough metal: GGX microfacets of a conductor, reflected once, or with the energy of further reflections given back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters, Table
from torchpt.bsdfs.conductor import metal, metal_colour
from torchpt.bsdfs.lobes import weighed, with_delta
from torchpt.math import microfacet
from torchpt.math.vectors import dot
from torchpt.records import BsdfSample

__all__ = ["RoughConductor", "alphas", "energy_at", "energy_table", "rough"]

#: Entries of an energy table: cosines, at squares of equal steps, and azimuths where the surface is anisotropic.
_COSINES, _COSINES_ANISOTROPIC, _AZIMUTHS = 64, 32, 17


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


def energy_table(parameters: Parameters, etas: Sequence[Tensor | None]) -> Table:
    """What a lossless surface with these roughnesses gives back, as one row: see :func:`energy_at`.

    Args:
        parameters: those of :func:`rough`, of one material.
        etas: relative index, or None for mirrors; one block of the table for each.
    """
    u, v = alphas(parameters)
    au, av = u.double(), v.double()
    isotropic = parameters["alpha_v"] is None
    steps = torch.linspace(0, 1, _COSINES if isotropic else _COSINES_ANISOTROPIC, dtype=au.dtype, device=au.device)
    cos = steps.square().clamp_min(1e-7)
    # Azimuths at equal steps of the roughness seen along them.
    step = torch.linspace(0, 1, 1 if isotropic else _AZIMUTHS, dtype=au.dtype, device=au.device)
    sin2_phi = (step * (2.0 * au + step * (av - au)) / (au + av)).clamp(1e-12, 1.0 - 1e-12)
    z = cos.repeat(len(step))
    r = (1.0 - z * z).clamp_min(0.0).sqrt()
    x, y = (1.0 - sin2_phi).sqrt().repeat_interleave(len(cos)), sin2_phi.sqrt().repeat_interleave(len(cos))
    wo = torch.stack((r, torch.zeros_like(r), z)) if isotropic else torch.stack((r * x, r * y, z))
    blocks = []
    for eta in etas:
        # The edge of total internal reflection asks for more nodes, which many azimuths would make too many.
        nodes = 64 if isotropic and eta is not None else 32
        index = None if eta is None else eta.double()
        blocks.append(microfacet.energy(wo, au, None if isotropic else av, index, nodes, nodes))
    return Table(torch.cat(blocks).clamp_max(1.0).to(u.dtype)[None])


def energy_at(table: Table, parameters: Parameters, wo: Tensor, block: Tensor | None = None) -> Tensor:
    """The energy ``(N,)`` that a lossless surface gives back of light along ``wo``.

    Args:
        table: as of :func:`energy_table`.
        parameters: lane values.
        wo: ``(3, N)``.
        block: ``(N,)`` 0 or 1, which of two relative indices; None where there is one.
    """
    isotropic = parameters["alpha_v"] is None
    cosines, azimuths = (_COSINES, 1) if isotropic else (_COSINES_ANISOTROPIC, _AZIMUTHS)
    last = cosines * azimuths * (1 if block is None else 2) - 1
    place = wo[2].abs().clamp(1e-12, 1.0).sqrt() * (cosines - 1)
    if block is not None:
        place = place + block * (cosines * azimuths)
    if isotropic:
        return table.at(place * (1.0 / last))
    au, av = alphas(parameters)
    r2 = torch.addcmul(wo[0] * wo[0], wo[1], wo[1]).clamp_min(1e-12)
    x, y = wo[0] * au, wo[1] * av
    seen = (torch.addcmul(x * x, y, y).clamp_min(1e-20) / r2).sqrt()
    # (seen - au) / (av - au), also where both roughnesses are the same.
    step = ((au + av) * (wo[1] * wo[1] / r2) / (seen + au)).clamp(0.0, 1.0) * (azimuths - 1)
    below = step.detach().floor().clamp_max(azimuths - 2)
    low = table.at((place + below * cosines) * (1.0 / last))
    return low + (table.at((place + (below + 1.0) * cosines) * (1.0 / last)) - low) * (step - below)


@dataclass(frozen=True)
class RoughConductor(Bsdf):
    """A rough mirror. A row with both roughnesses below ``1e-4`` is a smooth one: a delta lobe.

    Facets shade one another; light that meets more than one of them is lost, unless it is given back as Turquin does
    (*Practical Multiple Scattering Compensation for Microfacet Models*, 2019, equation 16): each direction ``wo`` has its
    lobe scaled by ``1 + F0 (1 - E) / E``, with ``E(wo)`` what facets of reflectance 1 give back.

    Attributes:
        schlick: its colour is given as ``reflectance`` at normal incidence rather than as ``eta`` and ``k``.
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
        energy_compensation: scaled so, and with masking correlated by height; not reciprocal then.
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
    energy_compensation: bool = False

    @property
    def reciprocal(self) -> bool:
        """See :class:`Bsdf`."""
        return not self.energy_compensation

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        out = {**metal(values), **rough(values, self.anisotropic)}
        if self.energy_compensation:
            out["energy"] = energy_table(out, [None])
        return out

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        at = microfacet.reflection(wo, wi, *alphas(parameters), microfacet.BOUNDED, self.energy_compensation)
        on = (~parameters["smooth"]).to(wo.dtype)
        value = self._colour(parameters, at.cos_m) * (at.value * on)
        if self.energy_compensation:
            f0 = metal_colour(parameters, torch.ones_like(wo[2]))
            value = torch.addcmul(value, value * f0, 1.0 / energy_at(parameters["energy"], parameters, wo) - 1.0)
        return value, at.pdf * on

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
