"""The film: filters drawn from, sums that lose nothing, the picture's own error."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchpt.images.metrics import FLOOR
from torchpt.physics.film import Film, filter_of

CPU = torch.device("cpu")


def test_a_million_samples_of_a_tenth():
    """float32 sums would read .10096 (STIFF_CASES 45)."""
    film = Film(1, 1, 1, CPU)
    block = torch.full((3, 64, 1), 0.1)
    for k in range(15_625 // 25):  # 40,000 adds here; the rest by weight below
        film.add(block, 0, 64 * k)
    film._sums *= 25
    film._counts *= 25
    film.add(block, 0, 1)
    assert float(film.mean()[0, 0, 0]) == pytest.approx(float(torch.tensor(0.1)), rel=1e-12)


def test_large_and_small_samples_add_up():
    film = Film(2, 1, 1, CPU)
    film.add(torch.tensor([1e8, 1.0]).expand(3, 1, 2), 0, 0)
    for k in range(1, 1001):
        film.add(torch.full((3, 1, 2), 1.0), 0, k)
    assert film.mean()[0, 0, 0] == pytest.approx((1e8 + 1000) / 1001, rel=1e-14)
    assert film.mean()[0, 1, 0] == 1


def test_mean_and_variance_are_those_of_the_randomizations():
    g = torch.Generator().manual_seed(1)
    samples = torch.rand(3, 12, 6, generator=g)
    film = Film(3, 2, 4, CPU)
    for first, pixels in ((0, 4), (4, 2)):  # chunks of pixels
        for start, count in ((0, 4), (4, 8)):  # passes
            film.add(samples[:, start : start + count, first : first + pixels], first, start)
    mean = samples.double().mean(1)
    torch.testing.assert_close(film.mean(), mean.T.reshape(2, 3, 3))
    groups = torch.stack([samples[:, k::4].double().mean(1) for k in range(4)])
    variance = film.variance()
    assert variance is not None
    torch.testing.assert_close(variance, (groups.var(0) / 4).T.reshape(2, 3, 3))
    assert film.relmse() == pytest.approx(float((variance / (film.mean() ** 2 + FLOOR)).mean()))
    torch.testing.assert_close(film.first_samples(), samples[:, 0].double().T.reshape(2, 3, 3))


def test_the_variance_is_unbiased():
    g = torch.Generator().manual_seed(2)
    film = Film(100, 100, 4, CPU, channels=1)
    film.add(torch.randn(1, 16, 10_000, generator=g), 0, 0)
    variance = film.variance()
    assert variance is not None
    # Each pixel's estimate has three degrees of freedom: relative deviation sqrt(2/3), over 10,000 pixels 0.8 %.
    assert float(variance.mean()) == pytest.approx(1 / 16, rel=0.033)


def test_one_randomization_knows_no_error_and_no_sample_is_black():
    film = Film(2, 2, 1, CPU)
    assert not film.mean().any()
    film.add(torch.ones(3, 2, 4), 0, 0)
    assert film.variance() is None
    assert film.relmse() is None
    partly = Film(1, 1, 4, CPU)
    partly.add(torch.ones(3, 2, 1), 0, 0)  # two of four randomizations have samples
    assert float(partly.mean()[0, 0, 0]) == 1
    assert partly.variance() is not None


def test_the_box_filter_fills_the_pixel():
    u = torch.tensor([0.0, 0.25, 0.5, 1 - 2**-24])
    offset = filter_of("box", CPU).offset(u)
    assert offset.tolist() == [-0.5, -0.25, 0.0, 0.5 - 2**-24]


@pytest.mark.parametrize(("stddev", "radius"), [(0.5, 2.0), (0.5, 1.0), (1.0, 4.0), (0.3, 0.5)])
@pytest.mark.slow
def test_the_gaussian_has_the_moments_of_mitsubas(stddev, radius):
    """Density proportional to ``exp(-x^2 / 2 s^2) - exp(-r^2 / 2 s^2)`` on [-r, r]."""
    x = np.linspace(-radius, radius, 2_000_001)
    weight = np.exp(-0.5 * (x / stddev) ** 2) - np.exp(-0.5 * (radius / stddev) ** 2)
    u = (torch.arange(1 << 20, dtype=torch.float64) + 0.5) / (1 << 20)
    offset = filter_of("gaussian", CPU, stddev=stddev, radius=radius).offset(u.float()).double().numpy()
    assert np.abs(offset).max() <= radius
    assert (np.diff(offset) >= 0).all()
    assert abs(offset.mean()) < 1e-6
    for power, tolerance in ((2, 5e-3), (4, 3e-2)):  # the inverse is tabulated: its last cells are a little wide
        exact = (weight * x**power).sum() / weight.sum()
        assert (offset**power).mean() == pytest.approx(exact, rel=tolerance)
    share = np.interp([-0.5 * radius, 0.25 * radius], x, np.cumsum(weight) / weight.sum())
    found = np.searchsorted(offset, [-0.5 * radius, 0.25 * radius]) / len(offset)
    np.testing.assert_allclose(found, share, atol=2e-4)


@pytest.mark.mitsuba
@pytest.mark.parametrize("stddev", [0.5, 0.8])
def test_the_gaussian_is_mitsubas(stddev):
    import importlib

    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    theirs = mitsuba.load_dict({"type": "gaussian", "stddev": stddev})
    radius = float(theirs.radius())
    assert radius == pytest.approx(4 * stddev)
    edges = np.linspace(-radius, radius, 41)
    x = np.linspace(-radius, radius, 4001)
    weight = np.array([theirs.eval(float(v)) for v in x])
    cumulative = np.concatenate(([0], np.cumsum(0.5 * (weight[1:] + weight[:-1]))))
    expected = np.diff(np.interp(edges, x, cumulative / cumulative[-1]))
    offset = filter_of("gaussian", CPU, stddev=stddev, radius=radius).offset((torch.arange(1 << 18) + 0.5) / (1 << 18))
    found = np.histogram(offset.numpy(), edges)[0] / (1 << 18)
    np.testing.assert_allclose(found, expected, atol=3e-4)
