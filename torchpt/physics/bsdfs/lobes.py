"""Lobes that several models are made of: diffuse, coats, glass, cosine powers, glossy reflection under a coat."""

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
from torchpt.physics.bsdfs.specs import GREY, index, reflectance
from torchpt.spec import Flag, Scalar

__all__ = [
    "Coat",
    "Glass",
    "Glossy",
    "PhongBase",
    "choose",
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
    "polished",
    "reflectance_at_normal",
    "sample_cosine_power",
    "tinted",
    "with_delta",
]


# ---- What models of several lobes share: cosines to a power, choice among two, and the weight of a drawn direction


def in_upper_hemisphere(*directions: Tensor) -> Tensor:
    """1 where all directions ``(3, N)`` are above the surface, else 0: ``(N,)``."""
    least = directions[0][2]
    for w in directions[1:]:
        least = torch.minimum(least, w[2])
    return (least > 0).to(least.dtype)


def cosine_power(one_minus_cos: Tensor, exponent: Tensor) -> Tensor:
    """``cos^exponent`` of angles ``(N,)`` given as ``one_minus_cos = 1 - cos``; 0 from a right angle on, also for exponent 0.

    An exponent of 1e5 multiplies the rounding of a cosine near 1 by as much; that of its difference from 1 it leaves small.
    """
    inside = one_minus_cos < 1.0
    return torch.exp(exponent * torch.log1p(-torch.where(inside, one_minus_cos, 0.0))) * inside


def sample_cosine_power(u: Tensor, exponent: Tensor) -> Tensor:
    """``1 - cos`` of angles drawn from ``u (N,)`` with density ``(exponent + 1) / 2 pi cos^exponent`` in solid angle."""
    return -torch.expm1(torch.log1p(-u) / (exponent + 1.0))


def mean(rgb: Tensor) -> Tensor:
    """Of the three channels: ``(3, N) -> (N,)``."""
    return (rgb[0] + rgb[1] + rgb[2]) * (1.0 / 3.0)


def reflectance_at_normal(eta: Tensor) -> Tensor:
    """Of a dielectric of relative index ``eta (N,)``."""
    root = (eta - 1.0) / (eta + 1.0)
    return root * root


def lobe_probability(a: Tensor, b: Tensor) -> Tensor:
    """Detached ``a / (a + b)``: how often to choose the first of two lobes; always, where both are 0."""
    a, b = a.detach(), b.detach()
    total = a + b
    return torch.where(total > 0, a / torch.where(total > 0, total, 1.0), 1.0)


def mixture_sample(
    model: Bsdf, parameters: Parameters, wo: Tensor, wi: Tensor, valid: Tensor | None = None
) -> BsdfSample:
    """The sample that drew ``wi (3, N)``: weighed by all lobes over the mixture of their densities.

    Direction and density are constants to derivatives: only what is reflected follows the parameters.

    Args:
        model: whose ``eval_pdf`` counts.
        parameters: lane values.
        wo: ``(3, N)``.
        wi: ``(3, N)``.
        valid: ``(N,)`` 0 where the draw failed for reasons that the directions do not tell.
    """
    wi = wi.detach()
    value, pdf = model.eval_pdf(parameters, wo, wi)
    pdf = pdf.detach() if valid is None else pdf.detach() * valid
    drawn = pdf > 0
    return BsdfSample(wi, pdf, torch.where(drawn, value / torch.where(drawn, pdf, 1.0), 0.0))


def with_delta(drawn: BsdfSample, chosen: Tensor, wi: Tensor, weight: Tensor) -> BsdfSample:
    """Lanes that ``chosen (N,)`` marks have drawn a delta lobe instead: ``wi (3, N)`` with ``weight (3, N)``."""
    return replace(
        drawn,
        wi=torch.where(chosen, wi, drawn.wi),
        pdf=torch.where(chosen, torch.inf, drawn.pdf),
        weight=torch.where(chosen, weight, drawn.weight),
    )


# ---- What boundaries between clear media share: their indices and tints, the choice of a side, a polished boundary


class Glass(Bsdf, part=True):
    """A part of a model: two media, and factors of what is reflected and of what passes."""

    parameters: ClassVar = {
        "int_ior": index(INDICES["bk7"], "index of refraction behind the normal"),
        "ext_ior": index(INDICES["air"], "index of refraction in front of it"),
        "specular_reflectance": reflectance(None, "a tint: a factor of what is reflected; 1 where it is not said"),
        "specular_transmittance": reflectance(None, "the same of what passes"),
    }


def dielectric_parameters(values: Parameters) -> Parameters:
    """What clear boundaries read: ``eta``, the index below over that above, and the factors, or None."""
    tints = {name: values.get(name) for name in ("specular_reflectance", "specular_transmittance")}
    return {"eta": values["int_ior"] / values["ext_ior"], **tints}


