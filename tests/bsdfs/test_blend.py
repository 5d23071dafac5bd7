"""Blends: against Mitsuba's, of deltas and of glass, nested, and with derivatives in the weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from few import few
from oracle import assert_same, both_sides, mitsuba_eval_pdf, random_pairs, rgb
from torch import Tensor

from torchpt.math import microfacet
from torchpt.physics.bsdfs import Bsdf, Parameters, gather
from torchpt.physics.bsdfs.kinds.blend import Blend
from torchpt.physics.bsdfs.kinds.conductor import Conductor
from torchpt.physics.bsdfs.kinds.dielectric import Dielectric
from torchpt.physics.bsdfs.kinds.diffuse import Diffuse
from torchpt.physics.bsdfs.kinds.null import Null
from torchpt.physics.bsdfs.kinds.phong import Phong
from torchpt.physics.bsdfs.kinds.principled import Principled
from torchpt.physics.bsdfs.kinds.roughconductor import RoughConductor
from torchpt.physics.bsdfs.kinds.roughdielectric import RoughDielectric

RED, BLUE = (0.8, 0.5, 0.1), (0.1, 0.2, 0.9)
GOLD = {"eta": (0.143, 0.375, 1.442), "k": (3.983, 2.386, 1.603)}
GLASS = {"int_ior": 1.5, "ext_ior": 1.0}
N = 1 << 16


def tensors(values: dict[str, Any], dtype: torch.dtype = torch.float32) -> Parameters:
    out: Parameters = {}
    for key, value in values.items():
        if isinstance(value, Tensor):
            out[key] = value
        elif isinstance(value, dict):
            out[key] = tensors(value, dtype)
        else:
            out[key] = torch.tensor(value, dtype=dtype).reshape((3, 1) if isinstance(value, tuple) else (1,))
    return out


def lanes(model: Bsdf, values: dict[str, Any], n: int, dtype: torch.dtype = torch.float32) -> Parameters:
    return gather(model.prepare(tensors(values, dtype)), torch.zeros(n, dtype=torch.int64))


def draw(model: Bsdf, values: dict[str, Any], cos: float, n: int = N, seed: int = 1):
    wo = torch.tensor([[(1 - cos * cos) ** 0.5], [0.0], [cos]]).expand(3, n)
    u = torch.rand(3, n, generator=torch.Generator().manual_seed(seed))
    return wo, model.sample(lanes(model, values, n), wo, u[2], u[:2])


MATTE = {"type": "diffuse", "reflectance": rgb(*RED)}
METAL = {
    "type": "roughconductor",
    "distribution": "ggx",
    "alpha": 0.3,
    "eta": rgb(*GOLD["eta"]),
    "k": rgb(*GOLD["k"]),
}
ROUGH_GLASS = {"type": "roughdielectric", "distribution": "ggx", "alpha": 0.3, **GLASS}


@pytest.mark.mitsuba
@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_values_and_densities_are_mitsubas(weight, monkeypatch):
    monkeypatch.setattr(microfacet, "BOUNDED", False)
    wo, wi = random_pairs(11)
    model = Blend(Diffuse(), RoughConductor())
    values = {"weight": weight, "a": {"reflectance": RED}, "b": {**GOLD, "alpha": 0.3}}
    theirs = mitsuba_eval_pdf({"type": "blendbsdf", "weight": weight, "a": MATTE, "b": METAL}, wo, wi)
    assert_same(model.eval_pdf(lanes(model, values, wo.shape[1]), wo, wi), theirs)


@pytest.mark.mitsuba
def test_nested_glass_is_mitsubas(monkeypatch):
    """What is opaque meets both sides: there, as `twosided` makes it."""
    monkeypatch.setattr(microfacet, "BOUNDED", False)
    wo, wi = both_sides(12, 1.5)
    model = Blend(Blend(Diffuse(), RoughConductor()), RoughDielectric())
    inner = {"weight": 0.4, "a": {"reflectance": RED}, "b": {**GOLD, "alpha": 0.3}}
    values = {"weight": 0.7, "a": inner, "b": {**GLASS, "alpha": 0.3}}
    blended = {"type": "blendbsdf", "weight": 0.4, "a": MATTE, "b": METAL}
    description = {"type": "blendbsdf", "weight": 0.7, "a": {"type": "twosided", "x": blended}, "b": ROUGH_GLASS}
    value, density = model.eval_pdf(lanes(model, values, wo.shape[1]), wo, wi)
    value_there, density_there = mitsuba_eval_pdf(description, wo, wi)
    # Chance of refraction is the models' own affair: only where both reflect or nothing refracts are densities the same.
    same_side = wo[2] * wi[2] > 0
    assert 0.2 < same_side.double().mean() < 0.8
    assert_same(
        (value, torch.where(same_side, density, 0.0)),
        (value_there, torch.where(same_side, density_there, 0.0)),
        {"grazing cosines": torch.minimum(wo[2].abs(), wi[2].abs()) < 1e-2},
    )


@pytest.mark.parametrize("cos", few([0.5, 1.0, -0.7], 2))
@pytest.mark.parametrize(
    ("model", "a", "b"),
    [
        (Blend(Diffuse(), Conductor(schlick=True)), {"reflectance": RED}, {"reflectance": BLUE}),
        (Blend(Dielectric(), Diffuse()), GLASS, {"reflectance": RED}),
        (Blend(Null(), Diffuse()), {}, {"reflectance": RED}),
        (Blend(Diffuse(), Null()), {"reflectance": RED}, {}),
    ],
    ids=str,
)
def test_a_blend_is_the_mean_of_its_parts(model, a, b, cos):
    """Directional albedo over many draws, and its derivative in the weight, which is that of `b` less that of `a`."""
    if cos < 0 and not model.transmits:
        pytest.skip("opaque models meet one side")
    weight = torch.tensor([0.3], requires_grad=True)
    wo, blended = draw(model, {"weight": weight, "a": a, "b": b}, cos)
    albedo = []
    for part, values in ((model.a, a), (model.b, b)):
        side = wo if part.transmits else torch.stack((wo[0], wo[1], wo[2].abs()))
        u = torch.rand(3, N, generator=torch.Generator().manual_seed(2))
        albedo.append(part.sample(lanes(part, values, N), side, u[2], u[:2]).weight.expand(3, N).mean(1))
    expected = albedo[0] + 0.3 * (albedo[1] - albedo[0])
    torch.testing.assert_close(blended.weight.mean(1).detach(), expected.detach(), rtol=0, atol=0.01)
    for channel in range(3):
        (slope,) = torch.autograd.grad(blended.weight[channel].mean(), weight, retain_graph=True)
        torch.testing.assert_close(slope[0], (albedo[1] - albedo[0])[channel].detach(), rtol=0, atol=0.02)


@pytest.mark.parametrize("weight", [0.0, 1.0])
@pytest.mark.parametrize("cos", [1.0, 0.3, -0.3, 0.0])
def test_a_weight_of_0_or_1_is_one_of_them(weight, cos):
    model = Blend(Dielectric(), Principled(transmissive=True))
    a, b = GLASS, {"base_color": RED, "roughness": 0.4, "spec_trans": 0.5}
    tensor = torch.tensor([weight], requires_grad=True)
    _, blended = draw(model, {"weight": tensor, "a": a, "b": b}, cos, 4096)
    (slope,) = torch.autograd.grad(blended.weight.sum(), tensor)
    assert torch.isfinite(slope).all()
    _, alone = draw(model.b if weight else model.a, b if weight else a, cos, 4096)
    torch.testing.assert_close(blended.pdf, alone.pdf, rtol=1e-3, atol=1e-4)
    assert alone.eta is not None and blended.eta is not None
    torch.testing.assert_close(blended.eta, alone.eta)
    drawn = alone.pdf > 0
    expected = alone.weight.expand(3, -1)[:, drawn]
    torch.testing.assert_close(blended.weight.detach()[:, drawn], expected, rtol=1e-3, atol=1e-4)


def test_eta_is_1_where_the_drawn_model_does_not_refract():
    wo, out = draw(Blend(Diffuse(), Dielectric()), {"weight": 0.5, "a": {"reflectance": RED}, "b": GLASS}, 0.8)
    refracted = out.wi[2] * wo[2] < 0
    assert out.eta is not None
    assert 0.4 < refracted.double().mean() < 0.55
    assert (out.eta[refracted] == 1.5).all() and (out.eta[~refracted] == 1.0).all()


def test_opaque_models_in_glass_meet_both_sides():
    model = Blend(Dielectric(), Phong())
    values = {"weight": 1.0, "a": GLASS, "b": {"diffuse": RED, "specular": BLUE, "exponent": 20.0}}
    wo, wi = random_pairs(13, 1000)
    flip = torch.tensor([[1.0], [1.0], [-1.0]])
    p = lanes(model, values, 1000)
    above, below = model.eval_pdf(p, wo, wi), model.eval_pdf(p, wo * flip, wi * flip)
    through = model.eval_pdf(p, wo, wi * flip)
    alone = Phong().eval_pdf(lanes(Phong(), values["b"], 1000), wo, wi)
    assert float(alone[0].min()) > 0
    for x, y, z, zero in zip(above, below, alone, through, strict=True):
        torch.testing.assert_close(x, z)
        torch.testing.assert_close(y, z)
        assert not zero.any()


def test_a_blend_is_what_its_parts_are():
    matte, mirror, glass = Diffuse(), Conductor(schlick=True), Dielectric()
    assert not Blend(matte, matte).delta and not Blend(matte, matte).transmits
    assert Blend(matte, mirror).delta and not Blend(matte, mirror).smooth
    assert Blend(mirror, glass).smooth and Blend(mirror, glass).refracts and Blend(mirror, glass).transmits
    assert Blend(matte, Null()).transmits and not Blend(matte, Null()).refracts
    assert Blend(matte, RoughConductor(anisotropic=True)).anisotropic and not Blend(matte, mirror).anisotropic
    assert not Blend(matte, Principled()).conserves and Blend(matte, mirror).conserves
    assert str(Blend(matte, mirror)) == "blend (diffuse, conductor (schlick))"
    assert Blend(matte, mirror) == Blend(Diffuse(), Conductor(schlick=True)) != Blend(mirror, matte)


def test_parts_with_tensors_of_their_own_show_them():
    @dataclass(frozen=True)
    class Learned(Diffuse):
        net: torch.nn.Module

    net = torch.nn.Linear(2, 3)
    found = list(Blend(Diffuse(), Blend(Learned(net), Diffuse())).weights())
    assert [id(t) for t in found] == [id(net.weight), id(net.bias)]
