"""Layers of first surfaces on a tape: their values under a tape of their own, and the edges that the camera sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core import autograd
from torchpt.core.threads import limited_threads
from torchpt.engines.engine import layers as layers_of
from torchpt.engines.engine import seen
from torchpt.gradients.edges.gradients import Boundary, boundary_of
from torchpt.paths.layers import LAYERS, SurfaceLayer, surface_layer
from torchpt.scene import Scene
from torchpt.scene.prepare import make_wave, rebuild_with_tape
from torchpt.scene.settings import Settings

__all__ = ["Asked", "differentiable", "followed"]

#: Lanes of a chunk of the interior.
LANES = 1 << 15


@dataclass(frozen=True)
class Asked:
    """Whose gradients are wanted, and how.

    Attributes:
        scene: whose layers.
        settings: of the backward pass.
        wanted: names of the parameters.
        dtype: of the lanes.
        edges: samples of edges a pixel; 0: none.
    """

    scene: Scene
    settings: Settings
    wanted: tuple[str, ...]
    dtype: torch.dtype
    edges: float


def followed(settings: Settings) -> tuple[str, ...]:
    """Return the layers that have gradients: of first surfaces, and no names of things."""
    kinds = {name: LAYERS[name] for name in settings.film.aovs}
    return tuple(name for name, kind in kinds.items() if issubclass(kind, SurfaceLayer) and kind.averaged)


def differentiable(
    layers: Mapping[str, Tensor],
    tensors: tuple[Tensor, ...],
    asked: Callable[[], Asked],
    given: Callable[..., dict[str, Tensor]],
) -> dict[str, Tensor]:
    """Return the layers as functions of ``tensors`` that autograd can go back through.

    Args:
        layers: as they were rendered, by name.
        tensors: those that are differentiated, and behind them all others that replace the scene's.
        asked: what the backward pass is to do, once it is known.
        given: from ``tensors`` to all parameters that replace the scene's.
    """
    names = tuple(layers)

    def rendered(*_: Tensor) -> tuple[Tensor, ...]:
        return tuple(value.clone() for value in layers.values())

    def work(cotangents: tuple[Tensor, ...], *values: Tensor) -> list[Tensor | None]:
        found = _gradients(asked(), names, given(*values), cotangents)
        return [*found, *(None for _ in values[len(found) :])]

    return dict(zip(names, autograd.custom_vjp(rendered, work, tensors), strict=True))


def _gradients(
    asked: Asked, names: tuple[str, ...], params: dict[str, Tensor], cotangents: tuple[Tensor, ...]
) -> list[Tensor | None]:
    """Return the gradients of the parameters that are wanted."""
    scene, settings, unit = asked.scene, asked.settings, asked.scene.space.unit
    kinds = [surface_layer(name) for name in names]
    worth = torch.cat([c * (unit if kind.length else 1.0) for c, kind in zip(cotangents, kinds, strict=True)], 2)
    worth = worth.permute(2, 0, 1).to(asked.dtype)
    with limited_threads(settings.render.threads):
        total = _interior(asked, names, params, worth)
        if not asked.edges:
            return list(total)

        def look(boundary: Boundary) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
            traced = boundary.traced

            def values(o: Tensor, d: Tensor, number: Tensor) -> Tensor:
                found = seen(traced.wave, names, traced.state(o, d, number))
                return torch.cat([found[name] for name in names]).double()

            return values

        boundary = boundary_of(scene, settings, params, asked.wanted, asked.dtype, worth)
        if boundary is None:
            return list(total)
        moved = boundary.gradients(boundary.primary(asked.edges, look(boundary)), asked.wanted)
    return [a if b is None else a + b.to(a.dtype) for a, b in zip(total, moved, strict=True)]


def _interior(asked: Asked, names: tuple[str, ...], params: dict[str, Tensor], worth: Tensor) -> tuple[Tensor, ...]:
    """Return what the values at first surfaces bring, a chunk of pixels at a time."""
    scene, settings = asked.scene, asked.settings
    plain = {name: value.detach() for name, value in params.items()}
    with torch.no_grad():
        still = make_wave(scene, settings, plain, asked.dtype, tape=True, attached=True)
    total = tuple(torch.zeros_like(plain[name]) for name in asked.wanted)
    flat, spp = worth.reshape(len(worth), -1), settings.render.spp
    pixels, samples = flat.shape[1], min(spp, LANES)
    step = max(LANES // samples, 1)
    for sample in range(0, spp, samples):
        many = min(samples, spp - sample)
        for first in range(0, pixels, step):
            count = min(step, pixels - first)
            with torch.enable_grad():
                leaves = [plain[name].clone().requires_grad_() for name in asked.wanted]
                wave = rebuild_with_tape(
                    still, scene, settings, {**plain, **dict(zip(asked.wanted, leaves, strict=True))}
                )
                found = layers_of(wave, names, first, count, sample, many, follow_ray=True)
                mean = torch.cat([found[name] for name in names]).sum(1) / spp
            if mean.requires_grad:
                grads = autograd.gradients_of([mean], leaves, [flat[:, first : first + count]])
                for sum_, grad in zip(total, grads, strict=True):
                    if grad is not None:
                        sum_ += grad
    return total
