"""Phong, Blinn-Phong, nonmetal, microfacet, Oren-Nayar: against their formulas written out, pair by pair of directions."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from oracle import ours_eval_pdf, random_pairs
from torch import Tensor

from torchpt.math.microfacet import fresnel_dielectric
from torchpt.physics.bsdfs import Bsdf, Parameters, gather
from torchpt.physics.bsdfs.kinds.blinn_phong import BlinnPhong
from torchpt.physics.bsdfs.kinds.microfacet import Microfacet
from torchpt.physics.bsdfs.kinds.nonmetal import Nonmetal
from torchpt.physics.bsdfs.kinds.phong import Phong
from torchpt.physics.bsdfs.kinds.plastic import Plastic
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.bsdfs.kinds.roughdiffuse import RoughDiffuse

RED, GREY = (0.8, 0.5, 0.1), (0.2, 0.3, 0.4)
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)

Vector = tuple[float, float, float]


def dot(a: Vector, b: Vector) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def half(a: Vector, b: Vector) -> Vector:
    s = tuple(x + y for x, y in zip(a, b, strict=True))
    length = math.sqrt(sum(x * x for x in s))
    return (s[0] / length, s[1] / length, s[2] / length)


def phong(v: dict[str, Any], wo: Vector, wi: Vector) -> list[float]:
    n, cos = v["exponent"], dot((-wo[0], -wo[1], wo[2]), wi)
    lobe = (n + 2) / (2 * math.pi) * max(cos, 0) ** n if cos > 0 else 0.0
    return [(kd / math.pi + ks * lobe) * wi[2] for kd, ks in zip(v["diffuse"], v["specular"], strict=True)]


def blinn_phong(v: dict[str, Any], wo: Vector, wi: Vector) -> list[float]:
    n = v["exponent"]
    lobe = (n + 2) / (2 * math.pi) * half(wo, wi)[2] ** n
    return [(kd / math.pi + ks * lobe) * wi[2] for kd, ks in zip(v["diffuse"], v["specular"], strict=True)]


def ggx_with_shortcut(roughness: float, wo: Vector, wi: Vector) -> float:
    """``D G / (4 cos cos)``."""
    a2, k, z = roughness**4, (roughness + 1) ** 2 / 8, half(wo, wi)[2]
    d = a2 / (math.pi * (z * z * (a2 - 1) + 1) ** 2)
    g = math.prod(w[2] / (w[2] * (1 - k) + k) for w in (wo, wi))
    return d * g / (4 * wo[2] * wi[2])


def nonmetal(v: dict[str, Any], wo: Vector, wi: Vector) -> list[float]:
    s, facets = v["specular"], ggx_with_shortcut(v["roughness"], wo, wi)
    return [(s * facets + (1 - s) * base / math.pi) * wi[2] for base in v["base_color"]]


def microfacet(v: dict[str, Any], wo: Vector, wi: Vector) -> list[float]:
    facets, eta, cos = ggx_with_shortcut(v["roughness"], wo, wi), v["ior"], wo[2]
    cos2_t = 1 - (1 - cos * cos) / eta**2
    f = 1.0
    if cos2_t > 0:
        cos_t = math.sqrt(cos2_t)
        f = (((cos - eta * cos_t) / (cos + eta * cos_t)) ** 2 + ((eta * cos - cos_t) / (eta * cos + cos_t)) ** 2) / 2
    return [
        (ks * f * facets + (1 - f) * kd / math.pi) * wi[2] for kd, ks in zip(v["diffuse"], v["specular"], strict=True)
    ]


def oren_nayar(v: dict[str, Any], wo: Vector, wi: Vector, fast: bool = False) -> list[float]:
    """Oren and Nayar 1994 by angles: their functional approximation, or the qualitative model."""
    sigma2 = (v["alpha"] / math.sqrt(2)) ** 2
    theta_r, theta_i = (math.acos(min(w[2], 1.0)) for w in (wo, wi))
    alpha, beta = max(theta_r, theta_i), min(theta_r, theta_i)
    cos_phi = math.cos(math.atan2(wo[1], wo[0]) - math.atan2(wi[1], wi[0]))
    c1, c2 = 1 - 0.5 * sigma2 / (sigma2 + 0.33), 0.45 * sigma2 / (sigma2 + 0.09)
    if fast:
        once, twice = c1 + c2 * max(0, cos_phi) * math.sin(alpha) * math.tan(beta), 0.0
    else:
        c2 *= math.sin(alpha) if cos_phi >= 0 else math.sin(alpha) - (2 * beta / math.pi) ** 3
        c3 = 0.125 * sigma2 / (sigma2 + 0.09) * (4 * alpha * beta / math.pi**2) ** 2
        once = c1 + cos_phi * c2 * math.tan(beta) + (1 - abs(cos_phi)) * c3 * math.tan((alpha + beta) / 2)
        twice = 0.17 * sigma2 / (sigma2 + 0.13) * (1 - cos_phi * (2 * beta / math.pi) ** 2)
    return [max(rho * once + rho * rho * twice, 0.0) / math.pi * wi[2] for rho in v["reflectance"]]


def oren_nayar_fast(v: dict[str, Any], wo: Vector, wi: Vector) -> list[float]:
    return oren_nayar(v, wo, wi, fast=True)


FORMULAS = [
    *(
        (RoughDiffuse(use_fast_approx=fast), oren_nayar_fast if fast else oren_nayar, {"reflectance": rho, "alpha": a})
        for fast in (False, True)
        for rho, a in ((RED, 0.2), (WHITE, 1.0), (GREY, 0.5), ((0.0, 0.01, 1.0), 1.0))
    ),
    *(
        (model, formula, {"diffuse": RED, "specular": GREY, "exponent": n})
        for n in (0.0, 0.5, 30.0, 1000.0, 1e5)
        for model, formula in ((Phong(), phong), (BlinnPhong(), blinn_phong))
    ),
    *((Nonmetal(), nonmetal, {"base_color": RED, "specular": 0.04, "roughness": r}) for r in (0.1, 0.5, 1.0)),
    *(
        (Microfacet(), microfacet, {"diffuse": RED, "specular": GREY, "roughness": r, "ior": ior})
        for r, ior in ((0.4, 1.85), (1.0, 1.5), (0.2, 0.7))
    ),
]


@pytest.mark.parametrize(
    ("model", "formula", "values"),
    FORMULAS,
    ids=[f"{model} {list(values.values())[-2:]}" for model, _, values in FORMULAS],
)
def test_values_are_the_formulas(model, formula, values):
    exponent = values.get("exponent", 0.0)
    wo, wi = random_pairs(21, 2000, sharp=0.1 if exponent <= 1000 else 0.003)
    expected = torch.tensor(
        [formula(values, a, b) for a, b in zip(wo.T.double().tolist(), wi.T.double().tolist(), strict=True)]
    ).T
    value, _ = ours_eval_pdf(model, values, wo, wi)
    assert float(expected.max()) > 1e-2
    # Unit vectors in float32 have lengths off by 6e-8, which the formulas above take for an angle.
    torch.testing.assert_close(value, expected.float(), rtol=1e-4 if exponent <= 1000 else 2e-2, atol=1e-5)


def exact(values: dict[str, Any], dtype: torch.dtype = torch.float64) -> Parameters:
    return {
        k: torch.tensor(v, dtype=dtype).reshape((3, 1) if isinstance(v, tuple) else (1,)) for k, v in values.items()
    }


def lanes(model: Bsdf, values: dict[str, Any], n: int, dtype: torch.dtype = torch.float64) -> Parameters:
    return gather(model.prepare(exact(values, dtype)), torch.zeros(n, dtype=torch.int64))


@pytest.mark.parametrize("model", [Phong(), BlinnPhong()], ids=str)
def test_an_exponent_of_1e5_is_as_good_in_float32_as_in_float64(model):
    values = {"diffuse": RED, "specular": GREY, "exponent": 1e5}
    wo, wi = random_pairs(22, 4000, near=1.0, sharp=0.003)
    # The same directions, unit in float64 too.
    wide = [w.double() / w.double().norm(dim=0) for w in (wo, wi)]
    value, pdf = model.eval_pdf(lanes(model, values, 4000, torch.float32), wo, wi)
    value_there, pdf_there = model.eval_pdf(lanes(model, values, 4000), *wide)
    assert float(pdf_there.max()) > 1e3
    torch.testing.assert_close(value.double(), value_there, rtol=2e-3, atol=1e-4)
    torch.testing.assert_close(pdf.double(), pdf_there, rtol=2e-3, atol=1e-4)


def grid(n: int = 700) -> tuple[Tensor, Tensor]:
    """Directions ``(3, M)`` of the upper half and their weights; close about the normal, where lobes are narrow."""
    x = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    z, wz = 1 - x**3, 3 * x**2 / n
    phi = (torch.arange(64, dtype=torch.float64) + 0.5) * (math.pi / 32)
    z, phi = z.repeat_interleave(64), phi.repeat(n)
    r = (1 - z * z).sqrt()
    return torch.stack((r * phi.cos(), r * phi.sin(), z)), wz.repeat_interleave(64) * (math.pi / 32)


@pytest.mark.parametrize(("exponent", "albedo"), [(0.0, 1.0), (10.0, 2.87), (100.0, 3.846), (1000.0, 3.984)])
def test_blinn_phong_creates_as_much_energy_as_its_integral_says(exponent, albedo):
    """At normal incidence ``4 (n + 2^(-n/2)) / (n + 4)``, and the draws agree."""
    model = BlinnPhong()
    values = {"diffuse": BLACK, "specular": WHITE, "exponent": exponent}
    wi, weight = grid()
    wo = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)
    value, _ = model.eval_pdf(lanes(model, values, wi.shape[1]), wo.expand_as(wi), wi)
    found = float((value[0] * weight).sum())
    assert found == pytest.approx(4 * (exponent + 2 ** (-exponent / 2)) / (exponent + 4), rel=1e-4)
    assert found == pytest.approx(albedo, abs=5e-3)
    n = 1 << 16
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(23))
    drawn = model.sample(lanes(model, values, n, torch.float32), wo.float().expand(3, n), u[2], u[:2]).weight[0]
    assert float(drawn.mean()) == pytest.approx(found, abs=5 * float(drawn.std()) / n**0.5)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 50.0])
@pytest.mark.parametrize("cos", [1.0, 0.5, 0.05])
def test_phong_of_reflectances_that_add_up_to_1_creates_no_energy(exponent, cos):
    model = Phong()
    values = {"diffuse": (0.0, 0.5, 0.9), "specular": (1.0, 0.5, 0.1), "exponent": exponent}
    wi, weight = grid()
    wo = torch.tensor([[math.sqrt(1 - cos * cos)], [0.0], [cos]], dtype=torch.float64).expand_as(wi)
    value, _ = model.eval_pdf(lanes(model, values, wi.shape[1]), wo, wi)
    albedo = (value * weight).sum(1)
    assert float(albedo.max()) <= 1.002
    if cos == 1.0:  # nothing of the lobe is below the surface
        torch.testing.assert_close(albedo, torch.ones(3, dtype=torch.float64), rtol=0, atol=2e-3)


@pytest.mark.parametrize("model", [Nonmetal(), Microfacet()], ids=str)
def test_a_polished_surface_is_the_limit_of_smooth_ones(model):
    """The delta's share of the light is what the narrowest lobe with a density reflects."""
    rough: dict[str, Any] = {"roughness": 0.011}
    if isinstance(model, Nonmetal):
        values: dict[str, Any] = {"base_color": RED, "specular": 0.3}
    else:
        values = {"diffuse": RED, "specular": WHITE, "ior": 1.85}
    n = 1 << 16
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(24))
    for cos in (1.0, 0.4, 0.1):
        wo = torch.tensor([[math.sqrt(1 - cos * cos)], [0.0], [cos]]).expand(3, n)
        narrow = model.sample(lanes(model, {**values, **rough}, n, torch.float32), wo, u[2], u[:2])
        polished = model.sample(lanes(model, {**values, "roughness": 0.0}, n, torch.float32), wo, u[2], u[:2])
        delta = torch.isinf(polished.pdf)
        assert delta.any() and not torch.isinf(narrow.pdf).any()
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        torch.testing.assert_close(polished.wi[:, delta], mirror[:, delta])
        error = 5 * (narrow.weight.var(1) / n).sqrt() + 5e-3
        assert ((narrow.weight.mean(1) - polished.weight.mean(1)).abs() < error).all()