def tinted(amount: Tensor, tint: Tensor | None) -> Tensor:
    """An amount ``(N,)`` as a colour ``(3, N)``, by a factor that may be absent."""
    return amount.expand(3, -1) if tint is None else amount * tint


def choose(reflectance: Tensor, lobe: Tensor) -> tuple[Tensor, Tensor]:
    """Whether to reflect, and the weight ``(N,)`` of what was chosen: 1, with the derivative of its amount."""
    r = reflectance.detach()
    reflects = lobe < r
    amount = torch.where(reflects, reflectance, 1.0 - reflectance)
    probability = torch.where(reflects, r, 1.0 - r)
    return reflects, amount / torch.where(probability > 0, probability, 1.0)


def polished(parameters: Parameters, wo: Tensor, lobe: Tensor) -> BsdfSample:
    """The mirror image, or the refracted ray, at a smooth boundary."""
    side = fresnel_dielectric(wo[2], parameters["eta"], torch.addcmul(wo[0] * wo[0], wo[1], wo[1]))
    reflects, lobe_probability = choose(side.reflectance, lobe)
    # Nothing is refracted under total internal reflection, where the reflectance is 1.
    sideways = torch.where(reflects, -1.0, -side.eta_ti)
    wi = torch.stack((wo[0] * sideways, wo[1] * sideways, torch.where(reflects, wo[2], side.cos_t)))
    weight = torch.where(
        reflects,
        tinted(lobe_probability, parameters["specular_reflectance"]),
        tinted(lobe_probability * side.eta_ti * side.eta_ti, parameters["specular_transmittance"]),
    )
    return BsdfSample(
        wi,
        torch.where(wo[2] != 0, math.inf, 0.0).to(wo.dtype),
        weight,
        torch.where(reflects, 1.0, side.eta_it).detach(),
    )


def dielectric_split_sum(parameters: Parameters, roughness: Tensor, f0: Tensor, eta: Tensor | None) -> SplitSumMaterial:
    """A clear boundary in the preview.

    Args:
        parameters: lane values.
        roughness: ``(N,)``.
        f0: reflectance at normal incidence ``(N,)``.
        eta: index below over that above ``(N,)``; None where nothing is bent.
    """
    one = torch.ones_like(f0)
    reflects, passes = parameters["specular_reflectance"], parameters["specular_transmittance"]
    return SplitSumMaterial(
        torch.zeros_like(one).expand(3, -1),
        tinted(f0, reflects),
        tinted(one, reflects),
        roughness,
        f0,
        tinted(one, passes),
        eta,
    )


# ---- What plastics share: a diffuse base under a clear coat


class Coat(Bsdf, part=True):
    """A part of a model: the base's colour, the coat's media and tint."""

    parameters: ClassVar = {
        "diffuse_reflectance": reflectance(GREY, "colour of the base"),
        "int_ior": index(INDICES["polypropylene"], "index of refraction of the coat"),
        "ext_ior": index(INDICES["air"], "index of refraction in front of it"),
        "specular_reflectance": reflectance(None, "a tint: a factor of what the coat reflects; 1 where it is not said"),
        "nonlinear": Flag(False, doc="whether light that the coat throws back takes the base's colour again"),
    }


def coat_parameters(values: Parameters, eta: Tensor, passed: Tensor, nonlinear: bool) -> Parameters:
    """What the coats have in common.

    Args:
        values: as given.
        eta: ``(1,)`` index of the coat over that outside.
        passed: ``(1,)`` part of diffuse light from within that the coat lets out.
        nonlinear: whether light that the coat throws back takes the base's colour again, which saturates it.
    """
    diffuse, specular = values["diffuse_reflectance"], values.get("specular_reflectance")
    diffuse_probability, again = mean(diffuse), diffuse if nonlinear else 1.0
    return {
        "eta": eta,
        "base": diffuse / ((1.0 - again + again * passed) * eta * eta),
        "diffuse_reflectance": diffuse,
        "specular_reflectance": specular,
        "specular_share": lobe_probability(
            torch.ones_like(diffuse_probability) if specular is None else mean(specular), diffuse_probability
        ),
    }


def coated_split_sum(parameters: Parameters, roughness: Tensor) -> SplitSumMaterial:
    """A coat in the preview, over a base which light enters by what the coat's mean reflectance leaves."""
    eta, factor = parameters["eta"], parameters["specular_reflectance"]
    one = torch.ones_like(eta)
    base = parameters["base"] * diffuse_transmittance(eta)
    f0 = reflectance_at_normal(eta)
    return SplitSumMaterial(base, tinted(f0, factor), tinted(one, factor), roughness, f0)


# ---- What models of Lambert and a lobe of a cosine's power share: their parameters, and how much energy they may make


