"""How a picture is cut: passes over its samples, chunks of its pixels, lanes of a wave."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from torchpt.settings import Settings

__all__ = ["BYTES_PER_LANE", "LANES", "Span", "chunks_of", "lanes_for", "passes", "randomizations_of"]

#: Lanes of a wave where memory is not limited: large enough to hide the cost of dispatch, small enough for the caches.
LANES = {"cpu": 1 << 18, "cuda": 1 << 22}
#: Peak bytes a lane takes in a wave, measured on the Cornell box; under a tape each vertex keeps about this much.
BYTES_PER_LANE = 640
#: From this many samples a pixel on they are shared by four independent randomizations, below by two. Each takes something
#: from Sobol' points (Cornell box, 64 spp: relMSE 0.38, 0.50, 0.58 of independent sampling for one, two, four), and two
#: already tell the picture's error; four make the variance of a single pixel less of a guess.
MANY_SAMPLES = 256
#: A pass never holds more samples a pixel than this.
LARGEST_PASS = 64

#: ``(first_pixel, pixels, first_sample, samples)``
Span = tuple[int, int, int, int]


def randomizations_of(spp: int) -> int:
    """How many independent randomizations share the samples of a pixel."""
    return min(spp, 4 if spp >= MANY_SAMPLES else 2)


def passes(spp: int, randomizations: int) -> Iterator[tuple[int, int]]:
    """First sample and number of samples of each pass; sizes double and depend on ``spp`` alone."""
    first, size = 0, randomizations
    while first < spp:
        count = min(size, spp - first)
        yield first, count
        first += count
        size = min(2 * size, LARGEST_PASS) if first > randomizations else size


def lanes_for(settings: Settings, device: torch.device, per_lane: int = BYTES_PER_LANE) -> int:
    """Lanes of a wave, under ``render.max_memory``."""
    lanes = LANES.get(device.type, LANES["cpu"])
    if settings.render.max_memory is not None:
        lanes = min(lanes, max(settings.render.max_memory // per_lane, 1))
    return lanes


def chunks_of(
    settings: Settings, lanes: int, randomizations: int, pixels: int
) -> Iterator[tuple[int, int, int, int, bool]]:
    """Ranges ``(first_pixel, pixels, first_sample, samples, ends_pass)``. Chunks split pixels, never samples' order."""
    for first_sample, samples in passes(settings.render.spp, randomizations):
        batch = max(min(samples, lanes), 1)
        for start in range(first_sample, first_sample + samples, batch):
            count = min(batch, first_sample + samples - start)
            step = max(lanes // count, 1)
            for first in range(0, pixels, step):
                last = first + step >= pixels and start + count == first_sample + samples
                yield first, min(step, pixels - first), start, count, last
