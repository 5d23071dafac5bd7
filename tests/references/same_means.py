"""Compares the means of two integrators' pictures, over several seeds."""

from __future__ import annotations

from typing import Any

import torch
from significance import t_limit

import torchpt

__all__ = ["SEEDS", "assert_same_means", "means", "pictures"]

#: Seeds of each integrator, unless told.
SEEDS = 16


def pictures(
    scene: torchpt.Scene,
    name: str,
    spp: int,
    compile: str = "on",
    first_seed: int = 1,
    seeds: int = SEEDS,
    **keys: Any,
) -> torch.Tensor:
    """Return pictures ``(seeds, H, W, 3)`` of successive seeds."""
    integrator = {"type": name, **keys}
    each = range(first_seed, first_seed + seeds)
    return torch.stack(
        [torchpt.render(scene, integrator=integrator, spp=spp, seed=seed, compile=compile) for seed in each]
    ).double()


def means(images: torch.Tensor, side: int) -> torch.Tensor:
    """Return the luminance of blocks ``(seeds, blocks)`` of ``side`` pixels."""
    n, height, width, _ = images.shape
    light = images @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    return light.reshape(n, height // side, side, width // side, side).mean((2, 4)).reshape(n, -1)


def assert_same_means(a: torch.Tensor, b: torch.Tensor) -> None:
    """Check that two sets of pictures of equally many seeds have the same mean, whole and in blocks of 4 x 4 pixels."""
    seeds = len(a)
    for side in (16, 4):
        x, y = means(a, side), means(b, side)
        z = (x.mean(0) - y.mean(0)) / ((x.var(0) + y.var(0)) / seeds).sqrt().clamp_min(1e-12)
        assert float(z.abs().max()) < t_limit(z.numel(), seeds - 1), (side, float(z.abs().max()))
        assert float(z.square().mean()) < 2.0 or z.numel() < 2
