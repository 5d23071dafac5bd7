"""What GGX facets have in common: their roughness, by one of three ways to say it, and the energy that they lose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, Values
from torchpt.physics.bsdfs.specs import fraction
from torchpt.spec import Flag, Refused

__all__ = ["Anisotropic", "Rough", "alphas", "energy_at", "energy_table", "mean_roughness", "rough"]

_ALPHA = 0.1  # where none is said

#: Entries of an energy table: cosines, at squares of equal steps, and azimuths where the surface is anisotropic.
_COSINES, _COSINES_ANISOTROPIC, _AZIMUTHS = 64, 32, 17


class Rough(Bsdf, part=True):
    """A part of a model: the roughness of its facets, the same along u and v."""

    parameters: ClassVar = {
        "alpha": fraction(None, f"roughness of the facets; {_ALPHA:g} where none is said"),
        "roughness": fraction(None, "the same as `alpha = roughness^2`"),
    }

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """One roughness only."""
        super().check(values, given)
        said = [key for key in ("alpha", "roughness", "alpha_u", "alpha_v") if values.get(key) is not None]
        if len(said) > 1 and said != ["alpha_u", "alpha_v"]:
            raise Refused(f"either {said[0]} or {said[1]}, not both", values[said[1]], (said[1],))
        if said in (["alpha_u"], ["alpha_v"]):
            raise Refused("alpha_u and alpha_v together", None, ("alpha_v" if said == ["alpha_u"] else "alpha_u",))

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """With a roughness, whether or not one is said."""
        found = super().given(values)
        return found if found.keys() & {"alpha", "roughness", "alpha_u"} else {**found, "alpha": _ALPHA}


class Anisotropic(Rough, part=True):
    """The same, with another roughness along u and v, and the energy that facets lose given back if wanted."""

    parameters: ClassVar = {
        "alpha_u": fraction(None, "`alpha` along the surface's u, with `alpha_v`"),
        "alpha_v": fraction(None, "`alpha` along its v, with `alpha_u`"),
        "energy_compensation": Flag(False, doc="whether light that facets pass on among each other is given back"),
    }

    energy_compensation: bool

    def __post_init__(self) -> None:
        if self.energy_compensation:
            self.has(tabulated=("alpha", "roughness", "alpha_u", "alpha_v", "int_ior", "ext_ior"), reciprocal=False)


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
        blocks.append(microfacet.directional_albedo(wo, au, None if isotropic else av, index, nodes, nodes))
    values = torch.cat(blocks).clamp_max(1.0).to(u.dtype)
    return Table(values, len(values))


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


def mean_roughness(parameters: Parameters) -> Tensor:
    """``sqrt(alpha)``, of the mean of both where they differ; 0 where the surface is smooth."""
    u, v = alphas(parameters)
    return torch.where(parameters["smooth"], 0.0, (u * v).sqrt().sqrt())
