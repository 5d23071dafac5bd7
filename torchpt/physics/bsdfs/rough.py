"""Roughness and distribution of microfacets, and tables of the energy lost between facets.

Alpha is the width of the distribution of facet normals: 0 a mirror, 1 very rough. It may differ along the surface's
tangents u and v (``alpha_u``, ``alpha_v``). Single-scattering models lose the light that meets more than one facet; a table
of their directional albedo, made once for each material, lets a model scale it back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.beckmann import BECKMANN
from torchpt.math.microfacet import GGX, MicrofacetDistribution
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, Values
from torchpt.physics.bsdfs.specs import fraction
from torchpt.spec import Choice, Flag, Refused

__all__ = ["Anisotropic", "Rough", "alphas", "energy_at", "energy_table", "mean_roughness", "roughness_parameters"]

_DEFAULT_ALPHA = 0.1  # as in Mitsuba

#: Entries of an energy table: cosines, equidistant in their square roots, times azimuths if the surface is anisotropic.
_COSINES, _COSINES_ANISOTROPIC, _AZIMUTHS = 64, 32, 17


class Rough(Bsdf, part=True):
    """Mixin of isotropic microfacet models: roughness, and the distribution of normals.

    Attributes:
        beckmann: the distribution is Beckmann's, not GGX.
    """

    parameters: ClassVar = {
        "distribution": Choice("ggx", names=("ggx", "beckmann"), doc="distribution of the facets' normals"),
        "alpha": fraction(None, f"alpha of the facets; {_DEFAULT_ALPHA:g} by default"),
        "roughness": fraction(None, "square root of `alpha`, in its place"),
    }

    beckmann: bool

    @property
    def facets(self) -> MicrofacetDistribution:
        """Return the distribution of normals."""
        return BECKMANN if self.beckmann else GGX

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse more than one of the three ways to specify roughness."""
        super().check(values, given)
        present = [key for key in ("alpha", "roughness", "alpha_u", "alpha_v") if values.get(key) is not None]
        if len(present) > 1 and present != ["alpha_u", "alpha_v"]:
            first, second, *_ = present
            raise Refused(f"either {first} or {second}, not both", values[second], (second,))
        if present in (["alpha_u"], ["alpha_v"]):
            raise Refused("alpha_u and alpha_v together", None, ("alpha_v" if present == ["alpha_u"] else "alpha_u",))

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """Return the values that are set (not None), and the default ``alpha`` if no roughness is."""
        found = super().given(values)
        return found if found.keys() & {"alpha", "roughness", "alpha_u"} else {**found, "alpha": _DEFAULT_ALPHA}


class Anisotropic(Rough, part=True):
    """Mixin of anisotropic microfacet models: roughness along u and v, and optional energy compensation."""

    parameters: ClassVar = {
        "alpha_u": fraction(None, "`alpha` along the surface's u, with `alpha_v`"),
        "alpha_v": fraction(None, "`alpha` along the surface's v, with `alpha_u`"),
        "energy_compensation": Flag(False, doc="whether the energy of multiple scattering between facets is added"),
    }

    energy_compensation: bool

    def __post_init__(self) -> None:
        if self.energy_compensation:
            # Sets these attributes.
            self.has(tabulated=("alpha", "roughness", "alpha_u", "alpha_v", "int_ior", "ext_ior"), reciprocal=False)


def roughness_parameters(values: Parameters, *, anisotropic: bool) -> Parameters:
    """Return ``alpha_u``, ``alpha_v`` (None if isotropic), and the mask ``smooth``: alphas so small that facets are a mirror.

    Args:
        values: ``alpha``, or ``roughness`` (its square root), or ``alpha_u`` and ``alpha_v``.
        anisotropic: whether ``alpha_u`` and ``alpha_v`` may differ.
    """
    alpha = values["roughness"].square() if "roughness" in values else values.get("alpha")
    u, v = values.get("alpha_u", alpha), values.get("alpha_v", alpha)
    assert u is not None and v is not None
    smooth = microfacet.is_smooth(torch.maximum(u, v))
    return {
        "alpha_u": microfacet.clamp_alpha(u),
        "alpha_v": microfacet.clamp_alpha(v) if anisotropic else None,
        "smooth": smooth,
    }


def alphas(parameters: Parameters) -> tuple[Tensor, Tensor]:
    """Return ``alpha_u`` and ``alpha_v``, each ``(N,)``, from :func:`roughness_parameters`."""
    u, v = parameters["alpha_u"], parameters["alpha_v"]
    return u, u if v is None else v


