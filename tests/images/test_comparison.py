"""Pictures side by side: which measure sees what, and what is said where there is none."""

from __future__ import annotations

import math
import sys
from importlib.util import find_spec

import pytest
import torch

from torchpt.images.colour import display
from torchpt.images.comparison import DisplayTransform, compare, comparison_map
from torchpt.images.false_colour import NOT_FINITE, false_colour
from torchpt.images.metrics import METRICS, error_map, psnr, relmse, ssim

DRAW = torch.Generator().manual_seed(7)
REFERENCE = 3.0 * torch.rand((24, 30, 3), generator=DRAW)
IMAGE = REFERENCE * (1.0 + 0.2 * torch.randn(REFERENCE.shape, generator=DRAW)).clamp(min=0.1)


@pytest.mark.parametrize("shown", [DisplayTransform(), DisplayTransform(-2.0, "aces", 0.5)])
def test_psnr_and_ssim_see_what_a_screen_shows_and_the_others_radiance(shown: DisplayTransform) -> None:
    found = compare(IMAGE, REFERENCE, shown)
    seen = [display(x.double(), shown.exposure, shown.tonemap, shown.gamma) for x in (IMAGE, REFERENCE)]
    assert list(found.metrics) == list(METRICS)
    assert found.metrics["psnr"] == pytest.approx(psnr(seen[0], seen[1]))
    assert found.metrics["ssim"] == pytest.approx(ssim(seen[0], seen[1]))
    assert found.metrics["relmse"] == relmse(IMAGE, REFERENCE)
    assert torch.equal(comparison_map("ssim", IMAGE, REFERENCE, shown), error_map("ssim", seen[0], seen[1]))
    assert torch.equal(comparison_map("mse", IMAGE, REFERENCE, shown), error_map("mse", IMAGE, REFERENCE))


def test_means_and_their_ratio_show_bias() -> None:
    found = compare(1.5 * REFERENCE, REFERENCE)
    assert found.ratio == pytest.approx(1.5, rel=1e-6) and found.nonfinite == (0, 0)
    assert found.means[1] == pytest.approx(REFERENCE.double().mean((0, 1)).tolist(), rel=1e-9)


def test_pixels_that_are_not_finite_are_counted_and_out_of_the_means_alone() -> None:
    image, reference = REFERENCE.clone(), REFERENCE.clone()
    image[0, 0, 1] = image[5, 5, 0] = math.nan
    reference[7, 7] = math.inf
    found = compare(image, reference)
    assert found.nonfinite == (2, 1) and found.ratio == 1.0
    assert not any(math.isfinite(value) for value in found.metrics.values())
    assert set(found.reasons) == set(METRICS) and all("not finite" in reason for reason in found.reasons.values())


def test_errors_beyond_float64_are_no_fault_of_the_pictures() -> None:
    found = compare(torch.full((2, 2, 1), 1e200, dtype=torch.float64), torch.zeros(2, 2, 1).double(), colours=False)
    assert found.reasons["mse"] == "an error is beyond the range of float64" and found.nonfinite == (0, 0)


def test_infinite_pixels_are_no_white() -> None:
    image = REFERENCE.clone()
    image[3, 3] = math.inf
    assert math.isnan(compare(image, REFERENCE).metrics["psnr"])


def test_nothing_finite() -> None:
    found = compare(torch.full_like(REFERENCE, math.nan), REFERENCE)
    assert found.nonfinite == (720, 0) and math.isnan(found.ratio) and all(map(math.isnan, found.means[0]))


def test_a_black_reference_has_no_ratio_and_no_flip() -> None:
    found = compare(IMAGE, torch.zeros_like(IMAGE))
    assert math.isnan(found.ratio) and math.isnan(found.metrics["flip"])
    if find_spec("flip_evaluator"):
        assert found.reasons == {"flip": "the reference is black, so there is no exposure to look at it by"}


def test_equal_pictures() -> None:
    found = compare(IMAGE, IMAGE)
    assert found.metrics["psnr"] == math.inf and found.reasons["psnr"] == "infinite: a screen shows both alike"
    bright = compare(REFERENCE + 2, REFERENCE + 3)  # cut at 1, both are white
    assert bright.reasons["psnr"] == found.reasons["psnr"] and bright.metrics["relmse"] > 0
    assert found.metrics["ssim"] == pytest.approx(1.0) and found.metrics["relmse"] == 0.0 and found.ratio == 1.0


def test_grey_is_seen_as_three_equal_channels() -> None:
    grey, other = IMAGE[..., :1], REFERENCE[..., :1]
    one = compare(grey, other).metrics
    three = compare(grey.expand(-1, -1, 3), other.expand(-1, -1, 3)).metrics
    assert one == pytest.approx(three, rel=1e-9, nan_ok=True)


def test_numbers_that_are_no_colours() -> None:
    found = compare(IMAGE[..., :2], REFERENCE[..., :2], colours=False)
    assert set(found.reasons) == {"psnr", "ssim", "flip"} and found.metrics["relmse"] > 0


def test_without_the_evaluator_all_others_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    found = compare(IMAGE, REFERENCE)
    assert found.reasons == {
        "flip": "needs the package flip-evaluator: pip install '.[compare]' in the checkout of torchpt"
    }
    assert all(math.isfinite(value) for name, value in found.metrics.items() if name != "flip")


def test_small_pictures_have_no_ssim() -> None:
    found = compare(IMAGE[:8], REFERENCE[:8])
    assert found.reasons["ssim"].startswith("looks through windows of 11 pixels") and found.metrics["psnr"] > 0


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="shape"):
        compare(IMAGE, REFERENCE[..., :1])


def test_colours_of_numbers() -> None:
    colours = false_colour(torch.tensor([0.0, 1.0, 2.0, 9.0, -1.0, math.nan, math.inf]), top=2.0)
    assert colours.shape == (7, 3)
    assert torch.equal(colours[0], colours[4]) and torch.equal(
        colours[2], colours[3]
    )  # what is beyond looks like the end
    assert (255 * colours[1]).round().tolist() == [0xB7, 0x37, 0x79]
    assert colours[5].tolist() == colours[6].tolist() == list(NOT_FINITE)


def test_the_brighter_the_further_off() -> None:
    values = torch.linspace(0, 1, 256)
    light = false_colour(values, 1.0) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert bool((light.diff() > 0).all())
