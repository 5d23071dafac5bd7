"""A rendering as files: the picture with its layers and what is known of it, and the denoised one beside it."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

from torchpt.files import as_path
from torchpt.images import write_image

if TYPE_CHECKING:
    from torchpt.forward.result import Rendering
    from torchpt.settings import Film

__all__ = ["beside", "write_denoised", "write_rendered"]


def beside(path: str | PathLike[str]) -> str:
    """Where a denoised picture goes: ``a.exr`` as ``a.denoised.exr``."""
    file = as_path(path)
    return str(file.with_name(f"{file.stem}.denoised{file.suffix}"))


def write_rendered(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the picture, shown as the film says; an ``.exr`` keeps layers, and facts in its header.

    Raises:
        OutputError: an ending that is not written, or a place that cannot be written.
    """
    write_image(
        path,
        rendering.image,
        rendering.layers if as_path(path).suffix.lower() == ".exr" else None,
        exposure=film.exposure,
        tonemap=film.tonemap,
        gamma=film.gamma,
        header=rendering.header(),
    )


def write_denoised(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the denoised picture; its header says that it is one, and nothing of an error, which nobody knows.

    Raises:
        OutputError: an ending that is not written, or a place that cannot be written.
    """
    assert rendering.denoised is not None
    facts = {name: value for name, value in rendering.header().items() if not name.startswith(("relmse", "heavy"))}
    write_image(
        path,
        rendering.denoised,
        exposure=film.exposure,
        tonemap=film.tonemap,
        gamma=film.gamma,
        header={**facts, "denoised": 1},
    )