class PhongBase(Bsdf, part=True):
    """A part of a model: a diffuse and a glossy reflectance, and how sharp the lobe is.

    Attributes:
        max_albedo: energy that a unit of ``specular`` reflects at most.
    """

    parameters: ClassVar = {
        "diffuse": reflectance(GREY, "reflectance of the diffuse lobe"),
        "specular": reflectance((0.2, 0.2, 0.2), "reflectance of the glossy one"),
        "exponent": Scalar(30.0, high=1e5, texture=True, doc="how sharp the glossy one is: the power of its cosine"),
    }
    lobed = True
    max_albedo: ClassVar[float] = 1.0

    @classmethod
    def energy(cls, values: Values) -> str:
        """See :class:`Bsdf`."""
        diffuse, specular = values["diffuse"], values["specular"]
        if not isinstance(diffuse, tuple) or not isinstance(specular, tuple):
            return ""
        max_albedo = max(kd + cls.max_albedo * ks for kd, ks in zip(diffuse, specular, strict=True))
        if max_albedo <= 1.0 + 1e-6:
            return ""
        terms = "diffuse + specular" if cls.max_albedo == 1.0 else f"diffuse + {cls.max_albedo:g} specular"
        return f"{terms} is {max_albedo:.4g}: above 1 it may reflect more light than it receives"


def phong_split_sum(parameters: Parameters, alpha2: Tensor, peak: Tensor | float) -> SplitSumMaterial:
    """Both lobes in the preview, added.

    Args:
        parameters: lane values.
        alpha2: square of the roughness of facets that would reflect as the lobe does ``(N,)``.
        peak: what the lobe reflects of ``specular`` at normal incidence.
    """
    specular = parameters["specular"] * peak
    roughness = alpha2.clamp(0.0, 1.0).sqrt().sqrt()
    return SplitSumMaterial(parameters["diffuse"], specular, specular, roughness, None)


# ---- A diffuse base under GGX facets whose masking is the shortcut ``G1(v) = nv / (nv (1 - k) + k)``, ``k = (r + 1)^2 / 8``
#
# Karis, *Real Shading in Unreal Engine 4*, 2013. Two models share it and differ in how much each lobe reflects.


class Glossy(Bsdf):
    """``f = diffuse / pi + specular D G / (4 cos_o cos_i)``; a subclass says how much of each at ``wo``."""

    lobed = True
    delta = True

    def lobe_factors(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Diffuse and specular factors ``(3, N)``."""
        raise NotImplementedError

    def roughness(self, parameters: Parameters) -> Tensor:
        """Roughness ``(N,)`` of the facets; 0 where they are a mirror."""
        return torch.where(parameters["smooth"], 0.0, parameters["alpha"].sqrt())

    def prepare(self, values: Parameters) -> Parameters:
        """Roughness becomes ``alpha`` and ``k``; below the least alpha the facets are a mirror."""
        values = dict(values)
        roughness = values.pop("roughness")
        alpha = roughness * roughness
        return {
            **values,
            "smooth": microfacet.is_smooth(alpha),
            "alpha": microfacet.roughness(alpha),
            "k": (roughness + 1.0) * (roughness + 1.0) * 0.125,
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        alpha, k = parameters["alpha"], parameters["k"]
        rough = torch.logical_not(parameters["smooth"]).to(wo.dtype)
        diffuse, specular = self.lobe_factors(parameters, wo)
        diffuse_probability = lobe_probability(mean(diffuse), mean(specular))
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].clamp_min(0.0)
        facets = microfacet.reflection(wo, wi, alpha, alpha, microfacet.BOUNDED)
        # The shortcut in place of Smith's masking.
        smith = (cos_o + microfacet.stretched_length(wo, alpha, alpha)) * (
            cos_i + microfacet.stretched_length(wi, alpha, alpha)
        )
        peak = facets.value * rough * smith / (4.0 * (cos_o - cos_o * k + k) * (cos_i - cos_i * k + k))
        cosine = cos_i * in_upper_hemisphere(wo, wi) * (1.0 / math.pi)
        return torch.addcmul(diffuse * cosine, specular, peak), diffuse_probability * cosine + (
            1.0 - diffuse_probability
        ) * facets.pdf * rough

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """One of the lobes by what they would reflect, the facets by visible normals."""
        assert lobe is not None
        alpha = parameters["alpha"]
        diffuse, specular = self.lobe_factors(parameters, wo)
        diffuse_probability = lobe_probability(mean(diffuse), mean(specular))
        shiny = lobe >= diffuse_probability
        m = microfacet.sample_normal(wo, alpha, alpha, u, microfacet.BOUNDED)
        about = microfacet.reflect(wo, m, wo[0] * m[0] + wo[1] * m[1] + wo[2] * m[2])
        drawn = mixture_sample(self, parameters, wo, torch.where(shiny, about, cosine_hemisphere(u)))
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        masking = wo[2] / (wo[2] - wo[2] * parameters["k"] + parameters["k"])
        weight = specular * (masking * masking / torch.where(shiny, 1.0 - diffuse_probability, 1.0))
        return with_delta(drawn, shiny & parameters["smooth"] & (wo[2] > 0), mirror, weight)
