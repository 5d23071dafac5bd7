"""One forward render: chunks of pixels, each a wave, accumulate in films."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.cameras import Camera
from torchpt.errors import RenderError
from torchpt.film import Film, Filter
from torchpt.integrators import Wave
from torchpt.integrators.compiled import CompiledStages, Stages
from torchpt.integrators.loop.kernels import Kernels
from torchpt.integrators.loop.schedule import Loop, Share
from torchpt.integrators.path import Limits, Tally
from torchpt.integrators.stages import Plan
from torchpt.lanes.graph import Unsupported
from torchpt.records import World
from torchpt.samplers import Sampler
from torchpt.scene import Scene
from torchpt.settings import (
    AovIntegrator,
    DirectIntegrator,
    GaussianFilter,
    IblIntegrator,
    MitchellFilter,
    PathIntegrator,
    Settings,
)

if TYPE_CHECKING:
    from torchpt.integrators.ibl import Preview

__all__ = [
    "BYTES_PER_LANE",
    "Progress",
    "Rendering",
    "Run",
    "chunks_of",
    "kernels_of",
    "lanes_for",
    "limited_threads",
    "loop_facts",
    "looped",
    "make_wave",
    "pixel_of",
]

#: Lanes of a wave where memory is not limited: large enough to hide the cost of dispatch, small enough for the caches.
LANES = {"cpu": 1 << 18, "cuda": 1 << 22}
#: Peak bytes a lane takes in a wave, measured on the Cornell box; under a tape each vertex keeps about this much.
BYTES_PER_LANE = 640
#: From this many samples a pixel on they are shared by four independent randomizations, below by two. Each takes something
#: from Sobol' points (Cornell box, 64 spp: relMSE 0.38, 0.50, 0.58 of independent sampling for one, two, four), and two
#: already tell the picture's error; four make the variance of a single pixel less of a guess.
MANY_SAMPLES = 256
#: A pass never holds more samples a pixel than this.
LARGEST_PASS = 64

#: From this many camera paths a BSDF model on ``compile: auto`` compiles: a cold start takes a minute each, and saves a
#: quarter of the rest.
COMPILE_REPAYS = 200_000_000

_compiled: WeakKeyDictionary[Scene, dict[Plan, CompiledStages]] = WeakKeyDictionary()
_kernels: WeakKeyDictionary[Scene, Kernels] = WeakKeyDictionary()
_previews: WeakKeyDictionary[Scene, tuple[World, Preview]] = WeakKeyDictionary()
_said: set[str] = set()
_forked = False
_threads_lock = threading.Lock()
_threads_before, _renders = 0, 0


def _after_fork() -> None:
    global _forked, _renders, _threads_lock
    _forked, _renders, _threads_lock = True, 0, threading.Lock()


os.register_at_fork(after_in_child=_after_fork)


@dataclass
class Rendering:
    """A picture and how it came about.

    Attributes:
        image: ``(H, W, 3)`` linear RGB.
        layers: what ``film.aovs`` asked for, each ``(H, W, C)``.
        spp: samples a pixel that the picture holds.
        seconds: wall time.
        build_seconds: of it, for the world and its search structure.
        compile_seconds: of it, for compiling.
        paths: camera samples traced.
        rays: rays traced, shadow rays included.
        nonfinite_samples: samples that were NaN or infinite, and counted as black.
        truncated_paths: paths ended by the cap on endless depth.
        clamped: fraction of the light that ``integrator.clamp`` took away; None where it is off.
        relmse: the picture's estimate of its own relMSE; None for a single randomization.
        complete: whether all samples asked for were taken.
        eager: stages that ran as tensor operations although kernels were wanted, and why.
    """

    image: Tensor
    layers: dict[str, Tensor] = field(default_factory=dict)
    spp: int = 0
    seconds: float = 0.0
    build_seconds: float = 0.0
    compile_seconds: float = 0.0
    paths: int = 0
    rays: int = 0
    nonfinite_samples: int = 0
    truncated_paths: int = 0
    clamped: float | None = None
    relmse: float | None = None
    complete: bool = True
    eager: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """The facts as plain values, ready for JSON."""
        facts: dict[str, Any] = {
            "spp": self.spp,
            "build_seconds": round(self.build_seconds, 4),
            "compile_seconds": round(self.compile_seconds, 4),
            "seconds": round(self.seconds, 4),
            "paths_per_second": round(self.paths / max(self.seconds, 1e-9)),
            "rays": self.rays,
            "nonfinite_samples": self.nonfinite_samples,
            "mean": [float(x) for x in self.image.double().mean((0, 1))],
            "relmse": self.relmse,
        }
        if self.truncated_paths:
            facts["truncated_paths"] = self.truncated_paths
        if self.clamped is not None:
            facts["clamped"] = self.clamped
        if not self.complete:
            facts["complete"] = False
        if self.eager:
            facts["eager"] = list(self.eager)
        return facts


@dataclass
class Progress:
    """The state of a render between two chunks.

    Attributes:
        done: camera samples taken.
        total: camera samples asked for.
        rays: rays traced.
        seconds: since the start.
        pass_finished: whether every pixel now has the same number of samples.
        snapshot: makes the picture so far.
    """

    done: int
    total: int
    rays: int
    seconds: float
    pass_finished: bool
    snapshot: Callable[[], Rendering]


@contextmanager
def limited_threads(wish: int | str) -> Iterator[None]:
    """Let torch use ``wish`` threads for a while."""
    global _renders, _threads_before
    with _threads_lock:
        if _renders == 0:
            _threads_before = torch.get_num_threads()
        _renders += 1
        # The thread pool of the parent does not survive a fork: waiting for it would never end.
        now = 1 if _forked else _threads_before if wish == "auto" else int(wish)
        if now != torch.get_num_threads():
            torch.set_num_threads(now)
    try:
        yield
    finally:
        with _threads_lock:
            _renders -= 1
            # Of renders that overlap, the last one puts back what the first one found.
            if _renders == 0 and torch.get_num_threads() != _threads_before and not _forked:
                torch.set_num_threads(_threads_before)


def make_wave(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor] | None,
    dtype: torch.dtype,
    tape: bool = False,
    attached: bool = False,
) -> Wave:
    """Everything that the waves of a render share; see :class:`Plan` for ``tape`` and ``attached``."""
    world, geometry = scene.world(dtype, params, "uv" in settings.film.aovs, settings.light_choice)
    threads = None if settings.render.threads == "auto" else int(settings.render.threads)
    moved = any(name.startswith("shapes.") and name.endswith((".vertices", ".to_world")) for name in params or {})
    accel = scene.accel(settings.render.accel, threads, geometry if moved else None)
    film, integrator = settings.film, settings.integrator
    own = film.filter
    stddev = own.stddev if isinstance(own, GaussianFilter) else 0.5
    lobes = (own.B, own.C) if isinstance(own, MitchellFilter) else ()
    limits, plan = None, Plan(settings.sampler.type, "mis", None, dtype, tape, attached)
    if isinstance(integrator, PathIntegrator):
        limits = Limits(integrator.max_depth, integrator.rr_depth)
        plan = Plan(settings.sampler.type, integrator.strategy, integrator.rr_prob, dtype, tape, attached)
    elif isinstance(integrator, DirectIntegrator):
        limits = Limits(2, 3)
        plan = Plan(settings.sampler.type, integrator.strategy, None, dtype, tape, attached)
    elif isinstance(integrator, IblIntegrator):
        limits = Limits(2, 3)
        plan = Plan(settings.sampler.type, "light", None, dtype, tape, attached)
    spp = settings.render.spp
    camera = scene.camera(film, scene.merged(params), dtype)
    randomizations = min(spp, 4 if spp >= MANY_SAMPLES else 2)
    return Wave(
        stages=_stages(scene, settings, plan, world, pixel_of(world, camera), own=not params),
        limits=limits,
        accel=accel,
        camera=camera,
        filter=Filter(own.type, own.radius, stddev, scene.device, *lobes),
        sampler=Sampler(settings.sampler.type, settings.render.seed, randomizations, spp, film.width),
        crop=film.crop or (0, 0, film.width, film.height),
        centre=scene.space.shift,
        preview=_preview(scene, world, own=not params) if isinstance(integrator, IblIntegrator) else None,
    )


def _preview(scene: Scene, world: World, own: bool) -> Preview:
    """The environment's maps; kept with the scene, unless the world is not the scene's ``own``."""
    from torchpt.integrators.ibl import Preview

    if not own or torch.is_grad_enabled():
        return Preview.of(world)
    kept = _previews.get(scene)
    if kept is None or kept[0] is not world:
        kept = _previews[scene] = world, Preview.of(world)
    return kept[1]


def pixel_of(world: World, camera: Camera) -> Tensor | None:
    """What textures filtered by the pixel's footprint need of the camera; None where there are none."""
    return camera.pixel() if world.textures.filtered else None


