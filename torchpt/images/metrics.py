"""How far an image is from its reference: numbers over linear RGB images ``(H, W, 3)``."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["mse", "psnr", "relmse", "ssim"]


def _pair(image: Tensor, reference: Tensor) -> tuple[Tensor, Tensor]:
    if image.shape != reference.shape:
        raise ValueError(f"images differ in shape: {tuple(image.shape)} and {tuple(reference.shape)}")
    return image.double(), reference.double()


def mse(image: Tensor, reference: Tensor) -> float:
    """Mean squared error over pixels and channels."""
    x, ref = _pair(image, reference)
    return float(((x - ref) ** 2).mean())


def relmse(image: Tensor, reference: Tensor, floor: float = 1e-2) -> float:
    """Relative mean squared error: the mean of ``(x - ref)² / (ref² + floor)`` (Rousselle et al. 2011, section 4.2)."""
    x, ref = _pair(image, reference)
    return float(((x - ref) ** 2 / (ref**2 + floor)).mean())


def psnr(image: Tensor, reference: Tensor, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio in decibels; infinite for equal images."""
    error = mse(image, reference)
    return float("inf") if error == 0 else float(10 * torch.log10(torch.tensor(peak**2 / error, dtype=torch.float64)))


def ssim(image: Tensor, reference: Tensor, peak: float = 1.0, window: int = 11) -> float:
    """Mean structural similarity (Wang et al. 2004), gaussian window of ``window`` pixels; 1 for equal images."""
    from kornia.metrics import ssim as kornia_ssim

    x, ref = _pair(image, reference)
    return float(kornia_ssim(x.movedim(-1, 0)[None], ref.movedim(-1, 0)[None], window, max_val=peak).mean())
