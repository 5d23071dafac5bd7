"""Burley's principled BSDF with the constants of Mitsuba 3's ``principled``: metal, dielectric, glass, clearcoat and sheen.

Burley, *Physically Based Shading at Disney*, 2012, and *Extending the Disney BRDF to a BSDF with Integrated Subsurface
Scattering*, 2015. It does not conserve energy: rough white creates energy at grazing angles, and sheen and clearcoat are
added without attenuating the lobes below.

The formulas of single lobes are in ``principled_lobes.py``; here they are weighted and chosen. "Front" is the upper side, that
of the shading normal; only a transmissive model is seen from the back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
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

#: Least alpha of the main lobes, as in Mitsuba.
ALPHA_MIN = 1e-3
#: Parameters that are kept even where they are 0.
_ALWAYS_KEPT = ("base_color", "roughness", "specular", "eta")
#: Parameters without effect, to the parameter that has to be above 0 for them to have one.
_DEPENDS_ON = {"sheen_tint": "sheen", "clearcoat_gloss": "clearcoat"}
#: Fresnel reflectance of the clearcoat at normal incidence: polyurethane, of index 1.5 (2012).
_COAT_F0 = 0.04


@dataclass(frozen=True)
class Principled(Bsdf):
    """Burley's principled BSDF, without its thin-surface form. A feature whose amount is 0 is not computed.

    Attributes:
        transmissive: ``spec_trans`` may be above 0.
        anisotropic: ``anisotropic`` may be above 0.
    """

    transmissive: bool = False
    anisotropic: bool = False

    name = "principled"
    parameters: ClassVar = {
        "base_color": reflectance(GREY, "colour of the surface"),
        "roughness": fraction(0.5, "roughness of the main lobes, from a mirror at 0 to plaster at 1"),
        "metallic": fraction(0.0, "fraction of metal"),
        "specular": fraction(None, "reflectance of a dielectric at normal incidence over 0.08; 0.5 without `eta`"),
        "eta": Scalar(None, low=1e-3, high=1e3, texture=True, doc="index of refraction, in place of `specular`"),
        "spec_tint": fraction(0.0, "how far the dielectric reflection takes the base's hue"),
        "anisotropic": fraction(0.0, "how far highlights are stretched across the tangent"),
        "sheen": fraction(0.0, "amount of sheen: reflection of cloth at grazing angles"),
        "sheen_tint": fraction(0.0, "how far sheen takes the base's hue"),
        "clearcoat": fraction(0.0, "amount of clearcoat: a second, uncoloured highlight"),
        "clearcoat_gloss": fraction(0.0, "sharpness of the clearcoat's highlight"),
        "spec_trans": fraction(0.0, "fraction of glass in the part that is not metal"),
        "flatness": fraction(0.0, "from the diffuse lobe at 0 to the fake subsurface lobe at 1"),
    }
    lobed = True  # `sample` reads a number `lobe`, which chooses between the lobes
    conserves = False

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse ``specular`` together with ``eta``."""
        super().check(values, given)
        if values["specular"] is not None and values["eta"] is not None:
            raise Refused("either specular or eta, not both", values["eta"], ("eta",))

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        variant = cls(transmissive=values["spec_trans"] != 0.0, anisotropic=values["anisotropic"] != 0.0)
        return variant, cls.given(values)

    @classmethod
    def given(cls, values: Values) -> dict[str, Any]:
        """Return the values without features whose amount is 0 and without parameters of such features."""
        found = super().given(values)
        if "specular" not in found and "eta" not in found:
            found["specular"] = 0.5
        for dependent, feature in _DEPENDS_ON.items():
            if found[feature] == 0.0:
                found[dependent] = 0.0
        return {key: value for key, value in found.items() if key in _ALWAYS_KEPT or value != 0.0}

    def __post_init__(self) -> None:
        # Sets these attributes.
        self.has(transmits=self.transmissive, refracts=self.transmissive)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        return tuple(
            cls(transmissive=transmissive, anisotropic=anisotropic)
            for anisotropic in (False, True)
            for transmissive in (False, True)
        )

    def prepare(self, values: Parameters) -> Parameters:
        """Return ``alpha_u`` and ``alpha_v`` for ``roughness``, ``eta`` for ``specular``, None for features that are absent.

        ``eta = 2 / (1 - sqrt(0.08 specular)) - 1`` gives a reflectance of ``0.08 specular`` at normal incidence. An index
        of 1 would make the refraction lobe a delta: as in Mitsuba it becomes 1.001.
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
            # The inner `where` keeps the infinite derivative of a root at 0 from becoming 0 * inf.
            positive = specular > 0
            root = torch.where(positive, (0.08 * torch.where(positive, specular, 1.0)).sqrt(), 0.0)
            eta = 2.0 / (1.0 - root) - 1.0
        alpha = roughness * roughness
        alpha_u, alpha_v = alpha, None
        if self.anisotropic:
            amount = values["anisotropic"] if "anisotropic" in values else torch.zeros_like(roughness)
            aspect = (1.0 - 0.9 * amount).sqrt()  # ratio of v's alpha to u's is its square (2012, section 5.4)
            alpha_u, alpha_v = alpha / aspect, (alpha * aspect).clamp_min(ALPHA_MIN)
        features = ("metallic", "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness")
        transmission = {}
        if self.transmissive:
            transmission["spec_trans"] = values["spec_trans"] if "spec_trans" in values else torch.zeros_like(roughness)
        return {
            "base_color": values["base_color"],
            "roughness": roughness,
            "alpha_u": alpha_u.clamp_min(ALPHA_MIN),
            "alpha_v": alpha_v,
            "eta": eta,
            **{name: values.get(name) for name in features},
            **transmission,
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        eta = parameters["eta"]
        front = None  # (N,) 1 for a wo in front, 0 behind; None: an opaque model
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
        # 1 where both directions are in front: the diffuse lobe and the clearcoat reflect there only.
        seen = ((cos_o > 0) & (cos_i > 0)).to(cos_i.dtype)
        if front is not None:
            seen = seen * front
        seen_cos = cos_i * seen
        value = torch.addcmul(value, self._diffuse(parameters, cos_o, cos_i, main.cos), seen_cos)
        pdf = pdf + probability.diffuse * (cos_i * seen * (1.0 / math.pi))
        if probability.clearcoat is not None:
            # Microfacet theory's D, F and G; lanes that are not seen get finite numbers, which `seen` makes 0.
            m = torch.where(seen > 0, main.m, up(main.m))
            d = gtr1(m, clearcoat_alpha(or_zero(parameters["clearcoat_gloss"], cos_o)))
            f = lerp(_COAT_F0, 1.0, facet.schlick)
            cos_o, cos_i = torch.where(seen > 0, cos_o, 1.0), torch.where(seen > 0, cos_i, 1.0)
            g = clearcoat_masking(wo, wi, cos_o, cos_i)
            # A clearcoat of 1 is a quarter of a full lobe (2012).
            value = value + (0.25 * parameters["clearcoat"]) * (f * d * g * seen_cos)
            cos = torch.where(main.cos > 0, main.cos, 1.0)
            pdf = pdf + probability.clearcoat * seen * (d * m[2] / (4.0 * cos))
        return value, pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Choose a lobe by :meth:`probabilities` and sample it."""
        assert lobe is not None
        eta, above, front, side = parameters["eta"], wo, None, None
        if self.transmissive:  # samples are drawn for a wo in front, and z is multiplied by the sign `side` at the end
            side = torch.copysign(torch.ones_like(wo[2]), wo[2])
            above, _, eta, front = flip_to_upper(wo, wo, eta)
        alpha_u, alpha_v = alphas(parameters)
        m = microfacet.sample_normal(above, alpha_u, alpha_v, u, bounded=self._bounded)
        cos = dot(above, m)
        facet = self._facet(parameters, above, m, cos.clamp_min(0.0), eta, front)
        probability = self.probabilities(parameters, above, facet, front)
        wi = microfacet.reflect(above, m, cos)
        # Lobes take intervals of the number `lobe` in the order diffuse, coat, refraction, reflection.
        threshold = probability.diffuse
        wi = torch.where(lobe < threshold, cosine_hemisphere(u), wi)
        if probability.clearcoat is not None:
            coat = sample_gtr1(clearcoat_alpha(or_zero(parameters["clearcoat_gloss"], lobe)), u)
            coated = (lobe >= threshold) & (lobe < threshold + probability.clearcoat)
            wi = torch.where(coated, microfacet.reflect(above, coat, dot(above, coat)), wi)
            threshold = threshold + probability.clearcoat
        if probability.refract is None or side is None:
            return mixture_sample(self, parameters, wo, wi)
        refracts = (lobe >= threshold) & (lobe < threshold + probability.refract)
        wi = torch.where(refracts, refract(above, m, cos, facet.interface), wi)
        # A reflection that ends up below the surface must not count as a refraction, nor the other way round.
        valid = ((wi[2] < 0) == refracts).to(wi.dtype)
        drawn = mixture_sample(self, parameters, wo, torch.stack((wi[0], wi[1], wi[2] * side)), valid)
        return replace(drawn, eta=torch.where(refracts, eta, 1.0).detach())

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the base colour."""
        return parameters["base_color"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return the metal, dielectric and glass lobes; sheen and clearcoat are left out."""
        base, eta = parameters["base_color"], parameters["eta"]
        f0 = reflectance_at_normal(eta).expand_as(base)
        if parameters["spec_tint"] is not None:
            f0 = f0 + (f0 * tint(base) - f0) * parameters["spec_tint"]
        dielectric_f0 = f0
        diffuse: Tensor = torch.ones_like(eta)  # fraction of the diffuse lobe
        if parameters["metallic"] is not None:
            f0 = f0 + (base - f0) * parameters["metallic"]
            diffuse = diffuse - parameters["metallic"]
        alpha_u, alpha_v = alphas(parameters)
        spec_trans, transmitted = parameters.get("spec_trans"), None
        if spec_trans is not None:
            # Light takes the root of the base colour on entering and again on leaving.
            transmitted = base.clamp_min(1e-12).sqrt() * (diffuse * spec_trans)
            diffuse = diffuse * (1.0 - spec_trans)
        return SplitSumMaterial(
            diffuse=base * diffuse,
            f0=f0,
            f90=torch.ones_like(eta),
            roughness=(alpha_u * alpha_v).sqrt().sqrt(),
            over=dielectric_f0,  # the diffuse lobe lies below the dielectric one alone, not below metal
            through=transmitted,
            eta=None if spec_trans is None else eta,
        )

    def probabilities(
        self, parameters: Parameters, wo: Tensor, facet: Facet, front: Tensor | None = None
    ) -> Probabilities:
        """Return the probabilities of the lobes, in proportion to the expected luminance of each.

        The directional albedos, and all their numbers, are fits: they change the noise, not the mean. Visible facets of rough
        surfaces face ``wo``, so their Fresnel reflectance rises less toward grazing, by about ``(1 - roughness)^2``, and
        masking loses about ``0.7 roughness^3``.

        Args:
            parameters: values per lane.
            wo: ``(3, N)``, on the upper side.
            facet: the facet that the main lobes reflect or refract at.
            front: ``(N,)`` 1 outside, 0 inside, where only the main lobes exist; None: outside.
        """
        with torch.no_grad():
            cos, roughness = wo[2].clamp_min(0.0), parameters["roughness"]
            metallic, spec_trans = parameters["metallic"], parameters.get("spec_trans")
            base = luminance(parameters["base_color"])
            weight = schlick_weight(cos)
            smoothness = (1.0 - roughness).clamp_min(0.0)
            grazing = weight * smoothness * smoothness  # Schlick's weight of the facets that are seen
            nonmetallic = 1.0 if metallic is None else 1.0 - metallic
            # Above 0 also for black, whose derivative may not be 0.
            diffuse = nonmetallic * (0.01 + 0.99 * base)
            dielectric = lerp(reflectance_at_normal(parameters["eta"]), 1.0, grazing)
            main = nonmetallic * dielectric
            if metallic is not None:
                main = main + metallic * lerp(base, 1.0, grazing)
            if spec_trans is not None:
                diffuse = diffuse * (1.0 - spec_trans)
                main = main + nonmetallic * spec_trans * (1.0 - dielectric) * base.clamp_min(0.0).sqrt()
            main = main * (1.0 - 0.7 * roughness * roughness * roughness)
            if parameters["sheen"] is not None:
                x2 = (1.0 - cos) * (1.0 - cos)
                diffuse = diffuse + parameters["sheen"] * nonmetallic * x2 * (0.06 + 0.03 * x2)
            coat = None
            if parameters["clearcoat"] is not None:
                # Smith's masking for alpha 0.25: 0.0625 is its square.
                g = 2.0 * cos / (cos + (cos * cos * 0.9375 + 0.0625).sqrt())
                coat = parameters["clearcoat"] * (0.75 * lerp(_COAT_F0, 1.0, weight) * cos * cos * g * g + 0.003)
            if front is not None:
                diffuse = diffuse * front
                coat = None if coat is None else coat * front
            total = diffuse + main if coat is None else diffuse + main + coat
            positive = total > 0
            scale = torch.where(positive, 1.0 / torch.where(positive, total, 1.0), 0.0)
            diffuse, main, coat = diffuse * scale, main * scale, None if coat is None else coat * scale
            if facet.refracted is None:
                return Probabilities(diffuse=diffuse, clearcoat=coat, reflect=main, refract=None)
            reflected, refracted = luminance(facet.reflected), luminance(facet.refracted)
            positive = reflected + refracted > 0
            main = main / torch.where(positive, reflected + refracted, 1.0) * positive
            return Probabilities(diffuse=diffuse, clearcoat=coat, reflect=main * reflected, refract=main * refracted)

    @property
    def _bounded(self) -> bool:
        """True if visible normals that would reflect ``wo`` below the surface are avoided; a refraction may use them."""
        return microfacet.BOUNDED and not (self.transmissive or self.anisotropic)

    def _main(self, parameters: Parameters, wo: Tensor, wi: Tensor, eta: Tensor) -> MainLobes:
        """Return both main lobes, GGX reflection and refraction, for a ``wo`` in front.

        The half vector ``m`` is ``s = wo + wi`` normalized, or ``s = wo + eta wi`` for a ``wi`` behind. The Jacobian divides
        by ``|s|`` in place of ``s . m``, which would cancel.
        """
        alpha_u, alpha_v = alphas(parameters)
        if not (self.transmissive or self.anisotropic):
            facets = microfacet.reflection(wo, wi, alpha_u, alpha_v, bounded=self._bounded)
            return MainLobes(
                m=facets.m,
                cos=facets.cos_m.clamp_min(0.0),
                reflection=facets.value,
                reflection_pdf=facets.pdf,
                refraction=facets.value,
                refraction_pdf=facets.pdf,
            )
        below = wi[2] < 0
        s = torch.where(below, wo + wi * eta, wo + wi) if self.transmissive else wo + wi
        square = dot(s, s)
        usable = square > 0
        square = torch.where(usable, square, 1.0)
        m = torch.where(usable, s * torch.copysign(square.rsqrt(), s[2]), up(s))
        cos, cos_far = dot(wo, m), dot(wi, m)
        # wo sees the front of the facet, and wi leaves on the side where its cosine at the facet says so.
        valid = usable & (wo[2] > 0) & (wi[2] != 0) & (cos > 0)
        reflects, refracts = valid & ~below & (cos_far > 0), valid & below & (cos_far < 0)
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].abs()
        s_o, s_i = (microfacet.stretched_length(w, alpha_u, alpha_v) for w in (wo, wi))
        # Density of visible normals over dot(wo, m), and Smith's masking of wi.
        d = microfacet.ggx(m, alpha_u, alpha_v) if not self.anisotropic else wide_ggx(m, alpha_u, alpha_v)
        d = 2.0 * d / (cos_o + s_o)
        g = 2.0 * cos_i / (cos_i + s_i)
        jacobian = cos * cos_far.abs() / square  # of refraction, without eta^2: f of radiance lacks it, the pdf has it
        return MainLobes(
            m=m,
            cos=torch.where(valid, cos, 0.0),
            reflection=torch.where(reflects, 0.25 * d * g, 0.0),
            reflection_pdf=torch.where(reflects, 0.25 * d, 0.0),
            refraction=torch.where(refracts, d * g * jacobian, 0.0),
            refraction_pdf=torch.where(refracts, d * jacobian * (eta * eta), 0.0),
        )

    def _facet(
        self, parameters: Parameters, wo: Tensor, m: Tensor, cos: Tensor, eta: Tensor, front: Tensor | None
    ) -> Facet:
        """Return the Fresnel factors at a facet: exact for dielectrics, Schlick's from the thinner side for tint and metal.

        Args:
            parameters: values per lane.
            wo: ``(3, N)`` in front.
            m: normal of the facet ``(3, N)``.
            cos: ``(N,)`` cosine of the two, at least 0.
            eta: ``(N,)`` index of the far side over that of ``wo``'s side.
            front: ``(N,)`` 1 where ``wo`` was in front before it was flipped, else 0; None: 1 everywhere.
        """
        base, metallic = parameters["base_color"], parameters["metallic"]
        sin2 = None
        if self.transmissive:  # the refracted direction is as accurate as this sine
            across = torch.addcmul(wo, m, cos, value=-1)
            sin2 = dot(across, across)
        interface = fresnel_dielectric(cos, eta, sin2)
        f = interface.reflectance
        schlick = schlick_weight(torch.where(eta > 1.0, cos, -interface.cos_t))
        nonmetallic = 1.0 if metallic is None else 1.0 - metallic
        reflected = (nonmetallic * f).expand_as(base)
        if parameters["spec_tint"] is not None:
            tinted = lerp(tint(base) * reflectance_at_normal(eta), 1.0, schlick)
            reflected = lerp(reflected, nonmetallic * tinted, parameters["spec_tint"])
        if metallic is not None:
            reflected = torch.addcmul(reflected, metallic, lerp(base, 1.0, schlick))
        # As in Mitsuba, an index of 1 has no main reflection, not even for metals.
        reflected = torch.where(eta == 1.0, 0.0, reflected)
        spec_trans = parameters.get("spec_trans")
        if spec_trans is None:
            return Facet(interface=interface, cos=cos, schlick=schlick, reflected=reflected, refracted=None)
        glass = nonmetallic * spec_trans
        if front is not None:  # inside there is glass alone
            reflected = torch.where(front > 0, reflected, glass * f)
        # The root of the base colour; the inner `where` keeps its infinite derivative at 0 from becoming 0 * inf.
        positive = base > 0
        root = torch.where(positive, torch.where(positive, base, 1.0).sqrt(), 0.0)
        refracted = root * (glass * (1.0 - f))
        return Facet(interface=interface, cos=cos, schlick=schlick, reflected=reflected, refracted=refracted)

    def _diffuse(self, parameters: Parameters, cos_o: Tensor, cos_i: Tensor, cos_d: Tensor) -> Tensor:
        """Return the diffuse and sheen lobes ``(3, N)`` without the cosine; ``cos_d`` is between ``wo`` and the half vector."""
        base, roughness = parameters["base_color"], parameters["roughness"]
        fresnel_o, fresnel_i = schlick_weight(cos_o), schlick_weight(cos_i)
        f = retro_diffuse(roughness, fresnel_o, fresnel_i, cos_d)
        if parameters["flatness"] is not None:
            flat = fake_subsurface(roughness, fresnel_o, fresnel_i, cos_d, cos_o, cos_i)
            f = lerp(f, flat, parameters["flatness"])
        metallic, spec_trans = parameters["metallic"], parameters.get("spec_trans")
        nonmetallic = None if metallic is None else 1.0 - metallic
        f = f * (1.0 / math.pi)
        if nonmetallic is not None:
            f = f * nonmetallic
        if spec_trans is not None:
            f = f * (1.0 - spec_trans)
        value = base * f
        if parameters["sheen"] is None:
            return value
        sheen = parameters["sheen"] * schlick_weight(cos_d)
        if nonmetallic is not None:
            sheen = sheen * nonmetallic
        if parameters["sheen_tint"] is None:
            return value + sheen
        return torch.addcmul(value, sheen, lerp(1.0, tint(base), parameters["sheen_tint"]))