def _stages(scene: Scene, settings: Settings, plan: Plan, world: World, pixel: Tensor | None, own: bool) -> Stages:
    """Eager stages; on CUDA compiled ones, which are kept with the scene unless the world is not the scene's ``own``."""
    mode = settings.render.compile
    if mode == "auto":
        _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
        work = width * height * settings.render.spp
        mode = (
            "on"
            if own
            and work >= COMPILE_REPAYS * len(world.materials.models)  # each has graphs of its own
            and plan.dtype == torch.float32
            and not scene.own_models  # code of the user's own may hold what cannot be compiled
            else "off"
        )
    if scene.device.type == "cpu" or mode == "off" or plan.tape or torch.is_grad_enabled():
        return Stages(plan, world, pixel)
    if not own:
        return CompiledStages(plan, world, pixel)
    kept = _compiled.setdefault(scene, {})
    if plan not in kept or kept[plan].world is not world:
        kept[plan] = CompiledStages(plan, world)
    return kept[plan].through(pixel)


def looped(wave: Wave, settings: Settings, device: torch.device) -> bool:
    """Whether a render takes the compiled loop: on a CPU, in float32, and without a tape."""
    plan = wave.stages.plan
    return device.type == "cpu" and settings.render.compile != "off" and plan.dtype == torch.float32 and not plan.tape


