"""``torchpt.gradient``: means, standard errors, robust means, what is refused."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.rendering import estimates

FLOOR = "materials.floor.reflectance"
SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 3], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 8, "height": 8, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 3},
    "materials": {"floor": {"type": "diffuse", "reflectance": [0.5, 0.4, 0.3]}},
    "shapes": {
        "plate": {"type": "rectangle", "material": "floor", "transform": [{"scale": 2}]},
        "side": {
            "type": "rectangle",
            "material": "floor",
            "transform": [{"rotate": {"axis": [0, 1, 0], "angle": 90}}, {"translate": [-1, 0, 1]}],
        },
        "lamp": {
            "type": "rectangle",
            "emission": [8, 8, 8],
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 180}}, {"scale": 0.3}, {"translate": [0.8, 0, 2]}],
        },
    },
}


def scene() -> torchpt.Scene:
    return torchpt.load(SCENE, "cpu")


def test_standard_errors_are_those_of_seeds():
    """Over many seeds the spread of the mean is the standard error that each call says."""
    loaded, found, said = scene(), list[Tensor](), list[Tensor]()
    cotangent = torch.full((8, 8, 3), 1.0 / 192)
    for seed in range(10):
        estimate = torchpt.gradient(loaded, cotangent, [FLOOR], spp=4, passes=4, seed=seed, threads=1)
        assert estimate.loss is None and (estimate.passes, estimate.spp, estimate.not_finite) == (4, 1, 0)
        found.append(estimate.gradients[FLOOR].double())
        said.append(estimate.standard_errors[FLOOR].double())
    spread, expected = torch.stack(found).std(0), torch.stack(said).square().mean(0).sqrt()
    assert ((spread / expected > 0.4) & (spread / expected < 1.9)).all()  # 10 seeds know a spread to 24 %


def test_standard_errors_know_the_noise_of_the_picture():
    """Near the minimum of a squared error almost all of the spread comes from the picture that it is taken of."""
    loaded = scene()
    target = torchpt.render(loaded, spp=512, seed=99, threads=1)
    found, said = list[Tensor](), list[Tensor]()
    for seed in range(12):
        estimate = torchpt.gradient(
            loaded, lambda picture: (picture - target).square().mean(), [FLOOR], spp=8, passes=4, seed=seed, threads=1
        )
        found.append(estimate.gradients[FLOOR].double())
        said.append(estimate.standard_errors[FLOOR].double())
    spread, expected = torch.stack(found).std(0), torch.stack(said).square().mean(0).sqrt()
    assert ((spread / expected > 0.4) & (spread / expected < 1.9)).all()  # 12 seeds know a spread to 21 %


def test_linear_losses_take_no_more_passes(monkeypatch: pytest.MonkeyPatch):
    calls = list[dict[str, Any]]()

    def counted(*given: Any, **wish: Any) -> Tensor:
        calls.append(wish)
        return torchpt.render(*given, **wish)

    monkeypatch.setattr(estimates, "render", counted)
    loaded, count = scene(), {}
    for name, loss in {"linear": lambda p: p.mean(), "square": lambda p: p.square().mean()}.items():
        calls.clear()
        torchpt.gradient(loaded, loss, [FLOOR], spp=4, passes=4, threads=1)
        count[name] = len(calls)
        seeds = [wish.get("seed_grad", wish["seed"]) for wish in calls]
        assert len(set(seeds)) == len(seeds)  # independent of each other
    assert count == {"linear": 1 + 1 + 4, "square": 1 + 4 + 4 + 2}


def test_the_mean_is_renders_gradient():
    loaded = scene()
    estimate = torchpt.gradient(loaded, lambda picture: picture.square().mean(), [FLOOR], spp=64, threads=1)
    leaf = loaded.params[FLOOR].clone().requires_grad_()
    picture = torchpt.render(loaded, params={FLOOR: leaf}, spp=64, spp_grad=1024, threads=1)
    loss = picture.square().mean()
    loss.backward()
    assert leaf.grad is not None
    assert estimate.loss == pytest.approx(float(loss.detach()), rel=1e-5)
    assert ((estimate.gradients[FLOOR] - leaf.grad).abs() < 5 * estimate.standard_errors[FLOOR]).all()
    assert 0 < estimate.relative_error() < 0.05


def test_values_and_the_same_seed():
    loaded, value = scene(), [0.2, 0.6, 0.1]
    calls = [
        torchpt.gradient(loaded, torch.ones(8, 8, 3), {FLOOR: value}, spp=2, passes=2, seed=3, threads=1)
        for _ in range(2)
    ]
    assert torch.equal(calls[0].gradients[FLOOR], calls[1].gradients[FLOOR])


def passes(monkeypatch: pytest.MonkeyPatch, values: list[list[float]], **wish: Any) -> torchpt.GradientEstimate:
    """Combine passes whose gradients are given."""
    each = iter(values)

    def render(_: Any, *, params: dict[str, Tensor], **__: Any) -> Tensor:
        return (params["x"] * torch.tensor(next(each))).sum().expand(1, 1, 3) / 3

    monkeypatch.setattr(estimates, "render", render)
    value = {"x": torch.zeros(2)}
    return estimates.gradient(None, torch.ones(1, 1, 3), value, passes=len(values), **wish)  # pyright: ignore[reportArgumentType]


def test_robust_means(monkeypatch: pytest.MonkeyPatch):
    values = [[1.0, 2.0], [1.2, 2.0], [0.8, 2.0], [100.0, -100.0]]
    assert passes(monkeypatch, values).gradients["x"].tolist() == pytest.approx([25.75, -23.5])
    median = passes(monkeypatch, values, combine="median")
    assert median.gradients["x"].tolist() == pytest.approx([1.1, 2.0])
    clipped = passes(monkeypatch, values, grad_clip=2.0)
    assert clipped.clipped == 1 and clipped.gradients["x"].norm() < 3
    rare = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [100.0, 0.0]]
    assert passes(monkeypatch, rare, grad_clip=2.0).gradients["x"].tolist() == [25.0, 0.0]
    broken = passes(monkeypatch, [*values[:3], [float("nan"), 0.0]])
    assert broken.not_finite == 1 and broken.gradients["x"].tolist() == pytest.approx([1.0, 2.0])


@pytest.mark.parametrize(
    ("wish", "named"),
    [
        ({"passes": 1}, "passes"),
        ({"spp": 0}, "spp"),
        ({"combine": "mode"}, "combine"),
        ({"grad_clip": 0}, "grad_clip"),
        ({"params": ["materials.none.reflectance"]}, "materials.none.reflectance"),
        ({"params": []}, "params"),
        ({"loss": torch.ones(4, 4, 3)}, "loss"),
        ({"loss": lambda picture: picture}, r"loss: .* got 'a tensor of shape \(8, 8, 3\)'"),
        ({"loss": lambda picture: torch.ones(())}, "loss: .* got 'a tensor that does not depend on the picture'"),
        ({"loss": lambda picture: torch.ones((), requires_grad=True) * 2}, "loss: .* does not depend on the picture"),
        ({"loss": 3}, "loss"),
        ({"grad_clip": "3"}, "grad_clip"),
    ],
    ids=[
        *("passes", "spp", "combine", "clip", "name", "none", "shape", "no number"),
        *("constant", "other leaf", "no function", "clip as text"),
    ],
)
def test_what_it_refuses(wish: dict[str, Any], named: str):
    given = {"loss": torch.ones(8, 8, 3), "params": [FLOOR], "spp": 2, "passes": 2, **wish}
    with pytest.raises(SceneError, match=named):
        torchpt.gradient(scene(), **given)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_modes_without_gradients_change_nothing(mode: Any):
    given = {"loss": lambda picture: picture.mean(), "params": [FLOOR], "spp": 2, "passes": 2}
    expected = torchpt.gradient(scene(), **given).gradients[FLOOR]
    with mode():
        found = torchpt.gradient(scene(), **given)
    assert torch.equal(found.gradients[FLOOR], expected) and not found.gradients[FLOOR].is_inference()


def test_one_name_and_patterns():
    given = scene()
    for names in (FLOOR, "*.reflectance", [FLOOR, "materials.*"]):
        found = torchpt.gradient(given, torch.ones(8, 8, 3), names, spp=2, passes=2)
        assert next(iter(found.gradients)) == FLOOR
    with pytest.raises(SceneError, match=r"^params: expected a parameter of this scene or a pattern of some"):
        torchpt.gradient(given, torch.ones(8, 8, 3), "lights.none.*")


def test_options_that_passes_set_themselves():
    with pytest.raises(TypeError, match="spp_grad"):
        torchpt.gradient(scene(), torch.ones(8, 8, 3), [FLOOR], spp_grad=3)
    with pytest.raises(TypeError, match="full"):
        torchpt.gradient(scene(), torch.ones(8, 8, 3), [FLOOR], full=True)
