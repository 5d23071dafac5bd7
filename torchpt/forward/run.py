"""One forward render: takes chunks and adds them up in films."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchpt.errors import RenderError
from torchpt.film import Film
from torchpt.forward.kept import kept
from torchpt.forward.result import Progress, Rendering
from torchpt.forward.schedule import chunks_of, lanes_for, passes
from torchpt.forward.wave import kernels_of, looped, make_wave, surface_layers
from torchpt.images.denoiser import GUIDES
from torchpt.integrators import LAYERS
from torchpt.integrators.base import Tally
from torchpt.integrators.loop.schedule import Loop, Share
from torchpt.lanes.graph import Unsupported
from torchpt.scene import Scene
from torchpt.settings import Settings

__all__ = ["Run", "say_once"]


@cache
def say_once(text: str) -> None:
    """A line on stderr, the first time only."""
    print(text, file=sys.stderr, flush=True)


class Run:
    """One forward render: accumulates chunks into films."""

    def __init__(
        self, scene: Scene, settings: Settings, params: Mapping[str, Tensor] | None, dtype: torch.dtype
    ) -> None:
        self.start = time.perf_counter()
        self.settings, self.device, self.unit = settings, scene.device, scene.space.unit
        self.wave = make_wave(scene, settings, params, dtype)
        self.build_seconds = time.perf_counter() - self.start
        _, _, self.width, self.height = self.wave.crop
        self.dtype = dtype
        self.integrator = settings.integrator
        self.seen = surface_layers(settings)
        self.on_progress: Callable[[Progress], bool | None] | None = None
        self.eager: list[str] = []
        self._begin()
        self.loop = self._loop(scene) if looped(self.wave, settings, self.device) else None

    def _begin(self) -> None:
        """Nothing is sampled yet."""
        width, height, device = self.width, self.height, self.device
        self.film = Film(width, height, self.wave.sampler.randomizations, device)
        self.layers = {name: Film(width, height, 1, device, len(layer.channels)) for name, layer in self.seen.items()}
        self.tally, self.done, self.ended = Tally(), 0, False
        self.bad = torch.zeros((), dtype=torch.int64, device=device)
        self.light = torch.zeros(2, dtype=torch.float64, device=device)  # before and after the clamp

    def _loop(self, scene: Scene) -> Loop:
        """The compiled loop; its kernels are kept with the scene."""
        keeper = kept(scene)
        kernels = keeper.kernels = kernels_of(scene, self.wave, keeper.kernels)
        for number, reason in kernels.eager.items():
            name = str(self.wave.stages.world.materials.models[number])
            self.eager.append(f"{name}: {reason}")
            say_once(
                f"torchpt: the material model {name} runs by tensor operations, as no kernel can be made of {reason}"
            )
        limited = self.settings.render.max_memory is not None
        return Loop(
            kernels,
            self.film,
            self.layers,
            torch.get_num_threads(),
            lanes_for(self.settings, self.device) if limited else None,
            self.integrator.clamp,
            self.integrator.strict,
        )

    def go(self, on_progress: Callable[[Progress], bool | None] | None) -> Rendering:
        """Take all samples, or as many as ``on_progress`` lets."""
        self.on_progress = on_progress
        if self.loop is not None:
            try:
                self._looped(self.loop)
                return self.result()
            except Unsupported as error:
                self.eager.append(f"all stages: {error}")
                say_once(f"torchpt: this scene renders by tensor operations, as no kernel can be made of {error}")
                self._begin()
        pixels = self.width * self.height
        lanes = lanes_for(self.settings, self.device)
        for first, count, sample, samples, ends in chunks_of(self.settings, lanes, self.film.randomizations, pixels):
            self._chunk(first, count, sample, samples)
            if self._advanced(count * samples, ends):
                break
        return self.result()

    def _advanced(self, samples: int, ends: bool) -> bool:
        """Tell of progress; returns whether to stop."""
        self.done += samples
        total = self.width * self.height * self.settings.render.spp
        if self.on_progress is None or self.ended:  # tasks of other threads still come in after the wish to stop
            return self.ended
        seconds = time.perf_counter() - self.start
        state = Progress(self.done, total, self.tally.rays, seconds, ends, self.result)
        self.ended = bool(self.on_progress(state)) and self.done < total
        return self.ended

    def _looped(self, loop: Loop) -> None:
        pixels = self.width * self.height

        def each(share: Share | None) -> bool:
            if share is None:
                return self._advanced(0, False)
            self.tally.rays += share.tally.rays
            self.tally.truncated += share.tally.truncated
            self.bad += share.bad
            self.light += torch.tensor(share.light, dtype=torch.float64)
            return self._advanced(share.samples, self.done + share.samples == pixels * (first + samples))

        for first, samples in passes(self.settings.render.spp, self.film.randomizations):
            if not loop.run(first, samples, each):
                break

    def _chunk(self, first: int, count: int, sample: int, samples: int) -> None:
        if self.integrator.light:
            radiance, tally = self.wave.radiance(first, count, sample, samples)
            self.tally.rays += tally.rays
            self.tally.truncated += tally.truncated
            self.film.add(self._checked(radiance, first, sample), first, sample)
        if self.seen:
            layers = self.wave.layers(tuple(self.seen), first, count, sample, samples)
            self.tally.rays += count * samples
            for name, values in layers.items():
                self.layers[name].add(values, first, sample)

    def _checked(self, radiance: Tensor, first: int, sample: int) -> Tensor:
        """Count what is not finite and take it as black; apply the clamp."""
        finite = torch.isfinite(radiance).all(0)
        self.bad += (~finite).sum()
        if self.integrator.strict and not bool(finite.all()):
            s, p = (int(i) for i in (~finite).nonzero()[0])
            x, y = (first + p) % self.width + self.wave.crop[0], (first + p) // self.width + self.wave.crop[1]
            raise RenderError(f"integrator.strict: sample {sample + s} of pixel ({x}, {y}) is not finite")
        radiance = torch.where(finite, radiance, 0.0)
        clamp = self.integrator.clamp
        if clamp is None:
            return radiance
        scale = (clamp / radiance.abs().amax(0).clamp_min(clamp)).clamp_max(1.0)
        clamped = radiance * scale
        self.light += torch.stack((radiance.double().sum(), clamped.double().sum()))
        return clamped

    def result(self) -> Rendering:
        """The picture so far."""
        image, radiant, film = self.film.mean().to(self.dtype), self.integrator.light, self.settings.film
        layers = self._layers()
        if not radiant:
            shown = layers[next(iter(self.seen))]
            blank = torch.zeros_like(shown[..., :1]).expand(-1, -1, max(3 - shown.shape[2], 0))
            image = shown.expand(-1, -1, 3).contiguous() if shown.shape[2] == 1 else torch.cat((shown, blank), -1)
        clamped = None
        if radiant and self.integrator.clamp is not None:
            before, after = self.light.tolist()
            clamped = 1.0 - after / before if before > 0 else 0.0
        pixels = self.width * self.height
        return Rendering(
            image=image,
            layers={name: layers[name] for name in film.aovs or self.integrator.layers},
            guides={name: layers[name] for name in GUIDES} if film.denoise else {},
            spp=self.done // pixels,
            seconds=time.perf_counter() - self.start,
            build_seconds=self.build_seconds,
            compile_seconds=0.0 if self.loop is None else self.loop.kernels.seconds,
            paths=self.done,
            rays=self.tally.rays,
            nonfinite_samples=int(self.bad),
            truncated_paths=self.tally.truncated,
            clamped=clamped,
            relmse=self.film.relmse() if radiant else None,
            complete=self.done == pixels * self.settings.render.spp,
            eager=tuple(self.eager),
        )

    def _layers(self) -> dict[str, Tensor]:
        """The layers so far: those of first surfaces, and those that the film makes."""
        layers = {}
        for name, layer in self.seen.items():
            film = self.layers[name]
            values = film.mean() * (self.unit if layer.length else 1.0) if layer.averaged else film.first()
            layers[name] = values.to(self.dtype)
        for name in self.settings.film.aovs:
            if name not in self.seen:
                made: Any = LAYERS[name]  # a FilmLayer
                layers[name] = made.of(self.film).to(self.dtype)
        return layers