@pytest.mark.parametrize(
    ("model", "values"),
    [
        (Phong(), {"diffuse": RED, "specular": GREY, "exponent": 20.0}),
        (BlinnPhong(), {"diffuse": RED, "specular": GREY, "exponent": 20.0}),
        (Nonmetal(), {"base_color": RED, "specular": 0.3, "roughness": 0.0}),
        (Microfacet(), {"diffuse": RED, "specular": GREY, "roughness": 0.0, "ior": 1.5}),
    ],
    ids=lambda x: str(x) if isinstance(x, Bsdf) else "",
)
def test_the_mean_weight_has_the_derivative_of_the_albedo(model, values):
    """Sampling is detached: the weights alone carry the derivative, through deltas too."""
    n = 1 << 16
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(25)).double()
    wo = torch.tensor([[0.6], [0.0], [0.8]], dtype=torch.float64).expand(3, n)
    name = "diffuse" if "diffuse" in values else "specular"

    def mean(scale: float, grad: bool) -> Tensor:
        inputs = exact(values)
        inputs[name] = (inputs[name] * scale).requires_grad_(grad)
        p = gather(model.prepare(inputs), torch.zeros(n, dtype=torch.int64))
        weight = model.sample(p, wo, u[2], u[:2]).weight[0].mean()
        return torch.autograd.grad(weight, inputs[name])[0].reshape(-1)[0] if grad else weight

    slope, change = float(mean(1.0, True)), float(mean(1.05, False) - mean(0.95, False))
    assert slope == pytest.approx(change / (0.1 * float(exact(values)[name].reshape(-1)[0])), rel=0.05, abs=0.02)


