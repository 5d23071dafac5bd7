"""Radiance along rays for those who ask again and again, such as edges: one sample a ray, without a render around it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.engines import tensors
from torchpt.engines.kernels.kernels import Kernels
from torchpt.engines.kernels.schedule import Loop
from torchpt.film import Film
from torchpt.forward.wave import kernels_of, looped
from torchpt.integrators.clamp import clamp_scale
from torchpt.integrators.plate import Plate
from torchpt.integrators.wave import Wave
from torchpt.lanes.graph import Unsupported
from torchpt.scene import Scene
from torchpt.settings import Settings

__all__ = ["Along"]


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
        plate = Plate(Film(wave.crop[2], 1, 1, wave.centre.device))
        loop.run([(plate, sample, 1)], lambda _: False)
        loop.dismiss(self._keep)
        return plate.film.sums[0]
