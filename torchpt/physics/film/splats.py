"""Sums of splats, which do not depend on the order of addition.

A splat is radiance that a path adds to a pixel other than its own. Threads add splats to any pixel at any time, so the sums are
integers (fixed point): integer addition gives the same bits in any order.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchpt.native.kernels import kernel

__all__ = ["LARGEST", "SplatSums", "Splats"]

#: A sum is three 64-bit integers, *limbs*: the whole part, and twice this many bits of the fraction.
FRACTION_BITS = 36
#: Splats from this value on count as infinite: a sum holds 256 of them below 2^63.
LARGEST = 2.0**55
#: Number of splats after which carries are propagated: a limb of 64 bits holds twice as many of 36 bits.
SPLATS_BEFORE_CARRY = 1 << 26


@dataclass(frozen=True)
class Splats:
    """The k splats of a wave or of a chunk (the samples that are traced together).

    Attributes:
        lane: ``(k,)`` int64 index, within the wave or chunk, of the sample that sends each splat.
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
        randomizations: number of randomizations of the sampler, see :class:`torchpt.physics.samplers.Randomizations`.
        device: device of the sums.
    """

    def __init__(self, pixels: int, randomizations: int, device: torch.device) -> None:
        self._pixels = pixels
        self._since_carry = 0  # splats since carries were last propagated
        # Limbs, highest first; channels; sums of randomization k at pixel p at k * pixels + p.
        self._sums = torch.zeros(3, 3, randomizations * pixels, dtype=torch.int64, device=device)
        self._lock = threading.Lock()
        if device.type == "cpu":
            kernel("splats", "add")  # compiled before samples are added

    @staticmethod
    def bytes_of(pixels: int, randomizations: int) -> int:
        """Return the size in bytes of the sums of this many pixels."""
        return 72 * pixels * randomizations  # three limbs of 8 bytes for each of three channels

    def add(self, randomization: Tensor, pixel: Tensor, value: Tensor) -> None:
        """Add splats on a CPU; thread-safe.

        Args:
            randomization: ``(k,)`` int64 index of the randomization of each splat's sample.
            pixel: ``(k,)`` int64 index of the target pixel.
            value: ``(3, k)``, each less than :data:`LARGEST`.

        Raises:
            IndexError: a pixel is not one of the picture.
        """
        # By numpy: torch would start a team of threads for each thread that renders.
        pixels, sums, values = pixel.numpy(), self._sums.numpy(), value.numpy().astype(np.float64, order="C")
        if len(pixels) and not 0 <= pixels.min() <= pixels.max() < self._pixels:
            raise IndexError(f"splats at pixels {pixels.min()} to {pixels.max()} of a picture of {self._pixels} pixels")
        index = randomization.numpy() * self._pixels + pixels
        with self._lock:
            self._count(len(index))
            kernel("splats", "add")(sums.reshape(-1), sums.shape[2], index, len(index), values.reshape(-1))

    def writes_of_add(self, randomization: Tensor, pixel: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the changes that :meth:`add` would make, on any device; arguments as there.

        Nothing is changed. Writing the values twice has no further effect, as for
        :meth:`torchpt.physics.film.Film.writes_of_add`.

        Returns:
            The sums ``(3, 3, m)``, indices ``(n,)`` int64 into their last axis, and the new values there ``(3, 3, n)``.
        """
        index, index_of_splat = torch.unique(randomization * self._pixels + pixel, return_inverse=True)
        with self._lock:
            self._count(len(pixel))
            values = self._sums[..., index]
        for values_of_limb, limb in zip(values, _limbs(value.double()), strict=True):
            values_of_limb.index_add_(1, index_of_splat, limb.to(torch.int64))
        return self._sums, index, values

    def add_state(self, sums: Tensor) -> None:
        """Add sums from :meth:`state` of another object."""
        with self._lock:
            self._sums += sums
            self._since_carry += 1
            self._carry()

    def state(self) -> Tensor:
        """Return the sums ``(3, 3, randomizations * pixels)`` int64, with all carries propagated, so that they are unique."""
        with self._lock:
            self._carry()
        return self._sums

    def values(self, randomization: int) -> Tensor:
        """Return the sums of one randomization ``(3, pixels)`` float64."""
        with self._lock:  # other threads may be adding while a preview is read
            self._carry()
            limbs = self._sums.view(3, 3, -1, self._pixels)[:, :, randomization]
            high, middle, low = (limb.double() for limb in limbs)
        return high + (middle + low * 2.0**-FRACTION_BITS) * 2.0**-FRACTION_BITS

    def _count(self, splats: int) -> None:
        """Count splats that are about to be added, after propagating carries if there are too many."""
        if self._since_carry + splats > SPLATS_BEFORE_CARRY:
            self._carry()
        self._since_carry += splats

    def _carry(self) -> None:
        """Move what exceeds the bits of a lower limb to the next higher one; the caller holds the lock."""
        if not self._since_carry:
            return
        high, middle, low = self._sums
        middle += low >> FRACTION_BITS
        low &= (1 << FRACTION_BITS) - 1
        high += middle >> FRACTION_BITS
        middle &= (1 << FRACTION_BITS) - 1
        self._since_carry = 0


def _limbs(value: Tensor) -> Iterator[Tensor]:
    """Yield three integers, in float64, in units of 1, 2**-36 and 2**-72 that add up to ``value``, float64."""
    for _ in range(3):
        limb = value.trunc()
        yield limb
        value = (value - limb) * 2.0**FRACTION_BITS
