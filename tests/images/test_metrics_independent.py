"""Measures and maps against other people's programs and against cases counted by hand."""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
import torch
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity
from torch import Tensor

from torchpt.images.metrics import MAPS, METRICS, error_map, flip, mse, psnr, relmse, relmse_trimmed, smape, ssim

HAS_FLIP = find_spec("flip_evaluator") is not None
needs_flip = pytest.mark.skipif(not HAS_FLIP, reason="flip-evaluator is not installed (extra `compare`)")
#: What a map of a measure is made into, to be the measure.
INNER = {"ssim": lambda errors: 1.0 - errors[5:-5, 5:-5].mean()}


def pictures(seed: int, high: int = 40, wide: int = 56) -> tuple[Tensor, Tensor]:
    """Display values: smooth colours, and the same with noise."""
    draw = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(0, 1, high), torch.linspace(0, 1, wide), indexing="ij")
    reference = torch.stack([x, y, 0.5 + 0.5 * torch.sin(9 * x * y)], dim=-1) * 0.8 + 0.1
    image = (reference + 0.1 * torch.randn(reference.shape, generator=draw)).clamp(0, 1)
    return image, reference


@pytest.mark.parametrize("seed", range(3))
def test_mse_psnr_and_ssim_are_those_of_scikit_image(seed: int) -> None:
    image, reference = pictures(seed)
    x, ref = image.double().numpy(), reference.double().numpy()
    assert mse(image, reference) == pytest.approx(mean_squared_error(x, ref), rel=1e-12)
    assert psnr(image, reference) == pytest.approx(peak_signal_noise_ratio(ref, x, data_range=1), rel=1e-9)
    options = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "channel_axis": 2,
        "data_range": 1.0,
    }
    found: Any = structural_similarity(ref, x, full=True, **options)  # Wang's own settings; 11 pixels wide
    mean, full = found
    assert ssim(image, reference) == pytest.approx(mean, rel=1e-9)
    ours = 1.0 - error_map("ssim", image, reference).numpy()
    assert np.allclose(ours[5:-5, 5:-5], full.mean(2)[5:-5, 5:-5], rtol=0, atol=1e-9)


@needs_flip
@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_flip_is_its_authors(scale: float) -> None:
    import flip_evaluator

    image, reference = (scale * picture for picture in pictures(1))
    errors, mean, _ = flip_evaluator.evaluate(reference.numpy(), image.numpy(), "HDR", applyMagma=False)
    assert 0 < flip(image, reference) == pytest.approx(mean, rel=1e-6)
    assert np.array_equal(error_map("flip", image, reference).float().numpy(), errors[..., 0])


def test_two_pixels_by_hand() -> None:
    reference = torch.tensor([[[1.0, 0.0, 0.3], [2.0, 2.0, 2.0]]])
    image = torch.tensor([[[1.5, 0.1, 0.3], [1.0, 2.0, 4.0]]])
    first = (0.25 / 1.01 + 0.01 / 0.01 + 0) / 3
    second = (1 / 4.01 + 0 + 4 / 4.01) / 3
    assert relmse(image, reference) == pytest.approx((first + second) / 2, rel=1e-6)
    assert error_map("relmse", image, reference).flatten().tolist() == pytest.approx([first, second], rel=1e-6)
    assert mse(image, reference) == pytest.approx((0.25 + 0.01 + 1 + 4) / 6, rel=1e-6)
    assert error_map("mse", image, reference).flatten().tolist() == pytest.approx([0.26 / 3, 5 / 3], rel=1e-6)
    one, two = (0.5 / 2.51 + 0.1 / 0.11) / 3, (1 / 3.01 + 2 / 6.01) / 3
    assert smape(image, reference) == pytest.approx((one + two) / 2, rel=1e-6)
    assert error_map("smape", image, reference).flatten().tolist() == pytest.approx([one, two], rel=1e-6)


def test_trimming_leaves_out_as_many_pixels_as_it_says() -> None:
    reference = torch.zeros(40, 50, 3)  # a thousandth of 2,000 pixels: two
    image = torch.full_like(reference, 0.1)  # relative error 1 everywhere
    image[3, 7] = 1e3
    image[30, 2, 1] = 1e18  # one channel is enough
    assert relmse_trimmed(image, reference) == pytest.approx(1.0, rel=1e-6)
    assert relmse(image, reference) > 1e30
    image[9, 9] = 0.3  # a third: relative error 9
    assert relmse_trimmed(image, reference) == pytest.approx((1997 + 9) / 1998, rel=1e-6)
    assert relmse_trimmed(image, reference, share=0.0) == pytest.approx(relmse(image, reference), rel=1e-12)
    assert relmse_trimmed(image, reference, share=0.0015) == pytest.approx(1.0, rel=1e-6)
    few = image[:10, :50]  # 500 pixels: none is left out
    assert relmse_trimmed(few, reference[:10]) == pytest.approx(relmse(few, reference[:10]), rel=1e-12)


