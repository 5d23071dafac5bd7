"""Material models as split-sum shading knows them: a diffuse colour, a mirror's colour and roughness, and what passes.

Each model has one rule here; a model that has none, such as a user's own, is taken for diffuse by its ``albedo``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt import bsdfs
from torchpt.bsdfs import Bsdf, Parameters
from torchpt.bsdfs.conductor import metal_colour
from torchpt.bsdfs.dielectric import tinted
from torchpt.bsdfs.principled_lobes import tint
from torchpt.bsdfs.roughconductor import alphas
from torchpt.ibl import Sky, SplitSumMaterial, fresnel
from torchpt.math.fresnel import fresnel_dielectric, fresnel_diffuse, refract
from torchpt.math.vectors import dot

__all__ = ["under"]


@dataclass(frozen=True)
class _Approximation:
    """A material at ``N`` points.

    Attributes:
        surface: what it reflects.
        through: colour of what is not mirrored but passes ``(3, N)``; None where nothing does.
        eta: index of refraction ``(N,)`` of what lies below; None: light passes straight on.
    """

    surface: SplitSumMaterial
    through: Tensor | None = None
    eta: Tensor | None = None


def under(sky: Sky, model: Bsdf, parameters: Parameters, n: Tensor, v: Tensor) -> Tensor:
    """Radiance ``(3, N)`` toward unit ``v`` from materials under the sky, nothing in its way.

    Args:
        sky: its maps.
        model: one for all points.
        parameters: lane values, as prepared.
        n: unit normals ``(3, N)``, on the outside of what light passes through, else on the side of ``v``.
        v: ``(3, N)``.
    """
    if isinstance(model, bsdfs.Blend):
        a, b = (under(sky, m, parameters[key], n, v) for m, key in ((model.a, "a"), (model.b, "b")))
        return a + (b - a) * parameters["weight"].clamp(0.0, 1.0)
    rule = next((RULES[kind] for kind in type(model).__mro__ if kind in RULES), None)
    found = _matte(model.albedo(parameters)) if rule is None else rule(parameters)
    side = torch.copysign(torch.ones_like(n[0]), dot(n, v).detach())
    out = sky.reflected(n * side, v, found.surface)
    if found.through is None:
        return out
    cosine = (dot(n, v) * side).clamp(0.0, 1.0)
    assert found.surface.over is not None
    on, passes = -v, 1.0 - fresnel(cosine, found.surface.over, found.surface)
    if found.eta is not None:
        eta = torch.where(side > 0, found.eta, 1.0 / found.eta)
        boundary = fresnel_dielectric(cosine, eta)
        on, passes = refract(v, n * side, cosine, boundary), passes * (boundary.reflectance < 1)
    return torch.addcmul(out, found.through * passes, sky.prefiltered(on, found.surface.roughness.clamp(0.0, 1.0)))


def _matte(color: Tensor) -> _Approximation:
    none = torch.zeros_like(color[0])
    return _Approximation(SplitSumMaterial(color, none, none, torch.ones_like(none), None))


def _normal_incidence(eta: Tensor) -> Tensor:
    root = (eta - 1.0) / (eta + 1.0)
    return root * root


def _roughness(parameters: Parameters) -> Tensor:
    """``sqrt(alpha)``, of the mean of both where they differ; 0 where the surface is smooth."""
    u, v = alphas(parameters)
    return torch.where(parameters["smooth"], 0.0, (u * v).sqrt().sqrt())


def _metal(parameters: Parameters, roughness: Tensor) -> _Approximation:
    factor, one = parameters["specular_reflectance"], torch.ones_like(roughness)
    f0 = metal_colour(parameters, one)
    black = torch.zeros_like(f0)
    return _Approximation(SplitSumMaterial(black, tinted(one, factor) * f0, tinted(one, factor), roughness, None))


def _conductor(parameters: Parameters) -> _Approximation:
    like = next(parameters[key] for key in ("reflectance", "eta") if parameters[key] is not None)
    return _metal(parameters, torch.zeros_like(like[0]))


def _rough_conductor(parameters: Parameters) -> _Approximation:
    return _metal(parameters, _roughness(parameters))


def _coat(parameters: Parameters, roughness: Tensor) -> _Approximation:
    """A coat over a diffuse base, which light enters by what the coat's mean reflectance leaves."""
    eta, factor = parameters["eta"], parameters["specular_reflectance"]
    one = torch.ones_like(eta)
    base = parameters["base"] * (1.0 - fresnel_diffuse(eta))
    f0 = _normal_incidence(eta)
    return _Approximation(SplitSumMaterial(base, tinted(f0, factor), tinted(one, factor), roughness, f0))


