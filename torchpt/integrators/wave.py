"""One render's waves: a pure function from a range of pixels and samples to radiance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt import lights
from torchpt.accel.base import Accel
from torchpt.cameras import Camera
from torchpt.film import FILTERS, Filter
from torchpt.integrators.base import Integrator
from torchpt.integrators.plate import Plate
from torchpt.integrators.stages import generate
from torchpt.integrators.vertex import StageContext, VertexInput, VertexOutput
from torchpt.math.vectors import take
from torchpt.records import PathState
from torchpt.samplers import Dimension, Draws, Sampler, Streams, salts

if TYPE_CHECKING:
    from torchpt.integrators.first_surface import FirstSurface

#: A stage of the surfaces of one BSDF model.
Bounce = Callable[[StageContext, int, VertexInput], VertexOutput]

__all__ = ["Bounce", "Rays", "Wave", "camera_state", "still_of"]


@dataclass(frozen=True)
class Rays:
    """Rays that paths begin with in place of a camera's: one for each pixel of a picture of one row.

    Attributes:
        o: origins ``(3, N)``, in the lanes' coordinates.
        d: unit directions ``(3, N)``.
        number: ``(N,)`` int64 of the pixels whose random numbers they have; None: of their own.
    """

    o: Tensor
    d: Tensor
    number: Tensor | None = None


@dataclass(frozen=True)
class Wave:
    """All that a render fixes for its waves.

    Attributes:
        context: what stages read beside their lanes.
        integrator: what makes radiance of camera rays.
        accel: the search.
        camera: on the whole film.
        filter: reconstruction filter.
        sampler: random numbers.
        crop: ``(x, y, width, height)`` of the picture on the film.
        centre: ``(3,)`` float64, see Space.shift.
        first: what happens at first surfaces; None where paths go on.
        given: rays in place of the camera's; None: the camera's.
    """

    context: StageContext
    integrator: Integrator
    accel: Accel
    camera: Camera
    filter: Filter
    sampler: Sampler
    crop: tuple[int, int, int, int]
    centre: Tensor
    first: FirstSurface | None = None
    given: Rays | None = None

    @property
    def bounce(self) -> Bounce:
        """Return what happens at surfaces: a stage."""
        return self.integrator.bounce if self.first is None else self.first.bounce

    def rays(
        self, first_pixel: int, pixels: int, first_sample: int, samples: int, plate: Plate | None = None
    ) -> PathState:
        """Rays of consecutive pixels of a plate (the picture, row by row); lanes run over pixels, then over samples."""
        device = self.centre.device
        x0, y0, width, _ = self.crop
        place = torch.arange(first_pixel, first_pixel + pixels, device=device)
        if plate is not None and plate.places is not None:
            place = plate.places[first_pixel : first_pixel + pixels]
        x, y = place % width + x0, place // width + y0
        sample = torch.arange(first_sample, first_sample + samples, device=device).repeat_interleave(pixels)
        return self.rays_of(x.repeat(samples), y.repeat(samples), sample, None if plate is None else plate.streams)

    def rays_of(self, x: Tensor, y: Tensor, sample: Tensor, streams: Streams | None = None) -> PathState:
        """Rays of single samples: the camera's, or those that are given.

        Args:
            x: of pixels on the whole film ``(N,)`` int64.
            y: of them, likewise.
            sample: of theirs ``(N,)`` int64.
            streams: which share a pixel's samples; None: those of the picture.
        """
        # Numbered on the whole film, so that a crop shows the very pixels of the full picture.
        pixel = y * self.camera.resolution[0] + x
        if self.given is not None:
            number = pixel if self.given.number is None else take(self.given.number, pixel)
            key = self.sampler.key(number, sample, streams)
            return camera_state(take(self.given.o, pixel), take(self.given.d, pixel), key)
        key = self.sampler.key(pixel, sample, streams)
        x, y = (a.to(self.context.plan.dtype) for a in (x, y))
        return generate(self.context.plan, self.camera, self.filter, x, y, key, salts(0, self.centre.device))

    def along(self, rays: Rays) -> Wave:
        """Return the wave whose paths begin with rays; no filter weighs them."""
        n = rays.d.shape[1]
        # Of filters that weigh nothing nothing is asked: kernels are those of renders.
        filter = FILTERS["box"]({}, rays.d.device) if self.filter.signed else self.filter
        camera = replace(self.camera, resolution=(n, 1))
        return replace(self, camera=camera, crop=(0, 0, n, 1), filter=filter, given=rays)

    def begun(self, state: PathState) -> PathState:
        """Return rays with what only some scenes and integrators ask of a path that begins."""
        world = self.context.world
        if any(model.refracts for model in world.materials.models):
            state = replace(state, eta=torch.ones_like(state.t_max))
        if lights.local(world.lights):
            state = replace(state, p=state.o.clone(), n=torch.zeros_like(state.o))
        if self.integrator.fields:
            state = replace(state, extra={own.name: own.begin(state.t_max) for own in self.integrator.fields})
        return state

    def weight(self, state: PathState) -> Tensor:
        """Return what the filter weighs the samples with ``(N,)``; after the paths are traced, since no stage needs to know."""
        draws = Draws(self.context.plan.sampler, state.key, salts(0, self.centre.device))
        return self.filter.weight(draws.two(Dimension.PIXEL)).to(self.context.plan.dtype)


def still_of(wave: Wave) -> Wave:
    """Return the wave as where no geometry is differentiated: the same values, and hits found between stages."""
    return replace(wave, context=replace(wave.context, plan=replace(wave.context.plan, attached=False)))


def camera_state(o: Tensor, d: Tensor, key: Tensor) -> PathState:
    """Paths that begin with rays ``o, d (3, N)``, d unit, and draw by ``key``."""
    n = d.shape[1]
    forever = torch.full((n,), math.inf, dtype=d.dtype, device=d.device)
    lane, nothing = torch.arange(n, device=d.device), torch.zeros_like(d)
    return PathState(o.clone(), d, forever, torch.ones_like(d), nothing, forever.clone(), lane, key)
