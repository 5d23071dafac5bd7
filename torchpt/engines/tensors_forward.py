"""The forward engine of tensor operations: samples of a picture, in *pieces* that are traced as one wave each.

A piece is a range of pixels and samples (:data:`torchpt.core.memory.Span`). It is added to the films whole or not at all, even
if an allocation fails, so that it can be rendered again with fewer lanes.
"""

from __future__ import annotations

import math
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
from torchpt.paths.photons import LightOfSample, SentLight, data_of
from torchpt.paths.state import Photon
from torchpt.paths.store import VertexStore
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film.splats import Splats

__all__ = ["TensorsForward"]

#: Attempts to add a computed piece to the films while memory is short.
ATTEMPTS = 16


class TensorsForward:
    """Forward engine of tensor operations, see :class:`torchpt.engines.engine.Forward`.

    Args:
        wave: of the render.
        budget: number of lanes of a piece.
    """

    compiled = False
    seconds = 0.0

    def __init__(self, wave: Wave, budget: Budget) -> None:
        self.wave, self.budget = wave, budget

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return 0: no memory is allocated beforehand, the budget measures what pieces take."""
        return 0

    def run(self, spans: Sequence[work.SampleRange], each: Callable[[TaskResult | None], bool]) -> bool:
        """See :class:`torchpt.engines.engine.Forward`."""
        for pixel_set, first, count in spans:
            if not self.wave.integrator.merging_counts:
                if not self._run(
                    partial(self._render_piece, self.wave, pixel_set, None), pixel_set, first, count, each
                ):
                    return False
                continue
            for sample in range(first, first + count):
                wave, traced = self.wave.at_sample(sample), None
                if wave.integrator.merges:
                    traced = self._light_of_sample(wave, pixel_set, sample, each)
                    if traced is None:
                        return False
                if not self._run(partial(self._render_piece, wave, pixel_set, traced), pixel_set, sample, 1, each):
                    return False
        return True

    def _run(
        self,
        piece: Callable[[Span], None],
        pixel_set: PixelSet,
        first: int,
        count: int,
        each: Callable[[TaskResult | None], bool],
    ) -> bool:
        """Call ``piece`` for samples of a pixel set; return False if ``each`` has ended the render."""
        pixels = pixel_set.film.width * pixel_set.film.height
        return not any(each(self._result) for _ in self.budget.run_in_chunks(piece, pixels, first, count))

    def _light_of_sample(
        self, wave: Wave, pixel_set: PixelSet, sample: int, each: Callable[[TaskResult | None], bool]
    ) -> LightOfSample | None:
        """Return what the light paths of one sample of all pixels leave; None if the render was ended."""
        sent: list[SentLight] = []
        if wave.light_paths is not None:
            piece = partial(self._trace_light, wave.light_paths, pixel_set, sent)
            if not self._run(piece, pixel_set, sample, 1, each):
                return None
        radius = wave.integrator.radius_at(sample)
        assert radius is not None
        return LightOfSample.of(sent, radius, wave.light_path_count)

    def _trace_light(self, wave: Wave, pixel_set: PixelSet, sent: list[SentLight], span: Span) -> None:
        """Trace the light paths of a piece of one sample, and append what they leave; if it raises, nothing was added."""
        first_pixel, pixels, *_ = span
        tally, splats, found = RayCounts(), list[Splats](), list[tuple[Tensor, Tensor, Photon]]()
        radiance = tensors.trace(wave, wave.rays(*span, pixel_set), tally, splats=splats, sent=found)
        photons = [(lane.cpu().numpy(), p.float().cpu().numpy(), data_of(photon)) for lane, p, photon in found]
        lost = (~torch.isfinite(radiance).all(0)).nonzero().squeeze(1).cpu().numpy()
        sent.append(SentLight.of(first_pixel, pixels, photons, splats, lost))
        self._result = TaskResult(tally)

    def _render_piece(self, wave: Wave, pixel_set: PixelSet, traced: LightOfSample | None, span: Span) -> None:
        """Render a piece and add it to the films; if it raises, nothing was added."""
        _, pixels, _, samples = span
        piece = _computed_piece(wave, pixel_set, traced, span)
        self._result = TaskResult(piece.tally, pixels * samples, piece.lost, piece.light)
        piece.write()

    def release_workers(self, keeps: bool) -> None:
        """See :class:`torchpt.engines.engine.Forward`. There is no memory to keep."""


@dataclass
class Piece:
    """A computed piece that is not in the films yet.

    Attributes:
        tally: counts of rays and truncated paths.
        lost: samples that were not finite.
        light: sums of radiance before and after the firefly clamp; zeros without a clamp.
        writes: views of the sums of films, and the new values for them.
        splats: sums of splats, indices along their last axis, and the new values there
            (:class:`~torchpt.physics.film.splats.Splats`).
    """

    tally: RayCounts = field(default_factory=RayCounts)
    lost: NonFinite = field(default_factory=NonFinite)
    light: tuple[float, float] = (0.0, 0.0)
    writes: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    splats: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list)

    def write(self) -> None:
        """Write the piece to the films. It stores final values and does not add, so a failed attempt can be repeated.

        Raises:
            RenderError: all attempts ran out of memory.
        """
        for _ in range(ATTEMPTS):
            if fits_in_memory(self._store):
                return
        raise RenderError("not enough memory to add samples to the film")

    def _store(self) -> None:
        for view, value in self.writes:
            view.copy_(value)
        for sums, index, value in self.splats:
            sums.index_copy_(2, index, value)


def _computed_piece(wave: Wave, pixel_set: PixelSet, traced: LightOfSample | None, span: Span) -> Piece:
    """Compute a piece: the samples ``span`` of a pixel set; ``traced``: the light of their sample, if it came before."""
    piece = Piece()
    first_pixel, pixels, first_sample, samples = span
    if wave.integrator.light:
        splats: list[Splats] = []
        store = VertexStore(pixels * samples) if wave.integrator.connects else None
        of_light: Tensor | float = 0.0
        if wave.light_paths is not None and (traced is None or store is not None):
            # Their radiance is 0, or NaN where a splat is not finite. Light of the sample that came before was counted there,
            # and its paths are traced again for the vertices that camera paths are connected to.
            starts, counts = wave.light_paths.rays(*span, pixel_set), RayCounts()
            own = splats if traced is None else None
            of_light = tensors.trace(wave.light_paths, starts, counts, splats=own, store=store)
            piece.tally.rays += counts.rays
            piece.tally.truncated += counts.truncated if traced is None else 0
        rays, photons = wave.rays(*span, pixel_set), None if traced is None else traced.photons
        radiance = tensors.weighted_radiance(wave, rays, piece.tally, splats=splats, store=store, photons=photons)
        radiance = radiance + of_light
        if traced is not None:
            splats, lost = traced.of_pixels(first_pixel, pixels)
            radiance[:, torch.from_numpy(lost).to(radiance.device)] = math.nan
        radiance = radiance.view(3, samples, pixels)
        finite = torch.isfinite(radiance).all(0)
        if not bool(finite.all()):
            piece.lost = NonFinite.of(radiance, first_pixel, first_sample, wave.crop, pixel_set)
            radiance = torch.where(finite, radiance, 0.0)
        clamp = wave.integrator.clamp
        if clamp is not None:
            before = _sum_of_light(radiance, splats)
            radiance = radiance * clamp_scale(radiance, clamp)
            splats = [replace(x, value=x.value * clamp_scale(x.value, clamp)) for x in splats]
            before, after = torch.stack((before, _sum_of_light(radiance, splats))).tolist()  # one transfer
            piece.light = before, after
        piece.writes += pixel_set.film.writes_of_add(radiance, first_pixel, first_sample)
        if pixel_set.film.splats is not None and splats:
            lane, pixel, value = (
                torch.cat([getattr(x, name) for x in splats], -1) for name in ("lane", "pixel", "value")
            )
            # lanes run over the pixels of a sample, then over samples
            stream = pixel_set.film.randomization_of(first_sample + lane // pixels)
            piece.splats.append(pixel_set.film.splats.writes_of_add(stream, pixel, value))
    if pixel_set.layers:  # AOVs, by camera rays of their own
        piece.tally.rays += pixels * samples
        for name, values in tensors.layers(wave, tuple(pixel_set.layers), *span, pixel_set).items():
            piece.writes += pixel_set.layers[name].writes_of_add(values, first_pixel, first_sample)
    return piece


def _sum_of_light(radiance: Tensor, splats: Sequence[Splats]) -> Tensor:
    return radiance.double().sum() + sum(x.value.double().sum() for x in splats)
