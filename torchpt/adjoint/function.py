"""A picture on autograd's tape: the forward pass keeps nothing, the backward pass samples anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["on_tape"]

Forward = Callable[..., Tensor]
Backward = Callable[..., Sequence[Tensor]]


class _Picture(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, forward: Forward, backward: Backward, held: int, *tensors: Tensor) -> Tensor:
        own = tensors[: len(tensors) - held]
        ctx.backward_pass = backward
        ctx.save_for_backward(*own)
        return forward(*(t.detach() for t in own))

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]: the decorator hides names
        ctx: Any, *cotangents: Tensor
    ) -> tuple[Tensor | None, ...]:
        tensors = tuple(t.detach() for t in ctx.saved_tensors)
        return (None, None, None, *ctx.backward_pass(cotangents[0].reshape(-1, 3).T, *tensors))


def on_tape(forward: Forward, backward: Backward, tensors: tuple[Tensor, ...], held: tuple[Tensor, ...]) -> Tensor:
    """A picture that autograd can go back through.

    Args:
        forward: from detached ``tensors`` to the picture ``(H, W, 3)``.
        backward: from the derivatives by its pixels ``(3, H W)``, and ``tensors``, to those by ``tensors`` and ``held``.
        tensors: what is handed to both.
        held: what both use by themselves, such as weights of modules.
    """
    return _Picture.apply(forward, backward, len(held), *tensors, *held)
