from __future__ import annotations

import math

import pytest
import torch

from torchpt.images.metrics import mse, psnr, relmse, ssim


def test_known_values() -> None:
    ref = torch.full((4, 5, 3), 0.5)
    image = ref + 0.1
    assert mse(image, ref) == pytest.approx(0.01, rel=1e-5)
    assert relmse(image, ref) == pytest.approx(0.01 / 0.26, rel=1e-5)
    assert psnr(image, ref) == pytest.approx(20.0, rel=1e-5)
    assert mse(ref, ref) == 0 and psnr(ref, ref) == math.inf


def test_ssim_falls_with_noise() -> None:
    rng = torch.Generator().manual_seed(0)
    ref = torch.rand((32, 32, 3), generator=rng)
    noise = torch.randn((32, 32, 3), generator=rng)
    values = [ssim(ref + s * noise, ref) for s in (0.0, 0.05, 0.2)]
    assert values[0] == pytest.approx(1.0) and values[0] > values[1] > values[2]


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="shape"):
        mse(torch.zeros(4, 5, 3), torch.zeros(5, 4, 3))
