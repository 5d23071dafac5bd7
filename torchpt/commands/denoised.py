"""The second picture of `film.denoise`, beside the one that was rendered."""

from __future__ import annotations

import time
from typing import Any

from torchpt.errors import OutputError

__all__ = ["denoise_rendering", "denoised_files"]


def denoised_files(wishes: Any, outs: list[str], others: list[str]) -> list[str]:
    """Where the denoised pictures go, one for each of ``outs``; none where none is wanted.

    Raises:
        RenderError: there is no denoiser.
        OutputError: a name that is taken, among ``outs`` or ``others``.
    """
    if not wishes.film.denoise:
        return []
    from torchpt.forward.files import beside
    from torchpt.images.denoiser import check_denoiser

    check_denoiser()
    for path in outs:
        if beside(path) in (*outs, *others):
            raise OutputError(beside(path), f"is where the denoised picture of {path} goes; choose another name")
    return [beside(path) for path in outs]


def denoise_rendering(rendering: Any, wishes: Any) -> float:
    """Give a rendering its denoised picture; returns the seconds that it took.

    Raises:
        RenderError: the denoiser failed.
    """
    from torchpt.forward import limited_threads
    from torchpt.images.denoiser import denoise

    start = time.perf_counter()
    with limited_threads(wishes.render.threads):
        rendering.denoised = denoise(rendering.image, **rendering.guides)
    return time.perf_counter() - start
