"""Counters, sums and weights at the limits of float32 and int32."""

from __future__ import annotations

import math

import torch

from torchpt.math.sampling import power_heuristic
from torchpt.physics.film import Film
from torchpt.physics.samplers import KINDS, Dimension, Draws, Sampler, salts
from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.harness import Harness

__all__ = ["CASES"]


def sums(harness: Harness, number: float) -> float:
    """Compare the mean of ``number`` samples of 0.1 with 0.1."""
    film = Film(4, 4, 1, torch.device("cpu"))
    chunk = torch.full((3, 1000, 16), 0.1)
    for k in range(int(number) // 1000):  # 1000 samples of each of 16 pixels
        film.add(chunk, first_pixel=0, first_sample=1000 * k)
    return float((film.mean() / torch.tensor(0.1).double() - 1.0).abs().max())


def late_samples(harness: Harness, first: float) -> float:
    """Return the deviation from 1/2 of the mean of 2^12 random numbers from sample ``first`` on, in units of 4 sigma."""
    worst = 0.0
    for kind in KINDS:
        if KINDS[kind].needs_count:
            continue  # has as many samples as a render takes, and none so late
        sample = torch.arange(4096) + int(first)
        seed, pixel = 3, 77  # any
        key = Sampler(kind, seed).key(torch.full((4096,), pixel), sample)
        draws = Draws(kind, key, salts(2, torch.device("cpu")))  # at vertex 2
        for u in (draws.one(Dimension.ROULETTE), *draws.two(Dimension.BSDF), *draws.two(Dimension.LIGHT)):
            if not bool(((u >= 0) & (u < 1)).all()) or len(torch.unique(u)) < 2000:  # half of them are repeated
                return math.inf
            sigma = 1.0 / (12 * 4096) ** 0.5  # of the mean of 4096 uniform numbers, each of variance 1 / 12
            worst = max(worst, abs(float(u.double().mean()) - 0.5) / (4 * sigma))
    return worst


def weights(harness: Harness, density: float) -> float:
    """Compare with 1: the sum of both MIS weights of a pair of densities, and the weight of a delta or of a density alone."""
    a = torch.tensor([density, density, 1.0, math.inf, density]).float()
    b = torch.tensor([1.0, density, density, 1.0, 0.0]).float()
    total = power_heuristic(a, b) + power_heuristic(b, a)
    return float((total[:3] - 1.0).abs().max()) + float((power_heuristic(a, b)[3:] - 1.0).abs().max())


CASES = (
    Case(
        name="sums of many samples",
        measures="relative",
        bound=1e-9,
        figure=sums,
        axis="samples",
        sweep=(1e3, 1e5, 1e6),
        quick_sweep=(1e3, 1e4),
        uses_backend=False,
    ),
    Case(
        name="numbers of late samples",
        measures="deviations / 4",
        bound=1.0,
        figure=late_samples,
        axis="sample",
        sweep=(0.0, 2.0**24, 2.0**31 - 5000),
        uses_backend=False,
    ),
    Case(
        name="weights of densities",
        measures="difference from 1",
        bound=1e-6,
        figure=weights,
        axis="density",
        sweep=powers_of_ten(-37, 37, step=2),
        uses_backend=False,
    ),
)
