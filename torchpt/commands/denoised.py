"""The second picture of `film.denoise`, beside the one that was rendered."""

from __future__ import annotations

from typing import Any

__all__ = ["denoised_files"]


def denoised_files(wishes: Any, outs: list[str]) -> list[str]:
    """Return where the denoised pictures go, one for each of ``outs``; none where none is wanted.

    Raises:
        RenderError: there is no denoiser.
    """
    if not wishes.film.denoise:
        return []
    from torchpt.forward.files import beside
    from torchpt.images.denoiser import check_denoiser

    check_denoiser()
    return [beside(path) for path in outs]
