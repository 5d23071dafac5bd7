"""GGX and Beckmann: normalization, visible normals, masking, and their behaviour at the ends of float32."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from few import few
from torch import Tensor

from torchpt.math import beckmann
from torchpt.math import microfacet as mf
from torchpt.math.beckmann import BECKMANN
from torchpt.math.diffuse_coat import diffuse_reflectance, normal_reflectance
from torchpt.math.vectors import dot

ROUGH = [(1e-4, 1e-4), (1e-3, 1e-3), (0.1, 0.1), (0.5, 0.5), (1.0, 1.0), (0.05, 0.6), (1.0, 1e-4)]
ANGLES = [0.0, 45.0, 85.0, 89.9]
FACETS = {"ggx": mf.GGX, "beckmann": BECKMANN}
WAYS = ["ggx", "ggx bounded", "beckmann"]
EDGES = torch.tensor([0.0, 2**-24, 0.5, 1 - 2**-24])


def towards(angle: float, n: int, dtype: torch.dtype = torch.float64, phi: float = 0.7) -> Tensor:
    a = math.radians(angle)
    w = torch.tensor([math.sin(a) * math.cos(phi), math.sin(a) * math.sin(phi), math.cos(a)], dtype=dtype)
    return w[:, None].expand(3, n).contiguous()


def normals(au: float, av: float, psi: Tensor, phi: Tensor) -> tuple[Tensor, Tensor]:
    """Normals of slopes ``tan(psi) (au cos(phi), av sin(phi))`` and the solid angle of a unit of ``psi, phi``."""
    r = psi.tan()
    m = torch.stack((au * r * phi.cos(), av * r * phi.sin(), torch.ones_like(r)))
    length = m.norm(dim=0)
    return m / length, au * av * r * (1 + r * r) / length**3


def grid(psis: int, phis: int, inner: int) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Legendre nodes in ``psis x phis`` cells of [0, pi/2] x [0, 2 pi]; weights ``(psis phis, inner^2)``."""
    x, w = np.polynomial.legendre.leggauss(inner)
    x, w = torch.tensor((x + 1) / 2), torch.tensor(w / 2)
    a = (torch.arange(psis).double()[:, None] + x) / psis * (math.pi / 2)
    b = (torch.arange(phis).double()[:, None] + x) / phis * (2 * math.pi)
    psi = a[:, None, :, None].expand(psis, phis, inner, inner).reshape(-1)
    phi = b[None, :, None, :].expand(psis, phis, inner, inner).reshape(-1)
    weights = torch.outer(w, w) * (math.pi / 2 / psis) * (2 * math.pi / phis)
    return psi, phi, weights.reshape(1, -1)


