"""An optimizer for vertices: Adam with one scale for all numbers of a tensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import ArgumentValueError

__all__ = ["AdamUniform"]


class AdamUniform(torch.optim.Optimizer):
    """Adam whose second moment is the largest of a tensor: all its numbers move in the direction of the mean gradient.

    Plain Adam divides each number by its own scale, which undoes the smoothness of :class:`torchpt.nn.LargeSteps`. Nicolet,
    Jacobson and Jakob, *Large Steps in Inverse Rendering of Geometry* (2021), section 3.4, propose this one with it.

    Args:
        params: tensors, or groups of them, as for all optimizers of torch.
        lr: rate: the largest step of a number, about.
        betas: decay of the first and second moment, in 0..1 without 1.
        eps: added to the divisor.

    Raises:
        ValueError: an argument, or a setting of a group, that is out of range or of another type.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-2,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        defaults = {"lr": lr, "betas": betas, "eps": eps}
        _check(defaults)
        super().__init__(params, defaults)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group of tensors with settings of their own, as for all optimizers of torch.

        Raises:
            ValueError: a setting is out of range or of another type.
        """
        if isinstance(param_group, dict):  # torch refuses others
            _check({**self.defaults, **param_group})
        super().add_param_group(param_group)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Take a step; ``closure`` evaluates the loss again, which is returned."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for value in group["params"]:
                if value.grad is None or not value.numel():
                    continue
                state = self.state[value]
                if not state:
                    state |= {"step": 0, "mean": torch.zeros_like(value), "square": torch.zeros_like(value)}
                state["step"] += 1
                state["mean"].lerp_(value.grad, 1.0 - beta1)
                state["square"].lerp_(value.grad.square(), 1.0 - beta2)
                # Both moments begin at 0: these factors undo that.
                mean = state["mean"] / (1.0 - beta1 ** state["step"])
                square = state["square"] / (1.0 - beta2 ** state["step"])
                value.sub_(group["lr"] * mean / (square.max().sqrt() + group["eps"]))
        return loss


def _check(settings: dict[str, Any]) -> None:
    """Raise ArgumentValueError unless the settings of a group are in their ranges."""
    for key in ("lr", "eps"):
        if not 0.0 <= _number(settings[key]) < math.inf:
            raise ArgumentValueError(key, settings[key], "a finite number >= 0")
    betas = settings["betas"]
    is_row = betas.dim() == 1 if isinstance(betas, Tensor) else isinstance(betas, Sequence)
    if not is_row or len(betas) != 2 or not all(0.0 <= _number(beta) < 1.0 for beta in betas):
        raise ArgumentValueError("betas", betas, "two numbers in 0..1 without 1")


def _number(value: Any) -> float:
    """Return a number, also of a tensor of one; nan where it is none."""
    if isinstance(value, Tensor) and value.numel() == 1 and not value.is_complex():
        return float(value.detach())
    return float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
