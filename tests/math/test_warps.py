"""Warps have the densities that they state."""

from __future__ import annotations

import math

import pytest
import torch
from trials import SIGNIFICANCE, grid_cells, uniform_p

from torchpt.math import sampling

TESTS = 17  # chi-square tests in this file
U = torch.rand(2, 1 << 16, generator=torch.Generator().manual_seed(8))
EDGES = torch.cartesian_prod(*(torch.tensor([0.0, 2**-24, 0.5, 1 - 2**-24]),) * 2).T
SIDE = 24


def assert_uniform(*coordinates: torch.Tensor) -> None:
    """Coordinates in [0, 1] that uniform points of the domain would spread evenly."""
    cells = grid_cells(torch.stack(coordinates).double().clamp(0, 1), SIDE)
    assert uniform_p(cells, SIDE ** len(coordinates)) > SIGNIFICANCE / TESTS


def azimuth(d: torch.Tensor) -> torch.Tensor:
    return torch.atan2(d[1].double(), d[0].double()) / (2 * math.pi) + 0.5


def assert_unit(d: torch.Tensor) -> None:
    assert (d.double().norm(dim=0) - 1).abs().max() < 5e-7


def test_concentric_disk():
    p = sampling.concentric_disk(U)
    square = (p.double() ** 2).sum(0)
    assert square.max() <= 1 + 1e-6
    assert_uniform(square, azimuth(p))
    assert torch.isfinite(sampling.concentric_disk(EDGES)).all()
    assert torch.equal(sampling.concentric_disk(torch.full((2, 1), 0.5)), torch.zeros(2, 1))


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 64])
def test_uniform_polygon(sides):
    p = sampling.uniform_polygon(U, sides).double()
    # In the sector of each corner pair: the distance from the centre as a share of the edge's, and the place along the edge.
    turn = (torch.atan2(p[1], p[0]) / (2 * math.pi) - 0.25) % 1.0 * sides
    edge = turn.floor()
    middle = 2 * math.pi * (0.25 + (edge + 0.5) / sides)
    out = (torch.cos(middle) * p[0] + torch.sin(middle) * p[1]) / math.cos(math.pi / sides)
    along = (-torch.sin(middle) * p[0] + torch.cos(middle) * p[1]) / math.sin(math.pi / sides)
    assert out.max() <= 1 + 1e-6
    whole = (edge + (along / out + 1) / 2) / sides
    assert_uniform(out**2, whole)
    edges = sampling.uniform_polygon(EDGES, sides)
    assert torch.isfinite(edges).all() and edges.norm(dim=0).max() <= 1 + 1e-6
    top = sampling.uniform_polygon(torch.tensor([[0.5], [1 - 2**-24]], dtype=torch.float64), sides)
    assert torch.allclose(top, torch.tensor([[0.0], [1]], dtype=torch.float64), atol=1e-6)
    assert torch.equal(sampling.uniform_polygon(torch.full((2, 1), 0.5), sides).abs(), torch.zeros(2, 1))


@pytest.mark.parametrize("sides", [3, 6, 11])
def test_uniform_polygon_keeps_areas_and_neighbours(sides):
    u = U[:, :20_000].double() * 0.998 + 0.001
    step = 1e-6
    rows = []
    for axis in range(2):
        ahead = torch.zeros(2, 1, dtype=torch.float64)
        ahead[axis] = step
        rows.append(
            (sampling.uniform_polygon(u + ahead, sides) - sampling.uniform_polygon(u - ahead, sides)) / (2 * step)
        )
    area = (rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0]).abs()
    exact = 0.5 * sides * math.sin(2 * math.pi / sides)
    smooth = (area / exact - 1).abs() < 1e-4
    assert smooth.double().mean() > 0.999  # all but where a difference straddles a seam
    assert max(float(row.abs().max()) for row in rows) < 6  # no seam tears the square apart


def test_cosine_hemisphere():
    d = sampling.cosine_hemisphere(U)
    assert_unit(d)
    assert d[2].min() >= 0
    assert_uniform(d[2].double() ** 2, azimuth(d))
    assert torch.isfinite(sampling.cosine_hemisphere(EDGES)).all()


def test_uniform_hemisphere_and_sphere():
    d = sampling.uniform_hemisphere(U)
    assert_unit(d)
    assert_uniform(d[2], azimuth(d))
    d = sampling.uniform_sphere(U)
    assert_unit(d)
    assert_uniform((d[2].double() + 1) / 2, azimuth(d))
    for warp in (sampling.uniform_hemisphere, sampling.uniform_sphere):
        assert torch.isfinite(warp(EDGES)).all()


@pytest.mark.parametrize("width", [1e-12, 1e-7, 1e-3, 0.5, 1.0, 2.0])
def test_uniform_cone(width):
    d = sampling.uniform_cone(U, torch.full((U.shape[1],), width))
    assert_unit(d)
    # From the sine, since 1 - cos of a narrow cone is lost in float32.
    sin2 = (d[:2].double() ** 2).sum(0)
    drop = torch.where(d[2] > 0.5, sin2 / (1 + (1 - sin2).clamp_min(0).sqrt()), 1 - d[2].double())
    assert drop.max() <= width * (1 + 1e-5)
    assert_uniform(drop / width, azimuth(d))


def test_uniform_triangle():
    b = sampling.uniform_triangle(U)
    assert b.min() >= 0
    assert b.sum(0).max() <= 1
    # Fold (u, v) onto the unit square: sqrt(1 - u') and v / (1 - u) are uniform for uniform (u, v).
    u, v = b.double()
    assert_uniform((1 - u) ** 2, v / (1 - u))
    edges = sampling.uniform_triangle(EDGES)
    assert edges.min() >= 0
    assert edges.sum(0).max() <= 1


def test_one_minus_cos_has_no_cancellation():
    sin2 = torch.logspace(-38, 0, 2000, dtype=torch.float64)
    exact = sin2 / (1 + (1 - sin2).sqrt())
    found = sampling.one_minus_cos(sin2.float()).double()
    relative = (found / exact - 1).abs()
    assert relative[sin2 < 6e-4].max() < 1e-6
    assert relative[sin2 < 1 - 1e-6].max() < 2e-4  # above the series: half an ulp of 1 over 3.4e-4
    assert float(sampling.one_minus_cos(torch.tensor(1.0))) == 1.0
    assert float(sampling.one_minus_cos(torch.tensor(0.0))) == 0.0
