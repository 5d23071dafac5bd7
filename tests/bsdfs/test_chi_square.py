"""The judge of the models is judged: it accepts a right model and rejects small errors planted in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from cases import Case
from chi_square import Tree, chart, direction, integrate
from test_contract import EACH, Experiment, Setting
from torch import Tensor

from torchpt.bsdfs import Bsdf, Parameters
from torchpt.math.vectors import dot, normalize
from torchpt.math.warps import cosine_hemisphere, uniform_sphere
from torchpt.records import BsdfSample

N = 1_000_000


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


@pytest.mark.parametrize("angle", [0.0, 60.0, 89.9])
@pytest.mark.parametrize("alpha", [1e-4, 0.1, 1.0])
def test_a_right_model_passes(alpha, angle):
    assert p_value({**RIGHT, "alpha": alpha}, angle) > EACH


@pytest.mark.parametrize(
    ("drawn", "values"),
    [
        ({"alpha": 1.01}, {}),
        ({"share": 0.32}, {}),
        ({"scale": 1.0}, {"scale": 1.02}),
        ({"scale": 1.0}, {"scale": 0.98}),
        ({"tilt": 0.0}, {"tilt": 0.02}),
    ],
    ids=["alpha", "lobe", "above", "below", "tilt"],
)
@pytest.mark.parametrize("alpha", [1e-4, 0.01, 0.1, 0.5])
def test_small_errors_are_found(drawn, values, alpha):
    """One percent of alpha, 0.02 of a lobe's probability, 2 % of the density: of all of it, or between its halves."""
    right = {**RIGHT, "alpha": alpha, **values}
    wrong = {key: value * alpha if key == "alpha" else value for key, value in drawn.items()}
    assert p_value(right, 30.0, wrong) < EACH


@pytest.mark.slow
def test_p_values_are_uniform():
    """Of the right model: no more are small than chance allows, and the test is not idle either."""
    torch.manual_seed(1)
    setting = Setting(Case(MODEL, RIGHT), 60.0, below=False, full=True)
    p = torch.tensor([Experiment(setting, 1 << 17).p_value() for _ in range(200)])
    assert float((p < 0.05).double().mean()) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / 200)
    assert float((p < 0.9).double().mean()) > 0.3


def test_the_chart_and_its_inverse():
    w = uniform_sphere(torch.rand(2, 1000, generator=torch.Generator().manual_seed(1), dtype=torch.float64))
    y, phi = chart(w, 0.3)
    torch.testing.assert_close(direction(y, phi, 0.3), w)


@pytest.mark.parametrize("below", [False, True])
def test_leaves_tile_their_half_and_hold_what_lies_in_them(below):
    generator = torch.Generator().manual_seed(2)
    w = uniform_sphere(torch.rand(2, 1 << 12, generator=generator, dtype=torch.float64))
    w[2] = w[2].abs() * (-1 if below else 1)
    places = chart(w, 0.0)
    tree = Tree.over(places, 5, below)
    y0, y1, p0, p1 = tree.rects
    assert math.isclose(float(((torch.tanh(y1) - torch.tanh(y0)) * (p1 - p0)).sum()), 2 * math.pi, rel_tol=1e-12)
    y, p = places
    leaf = tree.leaf(places)
    assert ((y0[leaf] <= y) & (y <= y1[leaf]) & (p0[leaf] <= p) & (p <= p1[leaf])).all()
    assert torch.bincount(leaf).min() > 100


def test_cubature_of_a_cone_and_of_a_polynomial():
    """A jump along a circle across the leaves, and what has a closed form."""
    rects = torch.tensor([[0.0, 30.0, -math.pi, math.pi]], dtype=torch.float64).T
    axis = direction(torch.tensor([0.5]), torch.tensor([1.0]), 0.0).double()

    def f(w: Tensor) -> Tensor:
        return torch.stack(((dot(w, axis) > 0.95).double(), w[2] ** 2, w[2] * w[0]))

    out = integrate(f, rects, 0.0, 1e-6)
    exact = torch.tensor([2 * math.pi * 0.05, 2 * math.pi / 3, 0.0], dtype=torch.float64)
    assert ((out.value[:, 0] - exact).abs() <= out.error[:, 0] + 1e-9).all()
    assert (out.error < 1e-3).all()
