"""A rendering as files: the picture with its layers and what is known of it, and the denoised one beside it."""

from __future__ import annotations

import time
from os import PathLike
from typing import TYPE_CHECKING, Any

from torchpt.files import as_path
from torchpt.images import write_image

if TYPE_CHECKING:
    from torch import Tensor

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
    layers = rendering.layers if as_path(path).suffix.lower() == ".exr" else None
    _write(path, rendering, film, rendering.image, layers=layers, header=rendering.header())


def write_denoised(path: str | PathLike[str], rendering: Rendering, film: Film) -> None:
    """Write the denoised picture; its header says that it is one, and nothing of an error, which nobody knows.

    Raises:
        OutputError: an ending that is not written, or a place that cannot be written.
    """
    assert rendering.denoised is not None
    facts = {name: value for name, value in rendering.header().items() if not name.startswith(("relmse", "heavy"))}
    _write(path, rendering, film, rendering.denoised, header={**facts, "denoised": 1})


def _write(path: str | PathLike[str], rendering: Rendering, film: Film, image: Tensor, **more: Any) -> None:
    """Write a picture of a rendering, and count the seconds that it took."""
    start = time.perf_counter()
    write_image(path, image, exposure=film.exposure, tonemap=film.tonemap, gamma=film.gamma, **more)
    rendering.write_seconds += time.perf_counter() - start
