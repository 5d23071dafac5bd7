"""How gradients are taken: an argument of ``render``, not another integrator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["KINDS", "Chunk"]


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
Chunks = Callable[..., Iterator[Chunk]]


class _Autograd(torch.autograd.Function):
    """The forward pass keeps nothing; the backward pass renders again, chunk by chunk, each under a tape of its own."""

    @staticmethod
    def forward(ctx: Any, forward: Forward, chunks: Chunks, held: tuple[Tensor, ...], *tensors: Tensor) -> Tensor:
        own = tensors[: len(tensors) - len(held)]
        ctx.chunks, ctx.held = chunks, held
        ctx.save_for_backward(*own)
        return forward(*(t.detach() for t in own))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        tensors = tuple(t.detach() for t in ctx.saved_tensors)
        flat = cotangents[0].reshape(-1, 3).T
        total = [torch.zeros_like(t) for t in (*tensors, *ctx.held)]
        for chunk in ctx.chunks(*tensors):
            with torch.enable_grad():
                leaves = [t.clone().requires_grad_() for t in tensors]
                radiance = chunk.radiance(*leaves)
            if not radiance.requires_grad:  # nothing in these pixels depends on the parameters
                continue
            share = flat[:, chunk.first : chunk.first + chunk.count].to(radiance.dtype)
            inputs = [*leaves, *ctx.held]
            for sum_, grad in zip(total, torch.autograd.grad(radiance, inputs, share, allow_unused=True), strict=True):
                if grad is not None:
                    sum_ += grad
        return (None, None, None, *total)


def autograd(forward: Forward, chunks: Chunks, tensors: tuple[Tensor, ...], held: tuple[Tensor, ...]) -> Tensor:
    """Reverse mode on a plain tape, a chunk of pixels at a time: memory grows with depth, not with the picture.

    Args:
        forward: from detached ``tensors`` to the picture.
        chunks: from ``tensors`` to its parts.
        tensors: what is handed to both.
        held: what both use by themselves, such as weights of modules.
    """
    return _Autograd.apply(forward, chunks, held, *tensors, *held)


KINDS = {"autograd": autograd}
