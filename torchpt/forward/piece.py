"""A piece of a pass by tensor operations, all or nothing: no allocation that fails leaves half a piece in the films."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchpt.errors import RenderError
from torchpt.forward.schedule import Span
from torchpt.integrators.base import Tally
from torchpt.integrators.plate import Plate
from torchpt.integrators.wave import Wave
from torchpt.shortage import ran_out

__all__ = ["Counts", "Piece", "take"]

#: How often it is tried to write what is computed already.
ATTEMPTS = 16


@dataclass
class Counts:
    """What is counted beside samples.

    Attributes:
        bad: samples that were not finite, an int64.
        light: before and after the clamp ``(2,)`` float64.
    """

    bad: Tensor
    light: Tensor

    @classmethod
    def none(cls, device: torch.device) -> Counts:
        """Nothing yet."""
        return cls(
            torch.zeros((), dtype=torch.int64, device=device), torch.zeros(2, dtype=torch.float64, device=device)
        )


@dataclass
class Piece:
    """A piece that is computed and not yet in the films.

    Attributes:
        tally: rays and paths.
        writes: places, and what they are to hold then.
    """

    tally: Tally = field(default_factory=Tally)
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


def take(wave: Wave, plate: Plate, counts: Counts, span: Span) -> Piece:
    """Compute a piece of a plate.

    Raises:
        RenderError: ``integrator.strict``, and a sample that is not finite.
    """
    first, count, sample, samples = span
    piece = Piece()
    if wave.integrator.light:
        radiance, tally = wave.radiance(first, count, sample, samples, plate)
        piece.tally.rays += tally.rays
        piece.tally.truncated += tally.truncated
        radiance = _checked(wave, radiance, plate, counts, span, piece)
        piece.writes += plate.film.after(radiance, first, sample)
    if plate.layers:
        layers = wave.layers(tuple(plate.layers), first, count, sample, samples, plate)
        piece.tally.rays += count * samples
        for name, values in layers.items():
            piece.writes += plate.layers[name].after(values, first, sample)
    return piece


def _checked(wave: Wave, radiance: Tensor, plate: Plate, counts: Counts, span: Span, piece: Piece) -> Tensor:
    """Count what is not finite and take it as black; apply the clamp."""
    finite = torch.isfinite(radiance).all(0)
    piece.writes.append((counts.bad, counts.bad + (~finite).sum()))
    integrator = wave.integrator
    if integrator.strict and not bool(finite.all()):
        s, p = (int(i) for i in (~finite).nonzero()[0])
        p = span[0] + p if plate.places is None else int(plate.places[span[0] + p])
        x0, y0, width, _ = wave.crop
        raise RenderError(
            f"integrator.strict: sample {span[2] + s} of pixel ({p % width + x0}, {p // width + y0}) is not finite"
        )
    radiance = torch.where(finite, radiance, 0.0)
    clamp = integrator.clamp
    if clamp is None:
        return radiance
    scale = (clamp / radiance.abs().amax(0).clamp_min(clamp)).clamp_max(1.0)
    clamped = radiance * scale
    light = torch.stack((radiance.double().sum(), clamped.double().sum()))
    piece.writes.append((counts.light, counts.light + light))
    return clamped
