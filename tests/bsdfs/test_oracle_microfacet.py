"""Metals, glass and plastics against Mitsuba 3: values and densities of rough lobes, and samples of deltas."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from oracle import assert_same, both_sides, mitsuba_bsdf, mitsuba_eval_pdf, ours_eval_pdf, random_pairs, rgb
from torch import Tensor

from torchpt.math import beckmann, microfacet
from torchpt.math.vectors import dot, normalize
from torchpt.physics.bsdfs import Bsdf, gather
from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.kinds.conductor import Conductor
from torchpt.physics.bsdfs.kinds.dielectric import Dielectric
from torchpt.physics.bsdfs.kinds.null import Null
from torchpt.physics.bsdfs.kinds.plastic import Plastic
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.bsdfs.kinds.roughdielectric import RoughDielectric
from torchpt.physics.bsdfs.kinds.roughplastic import RoughPlastic
from torchpt.physics.bsdfs.kinds.thindielectric import ThinDielectric

Values = dict[str, Any]

GOLD: Values = {"eta": (0.143, 0.375, 1.442), "k": (3.983, 2.386, 1.603)}
MIRROR: Values = {"eta": (0.0, 0.0, 0.0), "k": (1.0, 1.0, 1.0)}
CHROME: Values = {"eta": (3.2, 3.18, 2.3), "k": (3.3, 3.33, 3.1), "specular_reflectance": (0.2, 0.8, 0.5)}
TINTS: Values = {"specular_reflectance": (0.2, 0.8, 0.5), "specular_transmittance": (0.9, 0.3, 0.7)}
PAINT: Values = {"diffuse_reflectance": (0.8, 0.5, 0.1), "ext_ior": 1.000277}
DIM: Values = {"diffuse_reflectance": (0.05, 0.3, 0.95), "ext_ior": 1.0, "specular_reflectance": (0.2, 0.9, 0.5)}


@dataclass(frozen=True)
class Case:
    model: Bsdf
    values: Values

    def __str__(self) -> str:
        words = (f"{k}={'/'.join(map(str, v)) if isinstance(v, tuple) else f'{v:.4g}'}" for k, v in self.values.items())
        return f"{self.model} {' '.join(words)}"

    @property
    def theirs(self) -> Values:
        """Mitsuba's dict with the same numbers."""
        out: Values = {"type": self.model.name}
        if self.model.name.startswith("rough"):
            out["distribution"] = "beckmann" if getattr(self.model, "beckmann", False) else "ggx"
        if getattr(self.model, "nonlinear", False):
            out["nonlinear"] = True
        return out | {k: rgb(*v) if isinstance(v, tuple) else v for k, v in self.values.items()}

    @property
    def eta(self) -> float:
        return self.values["int_ior"] / self.values["ext_ior"]

    @property
    def sharp(self) -> float:
        """How near to the mirror image pairs have to be to meet the lobe."""
        alphas = [self.values[key] for key in ("alpha", "alpha_u", "alpha_v") if key in self.values]
        return min(0.1, 3 * min(alphas, default=0.1))


def glass(eta: float, **values: Any) -> Values:
    return {"int_ior": eta, "ext_ior": 1.0, **values}


ROUGH = [
    *(Case(RoughConductor(), {**GOLD, "alpha": a}) for a in (1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0)),
    Case(RoughConductor(), {**MIRROR, "alpha": 0.3}),
    Case(RoughConductor(), {**CHROME, "alpha": 0.2}),
    Case(RoughConductor(anisotropic=True), {**GOLD, "alpha_u": 0.05, "alpha_v": 0.4}),
    Case(RoughConductor(anisotropic=True), {**CHROME, "alpha_u": 1.0, "alpha_v": 0.01}),
    *(
        Case(RoughPlastic(nonlinear=nonlinear), {**colour, "int_ior": eta, "alpha": alpha})
        for nonlinear, colour, eta, alpha in (
            (False, PAINT, 1.49, 0.01),
            (False, PAINT, 1.49, 0.1),
            (False, DIM, 1.8, 0.3),
            (False, DIM, 1.3, 1.0),
            (True, PAINT, 1.49, 0.1),
            (True, DIM, 1.9, 0.5),
        )
    ),
    *(Case(RoughConductor(beckmann=True), {**GOLD, "alpha": a}) for a in (1e-3, 0.1, 0.5, 1.0)),
    Case(RoughConductor(beckmann=True, anisotropic=True), {**CHROME, "alpha_u": 0.05, "alpha_v": 0.4}),
    Case(RoughPlastic(beckmann=True), {**PAINT, "int_ior": 1.49, "alpha": 0.1}),
    Case(RoughPlastic(beckmann=True), {**DIM, "int_ior": 1.8, "alpha": 0.4}),
    Case(RoughPlastic(beckmann=True), {**DIM, "int_ior": 1.3, "alpha": 1.0}),
    Case(Plastic(), {**PAINT, "int_ior": 1.49}),
    Case(Plastic(), {**DIM, "int_ior": 1.9}),
    Case(Plastic(), {**DIM, "int_ior": 0.7}),
    Case(Plastic(nonlinear=True), {**DIM, "int_ior": 1.3}),
]

