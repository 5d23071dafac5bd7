"""The principled model against Mitsuba's: values as they are, densities with Mitsuba's fixed rates of its lobes."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest
import torch
from few import few
from oracle import assert_same, both_sides, mitsuba_eval_pdf, ours_eval_pdf, random_pairs, rgb
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from torchpt.math import microfacet
from torchpt.physics.bsdfs import Parameters, gather
from torchpt.physics.bsdfs.kinds.principled import Principled
from torchpt.physics.bsdfs.principled_lobes import Facet, Probabilities

RED, WHITE = (0.8, 0.5, 0.1), (1.0, 1.0, 1.0)

SETS: list[dict[str, Any]] = [
    {"base_color": RED, "roughness": 0.5},
    {"base_color": WHITE, "roughness": 1.0},
    {"base_color": RED, "roughness": 0.0, "specular": 0.8},
    {"base_color": RED, "roughness": 0.4, "specular": 0.2, "metallic": 0.7},
    {"base_color": RED, "roughness": 0.3, "metallic": 1.0},
    {"base_color": RED, "roughness": 0.3, "metallic": 1.0, "specular": 0.0},
    {"base_color": RED, "roughness": 0.5, "eta": 1.8, "spec_tint": 0.7},
    {"base_color": RED, "roughness": 0.6, "sheen": 0.8},
    {"base_color": RED, "roughness": 0.6, "sheen": 0.8, "sheen_tint": 0.5},
    {"base_color": RED, "roughness": 0.5, "clearcoat": 0.9, "clearcoat_gloss": 0.3},
    {"base_color": RED, "roughness": 0.5, "flatness": 0.6},
    {"base_color": RED, "roughness": 0.4, "anisotropic": 0.8, "metallic": 0.5},
    {"base_color": RED, "roughness": 1.0, "anisotropic": 1.0, "metallic": 1.0},
    {"base_color": RED, "roughness": 1.0, "anisotropic": 1.0, "spec_trans": 0.7, "eta": 1.5},
    {"base_color": RED, "roughness": 0.5, "eta": 0.7, "spec_tint": 0.5, "metallic": 0.3, "clearcoat": 0.5},
    {"base_color": RED, "roughness": 0.2, "spec_trans": 1.0, "eta": 1.5},
    {"base_color": RED, "roughness": 0.5, "spec_trans": 0.6, "eta": 1.33, "metallic": 0.2},
    {"base_color": RED, "roughness": 0.4, "spec_trans": 0.9, "eta": 0.7},
    {"base_color": RED, "roughness": 0.3, "spec_trans": 0.9, "specular": 0.0},
    {
        "base_color": RED,
        "roughness": 0.5,
        "specular": 0.6,
        "metallic": 0.2,
        "spec_tint": 0.3,
        "anisotropic": 0.7,
        "sheen": 0.5,
        "sheen_tint": 0.4,
        "clearcoat": 0.6,
        "clearcoat_gloss": 0.2,
        "flatness": 0.5,
        "spec_trans": 0.6,
    },
]


def model_of(values: dict[str, Any]) -> Principled:
    return Principled(transmissive="spec_trans" in values, anisotropic="anisotropic" in values)


def fixed_rates(
    self: Principled, parameters: Parameters, wo: Tensor, facet: Facet, front: Tensor | None = None
) -> Probabilities:
    """Return how Mitsuba chooses a lobe: by the parameters, and by Fresnel's reflectance where the main lobes share."""
    none = torch.zeros_like(wo[2])
    metallic, through = (parameters.get(name) for name in ("metallic", "spec_trans"))
    metallic, through = none if metallic is None else metallic, none if through is None else through
    outside = none + 1 if front is None else front
    f = facet.interface.reflectance
    bsdf = (1 - metallic) * through
    diffuse = outside * (1 - metallic) * (1 - through)
    coat = None if parameters["clearcoat"] is None else 0.25 * parameters["clearcoat"] * outside
    reflect = torch.where(outside > 0, 1 - bsdf * (1 - f), f)
    refract = torch.where(outside > 0, bsdf * (1 - f), 1 - f)
    total = diffuse + reflect + refract + (none if coat is None else coat)
    return Probabilities(
        diffuse / total,
        None if coat is None else coat / total,
        reflect / total,
        None if facet.refracted is None else refract / total,
    )


def pairs_for(values: dict[str, Any], seed: int) -> tuple[Tensor, Tensor]:
    if "spec_trans" not in values:
        return random_pairs(seed)
    specular = max(values.get("specular", 0.5), 1e-3)
    return both_sides(seed, values.get("eta", 2 / (1 - math.sqrt(0.08 * specular)) - 1))


