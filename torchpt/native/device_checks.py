"""The NVIDIA driver of this machine, and whether a card has passed the check of kernels.

The check renders on the card and compares the bits with those of the CPU. ``scripts/first_gpu.py`` runs it and calls
:func:`record`; ``device=auto`` takes a card only if its :func:`last_check` passed. A result is kept in the cache folder, by
card and driver: a new driver compiles kernels anew, so the card is checked anew.
"""

from __future__ import annotations

import ctypes
import functools
import json
import sys
import warnings
from contextlib import suppress
from typing import Any, NamedTuple

import torch

from torchpt.core.version import __version__
from torchpt.native import cache

__all__ = [
    "DRIVER_FILES",
    "CheckResult",
    "card_name",
    "cuda_of_driver",
    "driver_library",
    "driver_too_old",
    "driver_version",
    "last_check",
    "record",
    "recorded",
    "why_unavailable",
]

#: File names of the driver's library, by platform.
DRIVER_FILES = {"linux": ("libcuda.so.1", "libcuda.so"), "win32": ("nvcuda.dll",)}
#: Bytes of NVML's version text; NVML writes at most 80 (NVML_SYSTEM_DRIVER_VERSION_BUFFER_SIZE).
_VERSION_BYTES = 96


class CheckResult(NamedTuple):
    """The result of a check of one card with one driver.

    Attributes:
        card: the card's name, as torch knows it.
        driver: version of the NVIDIA driver.
        passed: True if every kernel gave the bits of the CPU.
        detail: one line for people: what was compared, or what failed.
        version: version of torchpt that was checked.
    """

    card: str
    driver: str
    passed: bool
    detail: str = ""
    version: str = __version__


def card_name(device: torch.device | int | None = None) -> str:
    """Return the name of a CUDA device; None: the current one."""
    return torch.cuda.get_device_name(device)


def driver_version() -> str:
    """Return the version of the NVIDIA driver, such as ``550.54.15``; ``""`` if there is none.

    It is read from NVML. Without that library it is the version of CUDA that the driver supports, such as ``CUDA 12.4``.
    """
    text = ctypes.create_string_buffer(_VERSION_BYTES)
    with suppress(OSError, AttributeError):
        nvml = ctypes.CDLL("nvml.dll" if sys.platform == "win32" else "libnvidia-ml.so.1")
        if nvml.nvmlInit_v2() == 0:  # 0: success
            status = nvml.nvmlSystemGetDriverVersion(text, ctypes.c_uint(len(text)))
            nvml.nvmlShutdown()
            if status == 0:
                return text.value.decode(errors="replace")
    version = cuda_of_driver()
    return f"CUDA {version[0]}.{version[1]}" if version else ""


@functools.cache
def driver_library() -> Any | None:
    """Return the library of the CUDA driver; None if there is none."""
    for name in DRIVER_FILES.get(sys.platform, ()):
        with suppress(OSError):
            return ctypes.CDLL(name)
    return None


def cuda_of_driver() -> tuple[int, int] | None:
    """Return the newest version of CUDA that the driver supports, such as ``(12, 4)``; None if there is no driver."""
    driver, number = driver_library(), ctypes.c_int(0)  # 1000 major + 10 minor
    if driver is None or driver.cuDriverGetVersion(ctypes.byref(number)) or not number.value:
        return None
    return number.value // 1000, number.value % 1000 // 10


def why_unavailable() -> str | None:
    """Return why torch can use no CUDA device, as a clause for the end of a sentence; None if it can."""
    if torch.cuda._is_in_bad_fork():
        remedy = "multiprocessing_context='spawn' starts workers that may use it"
        return f"this process was forked from one that uses CUDA ({remedy})"
    with warnings.catch_warnings():  # torch warns, in a whole paragraph, about a driver that is too old
        warnings.simplefilter("ignore")
        if torch.cuda.is_available():
            return None
    wanted = torch.version.cuda
    if wanted is None:
        return f"torch {torch.__version__} was built without CUDA"
    supported = cuda_of_driver()
    if supported is None:
        return "there is no NVIDIA driver"
    if driver_too_old():
        major, minor = supported
        return f"the NVIDIA driver is too old: it has CUDA {major}.{minor}, and torch was built for CUDA {wanted}"
    return "no CUDA device was found"


def driver_too_old() -> bool:
    """Return True if there is a driver, and torch was built for a later major version of CUDA than the driver supports."""
    wanted, supported = torch.version.cuda, cuda_of_driver()
    if wanted is None or supported is None:
        return False
    major, _ = supported
    return major < int(wanted.partition(".")[0])


def _entry(card: str, driver: str) -> str:
    """Return the name of the cache entry that holds the result for a card and a driver."""
    return f"cuda-check-{cache.digest(json.dumps([card, driver]))}.json"


def record(result: CheckResult) -> None:
    """Remember the result of a check, in place of an earlier one of the same card and driver.

    Without a private cache folder (:func:`torchpt.native.cache.cache_folder`) nothing is remembered.
    """
    cache.write(_entry(result.card, result.driver), json.dumps(result._asdict()).encode())


def recorded(card: str, driver: str) -> CheckResult | None:
    """Return the result of the last check of a card with a driver; None if there was none."""
    content = cache.read(_entry(card, driver))
    if content is None:
        return None
    try:
        return CheckResult(**json.loads(content))
    except (TypeError, ValueError):  # written by another version
        return None


def last_check(device: torch.device | int | None = None) -> CheckResult | None:
    """Return the last result for a CUDA device with the driver of this machine; None if it was never checked."""
    return recorded(card_name(device), driver_version())