GLASS = [
    *(Case(RoughDielectric(), glass(1.5, alpha=a)) for a in (1e-3, 0.01, 0.1, 0.5, 1.0)),
    *(Case(RoughDielectric(), glass(eta, alpha=0.2)) for eta in (1 / 1.5, 1.1, 2.4)),
    Case(RoughDielectric(), glass(10.0, alpha=0.5)),
    Case(RoughDielectric(), glass(1.5, alpha=0.3, **TINTS)),
    Case(RoughDielectric(anisotropic=True), glass(1.5, alpha_u=0.05, alpha_v=0.4, **TINTS)),
    Case(RoughDielectric(anisotropic=True), glass(1 / 1.33, alpha_u=0.6, alpha_v=0.1)),
    *(Case(RoughDielectric(beckmann=True), glass(1.5, alpha=a)) for a in (0.15, 0.4, 1.0)),
    Case(RoughDielectric(beckmann=True), glass(1 / 1.5, alpha=0.4)),
    Case(RoughDielectric(beckmann=True, anisotropic=True), glass(1.5, alpha_u=0.1, alpha_v=0.5, **TINTS)),
]


def grazing(wo: Tensor, wi: Tensor) -> Tensor:
    """Mitsuba divides by the cosine to the facet and by that to the surface, each rounded in float32."""
    m = normalize(wo + wi)
    return torch.minimum(wo[2].abs(), wi[2].abs()).minimum(dot(wo, m).abs()) < 0.02


def near_total_reflection(wo: Tensor, wi: Tensor, eta: float) -> Tensor:
    """Fresnel's root of a number that is rounded at ``eta^2`` times float32's precision."""
    ahead = torch.where(wo[2] > 0, eta, 1 / eta).double()
    reflects = wo[2] * wi[2] > 0
    m = normalize(wo.double() + wi.double() * torch.where(reflects, 1.0, ahead))
    cos2 = 1 - (1 - dot(wo.double(), m) ** 2) / (ahead * ahead)
    return cos2.abs() < 1e-3 * torch.maximum(1 / (ahead * ahead), torch.ones_like(ahead))


@pytest.fixture
def unbounded(monkeypatch):
    """Mitsuba draws visible normals without a bound: with one, our densities would differ from its."""
    monkeypatch.setattr(microfacet, "BOUNDED", False)


@pytest.fixture
def their_area(monkeypatch):
    """Mitsuba's density has the approximate masking of its value, ours the exact one of what is drawn."""
    monkeypatch.setattr(beckmann, "_hidden", lambda cos, t: 1.0 / beckmann._masking_by_cos(cos, t) - cos)


def their_passed(eta: Tensor) -> Tensor:
    """Mitsuba's fits of what passes a smooth boundary (Egan and Hilgeman 1973; d'Eon and Irving 2011), off by 0.1 % at 1.5."""
    x = torch.where(eta < 1.0, eta, 1.0 / eta)
    outer = 0.919317 + x * (-3.4793 + x * (6.75335 + x * (-7.80989 + x * (4.98554 - x * 1.36881))))
    return 1.0 - torch.where(eta < 1.0, -1.4399 * x * x + 0.7099 * x + 0.6681 + 0.0636 / x, outer)


@pytest.fixture
def their_fits(monkeypatch):
    """All but the fit is compared."""
    monkeypatch.setattr("torchpt.physics.bsdfs.kinds.plastic.diffuse_transmittance", their_passed)


@pytest.mark.mitsuba
@pytest.mark.parametrize("case", ROUGH, ids=str)
def test_reflection(case, unbounded, their_fits, their_area):
    wo, wi = random_pairs(11, sharp=case.sharp)
    theirs = mitsuba_eval_pdf(case.theirs, wo, wi)
    assert_same(ours_eval_pdf(case.model, case.values, wo, wi), theirs, {"near grazing": grazing(wo, wi)})


@pytest.mark.mitsuba
@pytest.mark.parametrize("case", GLASS, ids=str)
def test_reflection_and_refraction(case, their_area):
    wo, wi = both_sides(12, case.eta, sharp=case.sharp)
    theirs = mitsuba_eval_pdf(case.theirs, wo, wi)
    through = (wo[2] * wi[2] < 0) & (theirs[1] > 0)
    assert through.sum() > 1500 and (through & (wo[2] < 0)).sum() > 500
    causes = {
        "near grazing": grazing(wo, wi),
        "near the edge of total internal reflection": near_total_reflection(wo, wi, case.eta),
    }
    assert_same(ours_eval_pdf(case.model, case.values, wo, wi), theirs, causes)


