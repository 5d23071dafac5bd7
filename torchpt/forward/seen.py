"""What the films of a render come to: the picture with its own error, its layers, what was clamped."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchpt.film import KnownError
from torchpt.integrators import LAYERS

if TYPE_CHECKING:
    from torchpt.forward.run import Run

__all__ = ["clamped_of", "image_of", "layers_of"]


def image_of(run: Run, layers: Mapping[str, Tensor]) -> tuple[Tensor, KnownError | None]:
    """The picture ``(H, W, 3)`` so far, which is a layer where no light is carried, and its own error."""
    if run.integrator.light:
        values = run.picture.film.mean() if run.twice is None else run.twice.picture(run.picture.film)
        return values.to(run.dtype), _known_error(run, values)
    shown = layers[next(iter(run.seen))]
    if shown.shape[2] == 1:
        return shown.expand(-1, -1, 3).contiguous(), None
    return torch.cat((shown, torch.zeros_like(shown[..., :1]).expand(-1, -1, max(3 - shown.shape[2], 0))), -1), None


def clamped_of(run: Run) -> float | None:
    """The fraction of the light that ``integrator.clamp`` took away; None where it is off."""
    if not run.integrator.light or run.integrator.clamp is None:
        return None
    before, after = run.light.tolist()
    return 1.0 - after / before if before > 0 else 0.0


def _known_error(run: Run, picture: Tensor) -> KnownError | None:
    film = run.picture.film
    if run.twice is not None:
        return run.twice.known(film, picture)
    relmse = film.relmse()
    return None if relmse is None else KnownError(relmse, None, False)


def layers_of(run: Run) -> dict[str, Tensor]:
    """The layers so far: those of first surfaces, and those that the film makes."""
    layers = {}
    film = run.picture.film
    for name, layer in run.seen.items():
        seen = run.picture.layers[name]
        values = seen.mean() * (run.unit if layer.length else 1.0) if layer.averaged else seen.first()
        layers[name] = values.to(run.dtype)
    for name in run.settings.film.aovs:
        if name not in run.seen:
            made: Any = LAYERS[name]  # a FilmLayer
            counts = film.counts if run.twice is None else run.twice.counts(film)
            layers[name] = made.of(film, counts).to(run.dtype)
    return layers
