"""Convert names of devices, and choose one for ``auto``; called when a scene is loaded or moved."""

from __future__ import annotations

import torch

from torchpt.core.errors import RenderError, SceneError, warn_once
from torchpt.native import device_checks

__all__ = ["device_of"]


def device_of(name: str | torch.device) -> torch.device:
    """Return the device for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``; a CUDA device with its index, as tensors have it.

    ``auto`` takes CUDA only where ``scripts/first_gpu.py`` has found its kernels right with this card and driver. Where there
    is a CUDA device and it was not checked, one line on stderr says so.

    Raises:
        SceneError: another name.
        RenderError: the device is not available.
    """
    if name == "auto":
        return _auto()
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None  # torch knows no such name
    if device is None or device.type not in ("cpu", "cuda"):
        raise SceneError("render.device", str(name), "auto, cpu, cuda or cuda:N")
    if device.type == "cuda":
        missing = device_checks.why_unavailable()
        if missing is not None:
            raise RenderError(f"render.device: {name} is not available, as {missing}; cpu and auto are")
        if (device.index or 0) >= torch.cuda.device_count():
            count = torch.cuda.device_count()
            raise RenderError(
                f"render.device: {name} is not available; this machine has {count} CUDA devices, from cuda:0"
            )
        return device if device.index is not None else _current_cuda_device()
    return device


def _current_cuda_device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device())


def _auto() -> torch.device:
    """Return CUDA where its check has passed, else the CPU; a line says why a device is not taken."""
    cpu = torch.device("cpu")
    missing = device_checks.why_unavailable()
    if missing is not None:
        if torch.cuda._is_in_bad_fork() or device_checks.driver_too_old():
            warn_once(f"torchpt: device=auto takes the CPU, as {missing}")
        return cpu
    result = device_checks.last_check()
    if result is not None and result.passed:
        return _current_cuda_device()
    card, driver = device_checks.card_name(), device_checks.driver_version()
    if result is None:
        reason = "was never checked: scripts/first_gpu.py does that"
    else:
        reason = f"failed its check by scripts/first_gpu.py ({result.detail or 'it says what failed'})"
    warn_once(
        f"torchpt: device=auto takes the CPU, as {card} with driver {driver or 'unknown'} {reason}; device=cuda takes it"
    )
    return cpu
