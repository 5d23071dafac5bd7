"""A CUDA driver that is not there: kernels run on the CPU, in the memory of CPU tensors.

It has the functions of the driver's interface that :mod:`torchpt.engines.kernels.driver` calls, with their arguments. Kernels
are those that a device would run, written for one lane at a time (the width of a GPU thread) instead of in PTX: the same graph,
sinks, argument block, counters in memory and lists. They take lanes in a random order where that is asked for, so that places
in arenas and lists are as random as atomics make them on a device. :class:`PtxDriver` runs the PTX itself, slowly.
"""

from __future__ import annotations

import ctypes
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from ptx_machine import DeviceMemory, PtxMachine
from torch import Tensor

from torchpt.compiler import cache, cpu
from torchpt.compiler.form import Form
from torchpt.compiler.target import Target
from torchpt.engines.kernels.driver import Cuda

__all__ = ["PtxDriver", "ShuffledForm", "SimulatedCuda", "SimulatedDriver", "shuffled_lanes", "simulated_target"]


class SimulatedDriver:
    """The functions of a CUDA driver.

    Args:
        version: of the driver, as ``1000 major + 10 minor`` of CUDA.
        capability: compute capability of the device.
        present: number of devices.

    Attributes:
        launches: launches of each kernel, by number of the function.
        empty: launches without lanes.
    """

    def __init__(self, version: int = 12040, capability: tuple[int, int] = (9, 0), present: int = 1) -> None:
        self.version, self.capability, self.present = version, capability, present
        self.launches: Counter[int] = Counter()
        self.empty = 0
        self.refused = 0  # error code of the next launch
        self._functions: list[Any] = []

    def cuInit(self, flags: int) -> int:
        return 0 if self.present else 100

    def cuDriverGetVersion(self, version: Any) -> int:
        version._obj.value = self.version
        return 0

    def cuGetErrorName(self, code: int, name: Any) -> int:
        known = {2: b"CUDA_ERROR_OUT_OF_MEMORY", 100: b"CUDA_ERROR_NO_DEVICE", 218: b"CUDA_ERROR_INVALID_PTX"}
        name._obj.value = known.get(code, b"CUDA_ERROR_UNKNOWN")
        return 0

    def cuDeviceGet(self, device: Any, index: int) -> int:
        device._obj.value = index
        return 0 if index < self.present else 101

    def cuDeviceGetAttribute(self, value: Any, attribute: int, device: Any) -> int:
        value._obj.value = {16: 4, 75: self.capability[0], 76: self.capability[1]}[attribute]
        return 0

    def cuDevicePrimaryCtxRetain(self, context: Any, device: Any) -> int:
        context._obj.value = 1
        return 0

    def cuCtxSetCurrent(self, context: Any) -> int:
        return 0 if context.value == 1 else 201

    def cuModuleLoadDataEx(self, module: Any, image: bytes, options: int, keys: Any, values: Any) -> int:
        if not image.startswith(b"\x7fELF"):
            said = b"not an object file of this CPU"
            ctypes.memmove(values[0], said, len(said) + 1)
            return 218
        self._functions.append(cpu._loaded(image[:-1], cpu.host(), ""))
        module._obj.value = len(self._functions)
        return 0

    def cuModuleGetFunction(self, function: Any, module: Any, name: bytes) -> int:
        assert name == b"kernel"
        function._obj.value = module.value
        return 0

    def cuOccupancyMaxActiveBlocksPerMultiprocessor(self, blocks: Any, function: Any, threads: int, shared: int) -> int:
        blocks._obj.value = 2048 // threads
        return 0

    def cuFuncGetAttribute(self, value: Any, attribute: int, function: Any) -> int:
        value._obj.value = 0
        return 0

    def cuLaunchKernel(
        self, function: Any, gx: int, gy: int, gz: int, bx: int, by: int, bz: int, shared: int, stream: int,
        parameters: Any, extra: Any,
    ) -> int:  # fmt: skip
        assert gx > 0 and bx % 32 == 0 and gy == gz == by == bz == 1 and not shared and extra is None
        if self.refused:
            return self.refused
        address = ctypes.c_int64.from_address(parameters[1]).value
        lanes = ctypes.c_int64.from_address(address).value
        assert lanes >= 0
        self.launches[function.value] += 1
        self.empty += lanes == 0
        self._functions[function.value - 1].call(parameters[0], lanes)
        return 0


