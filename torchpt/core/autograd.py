"""A function of tensors whose backward pass is given, as autograd and ``torch.func`` take it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor
from torch._C import _DisableFuncTorch  # pyright: ignore[reportAttributeAccessIssue, reportPrivateUsage]
from torch._C._functorch import get_unwrapped, is_batchedtensor, is_functorch_wrapped_tensor

from torchpt.core.errors import TorchptError
from torchpt.core.threads import without_autocast

__all__ = ["Backward", "Forward", "custom_vjp", "is_batched", "is_transformed", "outside_transforms", "wants_gradients"]

Forward = Callable[..., tuple[Tensor, ...]]
Backward = Callable[..., Sequence[Tensor | None]]

_FORWARD_MODE = (
    "render has no forward-mode derivatives (jvp, jacfwd): take torch.func.vjp or backward(),"
    " or the difference of two renders of one seed"
)
_TWICE = (
    "render has no second derivatives: take the difference of two gradients of one seed_grad,"
    " or torch.func.vjp of the picture for a Gauss-Newton step"
)
_BATCHES = (
    "render takes batches of cotangents by torch.func.jacrev alone, not by vectorize=True or is_grads_batched=True"
)


def custom_vjp(
    forward: Forward, backward: Backward, tensors: tuple[Tensor, ...], captured: tuple[Tensor, ...] = ()
) -> tuple[Tensor, ...]:
    """What ``forward`` gives, as a function of ``tensors`` that autograd can go back through.

    The functions see plain tensors, whatever transforms of ``torch.func`` are at work. Under ``vmap``, and where
    cotangents come in batches (``jacrev``), they are called once for each element.

    Args:
        forward: from ``tensors`` to its results.
        backward: from the derivatives by these (a tuple) and ``tensors`` to those by ``tensors`` and ``captured``.
        tensors: what is handed to both.
        captured: what both use by themselves, such as weights of modules; they may change before the backward pass.

    Raises:
        TorchptError: forward mode is asked for; in the backward pass, second derivatives.
    """
    return _CustomVjp.apply(forward, backward, len(captured), *tensors, *captured)  # pyright: ignore[reportReturnType]


def wants_gradients(value: Tensor) -> bool:
    """Whether a tensor requires gradients, at any level of nested transforms of ``torch.func``."""
    return any(level.requires_grad for level in _levels(value))


def is_batched(value: Tensor) -> bool:
    """Whether a tensor stands for a batch of them, at any level of nested transforms of ``torch.func``."""
    return any(is_batchedtensor(level) for level in _levels(value))


def is_transformed(value: Tensor) -> bool:
    """Whether a transform of ``torch.func`` is at work on a tensor, whose numbers cannot be read there."""
    return is_functorch_wrapped_tensor(value)


def outside_transforms() -> AbstractContextManager[Any]:
    """Where tensors are made that no transform of ``torch.func`` at work is to know."""
    return _DisableFuncTorch()


def _levels(value: Tensor) -> Iterator[Tensor]:
    """A tensor, and those that transforms have wrapped up in it."""
    yield value
    while is_functorch_wrapped_tensor(value):
        value = get_unwrapped(value)
        yield value


class _CustomVjp(torch.autograd.Function):
    @staticmethod
    def forward(forward: Forward, backward: Backward, captured: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(forward(*(t.detach() for t in tensors[: len(tensors) - captured])))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        _, ctx.work, ctx.captured, *tensors = inputs
        ctx.save_for_backward(*tensors[: len(tensors) - ctx.captured])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        found = _CustomVjpBackward.apply(ctx.work, len(cotangents), *cotangents, *ctx.saved_tensors)
        assert found is not None
        return (None, None, None, *found)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_FORWARD_MODE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _each(_CustomVjp.apply, info.batch_size, in_dims, arguments)


class _CustomVjpBackward(torch.autograd.Function):
    """The backward pass, which ``torch.func`` differentiates once more without looking at it."""

    @staticmethod
    def forward(work: Backward, count: int, *tensors: Tensor) -> tuple[Tensor | None, ...]:
        try:
            plain = tuple(t.detach() for t in tensors)
        except RuntimeError as error:  # tensors of torch's older vmap, which has no rule for it
            raise TorchptError(_BATCHES) from error
        with without_autocast(plain[0].device):
            return tuple(work(plain[:count], *plain[count:]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        raise TorchptError(_TWICE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_TWICE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _each(_CustomVjpBackward.apply, info.batch_size, in_dims, arguments)


def _each(
    call: Callable[..., Any], count: int, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...]
) -> tuple[tuple[Tensor | None, ...], tuple[int | None, ...]]:
    """One call for each element of a batch, and their results in a batch."""
    rows = [
        call(*(a if dim is None else a.select(dim, k) for a, dim in zip(arguments, in_dims, strict=True)))
        for k in range(count)
    ]
    columns = tuple(None if column[0] is None else torch.stack(column) for column in zip(*rows, strict=True))
    return columns, tuple(None if column is None else 0 for column in columns)
