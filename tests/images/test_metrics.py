from __future__ import annotations

import math
import sys
from importlib.util import find_spec
from typing import Any

import pytest
import torch

import torchpt
from torchpt.images.colour import linear_to_srgb, srgb_to_linear
from torchpt.images.metrics import METRICS, flip, mse, psnr, relmse, smape, ssim

RNG = torch.Generator().manual_seed(0)
REFERENCE = torch.rand((32, 40, 3), generator=RNG)
NOISE = torch.randn((32, 40, 3), generator=RNG)
HAS_FLIP = find_spec("flip_evaluator") is not None
#: What says that two pictures are the same.
SAME = {"psnr": math.inf, "ssim": 1.0}


def test_known_values() -> None:
    ref = torch.full((12, 15, 3), 0.5)
    image = ref + 0.1
    assert mse(image, ref) == pytest.approx(0.01, rel=1e-5)
    assert relmse(image, ref) == pytest.approx(0.01 / 0.26, rel=1e-5)
    assert smape(image, ref) == pytest.approx(0.1 / 1.11, rel=1e-5)
    assert psnr(image, ref) == pytest.approx(20.0, rel=1e-5)
    assert psnr(image, ref, peak=10.0) == pytest.approx(40.0, rel=1e-5)
    # Flat pictures: their means alone count, with Wang's constant (0.01 peak)^2.
    assert ssim(image, ref) == pytest.approx((2 * 0.6 * 0.5 + 1e-4) / (0.36 + 0.25 + 1e-4), rel=1e-5)


@pytest.mark.parametrize("name", METRICS)
def test_every_metric_worsens_with_noise(name: str) -> None:
    if name == "flip" and not HAS_FLIP:
        pytest.skip("flip-evaluator is not installed (extra `compare`)")
    metric = METRICS[name]
    same, little, much = (metric((REFERENCE + s * NOISE).clamp(min=0), REFERENCE) for s in (0.0, 0.05, 0.2))
    assert same == pytest.approx(SAME.get(name, 0.0), abs=1e-12)
    assert same > little > much if name in SAME else same < little < much


@pytest.mark.parametrize("name", METRICS)
def test_shapes_must_agree(name: str) -> None:
    with pytest.raises(ValueError, match="shape"):
        METRICS[name](torch.zeros(14, 15, 3), torch.zeros(15, 14, 3))


@pytest.mark.parametrize("name", METRICS)
def test_what_is_not_finite_shows(name: str) -> None:
    image = REFERENCE.clone()
    image[3, 4, 1] = math.nan
    assert math.isnan(METRICS[name](image, REFERENCE))


def test_ssim_of_black_pictures_is_one() -> None:
    assert ssim(torch.zeros(16, 16, 3), torch.zeros(16, 16, 3)) == 1.0


def test_ssim_needs_a_window() -> None:
    with pytest.raises(ValueError, match="windows of 11 pixels"):
        ssim(torch.zeros(8, 30, 3), torch.zeros(8, 30, 3))


@pytest.mark.skipif(not HAS_FLIP, reason="flip-evaluator is not installed (extra `compare`)")
def test_flip_refuses_a_black_reference_rather_than_end_the_process(capfd: Any) -> None:
    with pytest.raises(ValueError, match="black"):
        flip(REFERENCE, torch.zeros_like(REFERENCE))
    assert 0 < flip(REFERENCE, REFERENCE * 1e-3) <= 1
    half = REFERENCE.clone()
    half[:20] = 0
    assert 0 < flip(REFERENCE, half) <= 1 and flip(torch.full_like(half, 0.7), torch.full_like(half, 0.7)) == 0
    assert capfd.readouterr().out == ""


def test_flip_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(ImportError, match=r"pip install .\.\[compare\]."):
        flip(REFERENCE, REFERENCE)


def test_metrics_are_public() -> None:
    assert torchpt.metrics.METRICS is METRICS


def test_our_srgb_is_kornias() -> None:
    from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

    colours = torch.linspace(0, 1, 3 * 32 * 32, dtype=torch.float64).reshape(1, 3, 32, 32)
    assert torch.allclose(linear_to_srgb(colours), linear_rgb_to_rgb(colours), atol=1e-6)
    assert torch.allclose(srgb_to_linear(colours), rgb_to_linear_rgb(colours), atol=1e-6)
