"""How many lanes and samples are taken at once. How long passes are, ``stopping.py`` says; how they are cut, ``waves.py``."""

from __future__ import annotations

import torch

from torchpt.forward.budget import Budget
from torchpt.settings import Settings

__all__ = ["BLOCK", "BYTES_PER_LANE", "LANES", "LARGEST_PASS", "Span", "budget_of", "streams_of"]

#: Lanes of a wave where memory is not limited: large enough to hide the cost of dispatch, small enough for the caches.
LANES = {"cpu": 1 << 18, "cuda": 1 << 22}
#: Peak bytes a lane takes in a wave, measured on the Cornell box; under a tape each vertex keeps about this much.
BYTES_PER_LANE = 640
#: From this many samples a pixel on they are shared by four streams, below by two, where every pixel is to know its variance.
#: Each takes something from Sobol' points (Cornell box, 64 spp: relMSE 0.38, 0.50, 0.58 of independent sampling for one, two,
#: four); four make the variance of a single pixel less of a guess.
MANY_SAMPLES = 256
#: A pass never holds more samples a pixel than this.
LARGEST_PASS = 64
#: Where something else than the number of samples may end a render, passes hold no more than this.
BLOCK = 16

#: ``(first_pixel, pixels, first_sample, samples)``
Span = tuple[int, int, int, int]


def streams_of(settings: Settings) -> int:
    """How many streams share the samples of a pixel: one, unless each pixel is to know its variance."""
    spp = settings.render.spp
    return min(spp, 4 if spp >= MANY_SAMPLES else 2) if "variance" in settings.film.aovs else 1


def budget_of(settings: Settings, device: torch.device, per_lane: int = BYTES_PER_LANE) -> Budget:
    """What waves of tensor operations may hold, under ``render.max_memory``."""
    return Budget(settings.render.max_memory, device, LANES.get(device.type, LANES["cpu"]), per_lane)
