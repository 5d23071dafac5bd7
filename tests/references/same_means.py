"""Whether the pictures of two integrators have the same means, over several seeds."""

from __future__ import annotations

from typing import Any

import torch
from significance import t_limit

import torchpt

__all__ = ["SEEDS", "assert_same_means", "means", "pictures"]

#: Seeds of each integrator.
SEEDS = 12


def pictures(
    scene: torchpt.Scene, name: str, spp: int, compile: str = "on", first_seed: int = 1, **keys: Any
) -> torch.Tensor:
    integrator = {"type": name, **keys}
    seeds = range(first_seed, first_seed + SEEDS)
    return torch.stack(
        [torchpt.render(scene, integrator=integrator, spp=spp, seed=seed, compile=compile) for seed in seeds]
    ).double()


def means(images: torch.Tensor, side: int) -> torch.Tensor:
    """Return the luminance of blocks ``(SEEDS, blocks)`` of ``side`` pixels."""
    n, height, width, _ = images.shape
    light = images @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    return light.reshape(n, height // side, side, width // side, side).mean((2, 4)).reshape(n, -1)


def assert_same_means(a: torch.Tensor, b: torch.Tensor) -> None:
    for side in (16, 4):
        x, y = means(a, side), means(b, side)
        z = (x.mean(0) - y.mean(0)) / ((x.var(0) + y.var(0)) / SEEDS).sqrt().clamp_min(1e-12)
        assert float(z.abs().max()) < t_limit(z.numel(), SEEDS - 1), (side, float(z.abs().max()))
        assert float(z.square().mean()) < 2.0 or z.numel() < 2
