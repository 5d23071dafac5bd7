"""Metrics of two pictures ``(H, W, 3)``, by name in :data:`METRICS`.

``error_map`` returns errors by pixel; :data:`MAPS` has the metrics for which there are such.
"""

from torchpt.images.metrics import (
    MAPS,
    METRICS,
    error_map,
    flip,
    mse,
    psnr,
    relmse,
    relmse_trimmed,
    smape,
    ssim,
)

__all__ = ["MAPS", "METRICS", "error_map", "flip", "mse", "psnr", "relmse", "relmse_trimmed", "smape", "ssim"]