@pytest.mark.mitsuba
def test_the_judge_notices_a_difference(unbounded):
    wo, wi = random_pairs(13)
    theirs = mitsuba_eval_pdf(Case(RoughConductor(), {**GOLD, "alpha": 0.3}).theirs, wo, wi)
    ours = ours_eval_pdf(RoughConductor(), {**GOLD, "alpha": 0.302}, wo, wi)
    with pytest.raises(AssertionError, match="agree"):
        assert_same(ours, theirs)
    value, pdf = ours_eval_pdf(RoughConductor(), {**GOLD, "alpha": 0.3}, wo, wi)
    pdf[17] *= 1.1
    with pytest.raises(AssertionError, match="without a cause"):
        assert_same((value, pdf), theirs)


DELTAS = [
    Case(Conductor(), GOLD),
    Case(Conductor(), CHROME),
    *(Case(Dielectric(), glass(eta)) for eta in (1.5, 1 / 1.5, 1.1, 10.0)),
    Case(Dielectric(), glass(1.5, **TINTS)),
    Case(ThinDielectric(), glass(1.5)),
    Case(ThinDielectric(), glass(1.5, **TINTS)),
    Case(Plastic(), {**PAINT, "int_ior": 1.49}),
    Case(Plastic(nonlinear=True), {**DIM, "int_ior": 1.9}),
    Case(Null(), {}),
]


def prepared(case: Case, n: int) -> Parameters:
    rows = {
        name: torch.tensor([[x] for x in value] if isinstance(value, tuple) else [value])
        for name, value in case.values.items()
    }
    return gather(case.model.prepare(rows), torch.zeros(n, dtype=torch.int64))


@pytest.mark.mitsuba
@pytest.mark.parametrize("case", DELTAS, ids=str)
def test_deltas(case, their_fits):
    """The same number chooses the same lobe here and there; 1e-3 of the lanes may have it on the edge of two."""
    n = 2000
    g = torch.Generator().manual_seed(14)
    wo, _ = both_sides(14, 1.5, n) if case.model.transmits else random_pairs(14, n)
    u = torch.rand(3, n, generator=g)
    drawn = case.model.sample(prepared(case, n), wo, u[2], u[:2])
    bsdf = mitsuba_bsdf(case.theirs)
    mitsuba: Any = importlib.import_module("mitsuba")
    context, point = mitsuba.BSDFContext(), mitsuba.SurfaceInteraction3f()
    same = 0
    for lane in range(n):
        point.wi = wo[:, lane].tolist()
        there, weight = bsdf.sample(context, point, float(u[2, lane]), u[:2, lane].tolist())
        delta = there.sampled_type & int(mitsuba.BSDFFlags.Delta | mitsuba.BSDFFlags.Null) != 0
        assert not delta or torch.isfinite(drawn.weight[:, lane]).all()
        near = torch.allclose(drawn.weight[:, lane], torch.tensor([weight[i] for i in range(3)]), rtol=1e-3, atol=1e-5)
        if delta:
            near &= torch.allclose(drawn.wi[:, lane], torch.tensor([there.wo[i] for i in range(3)]), atol=1e-4)
        near &= bool(torch.isinf(drawn.pdf[lane])) == delta
        if drawn.eta is not None:
            near &= abs(float(drawn.eta[lane]) - there.eta) < 1e-4 * there.eta
        same += near
    assert same >= 0.999 * n


@pytest.mark.parametrize(
    ("rough", "smooth"),
    [
        (Case(RoughConductor(), {**GOLD, "alpha": 0.0}), Case(Conductor(), GOLD)),
        (
            Case(RoughConductor(anisotropic=True), {**GOLD, "alpha_u": 0.0, "alpha_v": 0.9e-4}),
            Case(Conductor(), GOLD),
        ),
        (Case(RoughDielectric(), glass(1.5, alpha=0.0)), Case(Dielectric(), glass(1.5))),
        (Case(RoughDielectric(), glass(1.00005, alpha=0.3)), Case(Dielectric(), glass(1.00005))),
    ],
    ids=str,
)
def test_a_rough_model_without_roughness_is_the_smooth_one(rough, smooth):
    n = 1000
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(15))
    wo, wi = both_sides(15, 1.5, n) if smooth.model.transmits else random_pairs(15, n)
    a = rough.model.sample(prepared(rough, n), wo, u[2], u[:2])
    b = smooth.model.sample(prepared(smooth, n), wo, u[2], u[:2])
    for x, y in ((a.wi, b.wi), (a.pdf, b.pdf), (a.weight, b.weight), (a.eta, b.eta)):
        if x is not None and y is not None:
            torch.testing.assert_close(x, y)
    value, pdf = rough.model.eval_pdf(prepared(rough, n), wo, wi)
    assert not value.any() and not pdf.any()
