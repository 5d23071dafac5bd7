"""The arctangent: accurate, the same at every lane position, with derivatives everywhere."""

from __future__ import annotations

import math

import pytest
import torch

from torchpt.math.vectors import azimuth


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_it_is_the_angle(dtype, tolerance):
    g = torch.Generator().manual_seed(1)
    x, y = (torch.randn(100_001, generator=g, dtype=dtype) for _ in range(2))
    x[:20_000] *= 1e-30 if dtype == torch.float32 else 1e-200
    y[10_000:30_000] *= 1e25
    found = azimuth(x, y)
    exact = torch.atan2(y.double(), x.double()) % (2 * math.pi)
    apart = (found.double() - exact).abs()
    assert torch.minimum(apart, 2 * math.pi - apart).max() < tolerance
    assert (found >= 0).all() and (found < 2 * math.pi).all()


def test_axes_and_the_origin():
    x = torch.tensor([1.0, 0, -1, 0, 0, 1, -1, -0.0, 1e-45])
    y = torch.tensor([0.0, 1, 0, -1, 0, -1e-30, -0.0, 0.0, 0.0])
    quarter = 0.5 * torch.pi
    expected = torch.tensor([0, quarter, 2 * quarter, 3 * quarter, 0, 0, 2 * quarter, 0, 0])
    torch.testing.assert_close(azimuth(x, y), expected)


def test_every_lane_rounds_alike():
    x, y = torch.tensor(0.3).expand(37).contiguous(), torch.tensor(-0.7).expand(37).contiguous()
    assert len(azimuth(x, y).unique()) == 1
    assert len(torch.cat([azimuth(x[:n], y[:n]) for n in range(1, 37)]).unique()) == 1


def test_derivatives():
    x = torch.tensor([0.3, -0.2, 1.0, 0.0, 0.0, -1.0, 2.0, 1e-3], dtype=torch.float64, requires_grad=True)
    y = torch.tensor([0.1, 0.9, 0.0, 1.0, -1.0, -1e-3, 2.0, -5.0], dtype=torch.float64, requires_grad=True)
    azimuth(x, y).sum().backward()
    square = (x * x + y * y).detach()
    torch.testing.assert_close(x.grad, -y.detach() / square, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(y.grad, x.detach() / square, rtol=1e-9, atol=1e-9)
    zero = torch.zeros(1, requires_grad=True)
    azimuth(zero, zero).sum().backward()
    assert zero.grad is not None and torch.isfinite(zero.grad).all()
