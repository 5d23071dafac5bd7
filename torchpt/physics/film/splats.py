"""Light that samples bring to other pixels than their own, summed the same in whatever order it comes."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

__all__ = ["LARGEST", "SplatSums", "Splats"]

#: A sum is three integers of 64 bits: whole numbers, and two times 36 bits behind the point.
BITS = 36
#: From this number on a splat counts as infinite: a sum has room for 256 of them.
LARGEST = 2.0**55
#: Splats after which carries are taken: the lower integers have room for twice as many at one pixel.
CARRY = 1 << 26


@dataclass(frozen=True)
class Splats:
    """Splats of a wave or of a chunk.

    Attributes:
        lane: ``(k,)`` int64: the samples that bring them.
        pixel: ``(k,)`` int64: pixels of the picture that they go to, counted row by row.
        value: ``(3, k)`` radiance.
    """

    lane: Tensor
    pixel: Tensor
    value: Tensor


class SplatSums:
    """Sums of splats by pixel and stream, in fixed point: integers add up to the same in any order.

    The sums are exact: only what lies below ``2**-72`` of a splat is cut off.

    Args:
        pixels: of the picture.
        streams: that share the samples, see :class:`torchpt.physics.samplers.Randomizations`.
        device: where the sums live.
    """

    def __init__(self, pixels: int, streams: int, device: torch.device) -> None:
        self._pixels, self._streams, self._added = pixels, streams, 0
        self._sums = torch.zeros(3, 3, streams * pixels, dtype=torch.int64, device=device)
        self._lock = threading.Lock()

    @staticmethod
    def bytes_of(pixels: int, streams: int) -> int:
        """Return what sums of so many pixels take."""
        return 72 * pixels * streams

    def add(self, stream: Tensor, pixel: Tensor, value: Tensor) -> None:
        """Add splats on a CPU; several threads may.

        Args:
            stream: ``(k,)`` of the samples that bring them.
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
        """Return what :meth:`add` would change, on any device: sums, places ``(n,)`` in their last axis, and values there.

        Writing these twice does no harm; see :meth:`torchpt.physics.film.Film.after`.
        """
        place, where = torch.unique(stream * self._pixels + pixel, return_inverse=True)
        with self._lock:
            self._count(len(pixel))
            total = self._sums[..., place]
        for own, part in zip(total, _parts(value.double(), torch.trunc), strict=True):
            own.index_add_(1, where, part.to(torch.int64))
        return self._sums, place, total

    def join(self, sums: Tensor) -> None:
        """Add the sums of another one, see :meth:`state`."""
        with self._lock:
            self._sums += sums
            self._added += 1
            self._carry()

    def state(self) -> Tensor:
        """Return the sums ``(3, 3, streams * pixels)`` int64, in the one form in which carries are taken."""
        with self._lock:
            self._carry()
        return self._sums

    def values(self, stream: int) -> Tensor:
        """Return the sums of a stream ``(3, pixels)`` float64."""
        with self._lock:  # a picture that is looked at on the way: others may be adding
            self._carry()
            high, middle, low = (part.double() for part in self._sums.view(3, 3, -1, self._pixels)[:, :, stream])
        return high + (middle + low * 2.0**-BITS) * 2.0**-BITS

    def _count(self, splats: int) -> None:
        """Make room for so many splats."""
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
    """Yield whole numbers in units of 1, 2**-36 and 2**-72 that add up to values in float64; ``whole`` cuts off fractions."""
    for _ in range(3):
        part = whole(value)
        yield part
        value = (value - part) * 2.0**BITS
