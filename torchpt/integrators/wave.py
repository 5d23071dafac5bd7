"""One render's waves: a pure function from a range of pixels and samples to radiance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.accel import Accel
from torchpt.cameras import Camera
from torchpt.film import Filter
from torchpt.integrators.base import Integrator, Limits
from torchpt.integrators.plate import Plate
from torchpt.integrators.search import Search
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.tally import Tally
from torchpt.records import PathState
from torchpt.samplers import Dimension, Draws, Sampler, Streams, salts

if TYPE_CHECKING:
    from torchpt.integrators.first_surface import FirstSurface

__all__ = ["Wave", "camera_state"]


@dataclass(frozen=True)
class Wave:
    """What a render fixes for all of its waves.

    Attributes:
        stages: the stages bound to the scene.
        integrator: what makes radiance of camera rays.
        accel: the search.
        camera: on the whole film.
        filter: reconstruction filter.
        sampler: random numbers.
        crop: ``(x, y, width, height)`` of the picture on the film.
        centre: ``(3,)`` float64, see Space.shift.
        first: what happens at first surfaces; None where paths go on.
    """

    stages: Stages
    integrator: Integrator
    accel: Accel
    camera: Camera
    filter: Filter
    sampler: Sampler
    crop: tuple[int, int, int, int]
    centre: Tensor
    first: FirstSurface | None = None

    @property
    def limits(self) -> Limits | None:
        """Where paths end; None where no light is carried."""
        return self.integrator.limits if self.integrator.light else None

    def rays(
        self, first_pixel: int, pixels: int, first_sample: int, samples: int, plate: Plate | None = None
    ) -> PathState:
        """Camera rays of consecutive pixels of a plate (the picture, row by row); lanes run over pixels, then over samples."""
        device = self.centre.device
        x0, y0, width, _ = self.crop
        place = torch.arange(first_pixel, first_pixel + pixels, device=device)
        if plate is not None and plate.places is not None:
            place = plate.places[first_pixel : first_pixel + pixels]
        x, y = place % width + x0, place // width + y0
        sample = torch.arange(first_sample, first_sample + samples, device=device).repeat_interleave(pixels)
        return self.rays_of(x.repeat(samples), y.repeat(samples), sample, None if plate is None else plate.streams)

    def rays_of(self, x: Tensor, y: Tensor, sample: Tensor, streams: Streams | None = None) -> PathState:
        """Camera rays of single samples.

        Args:
            x: of pixels on the whole film ``(N,)`` int64.
            y: of them, likewise.
            sample: of theirs ``(N,)`` int64.
            streams: which share a pixel's samples; None: those of the picture.
        """
        # Numbered on the whole film, so that a crop shows the very pixels of the full picture.
        key = self.sampler.key(y * self.camera.resolution[0] + x, sample, streams)
        x, y = (a.to(self.stages.plan.dtype) for a in (x, y))
        return self.stages.generate(self.camera, self.filter, x, y, key, salts(0, self.centre.device))

    def radiance(
        self, first_pixel: int, pixels: int, first_sample: int, samples: int, plate: Plate | None = None
    ) -> Tensor:
        """Radiance ``(3, samples, pixels)``."""
        return self.brought(self.rays(first_pixel, pixels, first_sample, samples, plate)).view(3, samples, pixels)

    def brought(self, state: PathState, tally: Tally | None = None) -> Tensor:
        """Radiance ``(3, N)`` that camera rays bring, weighted by the filter; ``tally`` counts what it takes."""
        tally = Tally() if tally is None else tally
        radiance = self.integrator.radiance(self.stages, self.accel, state, self.first, tally)
        return radiance * self.weight(state) if self.filter.signed else radiance

    def weight(self, state: PathState) -> Tensor:
        """What the filter weighs the samples with ``(N,)``; after the paths are traced, since no stage needs to know."""
        draws = Draws(self.stages.plan.sampler, state.key, salts(0, self.centre.device))
        return self.filter.weight(draws.two(Dimension.PIXEL)).to(self.stages.plan.dtype)

    def layers(
        self,
        names: tuple[str, ...],
        first_pixel: int,
        pixels: int,
        first_sample: int,
        samples: int,
        plate: Plate | None = None,
        slide: bool = False,
    ) -> dict[str, Tensor]:
        """The layers ``names``, each ``(C, samples, pixels)``; ``slide``: see :func:`torchpt.integrators.aov.first_hit`."""
        state = self.rays(first_pixel, pixels, first_sample, samples, plate)
        return {name: value.view(-1, samples, pixels) for name, value in self.seen(names, state, slide).items()}

    def seen(self, names: tuple[str, ...], state: PathState, slide: bool = False) -> dict[str, Tensor]:
        """The layers ``names`` of first surfaces that camera rays meet, each ``(C, N)``, weighted by the filter."""
        from torchpt.integrators import aov

        plan, world = self.stages.plan, self.stages.world
        search = Search(self.accel, world, plan.sampler, plan.dtype)
        found = aov.first_hit(names, world, search, state, self.centre, plan.dtype, self.stages.pixel, slide)
        return aov.weighted(found, self.weight(state)) if self.filter.signed else found


def camera_state(o: Tensor, d: Tensor, key: Tensor) -> PathState:
    """Paths that begin with rays ``o, d (3, N)``, d unit, and draw by ``key``."""
    n = d.shape[1]
    forever = torch.full((n,), math.inf, dtype=d.dtype, device=d.device)
    lane, nothing = torch.arange(n, device=d.device), torch.zeros_like(d)
    return PathState(o.clone(), d, forever, torch.ones_like(d), nothing, forever.clone(), lane, key)
