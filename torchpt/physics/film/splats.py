"""Sums of splats, which do not depend on the order of addition."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

__all__ = ["LARGEST", "SplatSums", "Splats"]

#: A sum is three 64-bit integers: the whole part, and twice 36 bits of the fraction.
BITS = 36
#: Splats from this value on count as infinite: a sum holds 256 of them.
LARGEST = 2.0**55
#: Number of splats after which carries are propagated: the lower integers hold twice as many at one pixel.
CARRY = 1 << 26


@dataclass(frozen=True)
class Splats:
    """Splats of a wave or of a chunk.

    Attributes:
        lane: ``(k,)`` int64 lanes of the samples.
        pixel: ``(k,)`` int64 indices of the target pixels, row by row.
        value: ``(3, k)`` radiance.
    """

    lane: Tensor
    pixel: Tensor
    value: Tensor


class SplatSums:
    """Sums of splats by pixel and randomization, in fixed point: the same in any order of addition.

    The sums are exact, but for truncation of each splat below ``2**-72``.

    Args:
        pixels: number of pixels of the picture.
        streams: number of randomizations, see :class:`torchpt.physics.samplers.Randomizations`.
        device: device of the sums.
    """

    def __init__(self, pixels: int, streams: int, device: torch.device) -> None:
        self._pixels, self._streams, self._added = pixels, streams, 0
        self._sums = torch.zeros(3, 3, streams * pixels, dtype=torch.int64, device=device)
        self._lock = threading.Lock()

    @staticmethod
    def bytes_of(pixels: int, streams: int) -> int:
        """Return the size in bytes of the sums of this many pixels."""
        return 72 * pixels * streams

    def add(self, stream: Tensor, pixel: Tensor, value: Tensor) -> None:
        """Add splats on a CPU; thread-safe.

        Args:
            stream: ``(k,)`` int64 randomizations of the samples.
            pixel: ``(k,)`` int64.
            value: ``(3, k)``, each less than :data:`LARGEST`.
        """
        # By numpy: torch would start a team of threads for each thread that renders.
        place, sums = stream.numpy() * self._pixels + pixel.numpy(), self._sums.numpy()
        parts = [part.astype(np.int64) for part in _parts(value.numpy().astype(np.float64), np.trunc)]
        with self._lock:
            self._count(len(place))
            for total, part in zip(sums, parts, strict=True):
                for row, values in zip(total, part, strict=True):
                    np.add.at(row, place, values)

    def after(self, stream: Tensor, pixel: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what :meth:`add` would change, on any device: sums, indices ``(n,)`` into their last axis, and new values.

        Writing the values twice has no further effect; see :meth:`torchpt.physics.film.Film.after`.
        """
        place, where = torch.unique(stream * self._pixels + pixel, return_inverse=True)
        with self._lock:
            self._count(len(pixel))
            total = self._sums[..., place]
        for own, part in zip(total, _parts(value.double(), torch.trunc), strict=True):
            own.index_add_(1, where, part.to(torch.int64))
        return self._sums, place, total

    def join(self, sums: Tensor) -> None:
        """Add sums from :meth:`state` of another object."""
        with self._lock:
            self._sums += sums
            self._added += 1
            self._carry()

    def state(self) -> Tensor:
        """Return the sums ``(3, 3, streams * pixels)`` int64, with all carries propagated, so that they are unique."""
        with self._lock:
            self._carry()
        return self._sums

    def values(self, stream: int) -> Tensor:
        """Return the sums of one randomization ``(3, pixels)`` float64."""
        with self._lock:  # other threads may be adding while a preview is read
            self._carry()
            high, middle, low = (part.double() for part in self._sums.view(3, 3, -1, self._pixels)[:, :, stream])
        return high + (middle + low * 2.0**-BITS) * 2.0**-BITS

    def _count(self, splats: int) -> None:
        """Count splats that are about to be added, after propagating carries if there are too many."""
        if self._added + splats > CARRY:
            self._carry()
        self._added += splats

    def _carry(self) -> None:
        if not self._added:
            return
        high, middle, low = self._sums
        middle += low >> BITS
        low &= (1 << BITS) - 1
        high += middle >> BITS
        middle &= (1 << BITS) - 1
        self._added = 0


def _parts(value, whole):
    """Yield integers in units of 1, 2**-36 and 2**-72 that add up to ``value``, in float64; ``whole`` truncates."""
    for _ in range(3):
        part = whole(value)
        yield part
        value = (value - part) * 2.0**BITS
