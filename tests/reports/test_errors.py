"""Errors against a reference that is noisy itself."""

from __future__ import annotations

import math
from importlib.util import find_spec

import pytest
import torch

from torchpt.core.errors import AssetError
from torchpt.images import metrics, write_image
from torchpt.reports.analysis import error_map, measures, mse, relmse, relmse_trimmed
from torchpt.reports.runs import ReferencePicture, from_file
from torchpt.reports.study import MEASURES
from torchpt.scene.settings import Film

SHAPE = (40, 50, 3)

needs_flip = pytest.mark.skipif(
    find_spec("flip_evaluator") is None, reason="flip-evaluator is not installed (extra `compare`)"
)


def picture(seed: int) -> torch.Tensor:
    return torch.rand(SHAPE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@needs_flip
def test_an_exact_reference_gives_the_measures_of_all_pictures() -> None:
    image, exact = picture(0), ReferencePicture(picture(1), torch.zeros(SHAPE, dtype=torch.float64), (), {})
    found = measures(image, exact, MEASURES, Film())
    for name in ("relmse", "mse", "smape", "flip"):
        assert found[name] == pytest.approx(metrics.METRICS[name](image, exact.image), rel=1e-9), name
    assert found["psnr"] != pytest.approx(metrics.psnr(image, exact.image))  # of what a screen shows
    errors = error_map(image, exact).flatten().sort().values
    assert found["relmse_trimmed"] == pytest.approx(float(errors[:-2].mean()))  # 2 of 2,000 pixels
    assert float(errors.mean()) == pytest.approx(found["relmse"])


def test_the_noise_of_the_reference_is_taken_off() -> None:
    """Within 5 standard deviations."""
    random = torch.Generator().manual_seed(2)
    right = picture(1) + 0.5
    spread = 0.04 * right.square()  # of the reference; the picture's is a quarter
    own = []
    for _ in range(40):
        noisy = right + spread.sqrt() * torch.randn(SHAPE, generator=random, dtype=torch.float64)
        image = right + 0.5 * spread.sqrt() * torch.randn(SHAPE, generator=random, dtype=torch.float64)
        truth = ReferencePicture(noisy, spread, (), {})
        own.append((mse(image, truth), metrics.mse(image, noisy)))
    debiased, plain = (sum(values) / len(own) for values in zip(*own, strict=True))
    expected = float(spread.mean()) / 4
    assert debiased == pytest.approx(expected, rel=0.1) and plain == pytest.approx(5 * expected, rel=0.02)


@needs_flip
def test_what_has_no_value_is_not_a_number() -> None:
    small = ReferencePicture(
        torch.zeros(4, 4, 3, dtype=torch.float64), torch.zeros(4, 4, 3, dtype=torch.float64), (), {}
    )
    found = measures(small.image, small, ("ssim", "flip", "relmse"), Film())
    assert math.isnan(found["ssim"]) and math.isnan(found["flip"]) and found["relmse"] == 0.0
    bad = small.image.clone()
    bad[0, 0, 0] = math.nan
    assert math.isnan(relmse(bad, small)) and math.isnan(relmse_trimmed(bad, small))


def test_the_variance_in_a_file_counts(tmp_path) -> None:
    image, variance = picture(1).float(), picture(2).float()
    write_image(tmp_path / "a.exr", image, {"variance": variance})
    write_image(tmp_path / "b.exr", image)
    truth = from_file(str(tmp_path / "a.exr"), (50, 40))
    assert torch.equal(truth.variance, variance.double()) and truth.origin["variance"] is True
    assert not from_file(str(tmp_path / "b.exr"), (50, 40)).variance.any()
    with pytest.raises(AssetError, match="expected a picture of 64 x 40 pixels as the film is, got 50 x 40"):
        from_file(str(tmp_path / "a.exr"), (64, 40))
    image[0, 0, 0] = math.inf
    write_image(tmp_path / "c.exr", image)
    with pytest.raises(AssetError, match="finite"):
        from_file(str(tmp_path / "c.exr"), (50, 40))