def energy_table(parameters: Parameters, etas: Sequence[Tensor | None], facets: MicrofacetDistribution) -> Table:
    """Return the directional albedo of a lossless microfacet surface as one row of a table, for :func:`energy_at`.

    Entries run over cosines first, then over azimuths, then over ``etas``.

    Args:
        parameters: from :func:`roughness_parameters`, for one material.
        etas: relative indices, or None for a mirror; each gives one block of the table.
        facets: distribution of the normals.
    """
    alpha_u, alpha_v = alphas(parameters)
    au, av = alpha_u.double(), alpha_v.double()
    isotropic = parameters["alpha_v"] is None
    steps = torch.linspace(0, 1, _COSINES if isotropic else _COSINES_ANISOTROPIC, dtype=au.dtype, device=au.device)
    cos = steps.square().clamp_min(1e-7)  # of wo; at 0 the albedo is not defined
    # Azimuths at equal steps of alpha(phi) = sqrt((au cos phi)^2 + (av sin phi)^2): au at phi 0, av at a right angle.
    step = torch.linspace(0, 1, 1 if isotropic else _AZIMUTHS, dtype=au.dtype, device=au.device)
    sin2_phi = (step * (2.0 * au + step * (av - au)) / (au + av)).clamp(1e-12, 1.0 - 1e-12)
    z = cos.repeat(len(step))
    r = (1.0 - z * z).clamp_min(0.0).sqrt()
    # The cosine and the sine of the azimuth.
    x, y = (1.0 - sin2_phi).sqrt().repeat_interleave(len(cos)), sin2_phi.sqrt().repeat_interleave(len(cos))
    wo = torch.stack((r, torch.zeros_like(r), z)) if isotropic else torch.stack((r * x, r * y, z))
    blocks = []
    for eta in etas:
        # Gauss-Legendre nodes an axis. Total internal reflection has an edge and Beckmann a narrow lobe: they need twice as
        # many; for anisotropic surfaces, whose tables are larger, that would take too long.
        nodes = 64 if isotropic and (eta is not None or facets is not GGX) else 32
        index = None if eta is None else eta.double()
        albedo = microfacet.directional_albedo(
            wo, au, alpha_v=None if isotropic else av, eta=index, azimuths=nodes, heights=nodes, facets=facets
        )
        blocks.append(albedo)
    values = torch.cat(blocks).clamp_max(1.0).to(alpha_u.dtype)
    return Table(values, count=len(values))


def energy_at(table: Table, parameters: Parameters, wo: Tensor, block: Tensor | None = None) -> Tensor:
    """Return the directional albedo ``(N,)`` of a lossless microfacet surface for ``wo``.

    Args:
        table: from :func:`energy_table`.
        parameters: values per lane.
        wo: ``(3, N)``.
        block: ``(N,)`` 0 or 1, which of two ``etas`` of :func:`energy_table`; None if there is one.
    """
    isotropic = parameters["alpha_v"] is None
    cosines, azimuths = (_COSINES, 1) if isotropic else (_COSINES_ANISOTROPIC, _AZIMUTHS)
    last = cosines * azimuths * (1 if block is None else 2) - 1  # the table's x runs from 0 to 1 over entries 0 to last
    entry = wo[2].abs().clamp(1e-12, 1.0).sqrt() * (cosines - 1)  # fractional, as the table interpolates
    if block is not None:
        entry = entry + block * (cosines * azimuths)
    if isotropic:
        return table.at(entry * (1.0 / last))
    au, av = alphas(parameters)
    r2 = torch.addcmul(wo[0] * wo[0], wo[1], wo[1]).clamp_min(1e-12)
    x, y = wo[0] * au, wo[1] * av
    alpha_phi = (torch.addcmul(x * x, y, y).clamp_min(1e-20) / r2).sqrt()  # alpha along the azimuth of wo
    # (alpha_phi - au) / (av - au), also where both alphas are the same.
    step = ((au + av) * (wo[1] * wo[1] / r2) / (alpha_phi + au)).clamp(0.0, 1.0) * (azimuths - 1)
    below = step.detach().floor().clamp_max(azimuths - 2)
    low = table.at((entry + below * cosines) * (1.0 / last))
    return low + (table.at((entry + (below + 1.0) * cosines) * (1.0 / last)) - low) * (step - below)


def mean_roughness(parameters: Parameters) -> Tensor:
    """Return ``(alpha_u alpha_v)^(1/4)`` ``(N,)``: ``sqrt(alpha)`` if isotropic; 0 where the surface is smooth."""
    alpha_u, alpha_v = alphas(parameters)
    return torch.where(parameters["smooth"], 0.0, (alpha_u * alpha_v).sqrt().sqrt())
