"""A CUDA device for kernels: their code and launches by the driver's public interface, memory and streams by torch.

torch has no public way to launch a kernel of one's own with a structure as argument, so the driver's library is called through
ctypes. Everything else is torch's: its context of the device, its current stream, its allocator.
"""

from __future__ import annotations

import ctypes
import functools
import sys
import time
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.native.device_checks import DRIVER_FILES, driver_library

__all__ = [
    "OLDEST_CAPABILITY",
    "OLDEST_DRIVER",
    "THREADS",
    "Cuda",
    "Function",
    "HostCopy",
    "cuda_of",
    "library",
    "missing",
]

#: Oldest version of the driver's interface that compiles PTX 7.0, as ``1000 major + 10 minor`` of CUDA: 11.0.
OLDEST_DRIVER = 11000
#: Oldest compute capability that the PTX is for (``torchpt.compiler.ptx``).
OLDEST_CAPABILITY = (7, 5)
#: Threads of a block: a multiple of a warp's 32. Four warps: few registers are wasted where a kernel needs many.
THREADS = 128
#: Most registers of a thread. Fewer than kernels ask for: more warps hide the latency of memory better than spills cost.
REGISTERS = 96

# Values of the driver's enumerations, from cuda.h.
_JIT_MAX_REGISTERS, _JIT_ERROR_LOG, _JIT_ERROR_LOG_SIZE = 0, 5, 6  # CUjit_option
_ATTRIBUTE_REGISTERS, _ATTRIBUTE_LOCAL_BYTES = 4, 3  # CUfunction_attribute
_CAPABILITY_MAJOR, _CAPABILITY_MINOR, _MULTIPROCESSORS = 75, 76, 16  # CUdevice_attribute
_OUT_OF_MEMORY = 2  # CUresult


@functools.cache
def library() -> Any | None:
    """Return the driver's library with the types of arguments; None if there is none."""
    found = driver_library()
    if found is None:
        return None
    pointer, number, unsigned = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint
    found.cuInit.argtypes = [unsigned]
    found.cuDriverGetVersion.argtypes = [pointer]
    found.cuGetErrorName.argtypes = [number, pointer]
    found.cuDeviceGet.argtypes = [pointer, number]
    found.cuDeviceGetAttribute.argtypes = [pointer, number, number]
    found.cuDevicePrimaryCtxRetain.argtypes = [pointer, number]
    found.cuCtxSetCurrent.argtypes = [pointer]
    found.cuModuleLoadDataEx.argtypes = [pointer, ctypes.c_char_p, unsigned, pointer, pointer]
    found.cuModuleGetFunction.argtypes = [pointer, pointer, ctypes.c_char_p]
    found.cuFuncGetAttribute.argtypes = [pointer, number, pointer]
    found.cuOccupancyMaxActiveBlocksPerMultiprocessor.argtypes = [pointer, pointer, number, ctypes.c_size_t]
    found.cuLaunchKernel.argtypes = [pointer, *([unsigned] * 7), pointer, pointer, pointer]
    return found


def missing(index: int, driver: Any = None) -> str:
    """Return why kernels cannot run on a CUDA device, in a few words; empty if they can.

    Args:
        index: number of the device.
        driver: the driver's library; None: that of the machine.
    """
    driver = library() if driver is None else driver
    if driver is None:
        return f"there is no CUDA driver ({' or '.join(DRIVER_FILES.get(sys.platform, ('libcuda',)))})"
    version, device = ctypes.c_int(), ctypes.c_int()
    capability = ctypes.c_int(), ctypes.c_int()
    if code := (
        driver.cuInit(0)
        or driver.cuDriverGetVersion(ctypes.byref(version))
        or driver.cuDeviceGet(ctypes.byref(device), index)
        or driver.cuDeviceGetAttribute(ctypes.byref(capability[0]), _CAPABILITY_MAJOR, device)
        or driver.cuDeviceGetAttribute(ctypes.byref(capability[1]), _CAPABILITY_MINOR, device)
    ):
        return f"the CUDA driver says {_name(driver, code)}"
    if version.value < OLDEST_DRIVER:
        return f"the CUDA driver is too old: {_version(version.value)}, and {_version(OLDEST_DRIVER)} is needed"
    major, minor = (part.value for part in capability)
    if (major, minor) < OLDEST_CAPABILITY:
        oldest = ".".join(map(str, OLDEST_CAPABILITY))
        return f"the GPU is too old: its compute capability is {major}.{minor}, and {oldest} is needed"
    return ""


def _version(number: int) -> str:
    return f"{number // 1000}.{number % 1000 // 10}"


def _name(driver: Any, code: int) -> str:
    """Return the driver's name of an error, such as CUDA_ERROR_NO_DEVICE."""
    text = ctypes.c_char_p()
    if driver.cuGetErrorName(code, ctypes.byref(text)) or not text.value:
        return f"error {code}"
    return text.value.decode()


class Function:
    """A kernel on a device.

    Attributes:
        handle: of the driver.
        blocks: number of blocks of :attr:`Cuda.threads` threads, as of its load, that fill the device once.
        registers: of a thread.
        local_bytes: local memory of a thread: spilled registers and arrays.
        seconds: in which the driver has compiled it.
    """

    def __init__(self, handle: Any, blocks: int, registers: int, local_bytes: int, seconds: float = 0.0) -> None:
        self.handle, self.blocks = handle, blocks
        self.registers, self.local_bytes, self.seconds = registers, local_bytes, seconds


