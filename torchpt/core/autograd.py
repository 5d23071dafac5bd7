"""Functions of tensors with a custom backward pass (VJP, vector-Jacobian product), for autograd and ``torch.func``.

A render is such a function: :func:`custom_vjp` puts it on autograd's tape as one operation. A *cotangent* is the derivative of
the loss with respect to a result (PyTorch: ``grad_output``).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor
from torch._C import (  # pyright: ignore[reportPrivateUsage]
    _are_functorch_transforms_active,  # pyright: ignore[reportAttributeAccessIssue]
    _DisableFuncTorch,  # pyright: ignore[reportAttributeAccessIssue]
)
from torch._C._functorch import get_unwrapped, is_batchedtensor, is_functorch_wrapped_tensor

from torchpt.core.errors import TorchptError
from torchpt.core.threads import without_autocast

__all__ = [
    "Backward",
    "Forward",
    "custom_vjp",
    "is_batched",
    "is_transformed",
    "outside_transforms",
    "transforms_are_active",
    "wants_gradients",
]

Forward = Callable[..., tuple[Tensor, ...]]
Backward = Callable[..., Sequence[Tensor | None]]

# What errors tell the user of derivatives that a render does not have.
_NO_FORWARD_MODE = (
    "render has no forward-mode derivatives (jvp, jacfwd): take torch.func.vjp or backward(),"
    " or the difference of two renders of one seed"
)
_NO_SECOND_DERIVATIVES = (
    "render has no second derivatives: take the difference of two gradients of one seed_grad,"
    " or torch.func.vjp of the picture for a Gauss-Newton step"
)
_NO_OLD_VMAP = (
    "render takes batches of cotangents by torch.func.jacrev alone, not by vectorize=True or is_grads_batched=True"
)


def custom_vjp(
    forward: Forward, backward: Backward, tensors: tuple[Tensor, ...], captured: tuple[Tensor, ...] = ()
) -> tuple[Tensor, ...]:
    """Return ``forward(*tensors)``, differentiable in ``tensors`` and ``captured`` by ``backward``.

    Both functions get plain tensors, unwrapped from transforms of ``torch.func``. Under ``vmap``, and for batches of
    cotangents (``jacrev``), they are called once for each element.

    Args:
        forward: returns a tuple of tensors, given ``tensors``.
        backward: the VJP, called as ``backward(cotangents_of_results, *tensors)`` with a tuple first; returns the cotangents of
            ``tensors`` and then of ``captured``, None for 0.
        tensors: arguments of both.
        captured: tensors that both functions capture, such as weights of modules; they may change before the backward pass.

    Raises:
        TorchptError: forward-mode derivatives; in the backward pass, second derivatives.
    """
    return _CustomVjp.apply(forward, backward, len(captured), *tensors, *captured)  # pyright: ignore[reportReturnType]


def wants_gradients(value: Tensor) -> bool:
    """Return True if a tensor requires gradients, at any level of nested transforms of ``torch.func``."""
    return any(level.requires_grad for level in _levels(value))


def is_batched(value: Tensor) -> bool:
    """Return True if a tensor is batched by ``vmap``, at any level of nested transforms of ``torch.func``."""
    return any(is_batchedtensor(level) for level in _levels(value))


def is_transformed(value: Tensor) -> bool:
    """Return True if a transform of ``torch.func`` wraps a tensor, so that its values cannot be read."""
    return is_functorch_wrapped_tensor(value)


def outside_transforms() -> AbstractContextManager[Any]:
    """Return a context in which tensors are made outside of all transforms of ``torch.func``."""
    return _DisableFuncTorch()


def transforms_are_active() -> bool:
    """Return True inside of a transform of ``torch.func``."""
    return _are_functorch_transforms_active()


def _levels(value: Tensor) -> Iterator[Tensor]:
    """Yield a tensor, and the tensors that transforms of ``torch.func`` wrapped in it, one in the other."""
    yield value
    while is_functorch_wrapped_tensor(value):
        value = get_unwrapped(value)
        yield value


class _CustomVjp(torch.autograd.Function):
    """One call of :func:`custom_vjp`; the last ``captured`` (a number) of ``tensors`` are the captured ones."""

    @staticmethod
    def forward(forward: Forward, backward: Backward, captured: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(forward(*(tensor.detach() for tensor in tensors[: len(tensors) - captured])))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        _, ctx.vjp, captured, *tensors = inputs
        ctx.save_for_backward(*tensors[: len(tensors) - captured])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        gradients = _CustomVjpBackward.apply(ctx.vjp, len(cotangents), *cotangents, *ctx.saved_tensors)
        assert gradients is not None
        return (None, None, None, *gradients)  # forward, backward and captured are no tensors

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_NO_FORWARD_MODE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _call_for_each(_CustomVjp.apply, info.batch_size, in_dims, arguments)


def _with_signature(function: type[torch.autograd.Function]) -> None:
    """Store the signature of ``forward``, which torch would otherwise read from its code at every call."""
    forward: Any = function.forward
    forward.__signature__ = inspect.signature(forward)


class _CustomVjpBackward(torch.autograd.Function):
    """The backward pass as a function of its own, on which ``torch.func`` may call ``vmap`` or differentiate again."""

    @staticmethod
    def forward(vjp: Backward, results: int, *tensors: Tensor) -> tuple[Tensor | None, ...]:
        # The first tensors are the cotangents of that many results; the others are the arguments of the forward pass.
        try:
            plain = tuple(tensor.detach() for tensor in tensors)
        except RuntimeError as error:  # tensors of torch's older vmap, which has no rule for a custom Function
            raise TorchptError(_NO_OLD_VMAP) from error
        with without_autocast(plain[0].device):
            return tuple(vjp(plain[:results], *plain[results:]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        raise TorchptError(_NO_SECOND_DERIVATIVES)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_NO_SECOND_DERIVATIVES)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _call_for_each(_CustomVjpBackward.apply, info.batch_size, in_dims, arguments)


_with_signature(_CustomVjp)
_with_signature(_CustomVjpBackward)


def _call_for_each(
    call: Callable[..., Any], batch_size: int, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...]
) -> tuple[tuple[Tensor | None, ...], tuple[int | None, ...]]:
    """Return the stacked results of one call for each element of a batch, and their batch dimensions.

    ``in_dims`` has the batch dimension of each argument, None where it is the same for the whole batch, as ``vmap`` passes it.
    """
    calls = [
        call(*(value if dim is None else value.select(dim, k) for value, dim in zip(arguments, in_dims, strict=True)))
        for k in range(batch_size)
    ]
    # From results by call to calls by result; a cotangent of 0 is None in all calls alike.
    stacked = tuple(None if result[0] is None else torch.stack(result) for result in zip(*calls, strict=True))
    return stacked, tuple(None if result is None else 0 for result in stacked)