def kernels_of(scene: Scene, wave: Wave, before: Kernels | None = None) -> Kernels:
    """The kernels of a render; models of the user's own that no kernel can be made of are named in ``eager``."""
    packets = wave.accel.name == "brute" and not wave.stages.world.geometry.counts[4]
    fused = packets and wave.stages.world.materials.opacity is None and wave.preview is None
    kernels = Kernels(wave, packets, fused, before)
    own = [
        k
        for k, model in enumerate(wave.stages.world.materials.models)
        if any(model is mine for mine in scene.own_models)
    ]
    eager = kernels.probe(own) if wave.limits is not None else {}
    if eager and kernels.fused:  # what runs as tensor operations hands its rays to the search structure
        kernels = Kernels(wave, packets, False)
    kernels.eager = eager
    return kernels


def loop_facts(scene: Scene, settings: Settings) -> dict[str, Any]:
    """How a render of the scene would run: as the compiled loop, and how that searches, or as tensor operations."""
    with torch.no_grad():
        wave = make_wave(scene, settings, None, torch.float32)
        if not looped(wave, settings, scene.device):
            return {"stages": "compiled by torch" if wave.stages.compiled else "eager, by tensor operations"}
        kernels = kernels_of(scene, wave)
    search = "inside the stages" if kernels.fused else "kernels of packets" if kernels.packets else wave.accel.name
    names = [str(model) for model in wave.stages.world.materials.models]
    eager = {names[number]: reason for number, reason in kernels.eager.items()}
    return {
        "stages": "compiled to loops over lanes",
        "search": search,
        "rows_a_path": kernels.state.count,
        **({"eager": eager} if eager else {}),
    }


def _channels(settings: Settings) -> dict[str, int]:
    """How many channels each layer of the first surfaces has that is wanted."""
    wanted = settings.film.aovs
    if isinstance(settings.integrator, AovIntegrator) and not wanted:
        wanted = ("albedo",)
    if not wanted:
        return {}
    from torchpt.integrators.aov import CHANNELS

    return {name: CHANNELS[name] for name in wanted if name in CHANNELS}


def say_once(text: str) -> None:
    """A line on stderr, the first time only."""
    if text not in _said:
        _said.add(text)
        print(text, file=sys.stderr, flush=True)


def _passes(spp: int, randomizations: int) -> Iterator[tuple[int, int]]:
    """First sample and number of samples of each pass; sizes double and depend on ``spp`` alone."""
    first, size = 0, randomizations
    while first < spp:
        count = min(size, spp - first)
        yield first, count
        first += count
        size = min(2 * size, LARGEST_PASS) if first > randomizations else size


