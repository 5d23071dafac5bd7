"""The forward engine of tensor operations: samples of a picture, in *pieces* that are traced as one wave each.

A piece is a range of pixels and samples (:data:`torchpt.core.memory.Span`). It is added to the films whole or not at all, even
if an allocation fails, so that it can be rendered again with fewer lanes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.core.memory import Budget, Span, fits_in_memory
from torchpt.engines import tensors, work
from torchpt.engines.work import TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.photons import PHOTON, PhotonMap
from torchpt.paths.state import Photon
from torchpt.paths.store import VertexStore
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film import Film
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
            if self.wave.integrator.radius_at(0) is None:
                if not self._run(self.wave, pixel_set, first, count, each):
                    return False
                continue
            for sample in range(first, first + count):
                wave = self.wave.at_sample(sample)
                traced = self._trace_light_paths(wave, pixel_set, sample) if wave.integrator.merges else None
                if not self._run(wave, pixel_set, sample, 1, each, traced):
                    return False
        return True

    def _run(
        self,
        wave: Wave,
        pixel_set: PixelSet,
        first: int,
        count: int,
        each: Callable[[TaskResult | None], bool],
        traced: _LightPaths | None = None,
    ) -> bool:
        """Render samples of a pixel set in pieces; ``traced``: the light paths, if they came before."""
        pixels = pixel_set.film.width * pixel_set.film.height
        piece = partial(self._render_piece, wave, pixel_set, traced)
        return not any(each(self._result) for _ in self.budget.run_in_chunks(piece, pixels, first, count))

    def _trace_light_paths(self, wave: Wave, pixel_set: PixelSet, sample: int) -> _LightPaths:
        """Trace the light paths of one sample of all pixels, and return what they leave."""
        traced, radius = _LightPaths(), wave.integrator.radius_at(sample)
        assert radius is not None
        if wave.light_paths is not None:
            pixels = pixel_set.film.width * pixel_set.film.height
            for _ in self.budget.run_in_chunks(partial(traced.trace, wave.light_paths, pixel_set), pixels, sample, 1):
                pass
        traced.end(radius, wave.light_path_count)
        return traced

    def _render_piece(self, wave: Wave, pixel_set: PixelSet, traced: _LightPaths | None, span: Span) -> None:
        """Render a piece and add it to the films; if it raises, nothing was added."""
        _, pixels, _, samples = span
        piece = _computed_piece(wave, pixel_set, traced, span)
        if traced is not None:  # counted with the first piece
            piece.tally.rays += traced.tally.rays
            piece.tally.truncated += traced.tally.truncated
            traced.tally = RayCounts()
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


class _LightPaths:
    """What the light paths of one sample of all pixels leave, but for their splats, which are in the film.

    Attributes:
        tally: counts of their rays.
        photons: their photons.
    """

    def __init__(self) -> None:
        self.tally = RayCounts()
        self.photons: PhotonMap | None = None
        self._parts: list[tuple[np.ndarray, dict[str, np.ndarray]]] = []
        self._radiance: list[Tensor] = []

    def trace(self, wave: Wave, pixel_set: PixelSet, span: Span) -> None:
        """Trace the paths of a piece of one sample; if it raises, nothing was added."""
        first_pixel, _, sample, _ = span
        piece, splats, sent = Piece(), list[Splats](), list[tuple[Tensor, Photon]]()
        radiance = tensors.trace(wave, wave.rays(*span, pixel_set), piece.tally, splats=splats, sent=sent)
        parts = [
            ((lane + first_pixel).cpu().numpy(), {name: getattr(photon, name).cpu().numpy() for name in PHOTON})
            for lane, photon in sent
        ]
        _add_splats(piece, pixel_set.film, splats, lambda lane: sample + lane * 0)
        piece.write()
        self._parts += parts
        self._radiance.append(radiance)
        self.tally.rays += piece.tally.rays
        self.tally.truncated += piece.tally.truncated

    def end(self, radius: float, paths: float) -> None:
        """Sort the photons, once all paths are traced; arguments as for :meth:`PhotonMap.of`."""
        self.photons = PhotonMap.of(self._parts, radius, paths)
        self._parts.clear()
        if self._radiance:
            self._radiance = [torch.cat(self._radiance, 1)]

    def radiance(self, first_pixel: int, pixels: int) -> Tensor | float:
        """Return the radiance of the paths of some pixels ``(3, pixels)``: 0, or NaN where a splat is not finite."""
        return self._radiance[0][:, first_pixel : first_pixel + pixels] if self._radiance else 0.0


def _computed_piece(wave: Wave, pixel_set: PixelSet, traced: _LightPaths | None, span: Span) -> Piece:
    """Compute a piece: the samples ``span`` of a pixel set; ``traced``: the light paths, if they came before."""
    piece = Piece()
    first_pixel, pixels, first_sample, samples = span
    if wave.integrator.light:
        splats: list[Splats] = []
        store = VertexStore(pixels * samples) if wave.integrator.connects else None
        of_light: Tensor | float = 0.0
        if traced is not None:
            of_light = traced.radiance(first_pixel, pixels)
            if (
                store is not None and wave.light_paths is not None
            ):  # again, for the vertices that paths are connected to
                tensors.trace(wave.light_paths, wave.light_paths.rays(*span, pixel_set), piece.tally, store=store)
        elif wave.light_paths is not None:  # their radiance is 0, or NaN where a splat is not finite
            starts = wave.light_paths.rays(*span, pixel_set)
            of_light = tensors.trace(wave.light_paths, starts, piece.tally, splats=splats, store=store)
        rays, photons = wave.rays(*span, pixel_set), None if traced is None else traced.photons
        radiance = tensors.weighted_radiance(wave, rays, piece.tally, splats=splats, store=store, photons=photons)
        radiance = radiance + of_light
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
        # lanes run over the pixels of a sample, then over samples
        _add_splats(piece, pixel_set.film, splats, lambda lane: first_sample + lane // pixels)
    if pixel_set.layers:  # AOVs, by camera rays of their own
        piece.tally.rays += pixels * samples
        for name, values in tensors.layers(wave, tuple(pixel_set.layers), *span, pixel_set).items():
            piece.writes += pixel_set.layers[name].writes_of_add(values, first_pixel, first_sample)
    return piece


def _add_splats(piece: Piece, film: Film, splats: Sequence[Splats], sample_of: Callable[[Tensor], Tensor]) -> None:
    """Add splats to a piece; ``sample_of`` returns the samples of lanes."""
    if film.splats is None or not splats:
        return
    lane, pixel, value = (torch.cat([getattr(x, name) for x in splats], -1) for name in ("lane", "pixel", "value"))
    piece.splats.append(film.splats.writes_of_add(film.randomization_of(sample_of(lane)), pixel, value))


def _sum_of_light(radiance: Tensor, splats: Sequence[Splats]) -> Tensor:
    return radiance.double().sum() + sum(x.value.double().sum() for x in splats)
