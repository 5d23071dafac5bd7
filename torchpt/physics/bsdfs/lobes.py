"""Lobes and parameters that several models share: dielectric interfaces, coats, cosine powers, GGX over a diffuse base.

Directions are local, ``(3, N)``; values, cosines, probabilities and masks are ``(N,)``, colours ``(3, N)``. Sampling is
detached: probabilities and directions are constants under differentiation, and only what ``eval`` returns is differentiated.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.microfacet import diffuse_transmittance, fresnel_dielectric
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.presets import INDICES
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import GREY, reflectance, refraction_index
from torchpt.spec import Flag, Scalar

__all__ = [
    "Coat",
    "Glass",
    "Glossy",
    "PhongBase",
    "choose_reflection",
    "coat_parameters",
    "coated_split_sum",
    "cosine_power",
    "dielectric_parameters",
    "dielectric_split_sum",
    "in_upper_hemisphere",
    "lobe_probability",
    "mean",
    "mixture_sample",
    "phong_split_sum",
    "reflectance_at_normal",
    "sample_cosine_power",
    "sample_smooth_interface",
    "tinted",
    "with_delta",
]


# ---- Models of several lobes: powers of cosines, the choice between two lobes, the weight of a sampled direction


def in_upper_hemisphere(*directions: Tensor) -> Tensor:
    """Return 1 where all directions ``(3, N)`` lie in the upper hemisphere, else 0: ``(N,)``."""
    lowest = directions[0][2]
    for w in directions[1:]:
        lowest = torch.minimum(lowest, w[2])
    return (lowest > 0).to(lowest.dtype)


def cosine_power(one_minus_cos: Tensor, exponent: Tensor) -> Tensor:
    """Return ``cos^exponent`` ``(N,)`` for ``one_minus_cos = 1 - cos``; 0 from a right angle on, also for exponent 0.

    Takes ``1 - cos`` because an exponent of 1e5 would amplify the rounding error of a cosine near 1 by as much.
    """
    inside = one_minus_cos < 1.0
    return torch.exp(exponent * torch.log1p(-torch.where(inside, one_minus_cos, 0.0))) * inside


def sample_cosine_power(u: Tensor, exponent: Tensor) -> Tensor:
    """Sample ``1 - cos`` from ``u (N,)`` with density ``(exponent + 1) / (2 pi) cos^exponent`` per steradian."""
    return -torch.expm1(torch.log1p(-u) / (exponent + 1.0))


def mean(rgb: Tensor) -> Tensor:
    """Return the mean of the three channels: ``(3, N) -> (N,)``."""
    return (rgb[0] + rgb[1] + rgb[2]) * (1.0 / 3.0)


def reflectance_at_normal(eta: Tensor) -> Tensor:
    """Return the Fresnel reflectance at normal incidence for a relative index ``eta (N,)``."""
    root = (eta - 1.0) / (eta + 1.0)
    return root * root


def lobe_probability(a: Tensor, b: Tensor) -> Tensor:
    """Return the detached probability ``a / (a + b)`` of choosing the first of two lobes; 1 where both are 0."""
    a, b = a.detach(), b.detach()
    total = a + b
    return torch.where(total > 0, a / torch.where(total > 0, total, 1.0), 1.0)


def mixture_sample(
    model: Bsdf, parameters: Parameters, wo: Tensor, wi: Tensor, valid: Tensor | None = None
) -> BsdfSample:
    """Return the BSDF sample with direction ``wi``, weighted by ``eval / pdf`` over all lobes.

    Direction and density are detached: only ``eval`` is differentiated.

    Args:
        model: the BSDF that evaluates the weight.
        parameters: values per lane.
        wo: ``(3, N)``.
        wi: ``(3, N)`` as some lobe of the model has drawn it.
        valid: ``(N,)`` 0 where sampling failed although ``wi`` looks valid, else 1; None: 1 everywhere.
    """
    wi = wi.detach()
    value, pdf = model.eval_pdf(parameters, wo, wi)
    pdf = pdf.detach() if valid is None else pdf.detach() * valid
    drawn = pdf > 0
    return BsdfSample(wi=wi, pdf=pdf, weight=torch.where(drawn, value / torch.where(drawn, pdf, 1.0), 0.0))


def with_delta(drawn: BsdfSample, chosen: Tensor, wi: Tensor, weight: Tensor) -> BsdfSample:
    """Replace samples by those of a delta lobe, ``wi (3, N)`` with ``weight (3, N)``, where ``chosen (N,)`` is True."""
    return replace(
        drawn,
        wi=torch.where(chosen, wi, drawn.wi),
        pdf=torch.where(chosen, torch.inf, drawn.pdf),
        weight=torch.where(chosen, weight, drawn.weight),
    )


# ---- Dielectric interfaces: parameters, the choice between reflection and refraction, the smooth interface


class Glass(Bsdf, part=True):
    """Mixin of dielectrics: two indices of refraction, and factors of reflection and transmission."""

    parameters: ClassVar = {
        "int_ior": refraction_index(INDICES["bk7"], "index of refraction behind the normal"),
        "ext_ior": refraction_index(INDICES["air"], "index of refraction in front of the surface"),
        "specular_reflectance": reflectance(None, "factor of reflected light, 1 by default"),
        "specular_transmittance": reflectance(None, "factor of transmitted light, 1 by default"),
    }


def dielectric_parameters(values: Parameters) -> Parameters:
    """Return ``eta``, the index below over the one above, and the two factors of :class:`Glass`, None where absent."""
    factors = {name: values.get(name) for name in ("specular_reflectance", "specular_transmittance")}
    return {"eta": values["int_ior"] / values["ext_ior"], **factors}


def tinted(amount: Tensor, tint: Tensor | None) -> Tensor:
    """Return ``amount (N,)`` times the colour ``tint``, as ``(3, N)``; None counts as white."""
    return amount.expand(3, -1) if tint is None else amount * tint


def choose_reflection(reflectance: Tensor, lobe: Tensor) -> tuple[Tensor, Tensor]:
    """Choose reflection with probability ``reflectance (N,)``, else refraction, by a uniform number ``lobe (N,)``.

    Returns:
        A mask ``(N,)`` of reflection, and the weight ``(N,)``: the value over its detached probability, 1 in value, with the
        derivative of the value.
    """
    reflect_probability = reflectance.detach()
    reflects = lobe < reflect_probability
    value = torch.where(reflects, reflectance, 1.0 - reflectance)
    probability = torch.where(reflects, reflect_probability, 1.0 - reflect_probability)
    return reflects, value / torch.where(probability > 0, probability, 1.0)


def sample_smooth_interface(parameters: Parameters, wo: Tensor, lobe: Tensor) -> BsdfSample:
    """Sample reflection or refraction at a smooth dielectric interface.

    Args:
        parameters: from :func:`dielectric_parameters`, per lane.
        wo: ``(3, N)`` on either side.
        lobe: ``(N,)`` in [0, 1), chooses between the two.
    """
    # The squared sine is given too, since 1 - cos^2 would round it.
    side = fresnel_dielectric(wo[2], parameters["eta"], torch.addcmul(wo[0] * wo[0], wo[1], wo[1]))
    reflects, weight_of_choice = choose_reflection(side.reflectance, lobe)
    # Nothing is refracted under total internal reflection, where the reflectance is 1.
    sideways = torch.where(reflects, -1.0, -side.eta_ti)
    wi = torch.stack((wo[0] * sideways, wo[1] * sideways, torch.where(reflects, wo[2], side.cos_t)))
    weight = torch.where(
        reflects,
        tinted(weight_of_choice, parameters["specular_reflectance"]),
        tinted(weight_of_choice * side.eta_ti * side.eta_ti, parameters["specular_transmittance"]),
    )
    return BsdfSample(
        wi=wi,
        pdf=torch.where(wo[2] != 0, math.inf, 0.0).to(wo.dtype),
        weight=weight,
        eta=torch.where(reflects, 1.0, side.eta_it).detach(),
    )


def dielectric_split_sum(parameters: Parameters, roughness: Tensor, f0: Tensor, eta: Tensor | None) -> SplitSumMaterial:
    """Return the split-sum material of a dielectric interface.

    Args:
        parameters: from :func:`dielectric_parameters`, per lane.
        roughness: ``(N,)``.
        f0: reflectance at normal incidence ``(N,)``.
        eta: index below over the one above ``(N,)``; None where light passes straight on.
    """
    one = torch.ones_like(f0)
    reflected, transmitted = parameters["specular_reflectance"], parameters["specular_transmittance"]
    return SplitSumMaterial(
        diffuse=torch.zeros_like(one).expand(3, -1),
        f0=tinted(f0, reflected),
        f90=tinted(one, reflected),
        roughness=roughness,
        over=f0,  # transmitted light loses what the interface reflects
        through=tinted(one, transmitted),
        eta=eta,
    )


# ---- Plastics: a diffuse base under a dielectric coat


class Coat(Bsdf, part=True):
    """Mixin of plastics: colour of the base, indices of refraction and tint of the coat."""

    parameters: ClassVar = {
        "diffuse_reflectance": reflectance(GREY, "colour of the base"),
        "int_ior": refraction_index(INDICES["polypropylene"], "index of refraction of the coat"),
        "ext_ior": refraction_index(INDICES["air"], "index of refraction in front of the surface"),
        "specular_reflectance": reflectance(None, "factor of light that the coat reflects, 1 by default"),
        "nonlinear": Flag(False, doc="whether internally reflected light is multiplied by the base's colour again"),
    }


def coat_parameters(values: Parameters, eta: Tensor, transmittance: Tensor, *, nonlinear: bool) -> Parameters:
    """Return the lane parameters that both plastics read.

    Args:
        values: values of the material.
        eta: ``(1,)`` index of the coat over the one outside.
        transmittance: ``(1,)`` fraction of diffuse light from the base that leaves through the coat.
        nonlinear: whether internally reflected light is multiplied by the base's colour again, which saturates it.

    Returns:
        ``base``: what multiplies the coat's transmittances of ``wo`` and ``wi``, and the cosine over pi. ``coat_weight``: the
        mean of the coat's tint over the sum of that and of the base's mean, by which the lobe is chosen.
    """
    diffuse, specular = values["diffuse_reflectance"], values.get("specular_reflectance")
    diffuse_mean, bounced = mean(diffuse), diffuse if nonlinear else 1.0
    return {
        "eta": eta,
        # Light that the coat reflects back, 1 - transmittance, meets the base again and again: a geometric series. The
        # index squared is that of radiance which leaves the coat.
        "base": diffuse / ((1.0 - bounced + bounced * transmittance) * eta * eta),
        "diffuse_reflectance": diffuse,
        "specular_reflectance": specular,
        "coat_weight": lobe_probability(
            torch.ones_like(diffuse_mean) if specular is None else mean(specular), diffuse_mean
        ),
    }


def coated_split_sum(parameters: Parameters, roughness: Tensor) -> SplitSumMaterial:
    """Return the split-sum material of a coat over a base that gets the light which the coat transmits on average."""
    eta, factor = parameters["eta"], parameters["specular_reflectance"]
    one = torch.ones_like(eta)
    base = parameters["base"] * diffuse_transmittance(eta)
    f0 = reflectance_at_normal(eta)
    return SplitSumMaterial(
        diffuse=base,
        f0=tinted(f0, factor),
        f90=tinted(one, factor),
        roughness=roughness,
        over=f0,  # of the coat without its tint: the base loses what the coat reflects
    )


# ---- Phong models: a Lambertian lobe and a power of a cosine


class PhongBase(Bsdf, part=True):
    """Mixin of Phong models: a diffuse and a glossy reflectance, and the exponent.

    Attributes:
        max_albedo: largest albedo of the glossy lobe for ``specular`` 1, over exponents and directions.
    """

    parameters: ClassVar = {
        "diffuse": reflectance(GREY, "reflectance of the diffuse lobe"),
        "specular": reflectance((0.2, 0.2, 0.2), "reflectance of the glossy lobe"),
        "exponent": Scalar(30.0, high=1e5, texture=True, doc="exponent of the glossy lobe's cosine"),
    }
    lobed = True
    max_albedo: ClassVar[float] = 1.0

    @classmethod
    def energy(cls, values: Values) -> str:
        """Return a warning where both lobes may sum to an albedo above 1; "" where they do not, or have textures."""
        diffuse, specular = values["diffuse"], values["specular"]
        if not isinstance(diffuse, tuple) or not isinstance(specular, tuple):
            return ""
        albedo = max(kd + cls.max_albedo * ks for kd, ks in zip(diffuse, specular, strict=True))
        if albedo <= 1.0 + 1e-6:  # decimals such as 0.8 + 0.2 may round above 1
            return ""
        terms = "diffuse + specular" if cls.max_albedo == 1.0 else f"diffuse + {cls.max_albedo:g} specular"
        return f"{terms} is {albedo:.4g}: above 1 it may reflect more light than it receives"


def phong_split_sum(parameters: Parameters, alpha2: Tensor, peak: Tensor | float) -> SplitSumMaterial:
    """Return the split-sum material of a Phong model: both lobes added.

    Args:
        parameters: values per lane.
        alpha2: square of the GGX alpha ``(N,)`` of a lobe as wide.
        peak: albedo of the glossy lobe at normal incidence for ``specular`` 1.
    """
    specular = parameters["specular"] * peak
    roughness = alpha2.clamp(0.0, 1.0).sqrt().sqrt()
    return SplitSumMaterial(
        diffuse=parameters["diffuse"],
        f0=specular,
        f90=specular,
        roughness=roughness,
        over=None,  # the lobes are added
    )


# ---- A diffuse base under GGX facets with the approximate masking ``G1(v) = nv / (nv (1 - k) + k)``, ``k = (r + 1)^2 / 8``
#
# Karis, *Real Shading in Unreal Engine 4*, 2013: nv is the cosine of v and the normal, r the roughness. Two models share it,
# with different factors of the lobes.


class Glossy(Bsdf):
    """Base of ``f = diffuse / pi + specular D G / (4 cos_o cos_i)``; a subclass defines both factors."""

    lobed = True
    delta = True

    def lobe_factors(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Return the diffuse and the specular factor for ``wo``, each ``(3, N)``."""
        raise NotImplementedError

    def roughness(self, parameters: Parameters) -> Tensor:
        """Return the roughness ``(N,)`` of the facets; 0 where they form a mirror."""
        return torch.where(parameters["smooth"], 0.0, parameters["alpha"].sqrt())

    def prepare(self, values: Parameters) -> Parameters:
        """Return the values with ``alpha``, ``k`` (of the masking) and ``smooth`` in place of ``roughness``.

        ``smooth`` is True where alpha is so small that the facets are a mirror: then the specular lobe is a delta.
        """
        values = dict(values)
        roughness = values.pop("roughness")
        alpha = roughness * roughness
        return {
            **values,
            "smooth": microfacet.is_smooth(alpha),
            "alpha": microfacet.clamp_alpha(alpha),
            "k": (roughness + 1.0) * (roughness + 1.0) * 0.125,
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        alpha, k = parameters["alpha"], parameters["k"]
        rough = torch.logical_not(parameters["smooth"]).to(wo.dtype)
        diffuse, specular = self.lobe_factors(parameters, wo)
        diffuse_probability = lobe_probability(mean(diffuse), mean(specular))
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].clamp_min(0.0)
        facets = microfacet.reflection(wo, wi, alpha, alpha, bounded=microfacet.BOUNDED)
        # `facets.value` is D G / (4 cos_o) with Smith's masking; this factor divides it out, for the approximation below.
        smith = (cos_o + microfacet.stretched_length(wo, alpha, alpha)) * (
            cos_i + microfacet.stretched_length(wi, alpha, alpha)
        )
        peak = facets.value * rough * smith / (4.0 * (cos_o - cos_o * k + k) * (cos_i - cos_i * k + k))
        cosine = cos_i * in_upper_hemisphere(wo, wi) * (1.0 / math.pi)
        return torch.addcmul(diffuse * cosine, specular, peak), diffuse_probability * cosine + (
            1.0 - diffuse_probability
        ) * facets.pdf * rough

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Choose a lobe by the mean of its factor; sample the facets by visible normals."""
        assert lobe is not None
        alpha = parameters["alpha"]
        diffuse, specular = self.lobe_factors(parameters, wo)
        diffuse_probability = lobe_probability(mean(diffuse), mean(specular))
        is_specular = lobe >= diffuse_probability
        m = microfacet.sample_normal(wo, alpha, alpha, u, bounded=microfacet.BOUNDED)
        reflected = microfacet.reflect(wo, m, wo[0] * m[0] + wo[1] * m[1] + wo[2] * m[2])
        drawn = mixture_sample(self, parameters, wo, torch.where(is_specular, reflected, cosine_hemisphere(u)))
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        # Of wo, and of wi: it has the same cosine.
        masking = wo[2] / (wo[2] - wo[2] * parameters["k"] + parameters["k"])
        weight = specular * (masking * masking / torch.where(is_specular, 1.0 - diffuse_probability, 1.0))
        return with_delta(drawn, is_specular & parameters["smooth"] & (wo[2] > 0), mirror, weight)
