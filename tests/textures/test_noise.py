"""Noise: against a plain loop, and what noise should be: without bias, without direction, without a place where it fails."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpt.math.hashing import mix_int
from torchpt.physics.textures import KINDS, TexturePoint
from torchpt.physics.textures.computed import ComputedNode
from torchpt.physics.textures.kinds.noise import Noise
from torchpt.spec.schema import read_params

CPU = torch.device("cpu")
COLORS = {"n.color0": torch.zeros(3), "n.color1": torch.ones(3)}


def noise(uv: Tensor, area: Tensor | None = None, dtype: torch.dtype = torch.float64, **keys: Any) -> Tensor:
    """Values between 0 and 1, as a number's slot gets them."""
    return _read(uv, area, dtype, False, **keys)


def _read(uv: Tensor, area: Tensor | None, dtype: torch.dtype, slope: bool, **keys: Any) -> Tensor:
    values = read_params(Noise, {"scale": 1.0, **keys}, "n", None).values
    made = Noise.of(values)
    node = ComputedNode(made, "n", 0, Noise.matrix(values), tuple(made.constants(values).items()), area is not None)
    numbers = {
        f"n.{key}": torch.tensor(values[key], dtype=torch.float64) for key in ("scale", "persistence", "lacunarity")
    }
    table = node.table([node], {**COLORS, **numbers}, dtype, CPU)
    lanes, point = torch.zeros(uv.shape[1], dtype=torch.int64), TexturePoint(uv.to(dtype), area)
    return torch.stack(table.slope(lanes, point)) if slope else table.look_up(lanes, point, coloured=False)


def plain(x: float, y: float, key: int) -> float:
    """One octave, by Python's own integers."""
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j

    def corner(di: int, dj: int) -> float:
        bits = mix_int(mix_int((i + di) ^ key) + j + dj) & 0xFFFFFFFF
        long, short = math.cos(math.pi / 8), math.sin(math.pi / 8)
        gx, gy = (short, long) if bits >> 31 & 1 else (long, short)
        return gx * (-1) ** (bits >> 30 & 1) * (x - di) + gy * (-1) ** (bits >> 29 & 1) * (y - dj)

    u, v = (6 * t**5 - 15 * t**4 + 10 * t**3 for t in (x, y))
    low, high = ((1 - u) * corner(0, dj) + u * corner(1, dj) for dj in (0, 1))
    return (1 - v) * low + v * high