# -- coats and metals, by what is known of their energy


@pytest.mark.parametrize("nonlinear", [False, True])
@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_a_white_plastic_loses_nothing(angle, nonlinear):
    """What leaves the base of a coat and is thrown back within it comes out in the end: coat and base reflect 1 together."""
    model = Plastic(nonlinear)
    values = {"diffuse_reflectance": WHITE, "specular_reflectance": WHITE, "int_ior": 1.5, "ext_ior": 1.0}
    wi, weight = grid(200)
    n = wi.shape[1]
    slant = math.radians(angle)
    wo = torch.tensor([math.sin(slant), 0.0, math.cos(slant)], dtype=torch.float64)[:, None]
    base = (model.eval(lanes(model, values, n), wo.expand(3, n), wi) * weight).sum(1)
    coat = fresnel_dielectric(wo[2], torch.tensor([1.5], dtype=torch.float64)).reflectance
    assert (base + coat - 1).abs().max() < 1e-3


def test_energy_that_facets_give_back_takes_the_metals_colour():
    """A metal reflects ``F (1 + F0 g)`` where one of F = 1 reflects ``1 + g``, g = 1 / E - 1 (Turquin 2019, equation 16)."""
    gold: dict[str, Any] = {"eta": (0.14, 0.4, 1.5), "k": (4.0, 2.4, 1.9), "alpha": 0.7}
    mirror = {"eta": BLACK, "k": WHITE, "alpha": 0.7}
    wo, wi = (w.double() for w in random_pairs(23, 500))
    plain, whole = RoughConductor(), RoughConductor(energy_compensation=True)
    single, single_white, both, both_white = (
        model.eval(lanes(model, values, 500), wo, wi) for model in (plain, whole) for values in (gold, mirror)
    )
    lit = (single_white > 1e-4).all(0)
    ratio = (both / both_white * single_white / single)[:, lit]
    eta, k = (exact(gold)[name] for name in ("eta", "k"))
    f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    g = (1 - ratio[2]) / (ratio[2] - f0[2])
    assert lit.sum() > 100 and float(g.max()) > 0.05
    torch.testing.assert_close(ratio, (1 + f0 * g) / (1 + g), rtol=1e-5, atol=0)
