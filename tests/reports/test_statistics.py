"""Intervals, slopes and times to an error."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchpt.reports.statistics import estimate, f_tail, fit, t_quantile


def test_distributions_are_those_of_the_tables() -> None:
    assert t_quantile(4.0) == pytest.approx(2.776445, abs=1e-5)
    assert t_quantile(1e5) == pytest.approx(1.959988, abs=1e-5)
    assert t_quantile(1.0) == pytest.approx(12.7062, abs=1e-3)
    assert f_tail(3.325835, 5, 10) == pytest.approx(0.05, abs=1e-6)
    assert f_tail(0.0, 5, 10) == 1.0 and f_tail(math.inf, 5, 10) == 0.0


def test_an_interval_of_few_runs_is_students_and_never_negative() -> None:
    found = estimate([1.0, 2.0, 3.0, 4.0, 5.0])
    reach = 2.776445 * math.sqrt(0.5) / 3.0
    assert (found.mean, found.low, found.high) == pytest.approx((3.0, 3.0 * math.exp(-reach), 3.0 * math.exp(reach)))
    plain = estimate([1.0, 2.0, 3.0, 4.0, 5.0], positive=False)
    assert plain.low == pytest.approx(3.0 - 2.776445 * math.sqrt(0.5))
    assert estimate([0.1, 3.0]).low > 0.0  # type: ignore[operator]
    assert estimate([2.0]).low is None and estimate([-1.0, 0.5]).high is None


def test_a_power_law_is_found_and_followed() -> None:
    line = fit([4.0, 16.0, 64.0], [[0.5 / n * f for f in (0.9, 1.0, 1.1)] for n in (4.0, 16.0, 64.0)])
    assert line is not None and line.slope.mean == pytest.approx(-1.0)
    assert line.slope.low < -1.0 < line.slope.high  # type: ignore[operator]
    inside, beyond = line.x_at(math.log(0.5 / 20.0)) or (None, None)
    assert inside is not None and math.exp(inside.mean) == pytest.approx(20.0) and beyond is False
    assert inside.low < inside.mean < inside.high  # type: ignore[operator]
    outside, beyond = line.x_at(math.log(0.5 / 1000.0)) or (None, None)
    assert outside is not None and math.exp(outside.mean) == pytest.approx(1000.0) and beyond is True
    assert outside.high - outside.low > inside.high - inside.low  # type: ignore[operator]


def test_what_has_no_line_has_none() -> None:
    assert fit([4.0, 16.0], [[0.1, 0.2], [-0.1, 0.0]]) is None  # one step drowned in the reference's noise
    assert fit([4.0, 4.0], [[0.1, 0.2], [0.1, 0.1]]) is None
    rising = fit([4.0, 16.0], [[0.1, 0.2], [0.3, 0.3]])
    assert rising is not None and rising.x_at(-5.0) is None
    single = fit([1.0, 2.0], [[0.2], [0.1]])
    assert single is not None and single.slope.low is None


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """95 %, from 5 runs of 3 steps: of 400 fits more than 91 % and fewer than 98.5 % (at least 3 standard deviations)."""
    random, held, reached = np.random.default_rng(5), 0, 0
    for _ in range(400):
        line = fit([4, 16, 64], [[(1 + 0.2 * random.standard_normal()) / n for _ in range(5)] for n in (4, 16, 64)])
        assert line is not None and line.slope.low is not None and line.slope.high is not None
        held += line.slope.low <= -1.0 <= line.slope.high
        place = line.x_at(math.log(1 / 30))
        assert place is not None and place[0].low is not None and place[0].high is not None
        reached += place[0].low <= math.log(30) <= place[0].high
    assert 364 <= held <= 394
    assert 364 <= reached <= 394
