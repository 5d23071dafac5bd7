"""How gradients are taken: an argument of ``render``, not another integrator; and what of a render they go through."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchpt.forward import BYTES_PER_LANE, Waves, budget_of, limited_threads, make_wave, rebound
from torchpt.forward.budget import check_memory
from torchpt.forward.need import loaded, need_of
from torchpt.forward.schedule import Span
from torchpt.scene import Scene
from torchpt.settings import Settings
from torchpt.spec import Moves

__all__ = ["KINDS", "Chunk", "attached", "casts", "chunks", "tape_per_lane"]

#: Vertices of a path that memory is planned for where its depth is without end.
LONGEST = 64


@dataclass(frozen=True)
class Chunk:
    """Consecutive pixels and their share of the picture as a differentiable function.

    Attributes:
        first: the first pixel, row by row.
        count: how many.
        radiance: from the parameters' tensors to ``(3, count)``; shares of the same pixel add up.
    """

    first: int
    count: int
    radiance: Callable[..., Tensor]


Forward = Callable[..., Tensor]
#: From the tensors and what is done with a chunk: all of it, or nothing where it raises.
Chunks = Callable[..., None]
Edges = Callable[..., list[Tensor | None]]


class _Autograd(torch.autograd.Function):
    """The forward pass keeps nothing; the backward pass renders again, chunk by chunk, each under a tape of its own."""

    @staticmethod
    def forward(
        ctx: Any, forward: Forward, chunks: Chunks, edges: Edges | None, held: tuple[Tensor, ...], *tensors: Tensor
    ) -> Tensor:
        own = tensors[: len(tensors) - len(held)]
        ctx.chunks, ctx.held, ctx.edges = chunks, held, edges
        ctx.save_for_backward(*own)
        return forward(*(t.detach() for t in own))

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]: the decorator hides names
        ctx: Any, *cotangents: Tensor
    ) -> tuple[Tensor | None, ...]:
        tensors = tuple(t.detach() for t in ctx.saved_tensors)
        flat = cotangents[0].reshape(-1, 3).T
        total = [torch.zeros_like(t) for t in (*tensors, *ctx.held)]

        def add(chunk: Chunk) -> None:
            with torch.enable_grad():
                leaves = [t.clone().requires_grad_() for t in tensors]
                radiance = chunk.radiance(*leaves)
            if not radiance.requires_grad:  # nothing in these pixels depends on the parameters
                return
            share = flat[:, chunk.first : chunk.first + chunk.count].to(radiance.dtype)
            grads = torch.autograd.grad(radiance, [*leaves, *ctx.held], share, allow_unused=True)
            # Memory may run out in any of these sums: the total changes once all are there.
            total[:] = [sum_ if grad is None else sum_ + grad for sum_, grad in zip(total, grads, strict=True)]

        ctx.chunks(add, *tensors)
        if ctx.edges is not None:
            for sum_, grad in zip(total, ctx.edges(cotangents[0], *tensors), strict=False):
                if grad is not None:
                    sum_ += grad
        return (None, None, None, None, *total)


def autograd(
    forward: Forward,
    chunks: Chunks,
    tensors: tuple[Tensor, ...],
    held: tuple[Tensor, ...],
    edges: Edges | None = None,
) -> Tensor:
    """Reverse mode on a plain tape, a chunk of pixels at a time: memory grows with depth, not with the picture.

    Args:
        forward: from detached ``tensors`` to the picture.
        chunks: from what is done with each part of the picture, and ``tensors``; memory may ask for smaller parts.
        tensors: what is handed to both.
        held: what both use by themselves, such as weights of modules.
        edges: from the picture's cotangent and ``tensors`` to what moving edges add to the gradient of each, or None.
    """
    return _Autograd.apply(forward, chunks, edges, held, *tensors, *held)


KINDS = {"autograd": autograd}


def attached(scene: Scene, names: Iterable[str]) -> bool:
    """Whether any of the parameters moves surfaces or the camera, or bends rays that a delta lobe sends on."""
    owners = [*scene.built.parts, *scene.built.copies]
    bending = {material.name for owner in owners for material in owner.material.all() if material.bends}

    def moves(name: str) -> bool:
        moved = scene.spec(name).moves
        if moved is Moves.RAYS:  # by the material's name, or by a texture that any of them may read
            return any(name.startswith(f"{own}.") for own in bending) or bool(bending and "textures." in name)
        return moved is Moves.SURFACES

    return any(map(moves, names))


def casts(scene: Scene, names: Iterable[str]) -> bool:
    """Whether any of the parameters moves shadow edges."""
    return any(scene.spec(name).moves is Moves.SHADOWS for name in names)


def chunks(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    attached: bool,
    work: Callable[[Chunk], None],
) -> None:
    """Do something with chunks of pixels as differentiable functions of the tensors ``wanted``, for the backward pass.

    Args:
        scene: what.
        settings: of the backward pass.
        params: tensors in place of the scene's.
        wanted: names of those that are differentiated.
        dtype: of the lanes.
        attached: see :class:`torchpt.integrators.stages.Plan`.
        work: takes a chunk: all of it, or, where it raises, nothing.

    Raises:
        SceneError: ``render.max_memory`` is too small for it.
        RenderError: not even the tape of a single lane fits in memory.
    """
    plain = {name: value.detach() for name, value in params.items()}
    with torch.no_grad():
        still = make_wave(scene, settings, plain, dtype, True, attached)
    if settings.render.max_memory is not None:
        need = need_of(settings, scene.device, "tape", len(still.stages.world.materials.models))
        check_memory(settings.render.max_memory, scene.device, need.of_tape, 0)
    pixels, spp = still.crop[2] * still.crop[3], settings.render.spp
    clamp = settings.integrator.clamp

    def radiance(span: Span, *tensors: Tensor) -> Tensor:
        given = {**plain, **dict(zip(wanted, tensors, strict=True))}
        values, _ = rebound(still, scene, settings, given).radiance(*span)
        values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
        if clamp is not None:
            values = values * (clamp / values.detach().abs().amax(0).clamp_min(clamp)).clamp_max(1.0)
        return values.sum(1) / spp

    def piece(span: Span) -> None:
        work(Chunk(span[0], span[1], partial(radiance, span)))

    waves = Waves(budget_of(settings, scene.device, tape_per_lane(settings)), "the tape of a single lane")
    with limited_threads(settings.render.threads):  # while whoever asked for the chunks differentiates them
        for _ in waves.through(piece, pixels, 0, spp):
            pass
    loaded("tape")


def tape_per_lane(settings: Settings) -> int:
    """Bytes that the tape of a lane is expected to take: each vertex keeps about what a lane takes without one."""
    limits = settings.integrator.limits
    return BYTES_PER_LANE * max(limits.max_depth if 0 <= limits.max_depth < LONGEST else LONGEST, 1)