class PtxDriver(SimulatedDriver):
    """A driver whose kernels are PTX, run by the machine of :mod:`ptx_machine` in blocks of warps."""

    def cuModuleLoadDataEx(self, module: Any, image: bytes, options: int, keys: Any, values: Any) -> int:
        self._functions.append(PtxMachine(image[:-1].decode()))
        module._obj.value = len(self._functions)
        return 0

    def cuLaunchKernel(
        self, function: Any, gx: int, gy: int, gz: int, bx: int, by: int, bz: int, shared: int, stream: int,
        parameters: Any, extra: Any,
    ) -> int:  # fmt: skip
        machine: PtxMachine = self._functions[function.value - 1]
        self.launches[function.value] += 1
        arguments = [ctypes.string_at(parameters[k], size) for k, size in enumerate(machine.sizes)]
        machine.launch(_WholeMemory(), arguments, gx, bx, seed=self.launches.total())
        return 0


class _WholeMemory(DeviceMemory):
    """All memory of the process; tests of single kernels check the bounds of accesses."""

    _FIRST, _END = 1 << 12, 1 << 47

    def __init__(self) -> None:
        super().__init__()
        words: Any = (ctypes.c_uint8 * (self._END - self._FIRST)).from_address(self._FIRST)
        self.add(np.frombuffer(words, np.uint8))


class _Copied:
    """A copy to the host that is there at once; it has the values of the time at which it was started."""

    def __init__(self, values: Tensor) -> None:
        self._values = values.clone()

    def values(self) -> Tensor:
        return self._values


class SimulatedCuda(Cuda):
    """A device of the simulated driver, whose memory is that of CPU tensors.

    Attributes:
        fallback: why the last gradient was not taken by kernels; "" if it was.
    """

    def __init__(self, driver: SimulatedDriver | None = None) -> None:
        super().__init__(torch.device("cpu"), driver or SimulatedDriver())
        self.fallback = "no gradient was asked for"

    def _index(self) -> int:
        return 0

    def stream(self) -> int:
        return 0

    def to_device(self, values: Tensor) -> Tensor:
        return values

    def to_host(self, values: Tensor) -> Any:
        return _Copied(values)


# ---- Lanes in a random order

#: Primes above any number of lanes: lane ``k`` of ``n`` in the order of the loop is ``(prime * k + 1) mod n``.
_PRIMES = (2147483629, 2147483587)


@dataclass(frozen=True)
class ShuffledForm(Form):
    """One lane at a time, in a random order.

    Attributes:
        order: index of the prime that makes the order.
    """

    order: int = 0


def simulated_target(row: int, order: int | None = None) -> Target:
    """Return the target of a row length; ``order``: None: lanes in order, else the number of a random order."""
    form = Form(1, row) if order is None else ShuffledForm(1, row, order=order)
    return replace(cpu.host(), form=form)


def _shuffled(ir: str, prime: int) -> str:
    """Return the IR of a kernel whose loop takes lanes in a random order."""
    loop = "  %i = phi i64 [ 0, %entry ], "
    start = ir.index(loop)
    end = ir.index("\n", start) + 1
    line = ir[start:end].replace("%i =", "%k =")
    step = "  %next = add i64 %i, 1\n"
    assert ir.count(step) == 1
    moved = f"  %stepped = mul i64 %k, {prime}\n  %moved = add i64 %stepped, 1\n  %i = urem i64 %moved, %n\n"
    return ir[:start] + line + moved + ir[end:].replace(step, step.replace("%i", "%k"))


@contextmanager
def shuffled_lanes() -> Iterator[None]:
    """Write kernels of a :class:`ShuffledForm` so that their loop takes lanes in its order."""
    plain = cache.kernel_ir

    def written(stage: Any, form: Form) -> str:
        ir = plain(stage, form)
        return _shuffled(ir, _PRIMES[form.order]) if isinstance(form, ShuffledForm) else ir

    cache.kernel_ir = written
    try:
        yield
    finally:
        cache.kernel_ir = plain
