from __future__ import annotations

import pytest
import torch

from torchpt.core.errors import SceneError
from torchpt.images.colour import TONEMAPS, display, linear_to_srgb, srgb_to_linear


def test_srgb_at_known_values() -> None:
    linear = torch.tensor([0.0, 0.0031308, 0.18, 0.5, 1.0], dtype=torch.float64)
    encoded = torch.tensor([0.0, 0.04044994, 0.46135613, 0.73535698, 1.0], dtype=torch.float64)
    assert torch.allclose(linear_to_srgb(linear), encoded, atol=1e-7)
    assert torch.allclose(srgb_to_linear(encoded), linear, atol=1e-7)
    assert linear_to_srgb(torch.tensor(-1.0)) == 0


def test_srgb_keeps_all_bytes_and_gradients() -> None:
    levels = torch.arange(256) / 255
    assert torch.equal((linear_to_srgb(srgb_to_linear(levels)) * 255).round(), torch.arange(256.0))
    x = torch.tensor([0.0, 1e-4, 0.5], requires_grad=True)
    linear_to_srgb(x).sum().backward()
    assert x.grad is not None and torch.isfinite(x.grad).all()


@pytest.mark.parametrize("name", list(TONEMAPS))
def test_curves_rise_from_black_and_stay_in_range(name: str) -> None:
    x = torch.cat([torch.zeros(1), torch.logspace(-4, 30, 200)])
    y = display(x, tonemap=name, gamma=1.0)
    assert y[0] == 0 and (y.diff() >= -1e-6).all() and y.max() <= 1 and y.min() >= 0
    assert y[-1] > 0.99


def test_curves_at_known_values() -> None:
    one = torch.ones(1)
    assert display(one, tonemap="reinhard", gamma=1.0).item() == pytest.approx(0.5)
    assert display(one, tonemap="aces", gamma=1.0).item() == pytest.approx(2.54 / 3.16, rel=1e-6)
    assert display(one * 11.2 / 2, tonemap="filmic", gamma=1.0).item() == pytest.approx(1.0, rel=1e-6)


def test_exposure_in_stops_and_gamma_as_exponent() -> None:
    assert display(torch.tensor(0.1), exposure=2, gamma=1.0).item() == pytest.approx(0.4)
    assert display(torch.tensor(0.25), gamma=0.5).item() == pytest.approx(0.5)
    assert display(torch.tensor(0.25), gamma=0.6).item() == pytest.approx(0.25**0.6)


@pytest.mark.parametrize("name", list(TONEMAPS))
def test_nothing_odd_reaches_the_screen(name: str) -> None:
    odd = torch.tensor([float("nan"), float("inf"), -float("inf"), -1.0, 3e38])
    shown = display(odd, exposure=20, tonemap=name)
    assert torch.allclose(shown, torch.tensor([0.0, 1.0, 0.0, 0.0, 1.0]), atol=1e-2)


def test_unknown_names() -> None:
    with pytest.raises(SceneError, match=r"film.tonemap: expected one of none, reinhard, aces, filmic, got 'x'"):
        display(torch.ones(3), tonemap="x")
    for gamma in ("rec709", 0.0, -1.0):
        with pytest.raises(SceneError, match="film.gamma"):
            display(torch.ones(3), gamma=gamma)
