"""How fast the variance of a picture falls with the number of samples: a smooth scene, directly lit."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from few import few
from trials import film_of, shoot, spread

import torchpt
from torchpt.physics.samplers import KINDS

#: A floor that fills the picture under a lamp that nothing hides: smooth in the place within a pixel and on the lamp.
SMOOTH = {
    "camera": {"origin": [0, 2, 0], "target": [0, 0, 0], "up": [0, 0, -1], "fov": 50},
    "materials": {"grey": {"type": "diffuse", "reflectance": 0.6}},
    "shapes": {
        "floor": {"type": "rectangle", "material": "grey", "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"scale": 4}]},
        "lamp": {"type": "rectangle", "emission": 6, "transform": [
            {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [1.5, 3, 0.5]}]},
    },
}  # fmt: skip


@functools.cache
def variance(kind: str, spp: int, seeds: int, size: int) -> float:
    """Mean variance of a pixel over seeds."""
    scene = torchpt.load(SMOOTH, device="cpu")
    keys = {"type": "direct", "strategy": "light"}
    images = [shoot(scene, spp, seed, kind, keys, film_of(size)).image[..., :1] for seed in range(seeds)]
    return float(spread(images)[1].mean()) * seeds


def slope(kind: str, counts: list[int], seeds: int, size: int) -> float:
    """Exponent of a power law through the variances."""
    x = torch.tensor([math.log(n) for n in counts], dtype=torch.float64)
    y = torch.tensor([math.log(variance(kind, n, seeds, size)) for n in counts], dtype=torch.float64)
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


@pytest.mark.parametrize("kind", few(KINDS, 3))
def test_slope(kind):
    found = slope(kind, [16, 256], 4, 16)
    if kind == "independent":  # 4 seeds of 256 pixels: the deviation of the slope is 0.03
        assert abs(found + 1) < 0.1
    else:
        assert found < -1.3


@pytest.mark.slow
@pytest.mark.parametrize("kind", list(KINDS))
def test_slope_over_six_octaves(kind):
    counts = [16, 32, 64, 128, 256, 512, 1024]
    found = slope(kind, counts, 8, 24)
    if kind == "independent":
        assert abs(found + 1) < 0.05
    else:
        assert found < -1.3
    if kind == "sobol":  # a hundredth of the variance at the end
        assert variance(kind, 1024, 8, 24) < 0.01 * variance("independent", 1024, 8, 24)
