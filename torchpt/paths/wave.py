"""The tensors and settings that all waves of a render share, the pixels that samples are added to, and ray counts.

A *wave* is a range of pixels and samples whose paths are traced together, one path a *lane*. :class:`Wave` makes their first
rays and their initial state; an engine (:mod:`torchpt.engines`) takes them from there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.photons import merging_of
from torchpt.paths.state import PathState, StageContext, VertexInput, VertexOutput
from torchpt.physics import lights
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Film, Filter, filter_of
from torchpt.physics.samplers import Dimension, Draws, Randomizations, Sampler, salts
from torchpt.search.base import Accel

if TYPE_CHECKING:
    from torchpt.paths.integrators.first_surface import FirstSurface

__all__ = ["Bounce", "PixelSet", "RayCounts", "Rays", "Wave", "camera_state", "clamp_scale", "with_detached_geometry"]


# ---- Ray counts


@dataclass
class RayCounts:
    """Counts of rays and truncated paths.

    Attributes:
        rays: rays that were traced, shadow rays included.
        truncated: paths that were still alive, and were ended, at depth :data:`torchpt.paths.integrators.base.ENDLESS`.
    """

    rays: int = 0
    truncated: int = 0


# ---- Pixel sets: the films that samples are added to


@dataclass
class PixelSet:
    """Pixels that get the same number of samples, with their films.

    Attributes:
        film: sums of radiance, a column for each pixel of the set.
        layers: films of the layers of first surfaces, by name.
        randomizations: the sampler's independent sequences that share the samples of a pixel.
        indices: ``(n,)`` int64 indices of the pixels in the picture, row by row, on the lanes' device; None: all pixels.
    """

    film: Film
    layers: dict[str, Film] = field(default_factory=dict)
    randomizations: Randomizations = field(default_factory=Randomizations)
    indices: Tensor | None = None


# ---- The firefly clamp: ``integrator.clamp``


def clamp_scale(values: Tensor, clamp: float) -> Tensor:
    """Return factors ``(...)``, at most 1, by which samples ``(3, ...)`` have no channel above ``clamp``; hue is kept."""
    return clamp / values.abs().amax(0).clamp_min(clamp)


# ---- Waves: from a range of pixels and samples to camera rays


#: The stage of a vertex on surfaces of one BSDF model; the int is the model's index in ``world.materials.models``.
Bounce = Callable[[StageContext, int, VertexInput], VertexOutput]


@dataclass(frozen=True)
class Rays:
    """Rays that paths start with in place of camera rays: one for each pixel of a picture with a single row.

    Attributes:
        o: origins ``(3, N)``, in the lanes' coordinates (:class:`torchpt.scene.space.Space`).
        d: unit directions ``(3, N)``.
        number: ``(N,)`` int64: each ray draws the random numbers of the pixel with this index; None: ray k those of pixel k.
    """

    o: Tensor
    d: Tensor
    number: Tensor | None = None


@dataclass(frozen=True)
class Wave:
    """A render's job: the tensors and settings that all its waves share.

    Attributes:
        context: inputs of stages that are the same for all lanes.
        integrator: has the stages and limits of the paths.
        accel: the search: the acceleration structure over the scene's primitives.
        camera: the camera of the whole film, of which the picture may be a crop.
        filter: the reconstruction filter.
        sampler: makes the keys of random numbers.
        crop: ``(x, y, width, height)`` of the picture on the film.
        centre: ``(3,)`` float64 origin of the lanes' coordinates in the scene, in the lanes' unit of length, as
            :attr:`torchpt.scene.space.Space.shift` returns it: lanes count from there, so that float32 is exact enough. Only
            the layer of positions adds it.
        first_surface: shading of first surfaces, of an integrator that stops there; None: paths go on.
        start_rays: rays that paths start with; None: those of :meth:`Integrator.generate`.
        light_paths: the wave of light paths that are traced beside the samples, one for each; None: there are none.
    """

    context: StageContext
    integrator: Integrator
    accel: Accel
    camera: Camera
    filter: Filter
    sampler: Sampler
    crop: tuple[int, int, int, int]
    centre: Tensor
    first_surface: FirstSurface | None = None
    start_rays: Rays | None = None
    light_paths: Wave | None = None

    @property
    def bounce(self) -> Bounce:
        """Return the stage of surfaces."""
        return self.integrator.bounce if self.first_surface is None else self.first_surface.bounce

    def rays(
        self, first_pixel: int, pixels: int, first_sample: int, samples: int, pixel_set: PixelSet | None = None
    ) -> PathState:
        """Return camera rays of consecutive pixels and samples; lanes run over pixels, then over samples.

        Args:
            first_pixel: index of the first pixel in the pixel set.
            pixels: number of pixels.
            first_sample: index of the first sample of each pixel.
            samples: number of samples of each pixel.
            pixel_set: the pixels that ``first_pixel`` counts, and their randomizations; None: all pixels of the picture, row by
                row, with the picture's randomizations.
        """
        device = self.centre.device
        x0, y0, width, _ = self.crop
        index = torch.arange(first_pixel, first_pixel + pixels, device=device)  # in the picture
        if pixel_set is not None and pixel_set.indices is not None:
            index = pixel_set.indices[first_pixel : first_pixel + pixels]
        x, y = index % width + x0, index // width + y0
        sample = torch.arange(first_sample, first_sample + samples, device=device).repeat_interleave(pixels)
        return self.rays_of(
            x.repeat(samples), y.repeat(samples), sample, None if pixel_set is None else pixel_set.randomizations
        )

    def rays_of(self, x: Tensor, y: Tensor, sample: Tensor, randomizations: Randomizations | None = None) -> PathState:
        """Return the first rays of single samples.

        Args:
            x: column of the pixel on the whole film ``(N,)`` int64.
            y: its row, likewise.
            sample: index of the sample in the pixel ``(N,)`` int64.
            randomizations: randomizations that share the samples of a pixel; None: those of the picture.
        """
        # Pixels are numbered on the whole film, so that a crop has the same samples as the full picture.
        pixel = y * self.camera.resolution[0] + x
        if self.start_rays is not None:
            number = pixel if self.start_rays.number is None else take(self.start_rays.number, pixel)
            key = self.sampler.key(number, sample, randomizations)
            return camera_state(take(self.start_rays.o, pixel), take(self.start_rays.d, pixel), key)
        key = self.sampler.key(pixel, sample, randomizations)
        x, y = x.to(self.context.plan.dtype), y.to(self.context.plan.dtype)
        camera_salts = salts(0, self.centre.device)  # depth 0: the camera's random dimensions
        return self.generate(x, y, key, camera_salts)

    def generate(self, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """Return the first rays of paths, see :meth:`Integrator.generate`."""
        context = replace(self.context, camera=self.camera, filter=self.filter)
        return self.integrator.generate(context, x, y, key, salts)

    @property
    def light_path_count(self) -> float:
        """Return the number of light paths of a sample of all pixels."""
        return float(getattr(self.integrator.light_walk(), "fraction", 0.0)) * self.crop[2] * self.crop[3]

    def at_sample(self, sample: int) -> Wave:
        """Return the wave of sample ``sample`` of each pixel: weights count with merges within its radius."""
        radius = self.integrator.radius_at(sample)
        if radius is None:
            return self
        number = merging_of(radius, self.light_path_count)
        merging = torch.full((1,), number, dtype=self.context.plan.dtype, device=self.centre.device)
        light_paths = self.light_paths
        if light_paths is not None:
            light_paths = replace(light_paths, context=replace(light_paths.context, merging=merging))
        return replace(self, context=replace(self.context, merging=merging), light_paths=light_paths)

    def with_rays(self, rays: Rays) -> Wave:
        """Return the wave whose paths start with ``rays``, a picture of one row; samples have no filter weights."""
        n = rays.d.shape[1]
        # Start rays need no filter. One with negative lobes (``signed``) would still weigh the samples, so the box replaces it.
        # Others have no weights and stay: the filter is part of the key of compiled kernels, which are shared with renders.
        filter = filter_of("box", rays.d.device) if self.filter.signed else self.filter
        camera = replace(self.camera, resolution=(n, 1))
        return replace(self, camera=camera, crop=(0, 0, n, 1), filter=filter, start_rays=rays)

    def with_optional_fields(self, state: PathState) -> PathState:
        """Return the paths with the initial values of fields that only some scenes and integrators use.

        ``eta`` exists where a material refracts. ``p`` and ``n``, the last vertex and its normal, exist where the choice of a
        light depends on them; a camera is no surface, so ``n`` starts as 0. ``extra`` has the integrator's own fields.
        """
        world = self.context.world
        if any(model.refracts for model in world.materials.models):
            state = replace(state, eta=torch.ones_like(state.t_max))
        if lights.depends_on_point(world.lights):
            state = replace(state, p=state.o.clone(), n=torch.zeros_like(state.o))
        if self.integrator.fields:
            given = state.extra
            begun = {own.name: own.begin(state.t_max) for own in self.integrator.fields if own.name not in given}
            state = replace(state, extra={**given, **begun})
        return state

    def weight(self, state: PathState) -> Tensor:
        """Return the filter weights of samples ``(N,)``: 1, or a constant with the filter's sign if it has negative lobes.

        No stage needs them: they are drawn again from the key of each sample and multiply the result of its path.
        """
        draws = Draws(self.context.plan.sampler, state.key, salts(0, self.centre.device))
        return self.filter.weight(draws.two(Dimension.PIXEL)).to(self.context.plan.dtype)


def with_detached_geometry(wave: Wave) -> Wave:
    """Return the wave with geometry not differentiated (``plan.attached`` False); the paths have the same values.

    With differentiated geometry the stage of a surface searches the next hit itself, because the direction depends on both
    ends of the ray. In the wave that is returned hits are found between the stages, as the kernels of the backward pass expect.
    """
    return replace(wave, context=replace(wave.context, plan=replace(wave.context.plan, attached=False)))


def camera_state(o: Tensor, d: Tensor, key: Tensor) -> PathState:
    """Return the state of paths that start with rays ``o, d (3, N)``, d unit, and the sampler's ``key (rows, N)`` int32.

    The pdf is infinite: no light sampling competes with the camera, so emission that a camera ray hits counts whole.
    """
    n = d.shape[1]
    forever = torch.full((n,), math.inf, dtype=d.dtype, device=d.device)
    lane, nothing = torch.arange(n, device=d.device), torch.zeros_like(d)
    return PathState(
        o=o.clone(),
        d=d,
        t_max=forever,
        throughput=torch.ones_like(d),
        radiance=nothing,
        pdf=forever.clone(),
        lane=lane,
        key=key,
    )
