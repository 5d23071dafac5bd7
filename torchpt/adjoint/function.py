"""A picture on autograd's tape: the forward pass keeps nothing, the backward pass samples anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from torchpt import taped

__all__ = ["on_tape"]

Forward = Callable[..., Tensor]
Backward = Callable[..., Sequence[Tensor | None]]


def on_tape(forward: Forward, backward: Backward, tensors: tuple[Tensor, ...], held: tuple[Tensor, ...]) -> Tensor:
    """A picture that autograd and ``torch.func`` can go back through (see :func:`torchpt.taped.on_tape`).

    Args:
        forward: from detached ``tensors`` to the picture ``(H, W, 3)``.
        backward: from the derivatives by its pixels ``(3, H W)``, and ``tensors``, to those by ``tensors`` and ``held``.
        tensors: what is handed to both.
        held: what both use by themselves, such as weights of modules.
    """

    def forth(*plain: Tensor) -> tuple[Tensor, ...]:
        return (forward(*plain),)

    def back(cotangents: tuple[Tensor, ...], *plain: Tensor) -> Sequence[Tensor | None]:
        return backward(cotangents[0].reshape(-1, 3).T, *plain)

    return taped.on_tape(forth, back, tensors, held)[0]
