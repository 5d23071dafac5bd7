"""Counters, sums and weights where float32 and int32 end."""

from __future__ import annotations

import math

import torch

from torchpt.math.sampling import power_heuristic
from torchpt.physics.film import Film
from torchpt.physics.samplers import KINDS, Dimension, Draws, Sampler, salts
from torchpt.stress.case import Case, powers
from torchpt.stress.harness import Harness

__all__ = ["CASES"]


def sums(harness: Harness, number: float) -> float:
    """The mean of so many samples of 0.1."""
    film = Film(4, 4, 1, torch.device("cpu"))
    chunk = torch.full((3, 1000, 16), 0.1)
    for k in range(int(number) // 1000):
        film.add(chunk, 0, 1000 * k)
    return float((film.mean() / torch.tensor(0.1).double() - 1.0).abs().max())


def late_samples(harness: Harness, first: float) -> float:
    """Numbers of 2^12 samples from this one on: off the mean of a half, in standard deviations over 4."""
    worst = 0.0
    for kind in KINDS:
        if KINDS[kind].needs_count:
            continue
        sample = torch.arange(4096) + int(first)
        key = Sampler(kind, 3).key(torch.full((4096,), 77), sample)
        draws = Draws(kind, key, salts(2, torch.device("cpu")))
        for u in (draws.one(Dimension.ROULETTE), *draws.two(Dimension.BSDF), *draws.two(Dimension.LIGHT)):
            if not bool(((u >= 0) & (u < 1)).all()) or len(torch.unique(u)) < 2000:
                return math.inf
            worst = max(worst, abs(float(u.double().mean()) - 0.5) * (12 * 4096) ** 0.5 / 4)
    return worst


def weights(harness: Harness, density: float) -> float:
    """Both weights of a pair of densities make one."""
    a = torch.tensor([density, density, 1.0, math.inf, density]).float()
    b = torch.tensor([1.0, density, density, 1.0, 0.0]).float()
    total = power_heuristic(a, b) + power_heuristic(b, a)
    return float((total[:3] - 1.0).abs().max()) + float((power_heuristic(a, b)[3:] - 1.0).abs().max())


CASES = (
    Case("sums of many samples", "relative", 1e-9, sums, "samples", (1e3, 1e5, 1e6), (1e3, 1e4),
         backend=False),
    Case("numbers of late samples", "deviations / 4", 1.0, late_samples, "sample",
         (0.0, 2.0**24, 2.0**31 - 5000), backend=False),
    Case("weights of densities", "difference from 1", 1e-6, weights, "density", powers(-37, 37, 2), backend=False),
)  # fmt: skip
