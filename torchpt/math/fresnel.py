"""Fresnel's equations, unpolarized: dielectrics from both sides, conductors, Schlick's form, and the diffuse average."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = [
    "INDEX_MATCHED",
    "Interface",
    "diffuse_passed",
    "fresnel_conductor",
    "fresnel_dielectric",
    "refract",
    "schlick",
]

#: Relative indices this close to 1 let light straight through: the Jacobian of refraction vanishes there.
INDEX_MATCHED = 1e-4


class Interface(NamedTuple):
    """What a ray meets at a boundary of two dielectrics, each ``(N,)``."""

    reflectance: Tensor  # 1 under total internal reflection
    cos_t: Tensor  # signed against the normal; opposite to cos_i, 0 under total internal reflection
    eta_it: Tensor  # index of the far side over that of the side of the ray
    eta_ti: Tensor  # its reciprocal


def fresnel_dielectric(cos_i: Tensor, eta: Tensor, sin2_i: Tensor | None = None) -> Interface:
    """Reflectance of a boundary and the refracted cosine (Born and Wolf, *Principles of Optics*, section 1.5).

    Args:
        cos_i: ``(N,)`` cosine against the normal, negative from below.
        eta: ``(N,)`` index below the surface over that above it.
        sin2_i: ``(N,)`` squared sine, where it is known better than ``1 - cos_i^2`` rounds: an extreme index needs it.
    """
    above = cos_i >= 0
    matched = (eta - 1.0).abs() < INDEX_MATCHED
    eta = torch.where(matched, 1.0, eta)
    inverse = 1.0 / eta
    eta_it, eta_ti = torch.where(above, eta, inverse), torch.where(above, inverse, eta)
    c = cos_i.abs()
    sin2 = (1.0 - c) * (1.0 + c) if sin2_i is None else sin2_i
    cos2_t = 1.0 - eta_ti * eta_ti * sin2
    open_ = (cos2_t > 0) & (c > 0)
    # Neither the root nor the quotients below are ever asked for what they do not have.
    t = torch.where(open_, cos2_t, 1.0).sqrt()
    i = torch.where(open_, c, 1.0)
    s = (i - eta_it * t) / (i + eta_it * t)
    p = (t - eta_it * i) / (t + eta_it * i)
    r = torch.where(matched, 0.0, torch.where(open_, 0.5 * (s * s + p * p), 1.0))
    t = torch.where(matched, c, torch.where(open_, t, 0.0))
    return Interface(r, torch.where(above, -t, t), eta_it, eta_ti)


def refract(w: Tensor, m: Tensor, cos_i: Tensor, boundary: Interface) -> Tensor:
    """The refracted direction ``(3, N)``, unit where there is one.

    Written with the part of ``w`` that is perpendicular to ``m``, which stays small where it should be: an index of
    1e-3 magnifies its rounding a thousandfold.

    Args:
        w: ``(3, N)`` unit, leaving the surface on the side where light comes from.
        m: ``(3, N)`` unit normal.
        cos_i: ``(N,)`` their cosine.
        boundary: as of :func:`fresnel_dielectric`.
    """
    return torch.addcmul(m * boundary.cos_t, m * cos_i - w, boundary.eta_ti)


def fresnel_conductor(cos_i: Tensor, eta: Tensor, k: Tensor) -> Tensor:
    """Reflectance of a metal with index ``eta - i k`` (Born and Wolf, section 14.2): all broadcast against ``(3, N)``.

    With ``a^2 + b^2 = |eta^2 - sin^2|``: ``Rs = |(cos - (a + ib)) / (cos + (a + ib))|^2``, and ``Rp`` likewise.
    """
    cos2 = cos_i * cos_i
    sin2 = 1.0 - cos2
    real = eta * eta - k * k - sin2
    twice = 2.0 * eta * k
    tiny = torch.finfo(real.dtype).tiny
    ab2 = (real * real + twice * twice).clamp_min(tiny).sqrt()
    a = (0.5 * (ab2 + real)).clamp_min(tiny).sqrt()
    one, two = ab2 + cos2, 2.0 * cos_i * a
    s = (one - two) / (one + two).clamp_min(tiny)
    three, four = ab2 * cos2 + sin2 * sin2, two * sin2
    p = s * (three - four) / (three + four).clamp_min(tiny)
    # Where the metal's index is that of the air, what is left is rounding, of either sign.
    return (0.5 * (s + p)).clamp_min(0.0)


def schlick(cos_i: Tensor, f0: Tensor) -> Tensor:
    """``F0 + (1 - F0)(1 - cos)^5``, ``(N,), (3, N) -> (3, N)`` (Schlick 1994)."""
    x = (1.0 - cos_i).clamp(0.0, 1.0)
    x2 = x * x
    return f0 + (1.0 - f0) * (x2 * x2 * x)


def diffuse_passed(eta: Tensor) -> Tensor:
    """The part of diffuse light that a smooth boundary lets through, from the side with ``eta`` = far index over near index.

    A fit of ours to the integral of :func:`fresnel_dielectric` over the hemisphere, for all indices. What passes a boundary to
    the denser side is ``T(x) = x (p(x) + c x ln x)`` with ``x <= 1`` the ratio of the indices, as the integral has such a term
    at 0; what passes the other way is ``x^2 T(x)`` by reciprocity. ``T`` is right to 1.4e-4 of itself, and 1 at equal indices.
    """
    x = torch.where(eta < 1.0, eta, 1.0 / eta)
    fit = 5.3340758 + x * (1.9806515 + x * (-9.3608694 + x * (4.8516145 + x * (-2.5113928 + x * 0.7059204))))
    passed = x * (fit + 8.0130667 * x * torch.log(x))
    return torch.where(eta < 1.0, x * x * passed, passed)
