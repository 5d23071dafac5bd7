"""Functions of tensors with a custom backward pass (VJP, vector-Jacobian product), for autograd and ``torch.func``.

A render is such a function: :func:`custom_vjp` puts it on autograd's tape as one operation. A *cotangent* is the derivative of
the loss with respect to a result (PyTorch: ``grad_output``), a *tangent* the derivative of an argument or a result with respect
to the variable of forward mode.

Forward mode (JVP) and second derivatives come from one more function. With the VJP ``g(x, c) = cᵀ J(x)``, that is the
derivative of ``<g(x, c), u>``: with respect to ``c`` it is the JVP ``J u``, with respect to ``x`` the product of ``u`` with the
Hessian of ``<c, f(x)>``.

:func:`gradients_of` pulls cotangents back along a tape.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
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
    "Second",
    "custom_vjp",
    "gradients_of",
    "is_batched",
    "is_transformed",
    "outside_transforms",
    "transforms_are_active",
    "under_transforms",
    "wants_gradients",
]

Forward = Callable[..., tuple[Tensor, ...]]
Backward = Callable[..., Sequence[Tensor | None]]
#: Called as ``second(tangents, cotangents, *tensors)``, with a tangent, or None for 0, of each tensor; returns the JVPs of the
#: results, then the Hessian products with the tensors, None for 0. Without cotangents (None) it returns the JVPs alone.
Second = Callable[..., Sequence[Tensor | None]]

# What errors tell the user of derivatives that a render does not have.
_NO_FORWARD_MODE = (
    "this layer has no forward-mode derivatives (jvp, jacfwd): take torch.func.vjp or backward(),"
    " or the difference of two renders of one seed"
)
_NO_SECOND_DERIVATIVES = (
    "a layer such as depth has no second derivatives: take the difference of two gradients of one seed_grad,"
    " or torch.func.vjp of the picture for a Gauss-Newton step"
)
_NO_THIRD_DERIVATIVES = (
    "render has no third derivatives, and no second ones in forward mode alone: take the difference of two second derivatives"
    " of one seed_grad, or forward mode over torch.func.grad"
)
_NO_OLD_VMAP = (
    "render takes batches of cotangents by torch.func.jacrev alone, not by vectorize=True or is_grads_batched=True"
)


def custom_vjp(
    forward: Forward,
    backward: Backward,
    tensors: tuple[Tensor, ...],
    captured: tuple[Tensor, ...] = (),
    second: Second | None = None,
) -> tuple[Tensor, ...]:
    """Return ``forward(*tensors)``, differentiable in ``tensors`` and ``captured`` by ``backward``.

    All functions get plain tensors, unwrapped from transforms of ``torch.func``. Under ``vmap``, and for batches of
    cotangents (``jacrev``) or tangents (``jacfwd``), they are called once for each element.

    Args:
        forward: returns a tuple of tensors, given ``tensors``.
        backward: the VJP, called as ``backward(cotangents_of_results, *tensors)`` with a tuple first; returns the cotangents of
            ``tensors`` and then of ``captured``, None for 0.
        tensors: arguments of all functions.
        captured: tensors that the functions capture, such as weights of modules; they may change before the backward pass.
        second: for forward mode and second derivatives, see :data:`Second`; None: there are none.

    Raises:
        TorchptError: derivatives that are not there: forward-mode ones, second ones, third ones.
    """
    functions = _Functions(forward, backward, second, len(captured))
    return _CustomVjp.apply(functions, *tensors, *captured)  # pyright: ignore[reportReturnType]


def gradients_of(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], cotangents: Sequence[Tensor]
) -> tuple[Tensor | None, ...]:
    """Return the cotangents of inputs, given those of outputs; None for an input that no output depends on.

    As ``torch.autograd.grad(outputs, inputs, cotangents, allow_unused=True)``. That compares shapes by torch's symbolic shapes,
    and so imports SymPy: 31 MB that stay, and half a second at the first gradient of a process.

    Args:
        outputs: tensors of one device, at least one of which requires gradients; those that do not are ignored.
        inputs: tensors that require gradients.
        cotangents: one for each output, in its shape.
    """
    with torch.enable_grad():
        joined = _GivenCotangents.apply(tuple(cotangents), *outputs)
    return torch.autograd.grad(joined, inputs, allow_unused=True)  # pyright: ignore[reportArgumentType]


class _GivenCotangents(torch.autograd.Function):
    """A number whose derivatives by several outputs are given: their cotangents."""

    @staticmethod
    def forward(cotangents: tuple[Tensor, ...], *outputs: Tensor) -> Tensor:
        return torch.zeros((), device=outputs[0].device)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.cotangents, *_ = inputs

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *ctx.cotangents)


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


def under_transforms() -> bool:
    """Return True inside of a transform of ``torch.func``, or of ``torch.autograd.forward_ad.dual_level``."""
    return transforms_are_active() or torch.autograd.forward_ad._current_level >= 0


def _levels(value: Tensor) -> Iterator[Tensor]:
    """Yield a tensor, and the tensors that transforms of ``torch.func`` wrapped in it, one in the other."""
    yield value
    while is_functorch_wrapped_tensor(value):
        value = get_unwrapped(value)
        yield value


@dataclass(frozen=True)
class _Functions:
    """The functions of a call of :func:`custom_vjp`, and the number of tensors that they capture."""

    forward: Forward
    vjp: Backward
    second: Second | None
    captured: int

    def arguments(self, tensors: tuple[Any, ...]) -> tuple[Any, ...]:
        """Return tensors without the captured ones, which are the last."""
        return tensors[: len(tensors) - self.captured]


class _CustomVjp(torch.autograd.Function):
    """One call of :func:`custom_vjp`; the captured tensors are the last ones."""

    @staticmethod
    def forward(functions: _Functions, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(functions.forward(*(tensor.detach() for tensor in functions.arguments(tensors))))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.functions, *tensors = inputs
        ctx.set_materialize_grads(False)  # so that forward mode tells constants from variables
        ctx.like = [(tuple(result.shape), result.dtype, result.device) for result in output]
        arguments = ctx.functions.arguments(tuple(tensors))
        ctx.save_for_backward(*arguments)
        ctx.save_for_forward(*arguments)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Tensor | None, ...]:
        filled = [
            torch.zeros(shape, dtype=dtype, device=device) if cotangent is None else cotangent
            for cotangent, (shape, dtype, device) in zip(cotangents, ctx.like, strict=True)
        ]
        gradients = _CustomVjpBackward.apply(ctx.functions, len(filled), *filled, *ctx.saved_tensors)
        assert gradients is not None
        return (None, *gradients)  # the functions are no tensor

    @staticmethod
    def jvp(ctx: Any, *changes: Any) -> Any:
        functions: _Functions = ctx.functions
        tangents = changes[1:]  # without that of the functions
        if functions.second is None:
            raise TorchptError(_NO_FORWARD_MODE)
        return _second(functions, 0, functions.arguments(tangents), ctx.saved_tensors)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _call_for_each(_CustomVjp.apply, info.batch_size, in_dims, arguments)


class _CustomVjpBackward(torch.autograd.Function):
    """The backward pass as a function of its own, on which ``torch.func`` may call ``vmap`` or differentiate again."""

    @staticmethod
    def forward(functions: _Functions, results: int, *tensors: Tensor) -> tuple[Tensor | None, ...]:
        # The first tensors are the cotangents of that many results; the others are the arguments of the forward pass.
        plain = _plain(tensors)
        with without_autocast(plain[0].device):
            return tuple(functions.vjp(plain[:results], *plain[results:]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.functions, ctx.results, *tensors = inputs
        ctx.given = [gradient is not None for gradient in output]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Any:
        functions: _Functions = ctx.functions
        if functions.second is None:
            raise TorchptError(_NO_SECOND_DERIVATIVES)
        return (None, None, *_second(functions, ctx.results, functions.arguments(cotangents), ctx.saved_tensors))

    @staticmethod
    def jvp(ctx: Any, *given: Any) -> Any:
        functions, results, tangents = ctx.functions, ctx.results, given[2:]
        if functions.second is None:
            raise TorchptError(_NO_SECOND_DERIVATIVES)
        cotangents, tensors = ctx.saved_tensors[:results], ctx.saved_tensors[results:]
        products: list[Tensor | None] = [None] * len(ctx.given)
        if any(tangent is not None for tangent in tangents[results:]):  # the Hessian is symmetric
            products[: len(tensors)] = _second(functions, results, tangents[results:], ctx.saved_tensors)[results:]
        changes = tangents[:results]
        if any(change is not None for change in changes):
            changes = [
                torch.zeros_like(c) if change is None else change for c, change in zip(cotangents, changes, strict=True)
            ]
            linear = _CustomVjpBackward.apply(functions, results, *changes, *tensors)
            assert linear is not None
            products = [_sum(a, b) for a, b in zip(products, linear, strict=True)]
        return tuple(product if given else None for product, given in zip(products, ctx.given, strict=True))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _call_for_each(_CustomVjpBackward.apply, info.batch_size, in_dims, arguments)


class _Second(torch.autograd.Function):
    """JVPs of results, and Hessian products, as a function of its own."""

    @staticmethod
    def forward(functions: _Functions, results: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        # First tangents, then the cotangents of so many results, then as many arguments as tangents.
        count = (len(tensors) - results) // 2
        plain = _plain(tensors)
        tangents, cotangents, arguments = plain[:count], plain[count : count + results], plain[count + results :]
        assert functions.second is not None
        with without_autocast(arguments[0].device):
            return tuple(functions.second(tangents, cotangents or None, *arguments))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.functions, ctx.results, *tensors = inputs
        ctx.count = (len(tensors) - ctx.results) // 2
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*tensors[ctx.count :])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> Any:
        # Linear in the tangents; the other inputs are :class:`_Constant`.
        functions, results, count = ctx.functions, ctx.results, ctx.count
        jvps, products = (cotangents, ()) if results == 0 else (cotangents[:results], cotangents[results:])
        tensors = ctx.saved_tensors[results:]
        found: list[Tensor | None] = [None] * count
        if any(jvp is not None for jvp in jvps):
            assert all(jvp is not None for jvp in jvps)  # a render has one picture
            linear = _CustomVjpBackward.apply(functions, len(jvps), *jvps, *tensors)
            assert linear is not None
            found = list(linear[:count])
        if any(product is not None for product in products):  # the Hessian is symmetric
            twice = _second(functions, results, products, ctx.saved_tensors)
            found = [_sum(a, b) for a, b in zip(found, twice[results:], strict=True)]
        return (None, None, *found, *(None for _ in ctx.saved_tensors))

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_NO_THIRD_DERIVATIVES)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        return _call_for_each(_Second.apply, info.batch_size, in_dims, arguments)


class _Constant(torch.autograd.Function):
    """The identity, which cannot be differentiated: an input of a function without that derivative."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor) -> Tensor:
        return value.view_as(value)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *cotangents: Any) -> Any:
        raise TorchptError(_NO_THIRD_DERIVATIVES)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise TorchptError(_NO_THIRD_DERIVATIVES)


def _second(
    functions: _Functions, results: int, tangents: Sequence[Tensor | None], others: Sequence[Tensor]
) -> tuple[Tensor | None, ...]:
    """Call :class:`_Second` with tangents, and with cotangents and tensors (``others``) that are not differentiated again."""
    found = _Second.apply(functions, results, *tangents, *(_Constant.apply(tensor) for tensor in others))
    assert found is not None
    return found


def _sum(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    """Return a sum of which None is 0."""
    return b if a is None else a if b is None else a + b


def _plain(tensors: Sequence[Tensor | None]) -> tuple[Any, ...]:
    """Return tensors off all tapes."""
    try:
        return tuple(None if tensor is None else tensor.detach() for tensor in tensors)
    except RuntimeError as error:  # tensors of torch's older vmap, which has no rule for a custom Function
        raise TorchptError(_NO_OLD_VMAP) from error


def _with_signature(function: type[torch.autograd.Function]) -> None:
    """Store the signature of ``forward``, which torch would otherwise read from its code at every call."""
    forward: Any = function.forward
    forward.__signature__ = inspect.signature(forward)


_with_signature(_CustomVjp)
_with_signature(_CustomVjpBackward)
_with_signature(_Second)
_with_signature(_GivenCotangents)


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