def causes(wo: Tensor, wi: Tensor, gloss: float) -> dict[str, Tensor]:
    """Return where Mitsuba's float32 loses digits, and ours does not: see the test below."""
    grazing = torch.minimum(wo[2].abs(), wi[2].abs()) < 1e-2
    h = wo + wi
    off = (h[0] ** 2 + h[1] ** 2) / (h**2).sum(0)
    # 1 + (alpha^2 - 1) cos^2 is the difference of what is rounded at 6e-8.
    return {"grazing cosines": grazing, "the coat's peak": (off < 1e-3) & (gloss > 0.9)}


@pytest.mark.mitsuba
@pytest.mark.parametrize("values", SETS, ids=lambda v: " ".join(v))
def test_values_and_densities_are_mitsubas(values, monkeypatch):
    monkeypatch.setattr(Principled, "probabilities", fixed_rates)
    monkeypatch.setattr(microfacet, "BOUNDED", False)
    wo, wi = pairs_for(values, seed=len(str(values)))
    theirs = mitsuba_eval_pdf({"type": "principled", **described(values)}, wo, wi)
    ours = ours_eval_pdf(model_of(values), values, wo, wi)
    met = (theirs[1] > 0).double().mean()
    assert met > (0.4 if "spec_trans" in values else 0.99), "these pairs prove nothing"
    assert_same(ours, theirs, causes(wo, wi, values.get("clearcoat_gloss", 0.0)))


def described(values: dict[str, Any]) -> dict[str, Any]:
    return {key: rgb(*value) if isinstance(value, tuple) else value for key, value in values.items()}


@pytest.mark.mitsuba
def test_the_glossiest_coat_is_mitsubas_but_for_its_rounding(monkeypatch):
    """At gloss 1 the coat's alpha is 0.001, and Mitsuba's bracket rounds; float64 takes our side."""
    monkeypatch.setattr(Principled, "probabilities", fixed_rates)
    monkeypatch.setattr(microfacet, "BOUNDED", False)
    values = {"base_color": RED, "roughness": 0.5, "clearcoat": 0.9, "clearcoat_gloss": 1.0}
    wo, wi = random_pairs(3)
    theirs = mitsuba_eval_pdf({"type": "principled", **described(values)}, wo, wi)
    ours = ours_eval_pdf(Principled(), values, wo, wi)
    assert assert_same(ours, theirs, causes(wo, wi, 1.0), fraction=0.99)
    exact = exactly(Principled(), values, wo, wi)
    assert_same(ours, exact, fraction=1.0)