def _plastic(parameters: Parameters) -> _Approximation:
    return _coat(parameters, torch.zeros_like(parameters["eta"]))


def _rough_plastic(parameters: Parameters) -> _Approximation:
    return _coat(parameters, _roughness(parameters))


def _clear(parameters: Parameters, roughness: Tensor, f0: Tensor, eta: Tensor | None) -> _Approximation:
    one = torch.ones_like(f0)
    reflects, passes = parameters["specular_reflectance"], parameters["specular_transmittance"]
    surface = SplitSumMaterial(
        torch.zeros_like(one).expand(3, -1), tinted(f0, reflects), tinted(one, reflects), roughness, f0
    )
    return _Approximation(surface, tinted(one, passes), eta)


def _dielectric(parameters: Parameters) -> _Approximation:
    eta = parameters["eta"]
    return _clear(parameters, torch.zeros_like(eta), _normal_incidence(eta), eta)


def _rough_dielectric(parameters: Parameters) -> _Approximation:
    eta = parameters["eta"]
    return _clear(parameters, _roughness(parameters), _normal_incidence(eta), eta)


def _pane(parameters: Parameters) -> _Approximation:
    f0 = _normal_incidence(parameters["eta"])
    return _clear(parameters, torch.zeros_like(f0), 2.0 * f0 / (1.0 + f0), None)


def _nothing(parameters: Parameters) -> _Approximation:
    none = torch.zeros(3, len(parameters["row"]), device=parameters["row"].device)
    return _Approximation(SplitSumMaterial(none, none[0], none[0], none[0], none[0]), none + 1.0)


def _lobe(parameters: Parameters, alpha2: Tensor, peak: Tensor | float) -> _Approximation:
    """A diffuse and a glossy lobe, added."""
    specular = parameters["specular"] * peak
    roughness = alpha2.clamp(0.0, 1.0).sqrt().sqrt()
    return _Approximation(SplitSumMaterial(parameters["diffuse"], specular, specular, roughness, None))


def _phong(parameters: Parameters) -> _Approximation:
    """The lobe about the mirror direction is as narrow as one about half vectors of four times the exponent."""
    return _lobe(parameters, 2.0 / (4.0 * parameters["exponent"] + 2.0), 1.0)


def _blinn_phong(parameters: Parameters) -> _Approximation:
    n = parameters["exponent"]
    return _lobe(parameters, 2.0 / (n + 2.0), 4.0 * (n + torch.exp(-0.34657359 * n)) / (n + 4.0))


def _nonmetal(parameters: Parameters) -> _Approximation:
    s = parameters["specular"]
    roughness = torch.where(parameters["smooth"], 0.0, parameters["alpha"].sqrt())
    return _Approximation(SplitSumMaterial(parameters["base_color"], s, s, roughness, s))


def _microfacet(parameters: Parameters) -> _Approximation:
    specular = parameters["specular"]
    roughness = torch.where(parameters["smooth"], 0.0, parameters["alpha"].sqrt())
    f0 = _normal_incidence(parameters["ior"])
    return _Approximation(SplitSumMaterial(parameters["diffuse"], f0 * specular, specular, roughness, f0))


def _principled(parameters: Parameters) -> _Approximation:
    base, eta = parameters["base_color"], parameters["eta"]
    f0 = _normal_incidence(eta).expand_as(base)
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
    surface = SplitSumMaterial(base * rest, f0, torch.ones_like(eta), (u * v).sqrt().sqrt(), over)
    return _Approximation(surface, passing, None if through is None else eta)


RULES: dict[type[Any], Callable[[Parameters], _Approximation]] = {
    bsdfs.Diffuse: lambda parameters: _matte(parameters["reflectance"]),
    bsdfs.Conductor: _conductor,
    bsdfs.RoughConductor: _rough_conductor,
    bsdfs.Plastic: _plastic,
    bsdfs.RoughPlastic: _rough_plastic,
    bsdfs.Dielectric: _dielectric,
    bsdfs.RoughDielectric: _rough_dielectric,
    bsdfs.ThinDielectric: _pane,
    bsdfs.Null: _nothing,
    bsdfs.Phong: _phong,
    bsdfs.BlinnPhong: _blinn_phong,
    bsdfs.Nonmetal: _nonmetal,
    bsdfs.Microfacet: _microfacet,
    bsdfs.Principled: _principled,
}
