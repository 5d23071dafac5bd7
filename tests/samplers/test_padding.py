"""Padded Sobol' sets are independent of each other: shuffled, not only scrambled."""

from __future__ import annotations

import pytest
import torch

import torchpt
from torchpt.physics.samplers import Dimension, Draws, Sampler, salts

CPU = torch.device("cpu")


def draws(kind: str, pixel: int, points: int, depth: int) -> Draws:
    key = Sampler(kind, 0).key(torch.full((points,), pixel), torch.arange(points))
    return Draws(kind, key, salts(depth, CPU))


@pytest.mark.parametrize("kind", ["sobol", "independent"])
@pytest.mark.parametrize(
    ("first", "second"),
    [((Dimension.ROULETTE, 5), (Dimension.ROULETTE, 6)), ((Dimension.LIGHT_DIGITS, 2), (Dimension.ROULETTE, 2))],
)
def test_two_sets_of_one_dimension_fill_the_square(kind, first, second):
    # Scrambled alone, the top bits of both would differ by a constant: two of the four quarters would stay empty.
    shares = []
    for pixel in range(24):
        a = draws(kind, pixel, 256, first[1]).one(first[0]) < 0.5
        b = draws(kind, pixel, 256, second[1]).one(second[0]) < 0.5
        shares.append((a & b).float().mean())
    share = torch.stack(shares)
    assert float(share.min()) > 0.1 and float(share.max()) < 0.4  # 5 standard deviations of 256 fair draws


def test_roulette_converges():
    # A closed furnace of albedo 0.8 with roulette from the first vertex: all of the error is roulette's.
    room = {
        "camera": {"type": "perspective", "origin": [0, 0, 0], "target": [0, 0, 1], "fov": 60},
        "film": {"width": 12, "height": 12, "filter": "box"},
        "integrator": {"type": "path", "max_depth": -1, "rr_depth": 1, "rr_prob": 0.8},
        "materials": {"a": {"type": "diffuse", "reflectance": 0.8}},
        "shapes": {"room": {"type": "cube", "material": "a", "emission": 1, "flip_normals": True}},
    }
    scene = torchpt.load(room, "cpu")
    few, many = (float(torchpt.render(scene, spp=spp)[..., 0].std()) for spp in (16, 256))
    assert many < few / 3  # sixteen times the samples: a quarter at the Monte Carlo rate
