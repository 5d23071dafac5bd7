"""Noise taken out of a finished picture, by Intel's Open Image Denoise (its filter ``RT``; through the package pyoidn).

The picture is taken as linear radiance (HDR). What first surfaces are like, albedo and normals, tells edges from noise; as
lenses, opacity and pixel filters leave noise in them too, both are filtered first, each by itself, and then taken as clean,
as the library's manual advises for final frames. Features seen in mirrors and through glass are told by the picture alone.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.errors import RenderError

__all__ = ["GUIDES", "check_denoiser", "denoise", "denoiser_version"]

#: The layers that the denoiser looks at beside the picture.
GUIDES = ("albedo", "normal")
#: Pixels mirrored around the picture: the network sees black beyond its edge, and darkens or brightens what is near it (a
#: grey picture of 33 x 17 pixels by up to 13 %, with the margin by 0.1 %).
MARGIN = 16
_LOWEST, _HIGHEST = 2.0**-126, float(np.finfo(np.float32).max)

Picture = NDArray[np.float32]


def check_denoiser() -> None:
    """Find out before a long render whether its picture can be denoised.

    Raises:
        RenderError: the package is not installed, or its library does not run on this machine.
    """
    _library()


def denoiser_version() -> str:
    """What denoised pictures depend on beside what they are made of: the package, whose wheel holds the library."""
    return f"pyoidn {version('pyoidn')}"


def denoise(image: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    """A picture without its noise: a guess that looks right, and no estimate of anything.

    It is biased by an amount that nobody knows, so keep the noisy picture, and never compare or measure with this one as if
    it had been rendered. The same picture comes back for any number of threads; it runs on the CPU wherever ``image`` is.

    Args:
        image: ``(H, W, 3)`` linear radiance of any scale; negative values count as 0.
        albedo: ``(H, W, 3)``, the layer `albedo` of the same picture.
        normal: ``(H, W, 3)``, the layer `normal`; needs ``albedo`` too.

    Returns:
        ``(H, W, 3)`` linear radiance, of the type and on the device of ``image``.

    Raises:
        RenderError: the package pyoidn (extra ``denoise``) is not installed or does not run here, or a value of the picture
            is not finite.
        ValueError: another shape, a normal without albedo, a tensor that requires gradients (there are none).
    """
    if normal is not None and albedo is None:
        raise ValueError("normal: the denoiser takes it beside albedo only")
    for name, given in (("image", image), ("albedo", albedo), ("normal", normal)):
        if given is None:
            continue
        if given.ndim != 3 or given.shape[2] != 3 or 0 in given.shape or given.shape != image.shape:
            expected = "(H, W, 3)" if name == "image" else f"the picture's {tuple(image.shape)}"
            raise ValueError(f"{name}: expected {expected}, got {tuple(given.shape)}")
        if not given.is_floating_point():
            raise ValueError(f"{name}: expected a floating type, got {given.dtype}")
        if given.requires_grad:
            raise ValueError(f"{name}: requires gradients, and a denoised picture has none; hand over {name}.detach()")
    library = _library()
    pixels = image.cpu().double().numpy()
    bad = int((~np.isfinite(pixels)).any(2).sum())
    if bad:
        raise RenderError(f"denoising: expected finite values, got {bad} pixels that are not")
    scale = _scale(pixels)
    inputs = {"color": _framed(np.clip(pixels / scale, 0.0, _HIGHEST))}
    for name, guide, low in (("albedo", albedo, 0.0), ("normal", normal, -1.0)):
        if guide is not None:
            values = np.nan_to_num(guide.cpu().double().numpy(), nan=0.0)
            inputs[name] = _filtered(library, {name: _framed(np.clip(values, low, 1.0))}, {})
    made = _filtered(library, inputs, {"hdr": True, "cleanAux": albedo is not None})
    inside = made[MARGIN:-MARGIN, MARGIN:-MARGIN].astype(np.float64) * scale
    return torch.from_numpy(inside.clip(0.0, _HIGHEST)).to(image.device, image.dtype)


def _library() -> Any:
    """The package, ready to run."""
    try:
        import pyoidn
    except ImportError:
        raise RenderError(
            "denoising needs the package pyoidn: pip install '.[denoise]' in the checkout of torchpt"
        ) from None
    try:
        runs = pyoidn.Device.is_cpu_available()
    except OSError as problem:  # the library in the wheel is of another system
        raise RenderError(f"denoising: the library of the package pyoidn cannot be loaded ({problem})") from None
    if not runs:
        raise RenderError("denoising: Open Image Denoise does not run on this CPU (it needs SSE4.1 or NEON)")
    return pyoidn


def _scale(pixels: NDArray[np.float64]) -> float:
    """A power of two near the geometric mean of what is not black: the library takes values below 1e-8 for black."""
    brightness = pixels.max(2)
    lit = brightness[brightness > _LOWEST]
    return float(np.exp2(np.round(np.log2(lit).mean()))) if lit.size else 1.0


def _framed(values: NDArray[np.float64]) -> Picture:
    """A picture with its margin, as the library reads it."""
    around = ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0))
    return np.ascontiguousarray(np.pad(values.astype(np.float32), around, mode="symmetric"))


def _filtered(library: Any, inputs: dict[str, Picture], flags: dict[str, bool]) -> Picture:
    """What the filter makes of its inputs: one layer alone, or a picture with its layers.

    Raises:
        RenderError: what the library says.
    """
    output = np.empty_like(next(iter(inputs.values())))
    with library.Device() as device:
        device.set_int("numThreads", torch.get_num_threads())
        device.set_bool("setAffinity", False)  # threads of this process are not its own to pin
        device.commit()
        with library.Filter(device) as work:
            for name, values in {**inputs, "output": output}.items():
                work.set_image(name, values, library.OIDN_FORMAT_FLOAT3)
            for name, flag in flags.items():
                work.set_bool(name, flag)
            work.commit()
            work.execute()
        problem = device.get_error()
    if problem is not None:
        raise RenderError(f"denoising: {' '.join(problem.split())}")
    return output
