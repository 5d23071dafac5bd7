"""What a render fixes for all of its waves, the pixels that samples go to, and what is counted of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.state import PathState, StageContext, VertexInput, VertexOutput
from torchpt.paths.vertex import generate
from torchpt.physics import lights
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Film, Filter, filter_of
from torchpt.physics.samplers import Dimension, Draws, Randomizations, Sampler, salts
from torchpt.search.base import Accel

if TYPE_CHECKING:
    from torchpt.paths.integrators.first_surface import FirstSurface

__all__ = ["Bounce", "PixelSet", "RayCounts", "Rays", "Wave", "camera_state", "clamp_scale", "with_detached_geometry"]


# ---- Counts of what waves trace


@dataclass
class RayCounts:
    """Counts of rays and paths.

    Attributes:
        rays: that were searched for, those of shadows too.
        truncated: paths that were still alive at :data:`torchpt.paths.integrators.base.ENDLESS`.
    """

    rays: int = 0
    truncated: int = 0


# ---- What samples go to: sums of the pixels of a picture, or of some of them


@dataclass
class PixelSet:
    """Pixels that are sampled alike.

    Attributes:
        film: sums of radiance.
        layers: sums of layers of first surfaces, by name.
        streams: where their samples come from.
        places: which pixels of the picture they are ``(n,)`` int64, row by row, where the lanes live; None: all.
    """

    film: Film
    layers: dict[str, Film] = field(default_factory=dict)
    streams: Randomizations = field(default_factory=Randomizations)
    places: Tensor | None = None


# ---- The bound on what a single path may bring: ``integrator.clamp``


def clamp_scale(values: Tensor, clamp: float) -> Tensor:
    """Return what samples ``(3, ...)`` are scaled with ``(...)``, so that no channel is beyond ``clamp``; hue stays."""
    return clamp / values.abs().amax(0).clamp_min(clamp)


# ---- One render's waves: a pure function from a range of pixels and samples to radiance


#: A stage of the surfaces of one BSDF model.
Bounce = Callable[[StageContext, int, VertexInput], VertexOutput]


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
        self, first_pixel: int, pixels: int, first_sample: int, samples: int, pixel_set: PixelSet | None = None
    ) -> PathState:
        """Rays of consecutive pixels of a plate (the picture, row by row); lanes run over pixels, then over samples."""
        device = self.centre.device
        x0, y0, width, _ = self.crop
        place = torch.arange(first_pixel, first_pixel + pixels, device=device)
        if pixel_set is not None and pixel_set.places is not None:
            place = pixel_set.places[first_pixel : first_pixel + pixels]
        x, y = place % width + x0, place // width + y0
        sample = torch.arange(first_sample, first_sample + samples, device=device).repeat_interleave(pixels)
        return self.rays_of(
            x.repeat(samples), y.repeat(samples), sample, None if pixel_set is None else pixel_set.streams
        )

    def rays_of(self, x: Tensor, y: Tensor, sample: Tensor, streams: Randomizations | None = None) -> PathState:
        """Return rays of single samples: the camera's, or those that are given.

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

    def with_rays(self, rays: Rays) -> Wave:
        """Return the wave whose paths begin with rays; no filter weighs them."""
        n = rays.d.shape[1]
        # Of filters that weigh nothing nothing is asked: kernels are those of renders.
        filter = filter_of("box", rays.d.device) if self.filter.signed else self.filter
        camera = replace(self.camera, resolution=(n, 1))
        return replace(self, camera=camera, crop=(0, 0, n, 1), filter=filter, given=rays)

    def with_optional_fields(self, state: PathState) -> PathState:
        """Return rays with what only some scenes and integrators ask of a path that begins."""
        world = self.context.world
        if any(model.refracts for model in world.materials.models):
            state = replace(state, eta=torch.ones_like(state.t_max))
        if lights.depends_on_point(world.lights):
            state = replace(state, p=state.o.clone(), n=torch.zeros_like(state.o))
        if self.integrator.fields:
            state = replace(state, extra={own.name: own.begin(state.t_max) for own in self.integrator.fields})
        return state

    def weight(self, state: PathState) -> Tensor:
        """Return what the filter weighs the samples with ``(N,)``; after the paths are traced, since no stage needs to know."""
        draws = Draws(self.context.plan.sampler, state.key, salts(0, self.centre.device))
        return self.filter.weight(draws.two(Dimension.PIXEL)).to(self.context.plan.dtype)


def with_detached_geometry(wave: Wave) -> Wave:
    """Return the wave as where no geometry is differentiated: the same values, and hits found between stages."""
    return replace(wave, context=replace(wave.context, plan=replace(wave.context.plan, attached=False)))


def camera_state(o: Tensor, d: Tensor, key: Tensor) -> PathState:
    """Return paths that begin with rays ``o, d (3, N)``, d unit, and draw by ``key``."""
    n = d.shape[1]
    forever = torch.full((n,), math.inf, dtype=d.dtype, device=d.device)
    lane, nothing = torch.arange(n, device=d.device), torch.zeros_like(d)
    return PathState(o.clone(), d, forever, torch.ones_like(d), nothing, forever.clone(), lane, key)
