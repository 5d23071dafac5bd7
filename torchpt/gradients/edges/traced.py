"""Radiance along rays for those who ask again and again, such as edges: one sample a ray, without a render around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.compiler.graph import Unsupported
from torchpt.engines import tensors
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.kernels.threads import Loop
from torchpt.paths.state import FOREVER, PathState
from torchpt.paths.wave import PixelSet, Rays, Wave, clamp_scale
from torchpt.physics.film import Film
from torchpt.physics.samplers import Sampler
from torchpt.scene import Scene
from torchpt.scene.prepare import kernels_of, looped, make_wave
from torchpt.scene.settings import SAMPLERS, Settings
from torchpt.spec.schema import ParsedParams

__all__ = ["Along", "Traced", "traced_of"]


# ---- Radiance along rays for those who ask again and again, such as edges: one sample a ray, without a render around it


class Along:
    """Traces rays of waves that are alike, by kernels where a render would.

    Args:
        scene: whose.
        settings: of the render.
        wave: any of these waves.
    """

    def __init__(self, scene: Scene, settings: Settings, wave: Wave) -> None:
        self._scene, self._clamp = scene, wave.integrator.clamp
        # Kernels of a kind with stages of its own are made anew for each depth that is asked for.
        compiled = looped(settings, scene.device, wave.context.plan.dtype) and not wave.integrator.own_stages
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
        values = tensors.trace(wave, wave.rays(0, wave.crop[2], sample, 1))
        values = torch.where(torch.isfinite(values).all(0), values, 0.0).double()
        return values if self._clamp is None else values * clamp_scale(values, self._clamp)

    def _by_kernels(self, wave: Wave, sample: int) -> Tensor:
        self._kernels = kernels_of(self._scene, wave, self._kernels)
        loop = Loop(self._kernels, torch.get_num_threads(), self._clamp, False)
        pixel_set = PixelSet(Film(wave.crop[2], 1, 1, wave.centre.device))
        loop.run([(pixel_set, sample, 1)], lambda _: False)
        loop.dismiss(self._keep)
        return pixel_set.film.sums[0]


# ---- What rays of edges see: the forward render's own search, integrator and engines, without derivatives


@dataclass(frozen=True)
class Traced:
    """A render's wave whose rays are given one by one, and what traces them."""

    wave: Wave
    along: Along

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of the lanes."""
        return self.wave.context.plan.dtype

    def key(self, number: Tensor, row: int = 0) -> Tensor:
        """Return the sampler's keys of samples ``(N,)`` int64; those of one ``row`` share numbers with no other row."""
        return self.wave.sampler.key(number, torch.full_like(number, row))

    def nearest(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far rays ``(3, N)`` go, in units of ``d``, and the primitives that they meet; -1 for none."""
        t, prim, _, _ = self.wave.accel.intersect(o, d, torch.full_like(d[0], FOREVER, dtype=torch.float32))
        return t.double(), prim.long()

    def given(self, o: Tensor, d: Tensor, number: Tensor) -> Wave:
        """Return the wave along rays ``(3, N)``, ``d`` of any length, with the random numbers of samples ``number (N,)``."""
        return self.wave.along(Rays(o.to(self.dtype), (d / (d * d).sum(0).sqrt()).to(self.dtype), number))

    def state(self, o: Tensor, d: Tensor, number: Tensor) -> PathState:
        """Return paths that begin with rays, as of :meth:`given`."""
        return self.given(o, d, number).rays(0, len(number), 0, 1)

    def radiance(self, o: Tensor, d: Tensor, number: Tensor, row: int = 0, depth: int | None = None) -> Tensor:
        """Return the radiance ``(3, N)`` float64 that rays bring; black where it is not finite, as in pictures.

        Args:
            o: origins ``(3, N)``.
            d: directions ``(3, N)`` of any length.
            number: of the samples ``(N,)``, by which random numbers are drawn.
            row: of :meth:`key`.
            depth: vertices of their paths at most, in place of the integrator's own limit.
        """
        wave = self.given(o, d, number)
        if depth is not None:
            wave = replace(wave, integrator=wave.integrator.but(max_depth=depth))
        return self.along.radiance(wave, row)


def traced_of(scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype) -> Traced:
    """Return the wave of a scene under ``params``; its numbers are independent from sample to sample."""
    render = settings.render
    plain = replace(settings, sampler=ParsedParams(SAMPLERS["independent"], {}))
    wave = make_wave(scene, plain, params, dtype)
    if wave.accel.name == "brute":  # packets widen primitives by their rounding, further than edges look beside
        wave = make_wave(scene, replace(plain, render=render.but(accel="numba")), params, dtype)
    wave = replace(wave, sampler=Sampler(wave.sampler.points, settings.render.seed))
    return Traced(wave, Along(scene, settings, wave))
