"""The forward engine of kernels on a device: makes the kernels, and launches waves one ahead of the host."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.target import Target
from torchpt.core.memory import Budget, Span, explain_out_of_memory, fits_in_memory
from torchpt.engines.kernels.device import Count, DeviceEngine
from torchpt.engines.kernels.device_kernels import DeviceKernels, device_kernels
from torchpt.engines.kernels.device_search import search_on_device
from torchpt.engines.kernels.driver import Cuda, HostCopy, cuda_of
from torchpt.engines.kernels.engine import Chunk, count_samples
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.work import SampleRange, TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film import Film

__all__ = ["MAX_LANES", "DeviceForward", "device_forward"]

#: Most lanes of a wave: some hundred launches of a few microseconds each are then short beside the work.
MAX_LANES = 1 << 20
#: Fewest lanes of a wave; the number of lanes is a multiple of it.
MIN_LANES = 1 << 10


@dataclass
class _Launched:
    """A wave that was launched, and is finished on the host while the next one runs.

    Attributes:
        chunk: its pixels and samples.
        pixel_set: the films.
        tally: returns the counts of rays and paths, after a wait.
        lost: number of samples that are not finite, on its way to the host.
        slots: radiance of the samples.
        light: sums of radiance before and after the clamp, on their way to the host.
        rays: rays of layers.
    """

    chunk: Chunk
    pixel_set: PixelSet
    tally: Callable[[], RayCounts]
    lost: HostCopy
    slots: Any
    light: HostCopy | None
    rays: int


def device_forward(
    wave: Wave,
    own: Sequence[int],
    by_kernels: bool,
    before: Kernels | None = None,
    cuda: Cuda | None = None,
    target: Callable[[int], Target] = ptx_target,
    lanes: int = MAX_LANES,
) -> DeviceForward:
    """Return the forward engine of a wave on a device.

    Args:
        wave: of the render, on the device.
        own: see :func:`device_kernels`.
        by_kernels: True: rays are searched by kernels where these can; False: by the wave's acceleration structure.
        before: see :func:`device_kernels`.
        cuda: the device; None: that of the wave.
        target: returns the target of a row length.
        lanes: most lanes of a wave.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    device = cuda_of(wave.centre.device) if cuda is None else cuda
    search = search_on_device(wave.accel, by_kernels, device.device, before)
    last = before

    def make(row: int) -> DeviceKernels:
        nonlocal last
        last = device_kernels(wave, own, device, target(row), search, last)
        return last

    return DeviceForward(make, device, wave, lanes, wave.integrator.strict)