def lanes(au: float, av: float, n: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    return torch.full((n,), au, dtype=dtype), torch.full((n,), av, dtype=dtype)


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
@pytest.mark.parametrize(("au", "av"), ROUGH)
def test_projected_normals_cover_the_surface_once(au, av, facets):
    psi, phi, weights = grid(16, 16, 6)
    m, jacobian = normals(au, av, psi, phi)
    d = facets.density(m, *lanes(au, av, len(psi)))
    assert abs(float((d * m[2] * jacobian).reshape(256, -1).mul(weights).sum()) - 1) < 1e-6


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
@pytest.mark.parametrize("angle", few(ANGLES, 2))
@pytest.mark.parametrize(("au", "av"), ROUGH)
def test_visible_normals_cover_the_view_once(au, av, angle, facets):
    """The integral of ``D max(0, wo . m)`` is the projected area, by which densities divide; Smith's G1 is cos over it."""
    psi, phi, weights = grid(30, 30, 6)
    m, jacobian = normals(au, av, psi, phi)
    wo = towards(angle, len(psi))
    rough = lanes(au, av, len(psi))
    d, area = facets.density(m, *rough), facets.masking_terms(wo, wo, *rough).area
    total = (d * dot(wo, m).clamp_min(0) / area * jacobian).reshape(900, -1).mul(weights).sum()
    assert abs(float(total) - 1) < 1e-3
    # Walter et al. give 0.35 % for their fit of Beckmann's.
    g1 = facets.masking(wo[:, :1], *lanes(au, av, 1))
    torch.testing.assert_close(g1, wo[2, :1] / area[:1], rtol=1e-12 if facets is mf.GGX else 3.5e-3, atol=0)


@pytest.mark.parametrize(("facets", "bounded"), [(mf.GGX, False), (mf.GGX, True), (BECKMANN, False)], ids=WAYS)
@pytest.mark.parametrize("angle", few(ANGLES, 2))
@pytest.mark.parametrize(("au", "av"), few(ROUGH, 4))
def test_drawn_reflections_have_their_density(au, av, angle, facets, bounded):
    """Chi-square over cells in which normals of any roughness are spread evenly; 84 tests of z < 5: p < 3e-5 in all."""
    n, psis, phis, inner = 50_000, 12, 16, 12
    g = torch.Generator().manual_seed(3)
    wo = towards(angle, n)
    m = facets.sample_normal(wo, *lanes(au, av, n), torch.rand(2, n, generator=g, dtype=torch.float64), bounded)
    wi = mf.reflect(wo, m, dot(wo, m))
    psi = torch.atan(torch.hypot(m[0] / au, m[1] / av) / m[2])
    phi = torch.atan2(m[1] / av, m[0] / au) % (2 * math.pi)
    cell = (psi / (math.pi / 2) * psis).long().clamp_max(psis - 1) * phis
    cell += (phi / (2 * math.pi) * phis).long().clamp_max(phis - 1)
    seen = torch.bincount(cell[wi[2] > 0], minlength=psis * phis).double()

    psi, phi, weights = grid(psis, phis, inner)
    m, jacobian = normals(au, av, psi, phi)
    wo = towards(angle, len(psi))
    cos = dot(wo, m)
    wi = mf.reflect(wo, m, cos)
    there = facets.reflection(wo, wi, *lanes(au, av, len(psi)), bounded=bounded)
    pdf = torch.where(cos > 0, there.pdf * 4 * cos, 0)
    expected = n * (pdf * jacobian).reshape(psis * phis, -1).mul(weights).sum(1)
    big = expected > 30
    chi2 = ((seen - expected)[big] ** 2 / (expected[big] + (2e-3 * expected[big]) ** 2)).sum()
    assert (chi2 - big.sum()) / (2 * big.sum()).sqrt() < 5
    assert abs(seen[~big].sum() - expected[~big].sum()) < 5 * expected[~big].sum().sqrt() + 30


@pytest.mark.parametrize(("au", "av"), [(0.5, 0.5), (1.0, 1.0), (0.2, 0.8)])
def test_a_bound_leaves_out_what_cannot_be_seen_and_nothing_else(au, av):
    n = 80_000
    g = torch.Generator().manual_seed(4)
    u, wo, rough = torch.rand(2, n, generator=g, dtype=torch.float64), towards(40, n), lanes(au, av, n)
    means, failed = [], []
    for bounded in (False, True):
        m = mf.sample_normal(wo, *rough, u, bounded)
        wi = mf.reflect(wo, m, dot(wo, m))
        at = mf.reflection(wo, wi, *rough, bounded=bounded)
        means.append((at.value / at.pdf.clamp_min(1e-30)).mean())
        failed.append((wi[2] <= 0).double().mean())
    assert abs(means[0] - means[1]) < 5e-3
    assert failed[1] < failed[0]
    if au == av == 1:
        assert failed[1] == 0


def test_masking():
    au, av = lanes(0.3, 0.6, 5)
    for angle in (90.0, 89.99, 60.0, 0.0):
        w = towards(angle, 5)
        cos = w[2].clamp_min(0) * (angle != 90)
        tan2 = ((au * w[0]) ** 2 + (av * w[1]) ** 2) / (w[2] ** 2)
        g1 = mf.masking(cos, mf.stretched_length(w, au, av))
        expected = torch.zeros(5).double() if angle == 90 else 2 / (1 + (1 + tan2).sqrt())
        torch.testing.assert_close(g1, expected)


def test_masking_correlated_by_height():
    au, av = lanes(0.3, 0.6, 1)
    wo, wi = towards(70, 1), towards(50, 1, phi=2.0)
    s_o, s_i = mf.stretched_length(wo, au, av), mf.stretched_length(wi, au, av)
    lambda_o, lambda_i = (s_o / wo[2] - 1) / 2, (s_i / wi[2] - 1) / 2
    ours = mf.height_correlated_masking(wo[2], s_o, wi[2], s_i) * mf.masking(wo[2], s_o)
    torch.testing.assert_close(ours, 1 / (1 + lambda_o + lambda_i))
    assert ours > mf.masking(wo[2], s_o) * mf.masking(wi[2], s_i)
    zero = torch.zeros(1).double()
    assert mf.height_correlated_masking(zero, s_o, zero, s_i) == 0


def test_the_narrowest_peak_in_float32():
    au, av = lanes(1e-4, 1e-4, 1, torch.float32)
    peak = mf.ggx(torch.tensor([[0.0], [0.0], [1.0]]), au, av)
    torch.testing.assert_close(peak, torch.tensor([1e8 / math.pi]), rtol=1e-6, atol=0)


@pytest.mark.parametrize(("facets", "bounded"), [(mf.GGX, False), (mf.GGX, True), (BECKMANN, False)], ids=WAYS)
@pytest.mark.parametrize(("au", "av"), [(1e-4, 1e-4), (1.0, 1.0), (1e-4, 1.0)])
def test_edges_have_finite_values_and_derivatives(au, av, facets, bounded):
    u = torch.cartesian_prod(EDGES, EDGES).T
    n = u.shape[1]
    for angle in (0.0, 45.0, 89.999, 90.0):
        wo = towards(angle, n, torch.float32) if angle < 90 else torch.tensor([[1.0], [0.0], [0.0]]).expand(3, n)
        a, b = (x.requires_grad_() for x in lanes(au, av, n, torch.float32))
        m = facets.sample_normal(wo, a, b, u, bounded)
        assert (m.norm(dim=0) - 1).abs().max() < 1e-6 and (m[2] >= 0).all()
        wi = mf.reflect(wo, m, dot(wo, m)).detach().requires_grad_()
        for by_height in (False, True):
            at = facets.reflection(wo, wi, a, b, bounded, by_height)
            for x in at:
                assert torch.isfinite(x).all()
            assert (at.value >= 0).all() and (at.pdf >= 0).all()
            for gradient in torch.autograd.grad(at.value.sum(), (a, b, wi)):
                assert torch.isfinite(gradient).all()


def test_float32_draws_the_narrow_lobe_as_float64_does():
    g = torch.Generator().manual_seed(5)
    u = torch.rand(2, 10_000, generator=g)
    for angle in ANGLES:
        exact = mf.sample_normal(towards(angle, 10_000), *lanes(1e-4, 1e-4, 10_000), u.double())
        ours = mf.sample_normal(towards(angle, 10_000, torch.float32), *lanes(1e-4, 1e-4, 10_000, torch.float32), u)
        assert (ours[:2] - exact[:2]).abs().max() < 1e-5 * exact[:2].abs().max()


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
def test_derivatives(facets):
    g = torch.Generator().manual_seed(6)
    a, b = (torch.rand(4, generator=g, dtype=torch.float64) * 0.8 + 0.1 for _ in range(2))
    wo, wi = towards(50, 4), towards(30, 4, phi=3.5)
    inputs = (wo.requires_grad_(), wi.requires_grad_(), a.requires_grad_(), b.requires_grad_())
    for by_height in (False, True):

        def value(o: Tensor, i: Tensor, u: Tensor, v: Tensor, by_height: bool = by_height) -> Tensor:
            return facets.reflection(o, i, u, v, by_height=by_height).value

        assert torch.autograd.gradcheck(value, inputs)
        assert torch.autograd.gradgradcheck(value, inputs)


def test_special_functions_against_closed_forms():
    """The complementary error function and the inverse of the error function, fitted in float64."""
    x = torch.linspace(0, 6, 601, dtype=torch.float64)
    torch.testing.assert_close(beckmann._erfcx(x), torch.special.erfcx(x), rtol=2e-7, atol=0)
    q = torch.logspace(-9.5, 0, 601, dtype=torch.float64)
    s = beckmann._slope(q)
    torch.testing.assert_close(torch.special.erfc(-s), q, rtol=2e-5, atol=0)  # 2 s^2 times the error of s
    torch.testing.assert_close(beckmann._slope(2 - q[q > 1e-7]), -s[q > 1e-7], rtol=1e-7, atol=1e-15)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_slopes_of_gaussian_facets_invert_their_distribution_function(dtype):
    """At alpha 1 the slope along wo is at most cot(theta), with the density ``(cos - sin s) exp(-s^2)``."""
    u = torch.cat([torch.linspace(1e-6, 1 - 1e-6, 5001, dtype=torch.float64), 1 - torch.logspace(-6, -1, 200).double()])
    n, rough = len(u), lanes(1, 1, len(u), dtype)
    for angle in (0.0, 0.01, 10.0, 20.0, 45.0, 89.9, 90.0):
        z = math.cos(math.radians(angle)) if angle < 90 else 0.0
        x = math.sqrt(1 - z * z)
        wo = torch.tensor([[x], [0.0], [z]], dtype=dtype).expand(3, n)
        m = BECKMANN.sample_normal(wo, *rough, torch.stack((torch.full_like(u, 0.5), u)).to(dtype)).double()
        s, most = -m[0] / m[2], torch.tensor(z / max(x, 1e-9), dtype=torch.float64)

        def below(s: Tensor, x: float = x, z: float = z) -> Tensor:
            return z * (1 + torch.erf(s)) + x / math.sqrt(math.pi) * torch.exp(-s * s)

        assert (s <= most + 1e-6).all()
        torch.testing.assert_close(below(s) / below(most), u.to(dtype).double(), rtol=0, atol=5e-6)


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_what_facets_give_back(alpha, facets):
    """The quadratures agree with an average over draws, and with one another where they mean the same."""
    n = 1 << 15
    u = torch.quasirandom.SobolEngine(2, scramble=True, seed=7).draw(n, dtype=torch.float64).T.contiguous()
    rough, one = lanes(alpha, alpha, n), torch.tensor([alpha], dtype=torch.float64)
    eta = torch.tensor([1.5], dtype=torch.float64)
    for angle in (0.0, 60.0, 85.0):
        wo = towards(angle, n, phi=0.0)
        m = facets.sample_normal(wo, *rough, u)
        wi = mf.reflect(wo, m, dot(wo, m))
        at = facets.reflection(wo, wi, *rough, by_height=True)
        directional_albedo = mf.directional_albedo(wo[:, :1], one, None, None, facets=facets)
        assert abs(float(directional_albedo) - float((at.value / at.pdf.clamp_min(1e-30)).mean())) < 3e-3
        anisotropic = mf.directional_albedo(towards(angle, 1), one, one, None, 64, 64, facets)
        assert abs(float(anisotropic) - float(directional_albedo)) < 1e-3
        cos = wo[2, :1]
        seen = mf.fresnel_dielectric(dot(wo, m), eta).reflectance * facets.masking(wi, *rough)
        both = seen.mean() + mf.coat_transmittance(cos, one, eta, facets)
        assert 0 < float(both) <= 1 + 1e-3
        assert float(both) <= float(mf.directional_albedo(wo[:, :1], one, None, eta, facets=facets)) + 1e-3


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
@pytest.mark.parametrize("alpha", [0.03, 0.2, 1.0])
@pytest.mark.parametrize("eta", [1 / 2.4, 1 / 1.49, 1.3])
def test_diffuse_light_at_a_coat(facets, alpha, eta):
    """The quadratures of smooth parts agree with an average over draws, from either side of the coat."""
    n = 1 << 16
    u = torch.quasirandom.SobolEngine(3, scramble=True, seed=7).draw(n, dtype=torch.float64).T.contiguous()
    rough, one = lanes(alpha, alpha, n), torch.tensor([alpha], dtype=torch.float64)
    index = torch.tensor([eta], dtype=torch.float64)

    def reflected(cos: Tensor) -> float:
        wo = torch.stack(((1.0 - cos * cos).sqrt(), torch.zeros_like(cos), cos))
        m = facets.sample_normal(wo, *rough, u[:2])
        cos_m = dot(wo, m)
        wi = mf.reflect(wo, m, cos_m)
        return float((mf.fresnel_dielectric(cos_m, index).reflectance * facets.masking(wi, *rough)).mean())

    assert float(diffuse_reflectance(one, index, facets)) == pytest.approx(reflected(u[2].sqrt()), abs=3e-4)
    assert float(normal_reflectance(one, index, facets)) == pytest.approx(reflected(torch.ones(n).double()), abs=3e-4)


@pytest.mark.parametrize("facets", FACETS.values(), ids=FACETS)
@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("eta", [1 / 2.4, 1 / 1.49, 1.3])
@pytest.mark.parametrize("integral", [diffuse_reflectance, normal_reflectance])
def test_derivatives_of_a_coat(integral, facets, alpha, eta):
    """First and second derivatives by roughness and index are those of the values at steps that move many edges."""
    for i, step in ((0, 0.02 * alpha), (1, 0.003)):
        at = torch.tensor([alpha, eta], dtype=torch.float64)

        def value(x: Tensor, i: int = i, at: Tensor = at) -> Tensor:
            a, e = (x if k == i else at[k] for k in (0, 1))
            return integral(a[None], e[None], facets)[0]

        x = at[i].clone().requires_grad_()
        slope = torch.autograd.grad(value(x), x, create_graph=True)[0]
        first, second = slope.item(), torch.autograd.grad(slope, x)[0].item()
        with torch.no_grad():
            low, middle, high = value(x - step).item(), value(x).item(), value(x + step).item()
        assert first == pytest.approx((high - low) / (2 * step), rel=5e-3)
        # Beckmann's rational masking has a second derivative that jumps, which a step blurs.
        size = abs(first) / at[i].item() * (0.03 if facets is mf.GGX else 0.2)
        assert second == pytest.approx((high + low - 2 * middle) / step**2, rel=0.03, abs=size)
