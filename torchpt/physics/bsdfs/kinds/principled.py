"""Burley's principled model with the numbers of Mitsuba 3's ``principled``: metal, dielectric, glass, coat, cloth in one.

Burley, *Physically Based Shading at Disney*, 2012, and *Extending the Disney BRDF to a BSDF with Integrated Subsurface
Scattering*, 2015. It is no physical model: rough white creates energy at grazing angles, and sheen and coat are added to
what is there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.microfacet import INDEX_MATCHED, fresnel_dielectric, refract
from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import dot, luminance
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import mixture_sample, reflectance_at_normal
from torchpt.physics.bsdfs.principled_lobes import (
    Facet,
    MainLobes,
    Probabilities,
    clearcoat_alpha,
    clearcoat_masking,
    fake_subsurface,
    flip_to_upper,
    gtr1,
    lerp,
    or_zero,
    retro_diffuse,
    sample_gtr1,
    schlick_weight,
    tint,
    up,
    wide_ggx,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import alphas
from torchpt.physics.bsdfs.specs import GREY, fraction, reflectance
from torchpt.spec import Refused, Scalar

__all__ = ["Principled"]

#: Least alpha of the main lobes, as Mitsuba's.
ALPHA_MIN = 1e-3
#: What every material of the model is given, and features that only shape another.
_ALWAYS = ("base_color", "roughness", "specular", "eta")
_PART_OF = {"sheen_tint": "sheen", "clearcoat_gloss": "clearcoat"}


@dataclass(frozen=True)
class Principled(Bsdf):
    """Burley's principled model, but for thin surfaces; a feature whose amount is 0 is left out, not computed.

    Attributes:
        transmissive: light passes through (``spec_trans``).
        anisotropic: highlights may be longer across the tangent than along it.
    """

    transmissive: bool = False
    anisotropic: bool = False

    name = "principled"
    parameters: ClassVar = {
        "base_color": reflectance(GREY, "colour of the surface"),
        "roughness": fraction(0.5, "from a mirror to plaster"),
        "metallic": fraction(0.0, "share that is metal"),
        "specular": fraction(None, "how much a dielectric reflects: 0.08 of it at normal incidence; 0.5 without `eta`"),
        "eta": Scalar(None, low=1e-3, high=1e3, texture=True, doc="its index of refraction, in place of `specular`"),
        "spec_tint": fraction(0.0, "how much of the base's hue that reflection takes"),
        "anisotropic": fraction(0.0, "how much longer highlights are across the tangent than along it"),
        "sheen": fraction(0.0, "glow of cloth at grazing angles"),
        "sheen_tint": fraction(0.0, "how much of the base's hue it takes"),
        "clearcoat": fraction(0.0, "amount of a second, clear highlight"),
        "clearcoat_gloss": fraction(0.0, "how sharp that is"),
        "spec_trans": fraction(0.0, "share of what is no metal that is glass"),
        "flatness": fraction(0.0, "from the diffuse lobe to one that stands in for scattering below the surface"),
    }
    lobed = True
    conserves = False

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """One index only."""
        super().check(values, given)
        if values["specular"] is not None and values["eta"] is not None:
            raise Refused("either specular or eta, not both", values["eta"], ("eta",))

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(values["spec_trans"] != 0.0, values["anisotropic"] != 0.0), cls.given(values)

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """Features whose amount is 0 are left out, with what would only shape them."""
        found = super().given(values)
        if "specular" not in found and "eta" not in found:
            found["specular"] = 0.5
        for feature, whole in _PART_OF.items():
            if found[whole] == 0.0:
                found[feature] = 0.0
        return {key: value for key, value in found.items() if key in _ALWAYS or value != 0.0}

    def __post_init__(self) -> None:
        self.has(transmits=self.transmissive, refracts=self.transmissive)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`."""
        return tuple(cls(transmissive, anisotropic) for anisotropic in (False, True) for transmissive in (False, True))

    def prepare(self, values: Parameters) -> Parameters:
        """Roughness becomes ``alpha_u`` and ``alpha_v``, ``specular`` becomes ``eta``. What is absent counts as 0.

        ``eta = 2 / (1 - sqrt(0.08 specular)) - 1`` gives a reflectance of ``0.08 specular`` at normal incidence. An index
        that is 1 leaves a refracted lobe without extent: as Mitsuba does, it is moved a little.
        """
        roughness = values["roughness"]
        if "eta" in values:
            eta = values["eta"]
            if self.transmissive:
                eta = torch.where((eta - 1.0).abs() < 2.0 * INDEX_MATCHED, 1.001, eta)
        else:
            specular = values["specular"] if "specular" in values else torch.full_like(roughness, 0.5)
            if self.transmissive:
                specular = torch.where(specular < 1e-6, 1e-3, specular)
            some = specular > 0
            root = torch.where(some, (0.08 * torch.where(some, specular, 1.0)).sqrt(), 0.0)
            eta = 2.0 / (1.0 - root) - 1.0
        alpha = roughness * roughness
        alpha_u, alpha_v = alpha, None
        if self.anisotropic:
            amount = values["anisotropic"] if "anisotropic" in values else torch.zeros_like(roughness)
            aspect = (1.0 - 0.9 * amount).sqrt()
            alpha_u, alpha_v = alpha / aspect, (alpha * aspect).clamp_min(ALPHA_MIN)
        features = ("metallic", "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness")
        through = {}
        if self.transmissive:
            through["spec_trans"] = values["spec_trans"] if "spec_trans" in values else torch.zeros_like(roughness)
        return {
            "base_color": values["base_color"],
            "roughness": roughness,
            "alpha_u": alpha_u.clamp_min(ALPHA_MIN),
            "alpha_v": alpha_v,
            "eta": eta,
            **{name: values.get(name) for name in features},
            **through,
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        eta = parameters["eta"]
        front = None
        if self.transmissive:
            wo, wi, eta, front = flip_to_upper(wo, wi, eta)
        main = self._main(parameters, wo, wi, eta)
        facet = self._facet(parameters, wo, main.m, main.cos, eta, front)
        probability = self.probabilities(parameters, wo, facet, front)
        value = facet.reflected * main.reflection
        pdf = probability.reflect * main.reflection_pdf
        if facet.refracted is not None and probability.refract is not None:
            value = torch.addcmul(value, facet.refracted, main.refraction)
            pdf = torch.addcmul(pdf, probability.refract, main.refraction_pdf)
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].clamp_min(0.0)
        seen = ((cos_o > 0) & (cos_i > 0)).to(cos_i.dtype)
        if front is not None:
            seen = seen * front
        shown = cos_i * seen
        value = torch.addcmul(value, self._diffuse(parameters, cos_o, cos_i, main.cos), shown)
        pdf = pdf + probability.diffuse * (cos_i * seen * (1.0 / math.pi))
        if probability.clearcoat is not None:
            m = torch.where(seen > 0, main.m, up(main.m))
            d = gtr1(m, clearcoat_alpha(or_zero(parameters["clearcoat_gloss"], cos_o)))
            f = lerp(0.04, 1.0, facet.schlick)
            cos_o, cos_i = torch.where(seen > 0, cos_o, 1.0), torch.where(seen > 0, cos_i, 1.0)
            g = clearcoat_masking(wo, wi, cos_o, cos_i)
            value = value + (0.25 * parameters["clearcoat"]) * (f * d * g * shown)
            cos = torch.where(main.cos > 0, main.cos, 1.0)
            pdf = pdf + probability.clearcoat * seen * (d * m[2] / (4.0 * cos))
        return value, pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """One of the lobes by what each is expected to reflect."""
        assert lobe is not None
        eta, above, front, side = parameters["eta"], wo, None, None
        if self.transmissive:
            side = torch.copysign(torch.ones_like(wo[2]), wo[2])
            above, _, eta, front = flip_to_upper(wo, wo, eta)
        alpha_u, alpha_v = alphas(parameters)
        m = microfacet.sample_normal(above, alpha_u, alpha_v, u, self._bounded)
        cos = dot(above, m)
        facet = self._facet(parameters, above, m, cos.clamp_min(0.0), eta, front)
        probability = self.probabilities(parameters, above, facet, front)
        wi = microfacet.reflect(above, m, cos)
        threshold = probability.diffuse
        wi = torch.where(lobe < threshold, cosine_hemisphere(u), wi)
        if probability.clearcoat is not None:
            coat = sample_gtr1(clearcoat_alpha(or_zero(parameters["clearcoat_gloss"], lobe)), u)
            coated = (lobe >= threshold) & (lobe < threshold + probability.clearcoat)
            wi = torch.where(coated, microfacet.reflect(above, coat, dot(above, coat)), wi)
            threshold = threshold + probability.clearcoat
        if probability.refract is None or side is None:
            return mixture_sample(self, parameters, wo, wi)
        bent = (lobe >= threshold) & (lobe < threshold + probability.refract)
        wi = torch.where(bent, refract(above, m, cos, facet.interface), wi)
        # A direction that fell on the wrong side of its own lobe may not pass for one of the other.
        valid = ((wi[2] < 0) == bent).to(wi.dtype)
        drawn = mixture_sample(self, parameters, wo, torch.stack((wi[0], wi[1], wi[2] * side)), valid)
        return BsdfSample(drawn.wi, drawn.pdf, drawn.weight, torch.where(bent, eta, 1.0).detach())

    def albedo(self, parameters: Parameters) -> Tensor:
        """The base colour."""
        return parameters["base_color"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Metal, dielectric and glass; sheen and coat are left out."""
        base, eta = parameters["base_color"], parameters["eta"]
        f0 = reflectance_at_normal(eta).expand_as(base)
        if parameters["spec_tint"] is not None:
            f0 = f0 + (f0 * tint(base) - f0) * parameters["spec_tint"]
        over = f0
        rest: Tensor = torch.ones_like(eta)
        if parameters["metallic"] is not None:
            f0 = f0 + (base - f0) * parameters["metallic"]
            rest = rest - parameters["metallic"]
        u, v = alphas(parameters)
        through, passing = parameters.get("spec_trans"), None
        if through is not None:
            # Colour is taken at the way in and the way out.
            passing, rest = base.clamp_min(1e-12).sqrt() * (rest * through), rest * (1.0 - through)
        roughness, below = (u * v).sqrt().sqrt(), None if through is None else eta
        return SplitSumMaterial(base * rest, f0, torch.ones_like(eta), roughness, over, passing, below)

    def probabilities(
        self, parameters: Parameters, wo: Tensor, facet: Facet, front: Tensor | None = None
    ) -> Probabilities:
        """How often to draw each lobe: by the luminance that each is expected to send on.

        Mean reflectances of lobes by their angle are fits. Rough facets face ``wo``: their Fresnel rises less toward
        grazing, by about ``(1 - roughness)^2``, and they lose about ``0.7 roughness^3`` between one another.

        Args:
            parameters: lane values.
            wo: ``(3, N)``, on the upper side.
            facet: where the main lobes may reflect or refract.
            front: ``(N,)`` 1 outside, 0 inside, where only the main lobes are; None: outside.
        """
        with torch.no_grad():
            cos, roughness = wo[2].clamp_min(0.0), parameters["roughness"]
            metallic, through = parameters["metallic"], parameters.get("spec_trans")
            base = luminance(parameters["base_color"])
            weight = schlick_weight(cos)
            smoothness = (1.0 - roughness).clamp_min(0.0)
            raised = weight * smoothness * smoothness
            rest = 1.0 if metallic is None else 1.0 - metallic
            # Never quite 0: what is black may have a derivative.
            diffuse = rest * (0.01 + 0.99 * base)
            single = lerp(reflectance_at_normal(parameters["eta"]), 1.0, raised)
            main = rest * single
            if metallic is not None:
                main = main + metallic * lerp(base, 1.0, raised)
            if through is not None:
                diffuse = diffuse * (1.0 - through)
                main = main + rest * through * (1.0 - single) * base.clamp_min(0.0).sqrt()
            main = main * (1.0 - 0.7 * roughness * roughness * roughness)
            if parameters["sheen"] is not None:
                x2 = (1.0 - cos) * (1.0 - cos)
                diffuse = diffuse + parameters["sheen"] * rest * x2 * (0.06 + 0.03 * x2)
            coat = None
            if parameters["clearcoat"] is not None:
                g = 2.0 * cos / (cos + (cos * cos * 0.9375 + 0.0625).sqrt())
                coat = parameters["clearcoat"] * (0.75 * lerp(0.04, 1.0, weight) * cos * cos * g * g + 0.003)
            if front is not None:
                diffuse = diffuse * front
                coat = None if coat is None else coat * front
            total = diffuse + main if coat is None else diffuse + main + coat
            some = total > 0
            scale = torch.where(some, 1.0 / torch.where(some, total, 1.0), 0.0)
            diffuse, main, coat = diffuse * scale, main * scale, None if coat is None else coat * scale
            if facet.refracted is None:
                return Probabilities(diffuse, coat, main, None)
            a, b = luminance(facet.reflected), luminance(facet.refracted)
            some = a + b > 0
            main = main / torch.where(some, a + b, 1.0) * some
            return Probabilities(diffuse, coat, main * a, main * b)

    @property
    def _bounded(self) -> bool:
        return microfacet.BOUNDED and not (self.transmissive or self.anisotropic)

    def _main(self, parameters: Parameters, wo: Tensor, wi: Tensor, eta: Tensor) -> MainLobes:
        """Both main lobes; with the half vector ``s = wo + wi`` or ``wo + eta wi``, ``s . m = |s|``: nothing cancels."""
        alpha_u, alpha_v = alphas(parameters)
        if not (self.transmissive or self.anisotropic):
            r = microfacet.reflection(wo, wi, alpha_u, alpha_v, self._bounded)
            return MainLobes(r.m, r.cos_m.clamp_min(0.0), r.value, r.pdf, r.value, r.pdf)
        below = wi[2] < 0
        s = torch.where(below, wo + wi * eta, wo + wi) if self.transmissive else wo + wi
        square = dot(s, s)
        usable = square > 0
        square = torch.where(usable, square, 1.0)
        m = torch.where(usable, s * torch.copysign(square.rsqrt(), s[2]), up(s))
        cos, far = dot(wo, m), dot(wi, m)
        meets = usable & (wo[2] > 0) & (wi[2] != 0) & (cos > 0)
        reflects, refracts = meets & ~below & (far > 0), meets & below & (far < 0)
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].abs()
        s_o, s_i = (microfacet.stretched_length(w, alpha_u, alpha_v) for w in (wo, wi))
        # Density of visible normals over their cosine with wo, and Smith's masking of wi.
        d = microfacet.ggx(m, alpha_u, alpha_v) if not self.anisotropic else wide_ggx(m, alpha_u, alpha_v)
        d = 2.0 * d / (cos_o + s_o)
        g = 2.0 * cos_i / (cos_i + s_i)
        jacobian = cos * far.abs() / square
        return MainLobes(
            m,
            torch.where(meets, cos, 0.0),
            torch.where(reflects, 0.25 * d * g, 0.0),
            torch.where(reflects, 0.25 * d, 0.0),
            torch.where(refracts, d * g * jacobian, 0.0),
            torch.where(refracts, d * jacobian * (eta * eta), 0.0),
        )

    def _facet(
        self, parameters: Parameters, wo: Tensor, m: Tensor, cos: Tensor, eta: Tensor, front: Tensor | None
    ) -> Facet:
        """Fresnel at a facet: of a dielectric, with tint and metal by Schlick's weight of the angle on the thinner side."""
        base, metallic = parameters["base_color"], parameters["metallic"]
        sin2 = None
        if self.transmissive:  # the refracted direction is as good as this sine
            across = torch.addcmul(wo, m, cos, value=-1)
            sin2 = dot(across, across)
        interface = fresnel_dielectric(cos, eta, sin2)
        f = interface.reflectance
        schlick = schlick_weight(torch.where(eta > 1.0, cos, -interface.cos_t))
        rest = 1.0 if metallic is None else 1.0 - metallic
        reflected = (rest * f).expand_as(base)
        if parameters["spec_tint"] is not None:
            tinted = lerp(tint(base) * reflectance_at_normal(eta), 1.0, schlick)
            reflected = lerp(reflected, rest * tinted, parameters["spec_tint"])
        if metallic is not None:
            reflected = torch.addcmul(reflected, metallic, lerp(base, 1.0, schlick))
        # As in Mitsuba an index of 1 has no main reflection at all, not even a metal's.
        reflected = torch.where(eta == 1.0, 0.0, reflected)
        through = parameters.get("spec_trans")
        if through is None:
            return Facet(interface, cos, schlick, reflected, None)
        through = rest * through
        if front is not None:
            reflected = torch.where(front > 0, reflected, through * f)
        some = base > 0
        root = torch.where(some, torch.where(some, base, 1.0).sqrt(), 0.0)
        return Facet(interface, cos, schlick, reflected, root * (through * (1.0 - f)))

    def _diffuse(self, parameters: Parameters, cos_o: Tensor, cos_i: Tensor, cos_d: Tensor) -> Tensor:
        """Diffuse and sheen ``(3, N)`` without the cosine."""
        base, roughness = parameters["base_color"], parameters["roughness"]
        fresnel_o, fresnel_i = schlick_weight(cos_o), schlick_weight(cos_i)
        f = retro_diffuse(roughness, fresnel_o, fresnel_i, cos_d)
        if parameters["flatness"] is not None:
            flat = fake_subsurface(roughness, fresnel_o, fresnel_i, cos_d, cos_o, cos_i)
            f = lerp(f, flat, parameters["flatness"])
        metallic, through = parameters["metallic"], parameters.get("spec_trans")
        rest = None if metallic is None else 1.0 - metallic
        f = f * (1.0 / math.pi)
        if rest is not None:
            f = f * rest
        if through is not None:
            f = f * (1.0 - through)
        value = base * f
        if parameters["sheen"] is None:
            return value
        sheen = parameters["sheen"] * schlick_weight(cos_d)
        if rest is not None:
            sheen = sheen * rest
        if parameters["sheen_tint"] is None:
            return value + sheen
        return torch.addcmul(value, sheen, lerp(1.0, tint(base), parameters["sheen_tint"]))
