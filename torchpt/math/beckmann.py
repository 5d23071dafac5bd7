"""Beckmann's microfacet distribution, of surfaces whose heights are Gaussian: density, masking, visible normals.

Beckmann and Spizzichino, *The Scattering of Electromagnetic Waves from Rough Surfaces*, 1963; Walter, Marschner, Li, Torrance,
*Microfacet Models for Refraction through Rough Surfaces*, 2007. Slopes of facets are normally distributed, with standard
deviations ``alpha / sqrt(2)``.

Directions are those of :mod:`torchpt.math.microfacet`. Here ``t = sqrt((alpha_u x)^2 + (alpha_v y)^2)`` is the horizontal
length of the stretched direction, and ``a = |z| / t``. Products with ``z`` and ``t`` take the place of quotients by a cosine,
so that all is finite at grazing angles.

Values use the rational approximation of Smith's masking that Walter et al. give, within 0.35 %, as Mitsuba does. Densities use
the exact one: sampled normals follow it, so that averages are right.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.math.microfacet import MaskingTerms, MicrofacetDistribution, Reflection, half_vector
from torchpt.math.vectors import dot, normalize

__all__ = ["BECKMANN", "Beckmann"]

_INV_SQRT_PI = 1.0 / math.sqrt(math.pi)
_STEEPEST_COS2 = 1e-3  # of a normal: below it the density is 0 for every alpha, in float64 too
_LARGEST_A = 6.0  # erf(6) = 1 - 2e-17
_LEAST_T2 = 1e-30  # squared `t` below which a direction counts as the normal

#: Fits of our own, lowest power first. ``erfcx(x) = exp(x^2) erfc(x)`` over r, in powers of ``r = 1 / (1 + 0.4 x)`` for x in
#: [0, 6], relative error 1e-7.
_ERFCX = (
    0.2251152716, 0.2343214938, 0.1510020244, 0.3760602227, -0.3190791043, 0.6308127954, -0.3663105193, 0.06807771483,
)  # fmt: skip
#: The inverse of erf over its argument x, with ``w = -ln(1 - x^2)`` as in Giles, *Approximating the erfinv Function*, 2010: in
#: powers of ``w - 2.5`` for w < 5, and of ``sqrt(w) - 3.5`` from there to w = 23. Relative errors 3e-7 and 4e-7.
_CENTRE = (
    1.50140918, 0.2466414208, -0.004176258819, -0.001254631446, 0.0002173360377, -4.094211056e-06, -3.185884448e-06,
    3.1563447e-07,
)  # fmt: skip
_TAIL = (
    3.335484619, 1.007362906, 0.003301707926, -0.002015132386, 0.0009983437368, -0.000775424359, 0.0005645577801,
    -0.0001694074419,
)  # fmt: skip
_LEAST_Q = 2e-10  # 1 + erf(s) of the steepest slope: w = 22
_LEAST_U = 2.0**-26


class Beckmann(MicrofacetDistribution):
    """MicrofacetDistribution of a surface with Gaussian heights."""

    bounded_sampling = False

    def density(self, m: Tensor, alpha_u: Tensor, alpha_v: Tensor) -> Tensor:
        """See :meth:`MicrofacetDistribution.density`: ``exp(-(x^2/au^2 + y^2/av^2) / z^2) / (pi au av z^4)``."""
        x, y = m[0] / alpha_u, m[1] / alpha_v
        z2 = (m[2] * m[2]).clamp_min(_STEEPEST_COS2)
        return torch.exp(-torch.addcmul(x * x, y, y) / z2) / (math.pi * (alpha_u * alpha_v) * (z2 * z2))

    def sample_normal(self, wo: Tensor, alpha_u: Tensor, alpha_v: Tensor, u: Tensor, bounded: bool = False) -> Tensor:
        """See :meth:`MicrofacetDistribution.sample_normal`; there is no bound.

        For alpha 1, the slope ``s`` along ``wo`` has the density ``(z - t s) exp(-s^2)`` up to ``s = a`` (Heitz and d'Eon,
        *Importance Sampling Microfacet-Based BSDFs using the Distribution of Visible Normals*, 2014), the slope across is
        normally distributed. The distribution function is solved for ``q = 1 + erf(s)`` from the start that Jakob gives (*An
        Improved Visible Normal Sampling Routine for the Beckmann Distribution*, 2014), by two steps that solve its expansion
        to second order: it is flat at ``s = a``, where Newton's would be slow. Then it is off by at most 4e-6.
        """
        x, y = wo[0] * alpha_u, wo[1] * alpha_v
        l2 = torch.addcmul(x * x, y, y)
        slanted = l2 > _LEAST_T2
        t = torch.where(slanted, l2, _LEAST_T2).sqrt()
        inverse = 1.0 / t
        cos_phi, sin_phi = torch.where(slanted, x * inverse, 1.0), torch.where(slanted, y * inverse, 0.0)
        scale = torch.rsqrt(torch.addcmul(l2, wo[2], wo[2]).clamp_min(_LEAST_T2))
        z, t = wo[2] * scale, t * scale
        a = (z / t).clamp(0.0, _LARGEST_A)
        gauss = torch.exp(-a * a)
        largest = 2.0 - gauss * _erfcx(a)  # q at s = a
        along = u[1].clamp_min(_LEAST_U)
        goal = along * torch.addcmul(z * largest, t, gauss, value=_INV_SQRT_PI)
        q = largest * along * _erfcx((-torch.log(along)).clamp_min(1e-12).sqrt())
        for _ in range(2):
            s = _slope(q)
            gauss = torch.exp(-s * s)
            excess = torch.addcmul(z * q, t, gauss, value=_INV_SQRT_PI) - goal
            first = z - t * s
            # The second derivative is -t sqrt(pi) / 2 / gauss: solve excess + first h + second / 2 h^2 = 0.
            root = (first * first + math.sqrt(math.pi) * t * excess / gauss).clamp_min(1e-20).sqrt()
            q = q - 2.0 * excess / (first + root).clamp_min(1e-10)
            q = torch.minimum(q.clamp_min(_LEAST_Q), largest)
        s, across = _slope(q), _slope((2.0 * u[0]).clamp_min(_LEAST_Q))
        mx = (sin_phi * across - cos_phi * s) * alpha_u
        my = -(sin_phi * s + cos_phi * across) * alpha_v
        return normalize(torch.stack((mx, my, torch.ones_like(mx))))

    def reflection(
        self,
        wo: Tensor,
        wi: Tensor,
        alpha_u: Tensor,
        alpha_v: Tensor,
        bounded: bool = False,
        by_height: bool = False,
    ) -> Reflection:
        """See :meth:`MicrofacetDistribution.reflection`."""
        m = half_vector(wo, wi)
        above = torch.minimum(wo[2], wi[2]).sign().clamp_min(0.0)
        seen = self.masking_terms(wo, wi, alpha_u, alpha_v, by_height)
        pdf = 0.25 * self.density(m, alpha_u, alpha_v) * above / seen.area
        return Reflection(m=m, cos_m=dot(wo, m), value=pdf * seen.shadowing, pdf=pdf)

    def masking_terms(
        self, wo: Tensor, wi: Tensor, alpha_u: Tensor, alpha_v: Tensor, by_height: bool = False
    ) -> MaskingTerms:
        """See :meth:`MicrofacetDistribution.masking_terms`."""
        cos_o, cos_i = wo[2].abs(), wi[2].abs()
        t_o, t_i = _stretched(wo, alpha_u, alpha_v), _stretched(wi, alpha_u, alpha_v)
        area = cos_o + _hidden(cos_o, t_o)
        if by_height:
            # ci Ao / (Ao ci + Ai co - ci co), with A = c + hidden area
            weight = cos_i * area / torch.addcmul(area * cos_i, cos_o, _hidden(cos_i, t_i)).clamp_min(_LEAST_T2)
        else:
            weight = area * _masking_by_cos(cos_o, t_o) * (cos_i * _masking_by_cos(cos_i, t_i))
        return MaskingTerms(area=area, shadowing=weight)

    def masking(self, w: Tensor, alpha_u: Tensor, alpha_v: Tensor) -> Tensor:
        """See :meth:`MicrofacetDistribution.masking`."""
        cos = w[2].clamp_min(0.0)
        return cos * _masking_by_cos(cos, _stretched(w, alpha_u, alpha_v))


#: The one instance: it holds nothing.
BECKMANN = Beckmann()


def _stretched(w: Tensor, alpha_u: Tensor, alpha_v: Tensor) -> Tensor:
    """Return ``t`` ``(N,)``, at least 1e-15, where nothing is hidden at any cosine."""
    x, y = w[0] * alpha_u, w[1] * alpha_v
    return torch.addcmul(x * x, y, y).clamp_min(_LEAST_T2).sqrt()


def _hidden(cos: Tensor, t: Tensor) -> Tensor:
    """Return ``|z| Lambda`` ``(N,)``: the projected area of the facets that a direction would see but for others before them.

    Walter et al., equation 26: ``Lambda = (exp(-a^2) / (a sqrt(pi)) - erfc(a)) / 2``.
    """
    a = (cos / t).clamp_max(_LARGEST_A)
    gauss = torch.exp(-a * a)
    return 0.5 * gauss * (t * _INV_SQRT_PI - torch.minimum(cos, t * _LARGEST_A) * _erfcx(a)).clamp_min(0.0)


def _masking_by_cos(cos: Tensor, t: Tensor) -> Tensor:
    """Return the approximate Smith's ``G1 / |z|`` ``(N,)`` (Walter et al., equation 27); finite unless both are 0."""
    masked = cos < 1.6 * t
    quotient = (3.535 * t + 2.181 * cos) / torch.addcmul(2.577 * cos * cos, t, t + 2.276 * cos)
    return torch.where(masked, quotient, 1.0 / torch.where(masked, 1.0, cos.clamp_min(1e-20)))


def _erfcx(x: Tensor) -> Tensor:
    """Return ``exp(x^2) erfc(x)`` for x in [0, 6]."""
    r = 1.0 / (1.0 + 0.4 * x)
    return r * _polynomial(r, _ERFCX)


def _slope(q: Tensor) -> Tensor:
    """Return the slope ``s`` at which ``1 + erf(s) = q``."""
    w = -torch.log(q * (2.0 - q))
    central = w < 5.0
    tail = _polynomial(w.clamp_min(5.0).sqrt() - 3.5, _TAIL)
    return (q - 1.0) * torch.where(central, _polynomial(w - 2.5, _CENTRE), tail)


def _polynomial(x: Tensor, coefficients: tuple[float, ...]) -> Tensor:
    """Evaluate a polynomial whose lowest coefficient is the first."""
    *others, last = coefficients
    total = x * last + others[-1]
    for coefficient in reversed(others[:-1]):
        total = total * x + coefficient
    return total
