"""What a picture knows of its own error, on noise of which everything is known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchpt.physics.film import ErrorEstimate, pilots_of
from torchpt.physics.film.error import (
    RESAMPLING_RANDOMIZATIONS,
    Resampled,
    error_estimate,
    mean_of_neighbours,
    pixels_to_resample,
    probe_estimate,
)

SIDE = 96


def scene(generator: torch.Generator) -> Tensor:
    """Smooth, with an edge and a bright square."""
    y, x = torch.meshgrid(torch.arange(SIDE) / SIDE, torch.arange(SIDE) / SIDE, indexing="ij")
    light = 0.3 + 0.2 * torch.sin(5 * x) * y + 0.4 * (x > 0.5)
    light[20:30, 20:30] = 17.0
    return light.double()[..., None].expand(-1, -1, 3).contiguous()


def noisy(radiance: Tensor, sparkle: float, generator: torch.Generator) -> Tensor:
    """Unbiased: log-normal noise, and rare bright samples."""
    wide = 0.15 * torch.randn(radiance.shape[:2], generator=generator, dtype=torch.float64)
    values = radiance * (wide - 0.5 * 0.15**2).exp()[..., None]
    if sparkle:
        bright = torch.rand(radiance.shape[:2], generator=generator, dtype=torch.float64) < sparkle
        height = 10.0 * torch.rand(radiance.shape[:2], generator=generator, dtype=torch.float64)
        values = values + torch.where(bright, height, 0.0)[..., None]
    return values


def known(radiance: Tensor, sparkle: float, seed: int) -> tuple[ErrorEstimate, float]:
    """The estimate, and what is true of the same picture."""
    g = torch.Generator().manual_seed(seed)
    mean = radiance + 5.0 * sparkle
    picture, whole = noisy(radiance, sparkle, g), (SIDE, SIDE)
    pilots = pilots_of(seed, whole, (0, 0, *whole))
    flat = picture.view(-1, 3)
    a, b = flat[pilots.pixels].clone(), noisy(radiance, sparkle, g).reshape(-1, 3)[pilots.pixels]
    flat[pilots.pixels] = (a + b) / 2
    suspects, doubtful = pixels_to_resample(picture, pilots, a, b)
    places = torch.cat((suspects, doubtful))
    more = torch.stack([noisy(radiance, sparkle, g).reshape(-1, 3)[places] for _ in range(RESAMPLING_RANDOMIZATIONS)])
    again = Resampled(places, len(suspects), more.mean(0), more.var(0) / RESAMPLING_RANDOMIZATIONS)
    estimate = error_estimate(picture, pilots, a, b, None, b_counted=True, resampled=again)
    assert estimate is not None
    return estimate, float(((picture - mean).square() / (mean.square() + 0.01)).mean())


@pytest.mark.parametrize(("sparkle", "bias"), [(0.0, 0.03), (1e-3, 0.15)])
def test_it_is_right_in_the_mean(sparkle, bias):
    radiance = scene(torch.Generator())
    pairs = [known(radiance, sparkle, seed) for seed in range(16)]
    estimated, true = (sum(values) / len(values) for values in ([e.relmse for e, _ in pairs], [t for _, t in pairs]))
    assert estimated == pytest.approx(true, rel=bias)


@pytest.mark.parametrize("repeats", [25, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("sparkle", [0.0, 2e-5])
def test_the_interval_holds(sparkle, repeats):
    """Where it is not called heavy-tailed; sparkles are in one picture of six."""
    radiance = scene(torch.Generator())
    held, heavy = 0, 0
    for seed in range(repeats):
        estimate, true = known(radiance, sparkle, seed)
        heavy += estimate.heavy_tailed
        if not estimate.heavy_tailed:
            assert estimate.interval is not None
            held += estimate.interval[0] <= true <= estimate.interval[1]
    assert heavy < repeats * (0.1 if sparkle == 0 else 0.3)
    assert 0.88 <= held / (repeats - heavy) <= (1.0 if repeats < 200 else 0.995)


def test_an_error_of_few_pixels_is_called_heavy_tailed():
    """A line of pixels that are bright now and then, and nothing else that errs."""
    g, flags = torch.Generator().manual_seed(1), 0

    def value() -> Tensor:
        values = 0.5 + 1e-3 * torch.randn(SIDE, SIDE, 1, generator=g, dtype=torch.float64).repeat(1, 1, 3)
        values[40, 30:44] += torch.where(torch.rand(14, 1, generator=g) < 0.2, 20.0, 0.0)
        return values

    for seed in range(20):
        picture, pilots = value().clone(), pilots_of(seed, (SIDE, SIDE), (0, 0, SIDE, SIDE))
        first, second = (values.reshape(-1, 3)[pilots.pixels] for values in (picture, value()))
        suspects, doubtful = pixels_to_resample(picture, pilots, first, second)
        places = torch.cat((suspects, doubtful))
        more = torch.stack([value().reshape(-1, 3)[places] for _ in range(RESAMPLING_RANDOMIZATIONS)])
        again = Resampled(places, len(suspects), more.mean(0), more.var(0) / RESAMPLING_RANDOMIZATIONS)
        estimate = error_estimate(picture, pilots, first, second, None, b_counted=False, resampled=again)
        assert estimate is not None
        flags += estimate.heavy_tailed
    assert flags >= 18


def test_a_sparkle_is_known_wherever_it_is():
    radiance = torch.full((SIDE, SIDE, 3), 0.5, dtype=torch.float64)
    a = radiance.clone()
    a[33, 50] = 30.0
    pilots = pilots_of(0, (SIDE, SIDE), (0, 0, SIDE, SIDE))
    b = radiance.reshape(-1, 3)[pilots.pixels]
    suspects, _ = pixels_to_resample(a, pilots, b, b)
    assert 33 * SIDE + 50 in suspects.tolist()
    again = Resampled(suspects, len(suspects), radiance.reshape(-1, 3)[suspects], torch.zeros(len(suspects), 3))
    estimate = error_estimate(a, pilots, b, b, None, b_counted=False, resampled=again)
    assert estimate is not None and estimate.relmse == pytest.approx(
        29.5**2 / ((30 / 32) ** 2 + 0.01) / SIDE**2, rel=0.01
    )


def test_pilots_alone_ask_no_other_pixel():
    """The same from first and second values of pilots, whatever the picture."""
    g = torch.Generator().manual_seed(2)
    pilots = pilots_of(1, (64, 64), (0, 0, 64, 64))
    a, b = (0.5 + 0.05 * torch.randn(len(pilots), 3, generator=g, dtype=torch.float64) for _ in range(2))
    exact = 0.05**2 / 0.26
    assert probe_estimate(pilots, a, b, None, b_counted=False).relmse == pytest.approx(exact, rel=0.2)
    alone, both = (probe_estimate(pilots, a, b, None, b_counted=counted).relmse for counted in (False, True))
    assert both == pytest.approx(alone * 31 / 32)


def test_second_values_of_another_variance():
    """Of two streams that vary more than the one of first values."""
    g = torch.Generator().manual_seed(3)
    pilots = pilots_of(1, (256, 256), (0, 0, 256, 256))
    n = len(pilots)
    a = 0.5 + 0.05 * torch.randn(n, 3, generator=g, dtype=torch.float64)
    halves = 0.5 + 0.1 * torch.randn(2, n, 3, generator=g, dtype=torch.float64)
    b, spare = halves.mean(0), (halves[0] - halves[1]).square() / 4
    assert probe_estimate(pilots, a, b, spare, b_counted=False).relmse == pytest.approx(0.05**2 / 0.26, rel=0.1)


def test_what_lies_around():
    values = torch.arange(12.0, dtype=torch.float64).view(3, 4, 1)
    near = mean_of_neighbours(values, torch.ones(3, 4, dtype=torch.bool))
    assert float(near[1, 1, 0]) == pytest.approx(5.0) and float(near[0, 0, 0]) == pytest.approx((1 + 4 + 5) / 3)
    known_ones = torch.zeros(3, 4, dtype=torch.bool)
    known_ones[0, 1] = True
    masked = mean_of_neighbours(values, known_ones)
    assert float(masked[1, 1, 0]) == 1.0 and float(masked[2, 3, 0]) == 11.0  # none around: its own


@pytest.mark.parametrize("side", [1, 2, 5, 12])
def test_pictures_of_a_few_pixels(side):
    pilots = pilots_of(0, (side, side), (0, 0, side, side))
    picture = torch.rand(side, side, 3, dtype=torch.float64)
    a, b = torch.rand(2, len(pilots), 3, dtype=torch.float64)
    suspects, doubtful = pixels_to_resample(picture, pilots, a, b)
    places = torch.cat((suspects, doubtful))
    again = Resampled(places, len(suspects), torch.full((len(places), 3), 0.5).double(), torch.zeros(len(places), 3))
    for looked in (None, again):
        estimate = error_estimate(picture, pilots, a, b, None, b_counted=True, resampled=looked)
        assert estimate is None or estimate.relmse >= 0
        if estimate is not None:
            assert (len(pilots) - len(suspects) >= 8) <= (estimate.interval is not None) <= (len(pilots) >= 8)


def test_a_picture_without_error():
    pilots = pilots_of(0, (32, 32), (0, 0, 32, 32))
    black, values = torch.zeros(32, 32, 3).double(), torch.zeros(len(pilots), 3).double()
    estimate = error_estimate(black, pilots, values, values, None, b_counted=True, resampled=None)
    assert estimate == ErrorEstimate(0.0, (0.0, 0.0), False)
