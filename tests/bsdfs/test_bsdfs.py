"""Contracts of every BSDF, over the table of models: a new one is tested the moment it exists."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchpt import bsdfs
from torchpt.math.warps import uniform_hemisphere, uniform_sphere

G = torch.Generator().manual_seed(6)
N = 1 << 16
ANGLES = [0.0, 30.0, 60.0, 85.0, 89.9]

#: Parameters to test each model with: name -> stacked values of one row.
CASES: list[tuple[str, bsdfs.Parameters]] = [
    ("diffuse", {"reflectance": torch.tensor([[0.8], [0.5], [0.1]]), "two_sided": None}),
    ("diffuse", {"reflectance": torch.tensor([[1.0], [1.0], [1.0]]), "two_sided": None}),
    ("diffuse", {"reflectance": torch.tensor([[0.8], [0.5], [0.1]]), "two_sided": torch.tensor([False])}),
]


def towards(angle: float, n: int, below: bool = False) -> Tensor:
    a = math.radians(angle)
    return torch.tensor([[math.sin(a)], [0.0], [-math.cos(a) if below else math.cos(a)]]).expand(3, n)


def lanes(parameters: bsdfs.Parameters, n: int) -> bsdfs.Parameters:
    return bsdfs.gather(parameters, torch.zeros(n, dtype=torch.int64))


def drawn(model: str, parameters: bsdfs.Parameters, wo: Tensor):
    n = wo.shape[1]
    u = torch.rand(3, n, generator=G)
    return bsdfs.KINDS[model].sample(lanes(parameters, n), wo, u[2], u[:2])


def test_every_model_has_a_case():
    assert {model for model, _ in CASES} == set(bsdfs.KINDS)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize(("model", "parameters"), CASES)
def test_sampling_eval_and_pdf_agree(model, parameters, angle, below):
    kind, wo = bsdfs.KINDS[model], towards(angle, N, below)
    p, out = lanes(parameters, N), drawn(model, parameters, wo)
    live = out.pdf > 0
    assert (out.wi.norm(dim=0) - 1).abs().max() < 1e-6
    torch.testing.assert_close(kind.pdf(p, wo, out.wi)[live], out.pdf[live], rtol=1e-4, atol=1e-7)
    value = kind.eval(p, wo, out.wi)
    torch.testing.assert_close(value[:, live], (out.weight * out.pdf)[:, live], rtol=1e-4, atol=1e-7)
    assert (value >= 0).all()
    for x in (out.wi, out.pdf, out.weight):
        assert torch.isfinite(x).all()


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("model", "parameters"), CASES)
def test_the_density_integrates_to_one_and_eval_to_the_albedo(model, parameters, angle):
    kind, wo = bsdfs.KINDS[model], towards(angle, N)
    p, wi = lanes(parameters, N), uniform_sphere(torch.rand(2, N, generator=G))
    mass = (kind.pdf(p, wo, wi) * 4 * math.pi).double()
    assert abs(float(mass.mean()) - 1) < 4 * float(mass.std()) / N**0.5
    out = drawn(model, parameters, wo)
    weight = (out.weight * (out.pdf > 0)).double()
    reference = (kind.eval(p, wo, wi) * 4 * math.pi).double()
    error = (reference.var(1) / N + weight.var(1) / N).sqrt()
    assert ((weight.mean(1) - reference.mean(1)).abs() < 4 * error + 1e-9).all()
    assert (weight.mean(1) <= 1 + 1e-5).all()


@pytest.mark.parametrize(("model", "parameters"), CASES)
def test_reciprocity(model, parameters):
    kind = bsdfs.KINDS[model]
    a, b = (uniform_hemisphere(torch.rand(2, N, generator=G)) for _ in range(2))
    p = lanes(parameters, N)
    torch.testing.assert_close(kind.eval(p, a, b) * a[2], kind.eval(p, b, a) * b[2], rtol=1e-4, atol=1e-6)


def test_diffuse_is_lambert_on_both_sides_or_on_one():
    wo, wi = towards(20, 1), towards(50, 1)
    for _, parameters in CASES:
        p = lanes(parameters, 1)
        reflectance = p["reflectance"]
        assert reflectance is not None
        torch.testing.assert_close(bsdfs.KINDS["diffuse"].eval(p, wo, wi), reflectance / math.pi * wi[2])
        assert not bsdfs.KINDS["diffuse"].eval(p, wo, -wi).any()
        behind = bsdfs.KINDS["diffuse"].eval(p, -wo, -wi)
        one_sided = p["two_sided"] is not None
        torch.testing.assert_close(behind, torch.zeros(3, 1) if one_sided else reflectance / math.pi * wi[2])
        assert bool((drawn("diffuse", parameters, -wo).pdf == 0).all()) == one_sided


@pytest.mark.parametrize(("model", "parameters"), CASES)
def test_grazing_and_edge_numbers_stay_finite(model, parameters):
    u = torch.cartesian_prod(*(torch.tensor([0.0, 2**-24, 0.5, 1 - 2**-24]),) * 3).T
    for wo in (
        torch.tensor([[1.0], [0.0], [0.0]]),
        torch.tensor([[1.0], [0.0], [-0.0]]),
        towards(90, 1),
        towards(0, 1),
    ):
        wo = wo.expand(3, u.shape[1])
        out = bsdfs.KINDS[model].sample(lanes(parameters, u.shape[1]), wo, u[2], u[:2])
        live = out.pdf > 0
        assert torch.isfinite(out.wi).all() and torch.isfinite(out.pdf).all()
        assert torch.isfinite(out.weight[:, live]).all()
