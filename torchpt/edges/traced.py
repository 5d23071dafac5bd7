"""What rays of edges see: the forward render's own search and integrator, without derivatives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.engines import tensors
from torchpt.forward import make_wave
from torchpt.integrators.clamp import clamp_scale
from torchpt.integrators.plan import FOREVER
from torchpt.integrators.wave import Wave, camera_state
from torchpt.records import PathState
from torchpt.samplers import Sampler
from torchpt.scene import Scene
from torchpt.settings import SAMPLERS, Settings
from torchpt.spec.declared import Described

__all__ = ["Traced", "traced_of"]


@dataclass(frozen=True)
class Traced:
    """A render's wave whose rays are given one by one."""

    wave: Wave
    clamp: float | None

    @property
    def dtype(self) -> torch.dtype:
        """Of the lanes."""
        return self.wave.context.plan.dtype

    def key(self, sample: Tensor, row: int = 0) -> Tensor:
        """The sampler's keys of samples ``(N,)`` int64; those of one ``row`` share their numbers with those of no other."""
        return self.wave.sampler.key(sample, torch.full_like(sample, row))

    def nearest(self, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far rays ``(3, N)`` go, in units of ``d``, and the primitives that they meet; -1 for none."""
        t, prim, _, _ = self.wave.accel.intersect(o, d, torch.full_like(d[0], FOREVER, dtype=torch.float32))
        return t.double(), prim.long()

    def state(self, o: Tensor, d: Tensor, key: Tensor) -> PathState:
        """Camera rays; ``d`` of any length."""
        return camera_state(o.to(self.dtype), (d / (d * d).sum(0).sqrt()).to(self.dtype), key)

    def radiance(self, o: Tensor, d: Tensor, key: Tensor, depth: int | None = None) -> Tensor:
        """Radiance ``(3, N)`` float64 that rays bring; black where it is not finite, as in pictures.

        ``depth``: vertices of their paths at most, in place of the integrator's own limit.
        """
        wave = self.wave
        if depth is not None:
            wave = replace(wave, integrator=wave.integrator.but(max_depth=depth))
        values = tensors.trace(wave, self.state(o, d, key))
        values = torch.where(torch.isfinite(values).all(0), values, 0.0).double()
        if self.clamp is not None:
            values = values * clamp_scale(values, self.clamp)
        return values


def traced_of(scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype) -> Traced:
    """The wave of a scene under ``params``, eager; its numbers are independent from sample to sample."""
    render = settings.render
    plain = replace(settings, sampler=Described(SAMPLERS["independent"], {}))
    wave = make_wave(scene, plain, params, dtype)
    if wave.accel.name == "brute":  # packets widen primitives by their rounding, further than edges look beside
        wave = make_wave(scene, replace(plain, render=render.but(accel="numba")), params, dtype)
    return Traced(replace(wave, sampler=Sampler(wave.sampler.points, settings.render.seed)), settings.integrator.clamp)
