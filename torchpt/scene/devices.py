"""Convert names of devices."""

from __future__ import annotations

import torch

from torchpt.core.errors import RenderError, SceneError

__all__ = ["device_of"]


def device_of(name: str | torch.device) -> torch.device:
    """Return the device for ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.

    Raises:
        SceneError: another name.
        RenderError: the device is not available.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise SceneError("render.device", str(name), "auto, cpu, cuda or cuda:N")
    if device.type == "cuda" and (not torch.cuda.is_available() or (device.index or 0) >= torch.cuda.device_count()):
        found = f"{torch.cuda.device_count()} CUDA devices" if torch.cuda.is_available() else "no CUDA device"
        raise RenderError(f"render.device: {name} is not available; this machine has {found}")
    return device
