"""The bias test: how often it is wrong, and what it finds."""

from __future__ import annotations

import pytest
import torch
from few import few
from torch import Tensor

from torchpt.reports.analysis import bias_test, tiles
from torchpt.reports.runs import ReferencePicture

SIDE, RUNS, SPP = 32, 5, 16
TRUTHS, TRUTH_SPP = 8, 64


def samples(kind: str, count: int, random: torch.Generator) -> Tensor:
    """Means ``(SIDE, SIDE, 1)`` of so many samples of mean 1."""
    shape = (SIDE, SIDE, 1)
    if kind == "lognormal":
        return torch.exp(2.0 * torch.randn((count, *shape), generator=random) - 2.0).mean(0).double()
    smooth = 1.0 + torch.randn(shape, generator=random, dtype=torch.float64) / count**0.5
    if kind == "fireflies":  # of a thousand times the light, one in 10,000 samples
        return smooth + 1000.0 / count * torch.poisson(torch.full(shape, count * 1e-4), generator=random)
    return smooth


def case(kind: str, seed: int, change: Tensor | float = 1.0) -> tuple[list[Tensor], ReferencePicture, float]:
    random = torch.Generator().manual_seed(seed)
    base = 2.0 * torch.rand(SIDE, SIDE, 1, generator=random, dtype=torch.float64) ** 3 + 0.02
    colour = torch.tensor([1.0, 0.8, 0.5], dtype=torch.float64)
    runs = [base * samples(kind, SPP, random) * colour * change for _ in range(RUNS)]
    made = torch.stack([base * samples(kind, TRUTH_SPP, random) * colour for _ in range(TRUTHS)])
    truth = ReferencePicture(made.mean(0), made.var(0) / TRUTHS, tuple(made), {})
    return runs, truth, TRUTHS * TRUTH_SPP / (RUNS * SPP)


@pytest.mark.parametrize(
    ("kind", "cases"),
    few(
        [
            ("gaussian", 15),
            ("fireflies", 30),
            *(pytest.param(kind, 500, marks=pytest.mark.slow) for kind in ("gaussian", "fireflies", "lognormal")),
        ],
        1,
    ),
)
def test_unbiased_pictures_are_not_flagged(kind: str, cases: int) -> None:
    """The test's level is 0.1 %: of 500 more than 5 (1 %) come with a chance below 0.001."""
    flagged = sum(bias_test(*case(kind, seed)).biased for seed in range(cases))
    assert flagged <= cases // 100


def test_light_that_is_lost_everywhere_is_found() -> None:
    found = [bias_test(*case("gaussian", seed, 0.95)) for seed in range(5)]
    assert all(verdict.biased for verdict in found)
    assert all(verdict.low < -0.05 < verdict.high and verdict.high < 0 for verdict in found[:3])


def test_light_that_is_moved_is_found() -> None:
    change = torch.ones(SIDE, SIDE, 1, dtype=torch.float64)
    change[:4], change[4:8] = 1.4, 0.6  # about the same light in all
    assert all(bias_test(*case("gaussian", seed, change)).biased for seed in range(5))


def test_the_size_of_a_bias_is_told_without_noise() -> None:
    runs, truth, more = case("gaussian", 3, 0.5)
    expected = float(((0.5 * truth.image).square() * truth.weight).mean())
    assert bias_test(runs, truth, more).squared == pytest.approx(expected, rel=0.1)


def test_a_clamp_that_only_takes_fireflies_which_may_not_have_come_is_no_proof() -> None:
    """Two fireflies are expected in all runs, and none came: that is no wonder."""
    random = torch.Generator().manual_seed(1)
    runs = [
        1.0 + 0.01 * torch.randn(SIDE, SIDE, 1, generator=random, dtype=torch.float64).expand(-1, -1, 3)
        for _ in range(5)
    ]
    made = [
        1.0 + 0.005 * torch.randn(SIDE, SIDE, 1, generator=random, dtype=torch.float64).repeat(1, 1, 3)
        for _ in range(8)
    ]
    for k in range(8):  # 13 in the 6.4 times as many samples of the reference
        for spot in range(2 if k < 5 else 1):
            made[k][3 * k, 7 + spot] += 1000.0
    stack = torch.stack(made)
    truth = ReferencePicture(stack.mean(0), stack.var(0) / 8, tuple(made), {})
    assert not bias_test(runs, truth, 6.4).biased


def test_equal_and_black_pictures_are_unbiased_and_a_glow_is_not() -> None:
    black = torch.zeros(8, 8, 3, dtype=torch.float64)
    truth = ReferencePicture(black, black, (), {})
    assert not bias_test([black, black], truth).biased
    assert bias_test([black + 0.1, black + 0.1], truth).biased
    grey = black + 0.25
    assert not bias_test([grey, grey * (1 + 1e-7)], ReferencePicture(grey, black, (), {})).biased


def test_a_part_that_is_black_in_all_says_nothing() -> None:
    """As behind a scene without a sky."""
    runs, truth, more = case("gaussian", 3)
    keep = torch.ones(SIDE, SIDE, 1, dtype=torch.float64)
    keep[:9] = 0.0
    black = ReferencePicture(truth.image * keep, truth.variance * keep, tuple(run * keep for run in truth.runs), {})
    found = bias_test([run * keep for run in runs], black, more)
    assert not found.biased and 0.0 < found.chance <= 1.0


def test_tiles_part_the_picture() -> None:
    image = torch.arange(7 * 5 * 2, dtype=torch.float64).reshape(7, 5, 2)
    assert torch.equal(tiles(image, 1)[:, 0], image.mean((0, 1)))
    assert tiles(image, 2)[0, 0] == image[:4, :3, 0].mean() and tiles(image, 2)[1, 3] == image[4:, 3:, 1].mean()