class Cuda:
    """A CUDA device as kernels use it.

    Args:
        device: the device; one without an index is torch's current one.
        driver: the driver's library; None: that of the machine.

    Attributes:
        threads: threads of a block.
        registers: most registers of a thread; others are spilled to local memory. 255 is the hardware's bound.

    Raises:
        RenderError: there is no such device, or its driver cannot run kernels.
    """

    def __init__(self, device: torch.device, driver: Any = None) -> None:
        self.device, self.threads, self.registers = device, THREADS, REGISTERS
        reason = missing(self._index(), driver)
        if reason:
            raise RenderError(f"kernels cannot run on {device}: {reason}")
        self.driver: Any = library() if driver is None else driver
        number, self._context = ctypes.c_int(), ctypes.c_void_p()
        self._check(self.driver.cuDeviceGet(ctypes.byref(number), self._index()), "the device")
        # The primary context is the one that torch uses as well.
        self._check(self.driver.cuDevicePrimaryCtxRetain(ctypes.byref(self._context), number), "the device's context")
        value = ctypes.c_int()
        code = self.driver.cuDeviceGetAttribute(ctypes.byref(value), _MULTIPROCESSORS, number)
        self._check(code, "the number of multiprocessors")
        self.multiprocessors = value.value
        self._functions: dict[tuple[str, int, int], Function] = {}

    # -- what torch has

    def _index(self) -> int:
        return torch.cuda.current_device() if self.device.index is None else self.device.index

    def stream(self) -> int:
        """Return the handle of torch's current stream."""
        return torch.cuda.current_stream(self.device).cuda_stream

    def to_device(self, values: Tensor) -> Tensor:
        """Return a copy of a host's tensor, made in the order of the stream; the host does not wait for it."""
        return values.pin_memory().to(self.device, non_blocking=True)

    def to_host(self, values: Tensor) -> HostCopy:
        """Start to copy a tensor to the host."""
        return HostCopy(values)

    # -- the driver

    def _check(self, code: int, what: str, log: bytes = b"") -> None:
        """Raise for an error of the driver.

        Raises:
            MemoryError: the device is out of memory.
            RenderError: another error.
        """
        if code:
            said = " ".join(log.decode(errors="replace").split())
            text = f"CUDA: {what}: {_name(self.driver, code)}{': ' if said else ''}{said}"
            raise (MemoryError if code == _OUT_OF_MEMORY else RenderError)(text)

    def enter(self) -> None:
        """Make the device's context current in this thread; before other calls of the driver."""
        self._check(self.driver.cuCtxSetCurrent(self._context), "the device's context")

    def load(self, code: bytes, key: str) -> Function:
        """Return the kernel of a module, loaded once for each :attr:`threads` and :attr:`registers`.

        Args:
            code: PTX, which the driver compiles and keeps in a cache of its own.
            key: identifies the code.
        """
        known = key, self.threads, self.registers
        if known not in self._functions:
            self._functions[known] = self._loaded(code)
        return self._functions[known]

    def functions(self) -> list[Function]:
        """Return the kernels loaded so far."""
        return list(self._functions.values())

    def _loaded(self, code: bytes) -> Function:
        self.enter()
        start = time.perf_counter()
        driver, module, handle = self.driver, ctypes.c_void_p(), ctypes.c_void_p()
        log = ctypes.create_string_buffer(1 << 12)
        options = (ctypes.c_int * 3)(_JIT_ERROR_LOG, _JIT_ERROR_LOG_SIZE, _JIT_MAX_REGISTERS)
        values = (ctypes.c_void_p * 3)(ctypes.addressof(log), len(log), self.registers)
        found = driver.cuModuleLoadDataEx(ctypes.byref(module), code + b"\0", len(options), options, values)
        self._check(found, "the code of a kernel", log.value)
        self._check(driver.cuModuleGetFunction(ctypes.byref(handle), module, b"kernel"), "the code of a kernel")
        blocks, registers, local = (ctypes.c_int() for _ in range(3))
        found = driver.cuOccupancyMaxActiveBlocksPerMultiprocessor(ctypes.byref(blocks), handle, self.threads, 0)
        self._check(found, "the occupancy of a kernel")
        for value, attribute in ((registers, _ATTRIBUTE_REGISTERS), (local, _ATTRIBUTE_LOCAL_BYTES)):
            self._check(driver.cuFuncGetAttribute(ctypes.byref(value), attribute, handle), "a kernel's attributes")
        fill = max(blocks.value, 1) * self.multiprocessors
        return Function(handle, fill, registers.value, local.value, time.perf_counter() - start)

    def launch(self, function: Function, words: Any, lanes: int, most: int, stream: int) -> None:
        """Launch a kernel.

        Args:
            function: from :meth:`load`.
            words: the block of arguments, a ctypes array; it is copied now.
            lanes: address of the number of lanes, on the device.
            most: largest number of lanes that may stand there.
            stream: handle of the stream.
        """
        address = ctypes.c_int64(lanes)
        pointers = (ctypes.c_void_p * 2)(ctypes.addressof(words), ctypes.addressof(address))
        grid = max(min(-(-most // self.threads), function.blocks), 1)
        code = self.driver.cuLaunchKernel(function.handle, grid, 1, 1, self.threads, 1, 1, 0, stream, pointers, None)
        self._check(code, "the launch of a kernel")


@functools.cache
def cuda_of(device: torch.device) -> Cuda:
    """Return the device as kernels use it, one object for each; arguments and errors as of :class:`Cuda`."""
    return Cuda(device)


class HostCopy:
    """A copy of a device's tensor to the host that is under way.

    Args:
        values: the tensor.
    """

    def __init__(self, values: Tensor) -> None:
        self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
        self._host.copy_(values, non_blocking=True)
        self._event = torch.cuda.Event()
        self._event.record(torch.cuda.current_stream(values.device))

    def values(self) -> Tensor:
        """Wait for the copy and return it."""
        self._event.synchronize()
        return self._host
