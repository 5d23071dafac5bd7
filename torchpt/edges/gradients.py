"""The gradients that moving edges add: what ``render`` asks for after the interior of the picture is differentiated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchpt.accel.bounds import primitive_bounds
from torchpt.edges.bodies import Bodies, bodies_of
from torchpt.edges.draws import Numbers
from torchpt.edges.film import Worth
from torchpt.edges.primary import primary_of
from torchpt.edges.seen import pieces_of
from torchpt.edges.lit import sources_of
from torchpt.edges.occluders import occluders_of
from torchpt.edges.shadows import Shadows, in_chunks
from torchpt.edges.traced import Traced, traced_of
from torchpt.forward import limited_threads
from torchpt.integrators.path import PathIntegrator
from torchpt.scene import Scene
from torchpt.settings import Settings
from torchpt.spec import Moves

__all__ = ["add_gradients", "concerns"]

#: Bytes that a sample of an edge takes, two paths included.
BYTES_PER_SAMPLE = 4096
#: Samples of a chunk where memory is not limited.
SAMPLES = 1 << 15


class Samples(Protocol):
    """Samples of edges."""

    def sum(self, bodies: Bodies) -> Tensor:
        """Whose derivative is theirs."""
        ...


def concerns(scene: Scene, names: tuple[str, ...]) -> bool:
    """Whether any of the parameters moves edges."""
    return any(scene.spec(name).moves in (Moves.SURFACES, Moves.SHADOWS) for name in names)


@dataclass(frozen=True)
class _Asked:
    """What is differentiated."""

    scene: Scene
    settings: Settings
    plain: Mapping[str, Tensor]
    traced: Traced
    still: Bodies
    worth: Worth
    onward: bool

    def chunks(self, total: int) -> Iterator[tuple[int, int]]:
        """First samples and how many."""
        most = self.settings.render.max_memory
        step = SAMPLES if most is None else max(min(most // BYTES_PER_SAMPLE, SAMPLES), 1)
        for first in range(0, total, step):
            yield first, min(step, total - first)


def add_gradients(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    cotangent: Tensor,
    samples: int,
) -> tuple[Tensor | None, ...]:
    """What moving edges add to the gradients of ``wanted``; None for those that move none.

    Args:
        scene: whose.
        settings: of the backward pass, its seed included.
        params: all that replace the scene's, detached.
        wanted: names of those that are differentiated.
        dtype: of the lanes.
        cotangent: ``(H, W, 3)`` of the picture.
        samples: of each estimator, a pixel of the picture.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
    """
    moving = [name for name in wanted if concerns(scene, (name,))]
    if not moving or not samples:
        return (None,) * len(wanted)
    with limited_threads(settings.render.threads):
        plain = {name: value.detach() for name, value in params.items()}
        with torch.enable_grad():
            leaves = {name: plain[name].clone().requires_grad_() for name in moving}
            bodies = bodies_of(scene, settings.film, {**plain, **leaves})
        outputs = {name: t for name, t in bodies.tensors().items() if t.requires_grad}
        still = bodies.having({name: t.detach() for name, t in bodies.tensors().items()})
        if bodies.copies is not None:
            still = replace(still, copies=bodies.having({n: t.detach() for n, t in bodies.tensors().items()}).copies)
        with torch.no_grad():
            traced = traced_of(scene, settings, plain, dtype)
            worth = Worth(cotangent.permute(2, 0, 1), traced.wave.filter, traced.wave.crop)
            onward = any(not name.startswith("camera.") for name in moving)
            asked = _Asked(scene, settings, plain, traced, still, worth, onward)
        sums = {name: torch.zeros_like(t) for name, t in outputs.items()}
        total = samples * cotangent.shape[0] * cotangent.shape[1]
        for found in _samples(asked, total):
            _add(sums, still, found)
        found = torch.autograd.grad(list(outputs.values()), list(leaves.values()), list(sums.values()), allow_unused=True)
    by_name = dict(zip(leaves, found, strict=True))
    return tuple(by_name.get(name) for name in wanted)


def _samples(asked: _Asked, total: int) -> Iterator[Samples]:
    """Samples of all estimators, chunk by chunk."""
    still, worth = asked.still, asked.worth
    with torch.no_grad():
        pieces = pieces_of(asked.scene, still, asked.scene.merged(asked.plain), worth.bounds())
    if pieces is not None:
        primary = primary_of(still, pieces, asked.traced, Numbers(asked.settings.render.seed, 0))
        for first, count in asked.chunks(total):
            yield primary.samples(first, count, total, worth, asked.traced.radiance)
    yield from _shadows(asked, total)


def _shadows(asked: _Asked, total: int) -> Iterator[Samples]:
    """Samples of the edges of shadows: of lights, then of what surfaces reflect."""
    still, integrator, seed = asked.still, asked.traced.wave.integrator, asked.settings.render.seed
    depth = integrator.limits.max_depth
    if not isinstance(integrator, PathIntegrator) or 0 <= depth < 2:
        return
    with torch.no_grad():
        occluders = occluders_of(asked.scene, still, asked.scene.merged(asked.plain))
        if occluders is None:
            return
        world = asked.traced.wave.stages.world
        _, geometry = asked.scene.world(torch.float32, asked.plain)
        low, high = primitive_bounds(geometry)
        reach = float((high.double().amax(1) - low.double().amin(1)).norm()) * 0.5
        met = asked.settings.integrator.strategy in ("bsdf", "uniform")
        sources = sources_of(still, world, reach, met)
    if sources is None:
        return
    numbers = [Numbers(seed, stream) for stream in (1, 2)]
    parts = [Shadows(still, occluders, sources, asked.traced, numbers[0], reach, depth, asked.onward)]
    if not 0 <= depth < 3:
        parts.append(Shadows(still, occluders, None, asked.traced, numbers[1], reach, depth, asked.onward))
    for part in parts:
        yield from in_chunks(part, asked.chunks(total), total, asked.worth)


def _add(sums: dict[str, Tensor], still: Bodies, found: Samples) -> None:
    """Add the derivatives of a chunk."""
    tensors = still.tensors()
    with torch.enable_grad():
        leaves = {name: tensors[name].clone().requires_grad_() for name in sums}
        value = found.sum(still.having({**tensors, **leaves}))
    if not value.requires_grad:
        return
    grads = torch.autograd.grad(value, list(leaves.values()), allow_unused=True)
    for name, grad in zip(leaves, grads, strict=True):
        if grad is not None:
            sums[name] += grad
