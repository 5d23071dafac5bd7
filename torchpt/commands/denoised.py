"""The second picture of `film.denoise`, beside the one that was rendered."""

from __future__ import annotations

from typing import Any

from torchpt.errors import OutputError

__all__ = ["denoised_files"]


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
