"""Fresnel's equations against complex arithmetic written independently, their limits, and their derivatives."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchpt.math.microfacet import diffuse_transmittance, fresnel_conductor, fresnel_dielectric, refract, schlick

INDICES = [1e-3, 1 / 1.5, 0.99, 1.0, 1.00001, 1.01, 1.5, 10.0]
COSINES = torch.linspace(-1, 1, 401, dtype=torch.float64)


def reference(cos: Tensor, eta: Tensor) -> Tensor:
    """Reflectance for light that comes at ``cos >= 0`` upon a medium of complex index ``eta``."""
    cos_t = torch.sqrt(1 - (1 - cos * cos + 0j) / (eta * eta))
    s = (cos - eta * cos_t) / (cos + eta * cos_t)
    p = (eta * cos - cos_t) / (eta * cos + cos_t)
    return 0.5 * (s.abs() ** 2 + p.abs() ** 2)


@pytest.mark.parametrize("eta", [i for i in INDICES if abs(i - 1) > 1e-4])
def test_dielectric_from_both_sides(eta):
    cos = COSINES[COSINES != 0]
    side = fresnel_dielectric(cos, torch.full_like(cos, eta))
    ahead = torch.where(cos > 0, torch.full_like(cos, eta), 1 / eta)
    torch.testing.assert_close(side.reflectance, reference(cos.abs(), ahead + 0j), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(side.eta_it, ahead)
    torch.testing.assert_close(side.eta_ti, 1 / ahead)
    sine = (1 - cos * cos).sqrt()
    inside = sine < ahead * (1 - 1e-9)
    assert (side.reflectance[~inside] == 1).all() and (side.cos_t[~inside] == 0).all()
    assert (side.cos_t * cos <= 0).all()
    torch.testing.assert_close(ahead[inside] * (1 - side.cos_t[inside] ** 2).sqrt(), sine[inside], rtol=1e-6, atol=1e-6)


def test_the_reflectance_is_the_same_from_the_other_end_of_the_ray():
    cos = COSINES[COSINES > 0]
    side = fresnel_dielectric(cos, torch.full_like(cos, 1.5))
    back = fresnel_dielectric(side.cos_t, torch.full_like(cos, 1.5))
    torch.testing.assert_close(back.reflectance, side.reflectance)


@pytest.mark.parametrize("eta", [1 - 0.9e-4, 1.0, 1 + 0.9e-4])
def test_equal_indices_let_light_straight_through(eta):
    side = fresnel_dielectric(COSINES, torch.full_like(COSINES, eta))
    assert (side.reflectance == 0).all() and (side.eta_it == 1).all()
    torch.testing.assert_close(side.cos_t, -COSINES)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("eta", INDICES)
def test_edges_have_finite_values_and_derivatives(eta, dtype):
    critical = math.sqrt(max(0.0, 1 - min(eta, 1 / eta) ** 2))
    cos = torch.tensor(
        [0.0, -0.0, 1e-30, 1e-7, critical, critical + 1e-7, critical - 1e-7, 1.0, 1.0000001], dtype=dtype
    )
    cos = torch.cat((cos, -cos)).requires_grad_()
    index = torch.full_like(cos, eta, requires_grad=True)
    side = fresnel_dielectric(cos, index)
    assert ((side.reflectance >= 0) & (side.reflectance <= 1)).all()
    for out in side:
        assert torch.isfinite(out).all()
        for gradient in torch.autograd.grad(out.sum(), (cos, index), retain_graph=True, allow_unused=True):
            assert gradient is None or torch.isfinite(gradient).all()


def test_refraction_obeys_snell_even_where_the_index_magnifies_rounding():
    g = torch.Generator().manual_seed(1)
    for eta in (1e-3, 1.5):
        phi = 2 * math.pi * torch.rand(1000, generator=g)
        sine = torch.rand(1000, generator=g) * min(1.0, eta) * 0.99
        wo = torch.stack((sine * phi.cos(), sine * phi.sin(), (1 - sine * sine).sqrt()))
        up = torch.tensor([[0.0], [0.0], [1.0]]).expand(3, 1000)
        side = fresnel_dielectric(wo[2], torch.full((1000,), eta), sine * sine)
        wi = refract(wo, up, wo[2], side)
        torch.testing.assert_close(wi[:2] * eta, -wo[:2], rtol=1e-5, atol=1e-7)
        assert (wi.norm(dim=0) - 1).abs().max() < 1e-5 and (wi[2] < 0).all()


def test_conductor():
    cos = COSINES[COSINES > 0]
    for eta, k in ((0.143, 3.98), (1.442, 1.603), (2.0, 0.0), (0.0, 1.0), (0.2, 10.0)):
        index = torch.full_like(cos, eta) - 1j * torch.full_like(cos, k)
        ours = fresnel_conductor(cos, torch.full_like(cos, eta), torch.full_like(cos, k))
        torch.testing.assert_close(ours, reference(cos, index), rtol=1e-9, atol=1e-9)


def test_a_conductor_that_absorbs_nothing_is_a_dielectric():
    cos = COSINES[COSINES > 0]
    clear = fresnel_dielectric(cos, torch.full_like(cos, 1.7)).reflectance
    torch.testing.assert_close(fresnel_conductor(cos, torch.full_like(cos, 1.7), torch.zeros_like(cos)), clear)


@pytest.mark.parametrize(("eta", "k"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (10.0, 10.0), (1e-3, 1e-3)])
def test_conductor_edges(eta, k):
    cos = torch.cat((torch.tensor([0.0, 1e-7, 0.5, 1.0]), torch.linspace(0, 1, 1001))).requires_grad_()
    a, b = torch.full_like(cos, eta).requires_grad_(), torch.full_like(cos, k).requires_grad_()
    r = fresnel_conductor(cos, a, b)
    assert ((r >= 0) & (r <= 1 + 1e-6)).all()
    for gradient in torch.autograd.grad(r.sum(), (cos, a, b)):
        assert torch.isfinite(gradient).all()


def test_schlick():
    f0 = torch.tensor([[0.04], [0.5], [1.0]])
    torch.testing.assert_close(schlick(torch.ones(1), f0), f0)
    torch.testing.assert_close(schlick(torch.zeros(1), f0), torch.ones(3, 1))
    torch.testing.assert_close(schlick(torch.tensor([0.5]), f0), f0 + (1 - f0) / 32)


@pytest.mark.parametrize(
    "eta", [1e-3, 0.01, 0.1, 0.3, 0.45, 0.6, 0.9, 0.999, 1.001, 1.1, 1.49, 2.0, 5.0, 10.0, 100.0, 1e3]
)
def test_what_passes_a_boundary_of_diffuse_light(eta):
    cos2 = (torch.arange(200_000, dtype=torch.float64) + 0.5) / 200_000
    if eta > 1.0:
        exact = 1.0 - fresnel_dielectric(cos2.sqrt(), torch.full_like(cos2, eta)).reflectance.mean()
    else:  # all is reflected but in a narrow cone, whose directions the other side has in its whole hemisphere
        exact = eta**2 * (1.0 - fresnel_dielectric(cos2.sqrt(), torch.full_like(cos2, 1.0 / eta)).reflectance.mean())
    passed = diffuse_transmittance(torch.tensor([eta], dtype=torch.float64))[0]
    assert abs(passed / exact - 1.0) < 1.5e-4


def test_diffuse_light_passes_equal_indices_whole():
    assert float(diffuse_transmittance(torch.tensor([1.0], dtype=torch.float64))) == pytest.approx(1.0, abs=1e-7)


def test_derivatives():
    g = torch.Generator().manual_seed(2)
    cos = (torch.rand(6, generator=g, dtype=torch.float64) * 0.8 + 0.15).requires_grad_()
    eta = torch.tensor([1.5, 1.2, 0.9, 2.0, 10.0, 1.0027], dtype=torch.float64, requires_grad=True)
    k = torch.tensor([3.0, 0.1, 1.0, 2.0, 0.5, 4.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c, e: tuple(fresnel_dielectric(c, e)), (cos, eta))
    assert torch.autograd.gradcheck(fresnel_conductor, (cos, eta, k))
    assert torch.autograd.gradcheck(diffuse_transmittance, (eta,))
