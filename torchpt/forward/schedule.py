"""How a pass over samples is cut: chunks of pixels, lanes of a wave. How long passes are, ``stopping.py`` says."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchpt.settings import Settings

__all__ = ["BLOCK", "BYTES_PER_LANE", "LANES", "LARGEST_PASS", "Span", "lanes_for", "pieces", "streams_of"]

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


def pieces(lanes: int, pixels: int, first: int, count: int) -> Iterator[Span]:
    """Samples ``first .. first + count`` of all pixels in chunks of so many lanes: they split pixels, never samples' order."""
    batch = max(min(count, lanes), 1)
    for start in range(first, first + count, batch):
        samples = min(batch, first + count - start)
        step = max(lanes // samples, 1)
        for pixel in range(0, pixels, step):
            yield pixel, min(step, pixels - pixel), start, samples


def lanes_for(settings: Settings, device: torch.device, per_lane: int = BYTES_PER_LANE) -> int:
    """Lanes of a wave, under ``render.max_memory``."""
    lanes = LANES.get(device.type, LANES["cpu"])
    if settings.render.max_memory is not None:
        lanes = min(lanes, max(settings.render.max_memory // per_lane, 1))
    return lanes
