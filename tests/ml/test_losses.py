"""Losses of noisy pictures: their values, and which gradients are without bias.

In a scene of direct light a pixel is ``c X`` of an albedo ``c`` and a random ``X`` of mean ``m`` and variance ``v``. So the
squared error of the expectation has the derivative ``2 (c m - t) m``, and that of the noisy picture ``2 v c`` more: the
derivative of the variance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt import losses
from torchpt.images import metrics

WALL = "materials.wall.reflectance"
WISHES: dict[str, Any] = {"spp": 1, "threads": 1, "sampler": "independent"}
ROOM = {
    "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 4, "height": 4, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 2, "strategy": "bsdf"},
    "materials": {"wall": {"type": "diffuse", "reflectance": 0.5}},
    "shapes": {
        "back": {"type": "rectangle", "material": "wall", "transform": [{"scale": 2}]},
        "lamp": {"type": "sphere", "center": [2, 2, 2], "radius": 1.5, "emission": 3},
    },
}
ALBEDO = 0.5


@pytest.mark.parametrize(
    ("loss", "metric"), [(losses.l2, metrics.mse), (losses.relmse, metrics.relmse), (losses.smape, metrics.smape)]
)
def test_values_are_those_of_the_metrics(loss, metric):
    a, b = torch.rand(2, 5, 4, 3, generator=torch.Generator().manual_seed(1))
    assert float(loss(a, b)) == pytest.approx(metric(a, b), rel=1e-5)
    assert float(loss(a, a)) == 0


def test_two_equal_renders_are_the_plain_losses():
    a, b = torch.rand(2, 5, 4, 3, generator=torch.Generator().manual_seed(1))
    assert float(losses.unbiased_squared_error(a, a, b)) == pytest.approx(float(losses.l2(a, b)))
    assert float(losses.unbiased_relmse(a, a, b)) == pytest.approx(float(losses.relmse(a, b)))
    assert float(losses.unbiased_relmse(a, a, b, scale=2 * b)) < float(losses.relmse(a, b))
    assert float(losses.l1(a, b)) == pytest.approx(float((a - b).abs().mean()))


def test_of_two_renders_each_has_its_share_of_the_loss():
    """The product of both differences, so that noise of either enters once and both get a gradient."""
    a, b, t = torch.rand(3, 5, 4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    b.requires_grad_()
    squared, relative = losses.unbiased_squared_error(a, b, t), losses.unbiased_relmse(a, b, t, scale=t)
    torch.testing.assert_close(squared, ((a - t) * (b - t)).mean())
    weight = 1 / (t.square() + 0.01)
    torch.testing.assert_close(relative, ((a - t) * (b - t) * weight).mean())
    (grad,) = torch.autograd.grad(relative, b)
    torch.testing.assert_close(grad, (a - t) * weight / a.numel())


def test_pictures_of_whole_numbers_are_refused():
    """Their differences would wrap around."""
    photo = torch.full((4, 4, 3), 200, dtype=torch.uint8)
    for loss in (losses.l1, losses.l2, losses.relmse, losses.smape):
        for pair in ((photo, photo), (torch.zeros(4, 4, 3), photo)):
            with pytest.raises(TypeError, match=r"^picture: expected .* floating numbers, .* got one of torch.uint8"):
                loss(*pair)


def test_pictures_of_two_shapes_are_refused():
    for loss in (losses.l1, losses.l2, losses.relmse, losses.smape):
        with pytest.raises(ValueError, match="^pictures: expected one shape, got .* and "):
            loss(torch.zeros(4, 4, 3), torch.zeros(4, 1, 3))
    for loss in (losses.unbiased_squared_error, losses.unbiased_relmse):
        with pytest.raises(ValueError, match="^pictures: expected one shape, got .* and "):
            loss(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), torch.zeros(3))


class Truth(NamedTuple):
    """Moments of ``X`` by pixel, and a target."""

    mean: Tensor
    variance: Tensor
    target: Tensor


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(ROOM, "cpu")


@pytest.fixture(scope="module")
def truth(scene) -> Truth:
    params = {WALL: torch.ones(3)}
    single = torch.stack([torchpt.render(scene, params=params, seed=9_000 + k, **WISHES) for k in range(100)])
    # One sample is black or of one brightness b, so that its second moment is m b.
    many: dict[str, Any] = {**WISHES, "spp": 16_384}
    mean = torchpt.render(scene, params=params, seed=77, **many)
    bright = single.amax(0)
    assert ((single == 0) | ((single - bright).abs() < 1e-3 * bright)).all()
    return Truth(mean, mean * (bright - mean), 0.3 * mean + 0.05)


def gradients(scene: torchpt.Scene, loss: Callable[[Callable[..., Tensor]], Tensor], count: int) -> tuple[float, float]:
    """Mean of a gradient over renders, and its standard error; seeds are told apart."""
    seeds = itertools.count(1)
    found = []
    for _ in range(count):
        leaf = torch.full((), ALBEDO, requires_grad=True)

        def draw(leaf: Tensor = leaf, **more: Any) -> Tensor:
            seed = next(seeds)
            if more.pop("shared", False):
                more["seed_grad"] = seed
            wishes: dict[str, Any] = {**WISHES, **more}
            return torchpt.render(scene, params={WALL: leaf.expand(3)}, seed=seed, **wishes)

        loss(draw).backward()
        assert leaf.grad is not None
        found.append(float(leaf.grad))
    values = torch.tensor(found, dtype=torch.float64)
    return float(values.mean()), float(values.std()) / count**0.5


def expected(truth: Truth, weight: Tensor | float = 1.0) -> tuple[float, float]:
    """The derivative of the squared error of the expectation, and what that of the variance adds to it."""
    of_mean = 2 * (ALBEDO * truth.mean - truth.target) * truth.mean * weight
    return float(of_mean.double().mean()), float((2 * ALBEDO * truth.variance * weight).double().mean())


def weight(truth: Truth) -> Tensor:
    return 1 / (truth.target.square() + 1e-2)


WAYS: dict[str, tuple[Callable[[Truth], Callable[[Any], Tensor]], bool, bool]] = {
    # name: the loss, whether it is relative, whether it is biased by the variance
    "one render": (lambda t: lambda draw: losses.l2(draw(), t.target), False, False),
    "one render, shared samples": (lambda t: lambda draw: losses.l2(draw(shared=True), t.target), False, True),
    "two renders, shared samples": (
        lambda t: lambda draw: losses.unbiased_squared_error(draw(shared=True), draw(shared=True), t.target), False, False,
    ),
    "two renders": (lambda t: lambda draw: losses.unbiased_squared_error(draw(), draw(), t.target), False, False),
    "relmse of one render": (lambda t: lambda draw: losses.relmse(draw(), t.target), True, False),
    "relmse, shared samples": (lambda t: lambda draw: losses.relmse(draw(shared=True), t.target), True, True),
    "relmse of two renders": (lambda t: lambda draw: losses.unbiased_relmse(draw(), draw(), t.target), True, False),
}  # fmt: skip


def check(scene: torchpt.Scene, truth: Truth, way: str, count: int) -> None:
    make, relative, biased = WAYS[way]
    right, added = expected(truth, weight(truth) if relative else 1.0)
    mean, error = gradients(scene, make(truth), count)
    assert abs(mean - right - (added if biased else 0.0)) < 4 * error + 1e-3 * abs(right), (mean, error, right, added)
    assert added > 10 * error  # else this could not tell them apart


@pytest.mark.parametrize("way", ["one render", "two renders, shared samples"])
@pytest.mark.slow
def test_which_gradients_are_without_bias(scene, truth, way):
    check(scene, truth, way, 40)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_which_gradients_are_without_bias_by_many_renders(scene, truth, way):
    check(scene, truth, way, 1500)


@pytest.mark.slow
def test_the_value_of_one_render_holds_its_variance_and_that_of_two_does_not(scene, truth):
    picture = ALBEDO * truth.mean
    right, variance = float((picture - truth.target).square().mean()), ALBEDO**2 * float(truth.variance.mean())
    params = {WALL: torch.full((3,), ALBEDO)}
    pairs = [[torchpt.render(scene, params=params, seed=2 * k + j, **WISHES) for j in (0, 1)] for k in range(100)]
    for values, bias in (
        (torch.stack([losses.l2(a, truth.target) for a, _ in pairs]), variance),
        (torch.stack([losses.unbiased_squared_error(a, b, truth.target) for a, b in pairs]), 0.0),
    ):
        error = float(values.std()) / len(pairs) ** 0.5
        assert abs(float(values.mean()) - right - bias) < 4 * error
        assert variance > 10 * error
