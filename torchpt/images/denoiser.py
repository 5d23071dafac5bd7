"""Denoise a finished picture with Intel's Open Image Denoise (filter ``RT``, by the package pyoidn).

The picture is linear radiance (HDR). Albedo and normals of first surfaces separate edges from noise. Lenses, opacity and pixel
filters leave noise in them too, so each is filtered first by itself and then passed on as clean, as the library's manual
advises for final frames. Features seen in mirrors and through glass are in the picture alone.
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

#: The layers that guide the denoiser.
GUIDES = ("albedo", "normal")
#: Width of a mirrored margin around the picture, in pixels. The network sees black beyond the edge and changes the brightness
#: near it: of a grey picture of 33 x 17 pixels by up to 13 %, with the margin by 0.1 %.
MARGIN = 16
#: Smallest and largest normal numbers of float32.
_SMALLEST, _LARGEST = 2.0**-126, float(np.finfo(np.float32).max)

#: ``(H, W, 3)``, contiguous.
Picture = NDArray[np.float32]


def check_denoiser() -> None:
    """Check before a long render that its picture can be denoised.

    Raises:
        RenderError: the package pyoidn is not installed, or its library does not run on this machine.
    """
    _library()


def denoiser_version() -> str:
    """Return name and version of the denoiser's package, whose wheel contains the library."""
    return f"pyoidn {version('pyoidn')}"


def denoise(image: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    """Return a denoised picture: plausible to look at, but biased by an unknown amount.

    Keep the noisy picture, and do not measure errors with the denoised one as if it had been rendered. The result is the same
    for any number of threads; the denoiser runs on the CPU wherever ``image`` is.

    Args:
        image: ``(H, W, 3)`` linear radiance of any scale; negative values count as 0.
        albedo: ``(H, W, 3)``, the layer `albedo` of the same picture.
        normal: ``(H, W, 3)``, the layer `normal`; needs ``albedo`` too.

    Returns:
        ``(H, W, 3)`` linear radiance, of the type and on the device of ``image``.

    Raises:
        RenderError: the package pyoidn (extra ``denoise``) is not installed or does not run here, or a value of the picture
            is not finite.
        ValueError: another shape, a normal without albedo, or a tensor that requires gradients.
    """
    if normal is not None and albedo is None:
        raise ValueError("normal: the denoiser takes it beside albedo only")
    for name, layer in (("image", image), ("albedo", albedo), ("normal", normal)):
        if layer is None:
            continue
        if layer.ndim != 3 or layer.shape[2] != 3 or 0 in layer.shape or layer.shape != image.shape:
            expected = "(H, W, 3)" if name == "image" else f"the picture's {tuple(image.shape)}"
            raise ValueError(f"{name}: expected {expected}, got {tuple(layer.shape)}")
        if not layer.is_floating_point():
            raise ValueError(f"{name}: expected a floating type, got {layer.dtype}")
        if layer.requires_grad:
            raise ValueError(f"{name}: requires gradients, and a denoised picture has none; hand over {name}.detach()")
    library = _library()
    pixels = image.cpu().double().numpy()
    bad = int((~np.isfinite(pixels)).any(2).sum())
    if bad:
        raise RenderError(f"denoising: expected finite values, got {bad} pixels that are not")
    scale = _scale(pixels)
    inputs = {"color": _with_margin(np.clip(pixels / scale, 0.0, _LARGEST))}
    for name, guide, low in (("albedo", albedo, 0.0), ("normal", normal, -1.0)):
        if guide is not None:
            values = np.nan_to_num(guide.cpu().double().numpy(), nan=0.0)
            inputs[name] = _run_filter(library, {name: _with_margin(np.clip(values, low, 1.0))}, flags={})
    # cleanAux: the guides are free of noise, as they have been filtered.
    denoised = _run_filter(library, inputs, flags={"hdr": True, "cleanAux": albedo is not None})
    inside = denoised[MARGIN:-MARGIN, MARGIN:-MARGIN].astype(np.float64) * scale
    return torch.from_numpy(inside.clip(0.0, _LARGEST)).to(image.device, image.dtype)


def _library() -> Any:
    """Return the package pyoidn after checking that it runs on this machine."""
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
    """Return a power of two near the geometric mean of the non-black pixels: the library treats values below 1e-8 as black."""
    brightness = pixels.max(2)
    lit = brightness[brightness > _SMALLEST]
    return float(np.exp2(np.round(np.log2(lit).mean()))) if lit.size else 1.0


def _with_margin(values: NDArray[np.float64]) -> Picture:
    """Return the picture with a mirrored margin, float32 and contiguous."""
    around = ((MARGIN, MARGIN), (MARGIN, MARGIN), (0, 0))
    return np.ascontiguousarray(np.pad(values.astype(np.float32), around, mode="symmetric"))


def _run_filter(library: Any, inputs: dict[str, Picture], flags: dict[str, bool]) -> Picture:
    """Run the filter on one layer alone, or on a picture with its layers.

    Args:
        library: the package pyoidn.
        inputs: pictures by the names of the filter's inputs: ``color``, ``albedo``, ``normal``.
        flags: boolean parameters of the filter.

    Raises:
        RenderError: with the message of the library.
    """
    output = np.empty_like(next(iter(inputs.values())))
    with library.Device() as device:
        device.set_int("numThreads", torch.get_num_threads())
        device.set_bool("setAffinity", False)  # do not pin threads of this process
        device.commit()
        with library.Filter(device) as denoise_filter:
            for name, values in {**inputs, "output": output}.items():
                denoise_filter.set_image(name, values, library.OIDN_FORMAT_FLOAT3)
            for name, flag in flags.items():
                denoise_filter.set_bool(name, flag)
            denoise_filter.commit()
            denoise_filter.execute()
        problem = device.get_error()
    if problem is not None:
        raise RenderError(f"denoising: {' '.join(problem.split())}")
    return output
