"""Renders by the engine of a device, without a device: its kernels run on the CPU, in CPU memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pytest
from simulated_driver import PtxDriver, SimulatedCuda, shuffled_lanes, simulated_target

from torchpt.compiler.ptx import ptx_target
from torchpt.engines.kernels.device_backward import device_backward
from torchpt.engines.kernels.device_forward import DeviceForward, device_forward
from torchpt.gradients import replay
from torchpt.paths.wave import Wave
from torchpt.rendering import run
from torchpt.scene.prepare import own_models


@pytest.fixture
def device(monkeypatch) -> Iterator[Callable[..., SimulatedCuda]]:
    """A function that lets later renders use a simulated device; it returns the device.

    Its arguments are the most lanes of a wave, the number of the random order that kernels take lanes in (None: in order),
    and whether the kernels are PTX, which takes warps in a random order.
    """

    def use(lanes: int = 2048, order: int | None = None, by_kernels: bool = True, ptx: bool = False) -> SimulatedCuda:
        cuda = SimulatedCuda(PtxDriver() if ptx else None)
        target = ptx_target if ptx else partial(simulated_target, order=order)

        def engine(scene: Any, wave: Wave, eager: list[str], threads: int | None = None) -> DeviceForward:
            own = own_models(scene, wave)
            made = device_forward(wave, own, by_kernels, None, cuda, target, lanes)
            eager += [f"{number}: {reason}" for number, reason in made.kernels.eager.items()]
            return made

        def backward(kernels: Any, tape: Any, settings: Any, cotangent: Any, sums: Any) -> str:
            cuda.fallback = replay._replay_on_device([], tape, settings, cotangent, kernels.cotangent, sums, None)
            return cuda.fallback

        def made(tape: Any, own: Any, cotangent: Any, _: bool, lanes: int, before: Any) -> Any:
            return device_backward(tape, own, cotangent, by_kernels, lanes, before, cuda, target)

        monkeypatch.setattr(run, "kernel_engine", engine)
        monkeypatch.setattr(replay, "_replay_on_threads", backward)
        monkeypatch.setattr(replay, "device_backward", made)
        return cuda

    with shuffled_lanes():
        yield use
