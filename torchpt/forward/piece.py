"""Pieces of passes by tensor operations, all or nothing: no allocation that fails leaves half a piece in the films."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchpt.errors import RenderError
from torchpt.forward.schedule import Span
from torchpt.forward.shared import shared_wave
from torchpt.integrators.clamp import clamp_scale
from torchpt.integrators.lost import Lost
from torchpt.integrators.plate import Plate
from torchpt.integrators.tally import Tallies, Tally
from torchpt.integrators.wave import Wave
from torchpt.records import PathState, joined
from torchpt.shortage import ran_out

__all__ = ["Piece", "Work", "take"]

#: How often it is tried to write what is computed already.
ATTEMPTS = 16


@dataclass
class Piece:
    """A piece that is computed and not yet in the films.

    Attributes:
        tally: rays and paths.
        lost: samples that were not finite.
        writes: places, and what they are to hold then.
    """

    tally: Tally = field(default_factory=Tally)
    lost: Lost = field(default_factory=Lost)
    writes: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    def write(self) -> None:
        """Put it into the films. Nothing is allocated; and as it says what places hold, not what is added, it can be repeated.

        Raises:
            RenderError: copying failed for want of memory again and again.
        """
        for _ in range(ATTEMPTS):
            if self._written():
                return
        raise RenderError("not enough memory to add samples to the film")

    def _written(self) -> bool:
        try:
            for place, value in self.writes:
                place.copy_(value)
        except Exception as error:
            if not ran_out(error):
                raise
            return False
        return True


@dataclass(frozen=True)
class Work:
    """What a piece is to be of.

    Attributes:
        wave: of the render.
        plate: that its samples go to.
        light: all light before and after the clamp so far, ``(2,)`` float64.
        span: which samples.
    """

    wave: Wave
    plate: Plate
    light: Tensor
    span: Span

    @property
    def lanes(self) -> int:
        """How many samples."""
        _, pixels, _, samples = self.span
        return pixels * samples

    def rays(self) -> PathState:
        """The camera rays of the samples."""
        return self.wave.rays(*self.span, self.plate)


def take(works: Sequence[Work]) -> list[Piece]:
    """Compute pieces by one wave, to the very bits that each has alone; several are :func:`torchpt.forward.shared.alike`."""
    wave, scenes = shared_wave([work.wave for work in works])
    plate, sizes = works[0].plate, [work.lanes for work in works]
    pieces = [Piece() for _ in works]
    if wave.integrator.light:
        tally = Tally() if len(works) == 1 else Tallies(sizes, wave.centre.device)
        radiance = wave.brought(_state(works, scenes), tally)
        finite = torch.isfinite(radiance).all(0)
        every = bool(finite.all())
        of_each = zip(works, pieces, radiance.split(sizes, 1), finite.split(sizes), tally.each(), strict=True)
        for work, piece, own, known, its in of_each:
            piece.tally = its
            _add_light(work, piece, own, None if every else known)
    if plate.layers:
        layers = wave.seen(tuple(plate.layers), _state(works, scenes))
        parts = {name: values.split(sizes, 1) for name, values in layers.items()}
        for number, (work, piece) in enumerate(zip(works, pieces, strict=True)):
            piece.tally.rays += work.lanes
            first, pixels, sample, samples = work.span
            for name, values in parts.items():
                own = values[number].reshape(-1, samples, pixels)
                piece.writes += work.plate.layers[name].after(own, first, sample)
    return pieces


def _state(works: Sequence[Work], scenes: Sequence[int] | None) -> PathState:
    """The camera rays of all samples; their lanes follow each other. ``scenes``: which one each piece is of, of several."""
    states, before = [], 0
    for number, work in enumerate(works):
        state = work.rays()
        if before:
            state = replace(state, lane=state.lane + before)
        if scenes is not None:
            state = replace(state, scene=torch.full_like(state.lane, scenes[number]))
        states.append(state)
        before += work.lanes
    return joined(states)


def _add_light(work: Work, piece: Piece, radiance: Tensor, finite: Tensor | None) -> None:
    """Put radiance ``(3, n)`` where it belongs, but for samples that are not ``finite (n,)``; None: all are."""
    first, pixels, sample, samples = work.span
    radiance = radiance.reshape(3, samples, pixels)
    if finite is not None:
        piece.lost = Lost.of(radiance, first, sample, work.wave.crop, work.plate)
        radiance = torch.where(finite.view(samples, pixels), radiance, 0.0)
    clamp = work.wave.integrator.clamp
    if clamp is not None:
        clamped = radiance * clamp_scale(radiance, clamp)
        sums = torch.stack((radiance.double().sum(), clamped.double().sum()))
        piece.writes.append((work.light, work.light + sums))
        radiance = clamped
    piece.writes += work.plate.film.after(radiance, first, sample)