def lanes_for(settings: Settings, device: torch.device, per_lane: int = BYTES_PER_LANE) -> int:
    """Lanes of a wave, under ``render.max_memory``."""
    lanes = LANES.get(device.type, LANES["cpu"])
    if settings.render.max_memory is not None:
        lanes = min(lanes, max(settings.render.max_memory // per_lane, 1))
    return lanes


def chunks_of(
    settings: Settings, lanes: int, randomizations: int, pixels: int
) -> Iterator[tuple[int, int, int, int, bool]]:
    """Ranges ``(first_pixel, pixels, first_sample, samples, ends_pass)``. Chunks split pixels, never samples' order."""
    for first_sample, samples in _passes(settings.render.spp, randomizations):
        batch = max(min(samples, lanes), 1)
        for start in range(first_sample, first_sample + samples, batch):
            count = min(batch, first_sample + samples - start)
            step = max(lanes // count, 1)
            for first in range(0, pixels, step):
                last = first + step >= pixels and start + count == first_sample + samples
                yield first, min(step, pixels - first), start, count, last


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
        self.channels = _channels(settings)
        self.names = tuple(self.channels)
        self.on_progress: Callable[[Progress], bool | None] | None = None
        self.eager: list[str] = []
        self._begin()
        self.loop = self._loop(scene) if looped(self.wave, settings, self.device) else None

    def _begin(self) -> None:
        """Nothing is sampled yet."""
        width, height, device = self.width, self.height, self.device
        self.film = Film(width, height, self.wave.sampler.randomizations, device)
        self.layers = {name: Film(width, height, 1, device, channels) for name, channels in self.channels.items()}
        self.tally, self.done, self.ended = Tally(), 0, False
        self.bad = torch.zeros((), dtype=torch.int64, device=device)
        self.light = torch.zeros(2, dtype=torch.float64, device=device)  # before and after the clamp

    def _loop(self, scene: Scene) -> Loop:
        """The compiled loop; its kernels are kept with the scene."""
        kernels = _kernels[scene] = kernels_of(scene, self.wave, _kernels.get(scene))
        for number, reason in kernels.eager.items():
            name = str(self.wave.stages.world.materials.models[number])
            self.eager.append(f"{name}: {reason}")
            say_once(
                f"torchpt: the material model {name} runs by tensor operations, as no kernel can be made of {reason}"
            )
        settings, integrator = self.settings, self.settings.integrator
        limited = settings.render.max_memory is not None
        return Loop(
            kernels,
            self.film,
            self.layers,
            torch.get_num_threads(),
            lanes_for(settings, self.device) if limited else None,
            getattr(integrator, "clamp", None),
            getattr(integrator, "strict", False),
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

        for first, samples in _passes(self.settings.render.spp, self.film.randomizations):
            if not loop.run(first, samples, each):
                break

    def _chunk(self, first: int, count: int, sample: int, samples: int) -> None:
        if self.wave.limits is not None:
            radiance, tally = self.wave.radiance(first, count, sample, samples)
            self.tally.rays += tally.rays
            self.tally.truncated += tally.truncated
            self.film.add(self._checked(radiance, first, sample), first, sample)
        if self.names:
            found = self.wave.layers(self.names, first, count, sample, samples)
            self.tally.rays += count * samples
            for name, values in found.items():
                self.layers[name].add(values, first, sample)

    def _checked(self, radiance: Tensor, first: int, sample: int) -> Tensor:
        """Count what is not finite and take it as black; apply the clamp."""
        settings = self.settings.integrator
        assert not isinstance(settings, AovIntegrator)
        finite = torch.isfinite(radiance).all(0)
        self.bad += (~finite).sum()
        if settings.strict and not bool(finite.all()):
            s, p = (int(i) for i in (~finite).nonzero()[0])
            x, y = (first + p) % self.width + self.wave.crop[0], (first + p) // self.width + self.wave.crop[1]
            raise RenderError(f"integrator.strict: sample {sample + s} of pixel ({x}, {y}) is not finite")
        radiance = torch.where(finite, radiance, 0.0)
        if settings.clamp is None:
            return radiance
        scale = (settings.clamp / radiance.abs().amax(0).clamp_min(settings.clamp)).clamp_max(1.0)
        clamped = radiance * scale
        self.light += torch.stack((radiance.double().sum(), clamped.double().sum()))
        return clamped

    def result(self) -> Rendering:
        """The picture so far."""
        lengths = {"depth": self.unit, "position": self.unit}  # lanes count them in a unit of the scene's own
        layers = {name: (film.mean() * lengths.get(name, 1.0)).to(self.dtype) for name, film in self.layers.items()}
        aov = isinstance(self.settings.integrator, AovIntegrator)
        if layers:
            from torchpt.integrators.aov import NAMES

            for name in set(NAMES) & set(layers):
                layers[name] = self.layers[name].first().to(self.dtype)
        image = self.film.mean().to(self.dtype)
        variance = None if aov else self.film.variance()
        if aov and self.names:
            shown = layers[self.names[0]]
            blank = torch.zeros_like(shown[..., :1]).expand(-1, -1, 3 - shown.shape[2])
            image = shown.expand(-1, -1, 3).contiguous() if shown.shape[2] == 1 else torch.cat((shown, blank), -1)
        if "variance" in self.settings.film.aovs:
            layers["variance"] = torch.full_like(image, torch.inf) if variance is None else variance.to(self.dtype)
        clamped = None
        if not aov and self.settings.integrator.clamp is not None:  # type: ignore[union-attr]
            before, after = self.light.tolist()
            clamped = 1.0 - after / before if before > 0 else 0.0
        pixels = self.width * self.height
        return Rendering(
            image=image,
            layers=layers,
            spp=self.done // pixels,
            seconds=time.perf_counter() - self.start,
            build_seconds=self.build_seconds,
            compile_seconds=0.0 if self.loop is None else self.loop.kernels.seconds,
            paths=self.done,
            rays=self.tally.rays,
            nonfinite_samples=int(self.bad),
            truncated_paths=self.tally.truncated,
            clamped=clamped,
            relmse=None if aov else self.film.relmse(),
            complete=self.done == pixels * self.settings.render.spp,
            eager=tuple(self.eager),
        )
