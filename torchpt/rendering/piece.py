"""A piece of a pass by tensor operations, all or nothing: no allocation that fails leaves half a piece in the films."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.core.memory import Span, fits_in_memory
from torchpt.engines import tensors
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film.splats import Splats

__all__ = ["Piece", "take"]

#: How often it is tried to write what is computed already.
ATTEMPTS = 16


@dataclass
class Piece:
    """A piece that is computed and not yet in the films.

    Attributes:
        tally: rays and paths.
        lost: samples that were not finite.
        writes: places, and what they are to hold then.
        splats: the same of sums of splats: these, places in their last axis, values.
    """

    tally: RayCounts = field(default_factory=RayCounts)
    lost: NonFinite = field(default_factory=NonFinite)
    writes: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    splats: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list)

    def write(self) -> None:
        """Put it into the films. Nothing is allocated; and as it says what places hold, not what is added, it can be repeated.

        Raises:
            RenderError: copying failed for want of memory again and again.
        """
        for _ in range(ATTEMPTS):
            if fits_in_memory(self._copied):
                return
        raise RenderError("not enough memory to add samples to the film")

    def _copied(self) -> None:
        for place, value in self.writes:
            place.copy_(value)
        for sums, place, value in self.splats:
            sums.index_copy_(2, place, value)


def take(wave: Wave, pixel_set: PixelSet, light: Tensor, span: Span) -> Piece:
    """Compute a piece.

    Args:
        wave: of the render.
        pixel_set: that its samples go to.
        light: all light before and after the clamp so far, ``(2,)`` float64.
        span: which samples.
    """
    piece = Piece()
    first, pixels, sample, samples = span
    if wave.integrator.light:
        splats: list[Splats] = []
        brought = tensors.brought(wave, wave.rays(*span, pixel_set), piece.tally, splats=splats)
        radiance = brought.view(3, samples, pixels)
        finite = torch.isfinite(radiance).all(0)
        if not bool(finite.all()):
            piece.lost = NonFinite.of(radiance, first, sample, wave.crop, pixel_set)
            radiance = torch.where(finite, radiance, 0.0)
        clamp = wave.integrator.clamp
        if clamp is not None:
            before = radiance.double().sum() + sum(one.value.double().sum() for one in splats)
            radiance = radiance * clamp_scale(radiance, clamp)
            splats = [replace(one, value=one.value * clamp_scale(one.value, clamp)) for one in splats]
            after = radiance.double().sum() + sum(one.value.double().sum() for one in splats)
            piece.writes.append((light, light + torch.stack((before, after))))
        piece.writes += pixel_set.film.after(radiance, first, sample)
        if pixel_set.film.splats is not None and splats:
            lane, pixel, value = (
                torch.cat([getattr(one, name) for one in splats], -1) for name in ("lane", "pixel", "value")
            )
            stream = pixel_set.film.stream(sample + lane // pixels)
            piece.splats.append(pixel_set.film.splats.after(stream, pixel, value))
    if pixel_set.layers:
        piece.tally.rays += pixels * samples
        for name, values in tensors.layers(wave, tuple(pixel_set.layers), *span, pixel_set).items():
            piece.writes += pixel_set.layers[name].after(values, first, sample)
    return piece