@pytest.mark.parametrize("pixels", [1000, 3000, 7000, 9000, 13000])
def test_a_thousandth_of_thousands_is_whole(pixels: int) -> None:
    image = torch.zeros(pixels, 1, 3)
    image[: pixels // 1000] = 5.0
    assert relmse_trimmed(image, torch.zeros_like(image)) == 0.0
    image[pixels // 1000] = 5.0
    assert relmse_trimmed(image, torch.zeros_like(image)) > 0.0


@pytest.mark.parametrize("share", [-0.1, 1.0, math.nan])
def test_trimming_refuses_shares_that_leave_nothing(share: float) -> None:
    with pytest.raises(ValueError, match="share"):
        relmse_trimmed(torch.zeros(4, 4, 3), torch.zeros(4, 4, 3), share=share)


@pytest.mark.parametrize("name", MAPS)
def test_a_map_has_the_mean_of_its_measure_and_lies_where_the_error_is(name: str) -> None:
    if name == "flip" and not HAS_FLIP:
        pytest.skip("flip-evaluator is not installed (extra `compare`)")
    image, reference = pictures(2)
    errors = error_map(name, image, reference)
    assert errors.shape == image.shape[:2] and errors.dtype == torch.float64
    mean = INNER.get(name, Tensor.mean)(errors)
    assert float(mean) == pytest.approx(METRICS[name](image, reference), rel=1e-5)
    spot = reference.clone()
    spot[20:24, 30:34] += 0.5
    row, column = divmod(int(error_map(name, spot, reference).argmax()), 56)
    assert 18 <= row < 26 and 28 <= column < 36
    assert float(error_map(name, reference, reference).abs().max()) < 1e-9


def test_only_maps_that_are_there() -> None:
    with pytest.raises(ValueError, match="one of relmse, mse, smape, ssim, flip, got 'psnr'"):
        error_map("psnr", *pictures(0))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_one_pixel_that_is_not_finite(bad: float) -> None:
    image, reference = pictures(3)
    image[20, 30, 0] = bad
    for name, metric in METRICS.items():
        assert not math.isfinite(metric(image, reference)), name
    for name in ("relmse", "mse", "smape"):
        wrong = ~torch.isfinite(error_map(name, image, reference))
        assert wrong.nonzero().tolist() == [[20, 30]], name
    wrong = (~torch.isfinite(error_map("ssim", image, reference))).nonzero()
    assert len(wrong) == 121 and wrong.min(0).values.tolist() == [15, 25] and wrong.max(0).values.tolist() == [25, 35]


def test_a_black_reference() -> None:
    black = torch.zeros(16, 16, 3)
    image = torch.full_like(black, 0.2)
    assert relmse(image, black) == relmse_trimmed(image, black) == pytest.approx(4.0, rel=1e-6)
    assert smape(image, black) == pytest.approx(0.2 / 0.21, rel=1e-6)
    assert psnr(image, black) == pytest.approx(10 * math.log10(25), rel=1e-6)
    assert ssim(image, black) == pytest.approx(1e-4 / (0.04 + 1e-4), rel=1e-5)
    assert all(METRICS[name](black, black) == 0.0 for name in ("relmse", "relmse_trimmed", "mse", "smape"))


def test_one_firefly_of_many_pixels() -> None:
    """Carried by it: mse and relmse. Hardly moved: the trimmed and smape."""
    image, reference = pictures(4, 64, 64)
    lit = image.clone()
    lit[10, 10] = 1e4
    assert mse(lit, reference) > 1e4 and relmse(lit, reference) > 1e4
    assert relmse_trimmed(lit, reference) == pytest.approx(relmse_trimmed(image, reference), rel=0.02)
    assert smape(lit, reference) == pytest.approx(smape(image, reference), rel=0.02)


def test_float32s_largest_does_not_overflow() -> None:
    reference = torch.zeros(12, 12, 3)
    image = torch.full_like(reference, torch.finfo(torch.float32).max)
    assert all(math.isfinite(METRICS[name](image, reference)) for name in ("mse", "relmse", "smape", "relmse_trimmed"))
