"""The judge of the models is judged: it accepts a right model and rejects small errors planted in it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import pytest
import torch
from cases import Case
from chi_square import Chart, SlopeChart, Tree, integrate
from few import few
from test_contract import EACH, Experiment, Setting
from torch import Tensor

from torchpt.math.sampling import cosine_hemisphere, uniform_sphere
from torchpt.math.vectors import dot, normalize
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.physics.bsdfs.records import BsdfSample

N = 1_000_000


def slow(*values: float) -> list[Any]:
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


@dataclass(frozen=True)
class Planted(Bsdf):
    """A Lambert lobe and a mirror roughened by GGX's normals (sampled by D cos), with errors of the density to order."""

    name = "planted"
    lobed = True

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        h = normalize(wo + wi)
        alpha2 = parameters["alpha"] ** 2
        bracket = h[0] * h[0] + h[1] * h[1] + alpha2 * h[2] * h[2]
        rough = alpha2 * h[2].clamp_min(0.0) / (math.pi * bracket * bracket * 4 * dot(wo, h).clamp_min(1e-9))
        pdf = parameters["share"] * wi[2] / math.pi + (1 - parameters["share"]) * rough
        pdf = pdf * parameters["scale"] * (1 + parameters["tilt"] * torch.sign(wi[0]))
        pdf = torch.where(wi[2] > 0, pdf, 0.0)
        return pdf.expand(3, -1), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        assert lobe is not None
        tan = parameters["alpha"] * (u[0] / (1 - u[0])).sqrt()
        phi = 2 * math.pi * u[1]
        h = normalize(torch.stack((tan * torch.cos(phi), tan * torch.sin(phi), torch.ones_like(tan))))
        wi = torch.where(lobe < parameters["share"], cosine_hemisphere(u), 2 * dot(wo, h) * h - wo)
        pdf = self.pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, (pdf > 0).to(pdf.dtype).expand(3, -1))


MODEL = Planted()
RIGHT = {"alpha": 0.1, "share": 0.3, "scale": 1.0, "tilt": 0.0}


def p_value(values: dict[str, float], angle: float, drawn: dict[str, float] | None = None, number: int = N) -> float:
    setting = Setting(Case(MODEL, values), angle, below=False, full=False)
    return Experiment(setting, number, {**values, **(drawn or {})}).p_value()


@pytest.mark.parametrize(("alpha", "angle"), few(product([1e-4, 0.1, 1.0], [0.0, 60.0, 89.9]), 2))
def test_a_right_model_passes(alpha, angle):
    assert p_value({**RIGHT, "alpha": alpha}, angle, number=1 << 18) > EACH


@pytest.mark.parametrize(
    ("drawn", "values"),
    [
        pytest.param({"alpha": 1.01}, {}, id="alpha"),
        pytest.param({"share": 0.32}, {}, id="lobe", marks=pytest.mark.slow),
        pytest.param({"scale": 1.0}, {"scale": 1.02}, id="above", marks=pytest.mark.slow),
        pytest.param({"scale": 1.0}, {"scale": 0.98}, id="below"),
        pytest.param({"tilt": 0.0}, {"tilt": 0.02}, id="tilt"),
    ],
)
@pytest.mark.parametrize("alpha", [0.1, *slow(1e-4, 0.01, 0.5)])
def test_small_errors_are_found(drawn, values, alpha):
    """One percent of alpha, 0.02 of a lobe's probability, 2 % of the density: of all of it, or between its halves."""
    right = {**RIGHT, "alpha": alpha, **values}
    wrong = {key: value * alpha if key == "alpha" else value for key, value in drawn.items()}
    number = N if "alpha" in drawn else N // 4  # the smallest of them
    assert p_value(right, 30.0, wrong, number) < EACH


