"""The second picture of `film.denoise`, made of the first one and its layers."""

from __future__ import annotations

import time

from torchpt.core.threads import limited_threads
from torchpt.forward.result import Rendering
from torchpt.images import denoiser
from torchpt.settings import Settings

__all__ = ["denoise_rendering"]


def denoise_rendering(rendering: Rendering, settings: Settings) -> float:
    """Give a rendering of ``film.denoise`` its denoised picture, on as many threads as it had; returns the seconds it took.

    Raises:
        RenderError: the denoiser failed.
    """
    start = time.perf_counter()
    with limited_threads(settings.render.threads):
        rendering.denoised = denoiser.denoise(rendering.image.detach(), **rendering.guides)
    rendering.denoise_seconds = time.perf_counter() - start
    return rendering.denoise_seconds
