"""Tails of which everything is known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchpt.physics.film.error import MIN_PILOTS, is_heavy_tailed


def pareto(shape: float, count: int, seed: int) -> Tensor:
    """Draw values with a tail of that shape; 0 is the exponential distribution."""
    u = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return -u.log() if shape == 0.0 else (u**-shape - 1.0) / shape


@pytest.mark.parametrize("count", [64, 600, 16384])
@pytest.mark.parametrize(("shape", "heavy"), [(0.0, False), (0.3, False), (0.5, False), (2.0, True), (4.0, True)])
def test_heavy_tails_are_told_from_others(shape, heavy, count):
    told = sum(is_heavy_tailed(pareto(shape, count, seed)) for seed in range(40))
    least = 38 if count > 64 else 1 if shape == 2.0 else 30  # of a tail of twelve values little is known
    assert told >= least if heavy else told <= 1


def test_values_alike_and_few_have_no_tail():
    assert not is_heavy_tailed(torch.ones(100).double())
    assert not is_heavy_tailed(torch.zeros(MIN_PILOTS).double())
    few = torch.ones(100).double()
    few[:50] = 1.0 + torch.rand(50, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert not is_heavy_tailed(few)


def test_a_value_that_has_all_there_is():
    rare = torch.rand(2000, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1e-4
    rare[::200] = 10.0 ** torch.arange(10).double()
    assert is_heavy_tailed(rare)