@pytest.mark.slow
def test_p_values_are_uniform():
    """Of the right model: no more are small than chance allows, and the test is not idle either."""
    setting = Setting(Case(MODEL, RIGHT), 60.0, below=False, full=True)
    p = torch.tensor([Experiment(setting, 1 << 17, again=k).p_value() for k in range(200)])
    assert float((p < 0.05).double().mean()) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 200)
    assert float((p < 0.9).double().mean()) > 0.3


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_the_chart_and_its_inverse(scale):
    w = uniform_sphere(torch.rand(2, 1000, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    chart = Chart(0.3, scale)
    torch.testing.assert_close(chart.directions(chart.places(w)), w)


@pytest.mark.parametrize("eta", few([None, 1.5, 1 / 1.5, 10.0], 2))
@pytest.mark.parametrize("z", few([0.9, 1e-3, -0.5], 2))
def test_the_chart_of_slopes_and_its_inverse(z, eta):
    """Every direction on the side meant, or every one that a facet can refract to; its area adds up to theirs."""
    wo = torch.tensor([[math.sqrt(1 - z * z)], [0.0], [z]], dtype=torch.float64)
    w = uniform_sphere(torch.rand(2, 4000, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    w[2] = w[2].abs() * math.copysign(1, z if eta is None else -z)
    chart = SlopeChart(wo, eta)
    covered = chart.covers(w)
    torch.testing.assert_close(chart.directions(chart.places(w[:, covered])), w[:, covered], rtol=1e-6, atol=1e-6)
    rects = torch.tensor([chart.ends(False)], dtype=torch.float64).T
    places = chart.places(w[:, covered])
    home = torch.zeros(places.shape[1], dtype=torch.int64)
    whole = integrate(lambda w: torch.ones_like(w[:1]), rects, chart, 1e-5, (places, home))
    share = covered.double().mean()
    assert abs(float(whole.value) / (2 * math.pi) - share) < 0.01 + 4 * (share * (1 - share) / 4000).sqrt()


@pytest.mark.parametrize("below", [False, True])
def test_leaves_tile_their_half_and_hold_what_lies_in_them(below):
    generator = torch.Generator().manual_seed(2)
    w = uniform_sphere(torch.rand(2, 1 << 12, generator=generator, dtype=torch.float64))
    w[2] = w[2].abs() * (-1 if below else 1)
    chart = Chart(0.0, 0.01)
    places = chart.places(w)
    tree = Tree.over(places, 5, chart.ends(below))
    whole = integrate(lambda w: torch.ones_like(w[:1]), tree.rects, chart, 1e-9)
    assert math.isclose(float(whole.value.sum()), 2 * math.pi, rel_tol=1e-6)
    y0, y1, p0, p1 = tree.rects
    y, p = places
    leaf = tree.leaf(places)
    assert ((y0[leaf] <= y) & (y <= y1[leaf]) & (p0[leaf] <= p) & (p <= p1[leaf])).all()
    assert torch.bincount(leaf).min() > 100


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_cubature_of_a_cone_and_of_a_polynomial(scale):
    """A jump along a circle across the leaves, and what has a closed form."""
    chart = Chart(0.0, scale)
    rects = torch.tensor([chart.ends(False)], dtype=torch.float64).T
    axis = torch.tensor([[0.6], [0.0], [0.8]], dtype=torch.float64)

    def f(w: Tensor) -> Tensor:
        return torch.stack(((dot(w, axis) > 0.95).double(), w[2] ** 2, w[2] * w[0]))

    out = integrate(f, rects, chart, 1e-6)
    exact = torch.tensor([2 * math.pi * 0.05, 2 * math.pi / 3, 0.0], dtype=torch.float64)
    assert ((out.value[:, 0] - exact).abs() < torch.tensor([1e-4, 1e-6, 1e-6])).all()
    assert (out.error < 1e-3).all()


def test_cubature_finds_what_scouts_have_seen():
    """A lobe of 1e-4 in one leaf of the half sphere."""
    chart = Chart(0.0)
    rects = torch.tensor([chart.ends(False)], dtype=torch.float64).T
    axis = torch.tensor([[0.6], [0.0], [0.8]], dtype=torch.float64)

    def f(w: Tensor) -> Tensor:
        off = ((w - axis) ** 2).sum(0)
        return (1e-8 / (math.pi * (off + 1e-8) ** 2))[None]

    offsets = 1e-4 * (2 * torch.rand(3, 50, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1)
    scouts = chart.places(normalize(axis + offsets))
    out = integrate(f, rects, chart, 1e-6, (scouts, torch.zeros(50, dtype=torch.int64)))
    assert abs(float(out.value) - 1) < 1e-4