def points(n: int, reach: float, seed: int = 3) -> Tensor:
    return (torch.rand(2, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1) * reach


@pytest.mark.parametrize("seed", [0, 7, 2**31 - 1])
def test_against_a_plain_loop(seed: int):
    values = {"octaves": 3, "persistence": 0.6, "lacunarity": 2.5, "seed": seed}
    constants = Noise(3).constants(values)
    uv = points(60, 40.0)
    found = noise(uv, **values)
    for k, (x, y) in enumerate(uv.T.tolist()):
        total = sum(
            0.6**o
            * plain(
                x * 2.5**o + constants["shifts"][2 * o],
                y * 2.5**o + constants["shifts"][2 * o + 1],
                constants["keys"][o],
            )
            for o in range(3)
        )
        assert float(found[k]) == pytest.approx(0.5 + 0.75 * total / (1 + 0.6 + 0.36), abs=1e-12)


def test_one_octave_is_its_mean_at_whole_coordinates():
    grid = torch.cartesian_prod(torch.arange(-20, 20), torch.arange(-20, 20)).T.double()
    assert torch.equal(noise(grid, octaves=1), torch.full((1600,), 0.5, dtype=torch.float64))
    assert float(_read(grid, None, torch.float64, True, octaves=1).abs().min(0).values.min()) > 0.1
    assert float(noise(grid, octaves=4).std()) > 0.02  # the others are moved, each on its own


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("octaves", [1, 16])
def test_no_place_where_it_fails(dtype: torch.dtype, octaves: int):
    """At whole and half numbers, beside them, at zeros of either sign, far out and beyond what integers hold."""
    some = torch.tensor([0.0, -0.0, 0.5, 1.0, -1.0, 255.0, 256.0, 2.0**23, 2.0**31, 2.0**32 + 1, 1e20, 1e38, math.inf])
    some = torch.cat((some, torch.nextafter(some, torch.tensor(0.0)), -some)).double()
    uv = torch.cartesian_prod(some, some).T
    keys = {"octaves": octaves, "persistence": 1.0, "lacunarity": 16.0, "scale": 1e6}
    for area in (None, torch.zeros(uv.shape[1]), torch.full((uv.shape[1],), math.inf)):
        area = None if area is None else area.to(dtype)
        found = noise(uv, area, dtype, **keys)
        assert torch.isfinite(found).all() and float(found.min()) >= 0 and float(found.max()) <= 1
        assert torch.isfinite(_read(uv, area, dtype, True, **keys)).all()


def test_gradients_are_finite_where_footprints_are_none_or_all():
    uv = points(40, 1e3).requires_grad_()
    area = torch.cat((torch.zeros(20), torch.full((20,), 1e30))).double().requires_grad_()
    value = noise(uv, area, octaves=16, lacunarity=16.0, scale=1e6).sum()
    for grad in torch.autograd.grad(value, (uv, area)):
        assert torch.isfinite(grad).all()


@pytest.mark.parametrize(("octaves", "spread"), [(1, 0.162), (4, 0.1)])
def test_its_mean_and_spread(octaves: int, spread: float):
    values = noise(points(200_000, 2e4), octaves=octaves)
    cells = 200_000  # more cells than points: as good as independent
    assert float(values.mean()) == pytest.approx(0.5, abs=4 * spread / math.sqrt(cells))
    assert float(values.std()) == pytest.approx(spread, rel=0.05)
    assert float(((values - 0.5) ** 3).mean() / values.std() ** 3) == pytest.approx(0.0, abs=0.03)


def test_no_direction_is_preferred():
    """Along either axis and either diagonal it varies alike, and is as large: within 5 %."""
    uv = points(100_000, 1e4)
    here = noise(uv, octaves=1) - 0.5
    for length in (0.25, 0.5, 1.0):
        along = []
        for angle in range(0, 180, 45):
            step = length * torch.tensor([[math.cos(math.radians(angle))], [math.sin(math.radians(angle))]])
            along.append(float((here - noise(uv + step, octaves=1) + 0.5).square().mean()))
        assert max(along) < 1.12 * min(along), (length, along)
    dx, dy = _read(uv, None, torch.float64, True, octaves=1)
    assert float(dx.square().mean() / dy.square().mean()) == pytest.approx(1.0, abs=0.02)
    assert abs(float((dx * dy).mean() / dx.square().mean())) < 0.02


def test_cells_far_apart_have_nothing_in_common():
    """No period: not of 256, nor of any power of 2, nor between seeds or octaves."""
    uv = points(50_000, 500.0)
    here = noise(uv, octaves=1) - 0.5
    others = [
        noise(uv + torch.tensor([[float(x)], [float(y)]]), octaves=1) for x, y in ((256, 0), (0, 4096), (2**20, 2**20))
    ]
    others += [noise(uv, octaves=1, seed=seed) for seed in (1, 2, 2**30)]
    others += [noise(uv.flip(0), octaves=1)]
    for other in others:
        assert abs(float((here * (other - 0.5)).mean() / here.square().mean())) < 0.02


def test_it_is_smooth():
    """Value, slope and the slope's own change are continuous across cells."""
    along = torch.linspace(-1e-7, 1e-7, 2001, dtype=torch.float64)
    for x, y in ((3.0, 0.37), (0.61, -8.0)):
        uv = torch.stack((x + along, y + along))
        assert float(noise(uv, octaves=1).diff().abs().max()) < 1e-9
        assert float(_read(uv, None, torch.float64, True, octaves=1).diff().abs().max()) < 1e-8


@pytest.mark.slow
def test_octaves_fade_one_after_another():
    """What a footprint leaves of each is what the mean over it leaves, by least squares."""
    uv, parts = points(20_000, 100.0), (torch.arange(10, dtype=torch.float64) + 0.5) / 10 - 0.5
    here = noise(uv, octaves=1) - 0.5
    for side in (0.3, 0.7, 1.0, 1.4):
        steps = [side * torch.stack((x, y))[:, None] for x in parts for y in parts]
        mean = torch.stack([noise(uv + step, octaves=1) - 0.5 for step in steps]).mean(0)
        share = float((mean * here).mean() / here.square().mean())
        found = noise(uv, torch.full((20_000,), side**2, dtype=torch.float64), octaves=1) - 0.5
        assert float((found / here).median()) == pytest.approx(share, abs=0.02), side
    two = noise(uv, octaves=2) - 0.5
    second = 1.5 * two - here  # times a half, the second's height
    kept = 1.5 * (noise(uv, torch.full((20_000,), 0.25, dtype=torch.float64), octaves=2) - 0.5) - 2**-0.25 * here
    assert torch.allclose(kept, second * 2**-1.0, atol=1e-12)  # whose cells are a quarter as large
    wide = torch.full((20_000,), 4.0, dtype=torch.float64)
    fine = (noise(uv, wide, octaves=6) - 0.5).std() / (noise(uv, octaves=6) - 0.5).std()
    assert float(fine) < 0.08


def test_persistence_and_octaves():
    uv = points(1000, 50.0)
    assert torch.equal(noise(uv, octaves=5, persistence=0.0), noise(uv, octaves=1))
    assert "noise" in KINDS
