"""Models that a user writes and hands to ``torchpt.load``: pictures, gradients to their weights, errors."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from trials import film_of, shoot

import torchpt
from torchpt.core.errors import SceneError
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs import Parameters
from torchpt.physics.bsdfs.records import BsdfSample


class Neural(torchpt.Bsdf):
    """Reflectance from a small network of the angles; sampled by the cosine."""

    name = "neural"
    parameters = {"tint": (1.0, 1.0, 1.0)}  # noqa: RUF012

    def __init__(self) -> None:
        self.net = nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, 3), nn.Sigmoid())

    def eval(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        angles = torch.stack((wo[2], wi[2], (wo + wi)[2]), 1).to(next(self.net.parameters()).dtype)
        colour = self.net(angles).T.to(wi.dtype) * parameters["tint"]
        return colour * self.pdf(parameters, wo, wi)

    def pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
        return wi[2].clamp_min(0.0) / math.pi

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        pdf = self.pdf(parameters, wo, wi)
        value = self.eval(parameters, wo, wi)
        return BsdfSample(wi, pdf, value / torch.where(pdf > 0, pdf, 1.0))

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["tint"]


class Lambert(torchpt.Bsdf):
    """Diffuse again, written by a user, in one scale factor that is a trainable tensor of its own."""

    name = "lambert"
    parameters = {"level": 0.5}  # noqa: RUF012

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = torch.tensor(gain, requires_grad=True)

    def weights(self):
        yield self.gain

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / math.pi
        return (parameters["level"] * self.gain * pdf).expand(3, -1), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        return BsdfSample(wi, wi[2] / math.pi, (parameters["level"] * self.gain).expand(3, wi.shape[1]))

    def albedo(self, parameters: Parameters) -> Tensor:
        return parameters["level"].expand(3, -1)


def room(material: dict[str, Any]) -> dict[str, Any]:
    return {
        "camera": {"origin": [0, 1, 4], "target": [0, 0.5, 0], "fov": 40},
        "materials": {"mine": material, "white": {"type": "diffuse", "reflectance": 0.7}},
        "shapes": {
            "floor": {
                "type": "rectangle",
                "material": "white",
                "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
            },
            "ball": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.6, "material": "mine"},
            "lamp": {"type": "sphere", "center": [1, 3, 1], "radius": 0.4, "emission": 12},
        },
        "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100},
    }


def test_a_users_model_renders_as_the_built_in_one():
    own = torchpt.load(room({"type": "lambert", "level": 0.6}), "cpu", bsdfs={"lambert": Lambert()})
    built_in = torchpt.load(room({"type": "diffuse", "reflectance": 0.6}), "cpu")
    a, b = (shoot(scene, 4, film=film_of(32)).image for scene in (own, built_in))
    torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_gradients_reach_the_weights_of_a_module():
    torch.manual_seed(0)
    model = Neural()
    scene = torchpt.load(room({"type": "neural", "tint": [1, 0.8, 0.6]}), "cpu", bsdfs={"neural": model})
    wish: dict[str, Any] = {"film": {**film_of(8), "filter": "box"}, "spp": 8}
    parameters = list(model.net.parameters())
    loss = torchpt.render(scene, seed=1, seed_grad=1, **wish).square().mean()
    loss.backward()
    direction = [torch.randn_like(p) for p in parameters]
    slope = 0.0
    for p, d in zip(parameters, direction, strict=True):
        assert p.grad is not None and bool(torch.isfinite(p.grad).all()) and bool((p.grad != 0).any())
        slope += float((p.grad * d).sum())
    # The same samples again: the estimator itself is differentiated, but for MIS weights, which do not depend on it here.
    step, found = 1e-2, []
    for sign in (1, -1):
        with torch.no_grad():
            for p, d in zip(parameters, direction, strict=True):
                p.add_(d, alpha=sign * step)
            found.append(float(torchpt.render(scene, seed=1, **wish).square().mean()))
            for p, d in zip(parameters, direction, strict=True):
                p.sub_(d, alpha=sign * step)
    assert slope == pytest.approx((found[0] - found[1]) / (2 * step), rel=0.02)


def test_gradients_of_parameters_and_weights_together():
    model = Lambert(0.9)
    scene = torchpt.load(room({"type": "lambert", "level": 0.6}), "cpu", bsdfs={"lambert": model})
    level = torch.tensor(0.6, requires_grad=True)
    wish: dict[str, Any] = {"film": {**film_of(8), "filter": "box"}, "spp": 4, "seed": 3, "seed_grad": 3}
    torchpt.render(scene, params={"materials.mine.level": level}, **wish).mean().backward()
    assert level.grad is not None and model.gain.grad is not None
    # Only their product counts.
    assert float(level.grad) * 0.6 == pytest.approx(float(model.gain.grad) * 0.9, rel=1e-4)
    model.gain.requires_grad_(False)
    assert not torchpt.render(scene, **wish).requires_grad


def test_a_model_that_is_no_model():
    with pytest.raises(SceneError, match="bsdfs.mine"):
        torchpt.load(room({"type": "mine"}), "cpu", bsdfs={"mine": Neural})  # type: ignore[dict-item]
    with pytest.raises(SceneError, match="diffuse"):
        torchpt.load(room({"type": "diffuse"}), "cpu", bsdfs={"diffuse": Lambert()})
    with pytest.raises(TypeError, match="eval_pdf"):

        class Empty(torchpt.Bsdf):
            pass
