"""An optimizer for vertices: Adam with one scale for all numbers of a tensor."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

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
        ValueError: an argument out of range.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-2,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
    ) -> None:
        if not 0.0 <= lr < float("inf"):
            raise ValueError(f"expected lr >= 0, got {lr}")
        if not all(0.0 <= beta < 1.0 for beta in betas):
            raise ValueError(f"expected betas in 0..1 without 1, got {betas}")
        if not 0.0 <= eps < float("inf"):
            raise ValueError(f"expected eps >= 0, got {eps}")
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})

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
                if value.grad is None:
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
