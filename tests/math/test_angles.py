"""The azimuth against the library's, and at its edges."""

from __future__ import annotations

import math

import pytest
import torch

from torchpt.math.angles import azimuth


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-13)])
def test_against_atan2(dtype: torch.dtype, tolerance: float):
    generator = torch.Generator().manual_seed(1)
    x, y = torch.randn(2, 200_000, generator=generator, dtype=torch.float64).to(dtype)
    size = 10.0 ** (torch.rand(200_000, generator=generator, dtype=torch.float64) * 40 - 20).to(dtype)
    expected = torch.atan2(y.double(), x.double()) % (2 * math.pi)
    assert (azimuth(x * size, y * size).double() - expected).abs().max() < tolerance


def test_axes_and_the_origin():
    x = torch.tensor([1.0, 0.0, -1.0, 0.0, 0.0, 1.0, -1.0], dtype=torch.float64)
    y = torch.tensor([0.0, 1.0, 0.0, -1.0, 0.0, -0.0, -0.0], dtype=torch.float64)
    expected = torch.tensor([0.0, 0.5, 1.0, 1.5, 0.0, 0.0, 1.0], dtype=torch.float64) * math.pi
    assert torch.allclose(azimuth(x, y), expected, atol=1e-15)


def test_gradient():
    generator = torch.Generator().manual_seed(2)
    x, y = (torch.randn(200, generator=generator, dtype=torch.float64).requires_grad_() for _ in range(2))
    assert torch.autograd.gradcheck(azimuth, (x, y))
    zero = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(azimuth(zero, zero).sum(), zero)
    assert torch.isfinite(slope).all()


def test_places_do_not_matter():
    x, y = torch.randn(2, 1001, generator=torch.Generator().manual_seed(3))
    assert torch.equal(azimuth(x, y)[1:], azimuth(x[1:].clone(), y[1:].clone()))
