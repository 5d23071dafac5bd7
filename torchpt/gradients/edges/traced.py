"""Radiance along rays for those who ask again and again, such as edges: one sample a ray, without a render around it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import count

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.core.tree import map_leaves
from torchpt.engines.engine import Kernels, forward_kernels, trace
from torchpt.math.guiding import Round
from torchpt.math.vectors import dot, rows, take
from torchpt.paths.integrators.path import PathIntegrator
from torchpt.paths.state import T_MAX, PathState
from torchpt.paths.transmission import non_opaque, opacity_at, origins_behind
from torchpt.paths.wave import PixelSet, Rays, Wave, clamp_scale
from torchpt.physics.film import Film
from torchpt.physics.samplers import Dimension, Draws, Sampler, salts
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene import Scene
from torchpt.scene.prepare import kernels_of, make_wave, uses_kernels
from torchpt.scene.settings import SAMPLERS, Settings
from torchpt.spec.schema import ParsedParams

__all__ = ["Along", "Passing", "Traced", "Use", "traced_of"]


# ---- Radiance along rays for those who ask again and again, such as edges: one sample a ray, without a render around it


class Along:
    """Traces rays of waves that are alike, by kernels where a render would.

    Args:
        scene: whose.
        settings: of the render.
        wave: any of these waves.
    """

    def __init__(self, scene: Scene, settings: Settings, wave: Wave) -> None:
        self._scene = scene
        # Kernels of a kind with stages of its own are made anew for each depth that is asked for.
        own = wave.integrator.has_own_stages or scene.device.type != "cpu"
        compiled = not own and uses_kernels(settings, scene.device, wave.context.plan.dtype)
        self._compiled = compiled
        self._kernels: Kernels | None = None
        self._keep = settings.render.max_memory is None

    def radiance(self, wave: Wave, sample: int) -> Tensor:
        """Return what the rays that a wave is given bring, ``(3, N)`` float64, clamped, and black where it is not finite.

        ``sample``: which one of each ray.
        """
        if self._compiled and wave.crop[2]:
            try:
                return self._by_kernels(wave, sample)
            except Unsupported:  # the render has said so
                self._compiled = False
        values = trace(wave, wave.rays(0, wave.crop[2], sample, 1))
        values = torch.where(torch.isfinite(values).all(0), values, 0.0).double()
        clamp = wave.integrator.clamp
        return values if clamp is None else values * clamp_scale(values, clamp)

    def _by_kernels(self, wave: Wave, sample: int) -> Tensor:
        if self._kernels is None:
            self._kernels = kernels_of(self._scene, wave)
        engine = forward_kernels(self._kernels.with_rays(wave))
        pixel_set = PixelSet(Film(wave.crop[2], 1, 1, wave.centre.device))
        engine.run([(pixel_set, sample, 1)], lambda _: False)
        engine.release_workers(self._keep)
        return pixel_set.film.sums[0]


# ---- What rays of edges see: the forward render's own search, integrator and engines, without derivatives


class Use(IntEnum):
    """Uses of random numbers by samples of edges; to the sampler, which sample of a pixel it is."""

    PRIMARY = 0  # edges that the camera sees, and the paths of rays beside them
    LIGHTS = 1  # edges of shadows of lights, and the way on to the camera
    REFLECTED = 2  # the same of light that surfaces reflect
    BEHIND = 3  # the paths by which such light came
    HORIZONS = 4  # planes of faces that are shaded smooth


@dataclass(frozen=True)
class Passing:
    """Decides which surfaces N rays pass by their opacity; in a scene where all are opaque nothing of it is read.

    Attributes:
        key: of the sampler ``(rows, N)``.
        depth: vertex that rays reach: the same key and depth as of a path pass the same surfaces.
        free: ``(N,)`` distances before which rays pass all surfaces that are not opaque; None: nowhere.
        stop: ``(N,)`` distances from which on rays pass none; None: they may everywhere.
    """

    key: Tensor
    depth: int
    free: Tensor | None = None
    stop: Tensor | None = None


@dataclass(frozen=True)
class Traced:
    """A render's wave whose rays are given one by one, what traces them, and the random numbers of edges.

    A number is a function of the seed, the number of the sample, its use and the dimension, as in renders one of the seed, the
    pixel, the sample and the dimension.
    """

    wave: Wave
    with_rays: Along

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of the lanes."""
        return self.wave.context.plan.dtype

    @property
    def has_opacity(self) -> bool:
        """Return True where some surfaces let rays pass."""
        return self.wave.context.world.materials.opacity is not None

    def key(self, number: Tensor, use: Use) -> Tensor:
        """Return the sampler's keys of samples ``(N,)`` int64; those of different uses share no numbers."""
        return self.wave.sampler.key(number, torch.full_like(number, int(use)))

    def draws(self, key: Tensor, depth: int = 0) -> Draws:
        """Return the random numbers of samples at a vertex of their paths; 0: of the edge, and where its light comes from."""
        return Draws(self.wave.context.plan.sampler, key, salts(depth, key.device))

    def edge(self, number: Tensor, key: Tensor, total: int) -> tuple[Tensor, Tensor]:
        """Return where on the edges of the scene samples lie ``(N,)`` float64 in [0, 1], and another number of each.

        They are stratified: sample ``number`` of ``total`` lies in the interval of that number.
        """
        place, other = self.draws(key).two(Dimension.EDGE).double()
        return (number + place) / total, other

    def edges(self, turn: Round, first: int, count: int, use: Use) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return numbers and keys of samples ``first .. first + count`` of a round, then what :meth:`edge` returns."""
        local = torch.arange(first, first + count, device=self.wave.centre.device)
        number = local + turn.first
        key = self.key(number, use)
        return number, key, *self.edge(local, key, turn.count)

    def lens(self, key: Tensor, depth: int = 0) -> Tensor | None:
        """Return samples of the lens ``(2, N)`` float64; None without a lens. ``depth``: as for :meth:`draws`."""
        return self.draws(key, depth).two(Dimension.LENS).double() if self.wave.camera.lens else None

    def of_paths(self, number: Tensor, use: Use, free: Tensor | None = None) -> Passing | None:
        """Return what decides in :meth:`radiance` which surfaces rays pass; None where all are opaque.

        ``free``: as of :class:`Passing`.
        """
        return Passing(self.key(number, use), depth=1, free=free) if self.has_opacity else None

    def nearest(self, o: Tensor, d: Tensor, passing: Passing | None = None) -> tuple[Tensor, Tensor]:
        """Return how far rays ``(3, N)`` go, in units of ``d``, and the primitives that they meet; -1 for none.

        ``passing``: decides which surfaces rays pass by their opacity; None: they pass none.
        """
        hit = self.intersect(o, d, passing)
        return hit.t.double(), hit.prim

    def blocked(self, o: Tensor, d: Tensor, far: Tensor, passing: Passing | None = None) -> Tensor:
        """Return a mask ``(N,)`` of rays that meet something before ``far (N,)``, in units of ``d``.

        ``passing``: as for :meth:`nearest`.
        """
        if passing is not None and self.has_opacity:
            t, prim = self.nearest(o, d, passing)
            return (prim >= 0) & (t < far)
        return self.wave.accel.occluded(o, d, far.float())

    def intersect(self, o: Tensor, d: Tensor, passing: Passing | None = None) -> Hit:
        """Return the hits of rays ``(3, N)``, distances in units of ``d``; ``passing``: as for :meth:`nearest`."""
        t, prim, u, v = self.wave.accel.intersect(o, d, torch.full_like(d[0], T_MAX, dtype=torch.float32))
        hit = Hit(t, prim.long(), u, v)
        if passing is None or not self.has_opacity:
            return hit
        o, d, free, stop = o.to(self.dtype), d.to(self.dtype), passing.free, passing.stop
        if free is not None:
            hit = self._behind(o, d, hit, lambda lane, at, _: at.t < take(free, lane))

        def passes(lane: Tensor, at: Hit, step: int) -> Tensor:
            opacity = opacity_at(self.wave.context.world, take(o, lane), take(d, lane), at, miss=1.0)
            draws = Draws(self.wave.context.plan.sampler, take(passing.key, lane), salts(passing.depth, d.device, step))
            on = draws.one(Dimension.OPACITY) >= opacity
            return on if stop is None else on & (at.t < take(stop, lane))

        return self._behind(o, d, hit, passes)

    def _behind(self, o: Tensor, d: Tensor, hit: Hit, passes: Callable[[Tensor, Hit, int], Tensor]) -> Hit:
        """Return the hits of rays behind the surfaces that ``passes`` lets them pass.

        Args:
            o: origins ``(3, N)``.
            d: directions ``(3, N)``.
            hit: the first hits.
            passes: gets lanes ``(n,)``, their hits, and how many surfaces they have passed; returns a mask ``(n,)``.
        """
        world = self.wave.context.world
        lane = torch.arange(d.shape[1], device=d.device)
        for step in count():
            prim = take(hit.prim, lane)
            lane = take(lane, ((prim >= 0) & non_opaque(world, prim)).nonzero().squeeze(1))
            lane = take(lane, passes(lane, rows(hit, lane), step).nonzero().squeeze(1))
            if not len(lane):
                break
            start, way = take(o, lane), take(d, lane)
            behind = origins_behind(world, start, way, rows(hit, lane))
            on = self.intersect(behind, way)
            on = replace(on, t=on.t + (dot(behind - start, way) / dot(way, way)).to(on.t))
            hit = map_leaves(lambda old, new, lane=lane: old.index_copy(0, lane, new), hit, on)
        return hit

    def given(self, o: Tensor, d: Tensor, number: Tensor) -> Wave:
        """Return the wave along rays ``(3, N)``, ``d`` of any length, with the random numbers of samples ``number (N,)``."""
        return self.wave.with_rays(Rays(o.to(self.dtype), (d / (d * d).sum(0).sqrt()).to(self.dtype), number))

    def state(self, o: Tensor, d: Tensor, number: Tensor) -> PathState:
        """Return paths that begin with rays, as of :meth:`given`."""
        return self.given(o, d, number).rays(0, len(number), 0, 1)

    def radiance(
        self, o: Tensor, d: Tensor, number: Tensor, use: Use = Use.PRIMARY, depth: int | None = None
    ) -> Tensor:
        """Return the radiance ``(3, N)`` float64 that rays bring; black where it is not finite, as in pictures.

        Args:
            o: origins ``(3, N)``.
            d: directions ``(3, N)`` of any length.
            number: of the samples ``(N,)``, by which random numbers are drawn.
            use: of them.
            depth: vertices of their paths at most, in place of the integrator's own limit.
        """
        wave = self.given(o, d, number)
        if depth is not None:
            assert isinstance(wave.integrator, PathIntegrator)  # no other has these estimators
            wave = replace(wave, integrator=wave.integrator.to_depth(depth))
        if use is not Use.PRIMARY:  # no samples of pixels: what is before their edges weighs them
            wave = replace(wave, integrator=wave.integrator.but(clamp=None))
        return self.with_rays.radiance(wave, int(use))


def traced_of(scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype) -> Traced:
    """Return the wave of a scene under ``params``; its numbers are independent from sample to sample."""
    plain = replace(settings, sampler=ParsedParams(SAMPLERS["independent"], {}))
    # Packets search rays near an edge twice, and these all are.
    wave = make_wave(scene, plain, params, dtype, edges=True)
    wave = replace(wave, sampler=Sampler(wave.sampler.points, settings.render.seed))
    return Traced(wave, Along(scene, settings, wave))
