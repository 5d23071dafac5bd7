"""Samples by tensor operations, in pieces, each all or nothing: no allocation that fails leaves half a piece in the films."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.core.memory import Budget, Span, fits_in_memory
from torchpt.engines import tensors, work
from torchpt.engines.work import TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film.splats import Splats

__all__ = ["TensorsForward"]

#: How often it is tried to write what is computed already.
ATTEMPTS = 16


class TensorsForward:
    """Takes samples, see :class:`torchpt.engines.engine.Forward`.

    Args:
        wave: of the render.
        budget: lanes of a piece.
    """

    compiled = False
    seconds = 0.0

    def __init__(self, wave: Wave, budget: Budget) -> None:
        self.wave, self.budget = wave, budget

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return 0: no memory is taken beforehand."""
        return 0

    def run(self, spans: Sequence[work.Span], each: Callable[[TaskResult | None], bool]) -> bool:
        """See :class:`torchpt.engines.engine.Forward`."""
        for pixel_set, first, count in spans:
            pixels = pixel_set.film.width * pixel_set.film.height
            for _ in self.budget.through(partial(self._take, pixel_set), pixels, first, count):
                if each(self._share):
                    return False
        return True

    def _take(self, pixel_set: PixelSet, span: Span) -> None:
        """Take a piece: all of it, or nothing where it raises."""
        piece = _piece(self.wave, pixel_set, span)
        self._share = TaskResult(piece.tally, span[1] * span[3], piece.lost, piece.light)
        piece.write()

    def release_workers(self, keeps: bool) -> None:
        """See :class:`torchpt.engines.engine.Forward`: there is nothing to keep."""


@dataclass
class Piece:
    """A piece that is computed and not yet in the films.

    Attributes:
        tally: rays and paths.
        lost: samples that were not finite.
        light: before and after the clamp.
        writes: places, and what they are to hold then.
        splats: the same of sums of splats: these, places in their last axis, values.
    """

    tally: RayCounts = field(default_factory=RayCounts)
    lost: NonFinite = field(default_factory=NonFinite)
    light: tuple[float, float] = (0.0, 0.0)
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


def _piece(wave: Wave, pixel_set: PixelSet, span: Span) -> Piece:
    """Compute a piece: samples ``span`` of a plate."""
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
            before = _light(radiance, splats)
            radiance = radiance * clamp_scale(radiance, clamp)
            splats = [replace(one, value=one.value * clamp_scale(one.value, clamp)) for one in splats]
            piece.light = before, _light(radiance, splats)
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


def _light(radiance: Tensor, splats: Sequence[Splats]) -> float:
    return float(radiance.double().sum() + sum(one.value.double().sum() for one in splats))
