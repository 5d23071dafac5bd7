"""Map unconstrained numbers to the ranges of parameters, so that an optimizer may take any step.

=============  ======================================  =============================================================
kind           range                                   parameter
=============  ======================================  =============================================================
``Bounded``    two ends: albedos, roughnesses, angles  ``low + (high - low) ((1 + 2 e) sigmoid(x) - e)``, clamped
``LowerBounded``      one end: radiances, radii, indices      ``low + s (softplus(x) - e)``, clamped; ``s`` as below
``Unbounded``       none: points, directions, vertices      ``x``
``RigidMotion``      poses                                   ``exp(w)`` times the initial pose, at ``l t``; ``x = (w, t)``
=============  ======================================  =============================================================

A plain sigmoid never reaches 0 or 1, and is flat near them: an albedo of 0 would be ``x`` of minus infinity, and stay there.
So it is stretched by ``e = 0.05`` at each closed end, which is then reached at a finite ``x`` with a sixth of the slope in
the middle. Beyond an end the parameter is clamped, and only gradients that lead back pass (a projected gradient). Open ends
(a radius above 0) are not stretched. ``s`` is the mean magnitude of the initial value (1 if that is 0), so that a step of
``x`` is relative to the parameter's scale, for a lamp of 0.01 as for one of 1,000.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchpt.spec import Pose, Spec

__all__ = ["Bounded", "LowerBounded", "Parametrization", "RigidMotion", "Unbounded", "parametrization_of"]

#: Overshoot of a closed end, as a share of the range.
STRETCH = 0.05
#: Closest distance to an open end, as a share of the range.
CLOSEST = 1e-6
#: A range that is wider than the parameter by more than this factor counts as open-ended.
WIDE = 100.0


class _ProjectedClamp(torch.autograd.Function):
    """``clamp`` that passes gradients beyond an end if they lead back into the range."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, low: float, high: float) -> Tensor:
        return x.clamp(low, high)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, ctx.low, ctx.high = inputs
        ctx.save_for_backward(x)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> Any:
        (x,), (cotangent,) = ctx.saved_tensors, cotangents
        outward = ((x <= ctx.low) & (cotangent > 0)) | ((x >= ctx.high) & (cotangent < 0))
        return torch.where(outward, 0.0, cotangent), None, None


class Parametrization(nn.Module):
    """Map of one parameter: ``forward`` computes it from the optimized numbers ``x``, ``inverse`` computes ``x``.

    Both keep the device and dtype of their argument. Buffers hold what depends on the initial value.
    """

    def inverse(self, value: Tensor) -> Tensor:
        """Return ``x`` of a value of the parameter."""
        raise NotImplementedError


class Unbounded(Parametrization):
    """The identity, for parameters without bounds."""

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return x

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return value


class Bounded(Parametrization):
    """A range between two ends; ``open_low`` and ``open_high``: True for an end that is excluded."""

    def __init__(self, low: float, high: float, open_low: bool, open_high: bool) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.below, self.over = (0.0 if open_end else STRETCH for open_end in (open_low, open_high))
        self.least, self.most = (CLOSEST if open_low else 0.0), 1.0 - (CLOSEST if open_high else 0.0)

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share: Any = _ProjectedClamp.apply(
            (1.0 + self.below + self.over) * x.sigmoid() - self.below, self.least, self.most
        )
        return self.low + (self.high - self.low) * share

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share = ((value.double() - self.low) / (self.high - self.low)).clamp(self.least, self.most)
        return ((share + self.below) / (1.0 + self.below + self.over)).logit().to(value)


class LowerBounded(Parametrization):
    """A range above an end, and up to a distant one; ``start``: initial value of the parameter."""

    scale: Tensor

    def __init__(self, low: float, high: float, open_low: bool, start: Tensor) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.below, self.least = (0.0, CLOSEST) if open_low else (STRETCH, 0.0)
        scale = (start.double() - low).abs().mean()
        self.register_buffer("scale", (scale if scale > 0 else torch.ones_like(scale)).to(start))

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        above: Any = _ProjectedClamp.apply(nn.functional.softplus(x) - self.below, self.least, math.inf)
        value: Any = _ProjectedClamp.apply(self.low + self.scale * above, -math.inf, self.high)
        return value

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        y = ((value.double() - self.low) / self.scale.double()).clamp(min=self.least) + self.below
        return (y + torch.log(-torch.expm1(-y))).to(value)


class RigidMotion(Parametrization):
    """A rigid motion of a pose: rotation about the origin of the pose, and translation; scale and shear are kept.

    ``x`` is ``(6,)``: the rotation from the initial pose as axis times angle in radians, and the position of the origin in
    units of ``length``, so that steps of both change the picture alike.
    """

    frame: Tensor

    def __init__(self, start: Tensor, length: float = 1.0) -> None:
        super().__init__()
        self.length = length
        self.register_buffer("frame", start.detach()[:3, :3].clone())

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        a, b, c = x[:3].double().unbind()  # large angles lose their digits in float32
        zero = torch.zeros_like(a)
        across = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)  # cross-product matrix
        turned = (torch.linalg.matrix_exp(across) @ self.frame.double()).to(x.dtype)
        last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=x.dtype, device=x.device)
        return torch.cat((torch.cat((turned, self.length * x[3:, None]), 1), last))

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the pose is no rigid motion of the initial one.
        """
        from kornia.geometry.conversions import rotation_matrix_to_axis_angle

        turn = value[:3, :3].double() @ torch.linalg.inv(self.frame.double())
        if not torch.allclose(turn @ turn.T, torch.eye(3).to(turn), atol=1e-4) or torch.linalg.det(turn) < 0:
            raise ValueError("expected the pose at first, turned and moved")
        return torch.cat((rotation_matrix_to_axis_angle(turn[None])[0].to(value), value[:3, 3] / self.length))


def parametrization_of(spec: Spec, start: Tensor, rigid: bool = True, length: float = 1.0) -> Parametrization:
    """Return the range of a parameter with initial value ``start``.

    ``rigid``: poses move rigidly; ``length``: size of the scene.
    """
    if isinstance(spec, Pose):
        return RigidMotion(start, length) if rigid or spec.angles or spec.rigid else Unbounded()
    low, high = getattr(spec, "low", None), getattr(spec, "high", None)
    above, below = getattr(spec, "above", None), getattr(spec, "below", None)
    # Of a closed and an open end, the tighter one counts.
    open_low = above is not None and (low is None or above >= low)
    open_high = below is not None and (high is None or below <= high)
    low, high = above if open_low else low, below if open_high else high
    if low is None:
        return Unbounded()
    largest = float((start.double() - low).abs().max()) if start.numel() else 0.0
    if high is None or high - low > WIDE * max(largest, 1.0):
        return LowerBounded(low, math.inf if high is None else high, open_low, start)
    return Bounded(low, high, open_low, open_high)