def exactly(model: Principled, values: dict[str, Any], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
    """In float64."""
    rows = {
        key: torch.tensor(value, dtype=torch.float64).reshape(-1, 1)
        if isinstance(value, tuple)
        else torch.tensor([value], dtype=torch.float64)
        for key, value in values.items()
    }
    lanes = gather(model.prepare(rows), torch.zeros(wo.shape[1], dtype=torch.int64))
    return model.eval_pdf(lanes, wo.double(), wi.double())


def hemisphere(n: int = 400) -> tuple[Tensor, Tensor]:
    """Directions ``(3, M)`` and their weights: midpoints in the azimuth, and in the cosine squared toward grazing."""
    z = ((torch.arange(n, dtype=torch.float64) + 0.5) / n) ** 2
    wz = 2 * z.sqrt() / n
    phi = (torch.arange(2 * n, dtype=torch.float64) + 0.5) * (math.pi / n)
    z, phi = z.repeat_interleave(2 * n), phi.repeat(n)
    r = (1 - z * z).sqrt()
    return torch.stack((r * phi.cos(), r * phi.sin(), z)), wz.repeat_interleave(2 * n) * (math.pi / n)


@pytest.mark.parametrize(("angle", "albedo"), few([(0, 1.05), (60, 1.08), (80, 1.31), (88, 1.54)], 2))
def test_rough_white_has_its_known_albedo(angle, albedo):
    wi, weight = hemisphere()
    a = math.radians(angle)
    wo = torch.tensor([[math.sin(a)], [0.0], [math.cos(a)]], dtype=torch.float64).expand_as(wi)
    value, _ = exactly(Principled(), {"base_color": WHITE, "roughness": 1.0}, wo, wi)
    assert float((value[0] * weight).sum()) == pytest.approx(albedo, abs=5.1e-3)


@pytest.mark.parametrize("transmissive", [False, True])
@pytest.mark.parametrize("anisotropic", [False, True])
def test_an_absent_feature_is_a_feature_of_amount_0(transmissive, anisotropic):
    """Stacked beside a material that has it, an absent one becomes 0: that may change nothing."""
    model = Principled(transmissive, anisotropic)
    base: dict[str, Any] = {"base_color": RED, "roughness": 0.4}
    names = ("metallic", "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness")
    wo, wi = both_sides(5, 1.5, 1000) if transmissive else random_pairs(5, 1000)
    bare = ours_eval_pdf(model, base, wo, wi)
    zeros = ours_eval_pdf(model, {**base, **dict.fromkeys(names, 0.0), "anisotropic": 0.0, "spec_trans": 0.0}, wo, wi)
    for a, b in zip(bare, zeros, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)


class Counted(TorchDispatchMode):
    """Counts operations by name."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.found[str(func)] += 1
        return func(*args, **(kwargs or {}))


def test_an_absent_feature_costs_nothing():
    base: dict[str, Any] = {"base_color": RED, "roughness": 0.4}
    wo, wi = random_pairs(6, 100)
    counts = {}
    for name in ("", "metallic", "spec_tint", "sheen", "clearcoat", "flatness"):
        with Counted() as counted:
            ours_eval_pdf(Principled(), {**base, name: 0.5} if name else base, wo, wi)
        counts[name] = counted.found
    total = {name: found.total() for name, found in counts.items()}
    assert all(total[name] > total[""] for name in total if name), total
    assert "aten.log.default" in counts["clearcoat"] and "aten.log.default" not in counts[""]


CHOSEN: list[dict[str, Any]] = [
    {"base_color": RED, "roughness": 0.5},
    {"base_color": (0.1, 0.1, 0.1), "roughness": 0.2},
    {"base_color": WHITE, "roughness": 0.3, "clearcoat": 1.0, "clearcoat_gloss": 0.8},
    {"base_color": RED, "roughness": 0.3, "metallic": 0.3},
    {"base_color": WHITE, "roughness": 0.2, "spec_trans": 0.5},
]


@pytest.mark.parametrize("values", CHOSEN, ids=lambda v: " ".join(f"{key} {value}" for key, value in v.items()))
def test_lobes_by_expected_contribution_beat_fixed_rates(values, monkeypatch):
    """Variance of the estimated albedo, over all angles from above."""
    n, model = 1 << 16, model_of(values)
    g = torch.Generator().manual_seed(8)
    z, u = torch.rand(n, generator=g), torch.rand(3, n, generator=g)
    wo = torch.stack(((1 - z * z).sqrt(), torch.zeros(n), z))
    rows = {k: torch.tensor(v).reshape(-1, 1) if isinstance(v, tuple) else torch.tensor([v]) for k, v in values.items()}
    lanes = gather(model.prepare(rows), torch.zeros(n, dtype=torch.int64))
    ours = model.sample(lanes, wo, u[2], u[:2]).weight
    monkeypatch.setattr(Principled, "probabilities", fixed_rates)
    theirs = model.sample(lanes, wo, u[2], u[:2]).weight
    error = ((ours.var(1) + theirs.var(1)) / n).sqrt()
    assert ((ours.mean(1) - theirs.mean(1)).abs() < 5 * error).all()
    mean = ours.mean(1)
    assert (ours - mean[:, None]).square().mean() < 0.8 * (theirs - mean[:, None]).square().mean()


def test_probabilities_add_up_to_1(monkeypatch):
    """Also inside; where nothing is reflected or let through, to 0."""
    honest, seen = Principled.probabilities, []

    def spied(*args, **kwargs):
        seen.append(honest(*args, **kwargs))
        return seen[-1]

    monkeypatch.setattr(Principled, "probabilities", spied)
    for values in SETS:
        ours_eval_pdf(model_of(values), values, *pairs_for(values, 9))
        total = torch.stack([p for p in seen.pop() if p is not None]).sum(0)
        torch.testing.assert_close(total, torch.ones_like(total))
    black = {"base_color": (0.0, 0.0, 0.0), "roughness": 0.5, "eta": 1.5, "spec_trans": 0.7, "metallic": 1.0}
    wo, wi = both_sides(9, 1.5)
    ours_eval_pdf(model_of(black), black, wo, wi)
    total = torch.stack([p for p in seen.pop() if p is not None]).sum(0)
    assert not total[wo[2] < 0].any() and total[wo[2] > 0].all()