class DeviceForward:
    """Forward engine of kernels on a device, see :class:`torchpt.engines.engine.Forward`.

    Args:
        make: makes the kernels for a row length.
        cuda: the device.
        wave: of the render.
        lanes: most lanes of a wave.
        strict: True: the render ends at the first sample that is not finite, so each wave is waited for.
    """

    compiled = True

    def __init__(
        self, make: Callable[[int], DeviceKernels], cuda: Cuda, wave: Wave, lanes: int = MAX_LANES, strict: bool = False
    ) -> None:
        self._make, self.cuda, self.wave, self.strict = make, cuda, wave, strict
        self.budget = Budget(
            cuda.device, lanes, what="a wave of the fewest lanes", fallback="waves of fewer lanes", min_lanes=MIN_LANES
        )
        self.kernels = make(lanes)
        self._seconds = 0.0  # of kernels that were replaced
        self._made: DeviceEngine | None = None
        self._spare: Any = None  # slots of the next wave
        self._clamped: Any = None

    @property
    def seconds(self) -> float:
        """Return the seconds spent on making kernels."""
        return self._seconds + self.kernels.seconds

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a lane takes, for these layers."""
        return self.kernels.rows(layers) + 6  # slots of a second wave, and clamped samples

    def release_workers(self, keeps: bool) -> None:
        """Release the memory of waves; torch's allocator keeps it for the next render."""
        self._made = self._spare = self._clamped = None

    def run(self, spans: Sequence[SampleRange], each: Callable[[TaskResult | None], bool]) -> bool:
        """See :class:`torchpt.engines.engine.Forward`. The host is one wave behind the device."""
        behind: deque[_Launched] = deque()  # waves that are not finished on the host
        for pixel_set, first, count in spans:
            pixels = pixel_set.film.width * pixel_set.film.height
            self._engine()  # settles the number of lanes
            launch = partial(self._launch, behind, pixel_set)
            for _ in self.budget.run_in_chunks(launch, pixels, first, count):
                while len(behind) > (0 if self.strict else 1):
                    if each(self._result_of(behind.popleft())):
                        return self._report_rest(behind, each)
        while behind:
            if each(self._result_of(behind.popleft())):
                return False
        return True

    def _engine(self) -> DeviceEngine:
        """Return the engine, with memory for as many lanes as the budget allows."""
        while True:
            row = max(self.budget.lanes // MIN_LANES * MIN_LANES, MIN_LANES)
            if self._made is not None and self.kernels.row == row:
                return self._made
            self.release_workers(keeps=False)
            self.budget.lanes = row
            if row != self.kernels.row:
                self._seconds += self.kernels.seconds
                self.kernels = self._make(row)
            if not fits_in_memory(self._make_engine):
                self.budget.shrink()

    def _make_engine(self) -> None:
        self._made = DeviceEngine(self.kernels)
        self._spare = self._made.device_calls.memory(3)

    def _launch(self, behind: deque[_Launched], pixel_set: PixelSet, span: Span) -> None:
        """Launch the kernels of a wave and append it to ``behind``.

        Memory that runs out before samples are added to films leaves the films as they were.

        Raises:
            RenderError: memory ran out while samples were added.
        """
        engine, clamp, chunk = self._engine(), self.wave.integrator.clamp, Chunk(*span, pixel_set)
        calls = engine.device_calls
        engine.begin_wave(chunk)
        names, rays = tuple(pixel_set.layers), 0
        if names:
            rays = engine.layers(chunk, names)
            engine.begin_wave(chunk)  # its tally is that of the chunk alone
        light = None
        if self.wave.integrator.light:
            # Slots of the wave before are read until it is finished.
            calls.slots, self._spare = self._spare, calls.slots
            engine.slots = calls.slots
            engine.launch(chunk)
        with explain_out_of_memory("the sums of a film"):
            lost = calls.lanes(0)
            if self.wave.integrator.light:
                light = self._add(engine, chunk, pixel_set.film, clamp, lost)
            shown: Any = engine.shown
            first = 0
            for film in pixel_set.layers.values():
                address = shown.address + 4 * self.kernels.row * first
                calls.accumulate(film, chunk, address, None, None, calls.lanes(0))
                count_samples(film, chunk, shown.floats[first : first + film.channels])
                first += film.channels
            copied = self.cuda.to_host(lost.value)
            behind.append(_Launched(chunk, pixel_set, engine.tallies(), copied, calls.slots, light, rays))

    def _add(self, engine: DeviceEngine, chunk: Chunk, film: Film, clamp: float | None, lost: Count) -> HostCopy | None:
        """Add the radiance and the splats of a chunk to the film; return the light before and after the clamp."""
        calls, used = engine.device_calls, chunk.pixels * chunk.samples
        if clamp is not None and self._clamped is None:
            self._clamped = calls.memory(3)
        calls.accumulate(film, chunk, calls.slots.address, clamp, self._clamped, lost)
        values = calls.slots.floats if clamp is None else self._clamped.floats
        count_samples(film, chunk, values)
        light = None
        if clamp is not None:
            plain = calls.slots.floats[:, :used]
            plain = torch.where(torch.isfinite(plain).all(0), plain, 0.0)
            light = torch.stack((plain.double().sum(), values[:, :used].double().sum()))
        for splats in engine.splats:
            value = splats.value
            if clamp is not None and light is not None:
                value = value * clamp_scale(value, clamp)
                light = light + torch.stack((splats.value.double().sum(), value.double().sum()))
            assert film.splats is not None
            stream = film.randomization_of(chunk.first_sample + splats.lane // chunk.pixels)
            sums, place, total = film.splats.writes_of_add(stream, splats.pixel, value)
            sums.index_copy_(2, place, total)
        return None if light is None else self.cuda.to_host(light)

    def _report_rest(self, behind: deque[_Launched], each: Callable[[TaskResult | None], bool]) -> bool:
        """Report the waves that were launched before the render was to end; return False."""
        while behind:
            each(self._result_of(behind.popleft()))
        return False

    def _result_of(self, wave: _Launched) -> TaskResult:
        """Return the result of a wave, after a wait."""
        chunk, used = wave.chunk, wave.chunk.pixels * wave.chunk.samples
        result = TaskResult(wave.tally(), used if self.wave.integrator.light or wave.rays else 0)
        result.tally.rays += wave.rays
        if wave.light is not None:
            before, after = wave.light.values().tolist()
            result.light = before, after
        if int(wave.lost.values()):
            radiance = wave.slots.floats[:, :used].view(3, chunk.samples, chunk.pixels)
            result.lost = NonFinite.of(radiance, chunk.first_pixel, chunk.first_sample, self.wave.crop, wave.pixel_set)
        return result
