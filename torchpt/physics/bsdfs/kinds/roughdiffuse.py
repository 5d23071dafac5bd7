"""Oren and Nayar's rough diffuse reflector: V-shaped grooves of Lambertian facets, with light that two facets reflect.

The functional approximation of Oren, Nayar, *Generalization of Lambert's Reflectance Model*, 1994, as Mitsuba 0.6 has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import azimuth
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import mixture_sample
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.bsdfs.specs import GREY, fraction, reflectance
from torchpt.spec import Flag

__all__ = ["RoughDiffuse"]

_LEAST = 1e-10  # of sines and cosines that divide
_MOST = 0.95  # of the reflectance: all light in, less light out, at any alpha


@dataclass(frozen=True)
class RoughDiffuse(Bsdf):
    """Rough and diffuse as plaster, clay, the moon: flatter shading than Lambert, brighter toward the light.

    With ``alpha`` 0 it is ``diffuse``.

    Attributes:
        use_fast_approx: the qualitative model of two terms.
    """

    name = "roughdiffuse"
    parameters: ClassVar = {
        "reflectance": reflectance(GREY, "share of the light that a facet reflects"),
        "alpha": fraction(
            0.2, "alpha of the facets, as that of Beckmann's: sqrt(2) times the deviation of their angles"
        ),
        "use_fast_approx": Flag(
            False, doc="whether the short form is used, without light that facets reflect onto others"
        ),
    }

    conserves = False  # white facets reflect up to 1.05 of grazing light
    use_fast_approx: bool = False

    @classmethod
    def energy(cls, values: Values) -> str:
        """Return a warning where the facets are nearly white; "" where they are not, or have textures."""
        colour, alpha = values["reflectance"], values["alpha"]
        if not isinstance(colour, tuple) or alpha == 0.0 or max(colour) <= _MOST:
            return ""
        return (
            f"a reflectance of {max(colour):.4g} is above {_MOST:g}: it may reflect more grazing light than it receives"
        )

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        return cls(use_fast_approx=values["use_fast_approx"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        return cls(), cls(use_fast_approx=True)

    def prepare(self, values: Parameters) -> Parameters:
        """Return the reflectance and the factors ``c1`` to ``c4`` of the terms; see :meth:`Bsdf.prepare`."""
        sigma2 = 0.5 * values["alpha"].square()
        groove = sigma2 / (sigma2 + 0.09)
        return {
            "reflectance": values["reflectance"],
            "c1": 1.0 - 0.5 * sigma2 / (sigma2 + 0.33),
            "c2": 0.45 * groove,
            "c3": 0.125 * groove,
            "c4": 0.17 * sigma2 / (sigma2 + 0.13),
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`; values are at least 0, below which the fit falls for rays that graze from two sides."""
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].clamp_min(0.0)
        sin_o, sin_i = _sine(wo), _sine(wi)
        density = cos_i * (1.0 / math.pi)
        # Of the azimuths between both: 0 where one has none.
        cos_phi = (torch.addcmul(wo[0] * wi[0], wo[1], wi[1]) / (sin_o * sin_i)).clamp(-1.0, 1.0)
        # The larger of both angles with the normal is Oren and Nayar's alpha, the smaller one is beta.
        sin_alpha, sin_beta = torch.maximum(sin_o, sin_i), torch.minimum(sin_o, sin_i)
        cos_beta = torch.maximum(cos_o, cos_i).clamp_min(_LEAST)
        tan_beta = sin_beta / cos_beta
        rho, c1, c2 = parameters["reflectance"], parameters["c1"], parameters["c2"]
        if self.use_fast_approx:
            return rho * ((c1 + c2 * cos_phi.clamp_min(0.0) * sin_alpha * tan_beta) * density), density
        theta_o, theta_i = azimuth(cos_o, sin_o), azimuth(cos_i, sin_i)
        alpha = torch.maximum(theta_o, theta_i) * (2.0 / math.pi)  # over a right angle, as beta is
        beta = torch.minimum(theta_o, theta_i) * (2.0 / math.pi)
        towards = sin_alpha - torch.where(cos_phi < 0, beta * beta * beta, 0.0)
        both = alpha * beta
        tan_mean = (sin_alpha + sin_beta) / (cos_beta + torch.minimum(cos_o, cos_i))  # of (alpha + beta) / 2
        once = (
            c1 + c2 * cos_phi * towards * tan_beta + parameters["c3"] * (1.0 - cos_phi.abs()) * (both * both) * tan_mean
        )
        twice = parameters["c4"] * (1.0 - cos_phi * (beta * beta))
        return (rho * (once + rho * twice)).clamp_min(0.0) * density, density

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Sample the cosine-weighted hemisphere."""
        return mixture_sample(self, parameters, wo, cosine_hemisphere(u))

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the reflectance of a facet."""
        return parameters["reflectance"]


def _sine(w: Tensor) -> Tensor:
    """Return the sine ``(N,)`` of the angle of ``w (3, N)`` with the normal, more than 0."""
    return torch.addcmul(w[0] * w[0], w[1], w[1]).clamp_min(_LEAST * _LEAST).sqrt()
