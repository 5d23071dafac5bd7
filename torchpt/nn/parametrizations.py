"""Numbers without bounds for parameters that have some, so that an optimizer may take any step.

=============  ======================================  =============================================================
kind           of                                      parameter
=============  ======================================  =============================================================
``Bounded``    two ends: albedos, roughnesses, angles  ``low + (high - low) ((1 + 2 e) sigmoid(x) - e)``, held at the ends
``LowerBounded``      one end: radiances, radii, indices      ``low + s (softplus(x) - e)``, held at the end; ``s`` as below
``Unbounded``       none: points, directions, vertices      ``x``
``RigidMotion``      poses                                   ``exp(w)`` times the pose at first, at ``l t``; ``x = (w, t)``
=============  ======================================  =============================================================

A plain sigmoid reaches neither 0 nor 1, and has no slope near them: an albedo of 0 would be minus infinity, and stay there.
So it is stretched by ``e = 0.05`` at each end that belongs to the range, which is then met at a finite ``x`` with a sixth of
the slope in the middle. Beyond an end the parameter is held there, and only derivatives that lead back pass (a projected
gradient). An end that does not belong to the range (a radius above 0) is not stretched to. ``s`` is the mean magnitude of the
parameter at first (1 where that is 0), so that a step of ``x`` is one of its own scale, for a lamp of 0.01 as for one of 1,000.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchpt.spec import Pose, Spec

__all__ = ["Bounded", "LowerBounded", "Parametrization", "RigidMotion", "Unbounded", "parametrization_of"]

#: By how much an end that belongs to the range is overshot, as a share.
STRETCH = 0.05
#: How near an end that does not belong to it is come to, as a share.
CLOSEST = 1e-6
#: A range this many times wider than the parameter is one with a single end.
WIDE = 100.0


class _ProjectedClamp(torch.autograd.Function):
    """``clamp`` whose derivative passes beyond an end too, where a step against it leads back."""

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
    """One parameter: ``forward`` makes it of the numbers ``x`` that are optimized, ``inverse`` finds these.

    Both keep the device and the type of what they are given. Buffers hold what depends on the parameter at first.
    """

    def inverse(self, value: Tensor) -> Tensor:
        """The numbers that stand for ``value``."""
        raise NotImplementedError


class Unbounded(Parametrization):
    """The numbers themselves."""

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return x

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        return value


class Bounded(Parametrization):
    """Between two ends; ``open_low`` and ``open_high``: whether they do not belong to the range."""

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
    """Above an end, and up to another one that lies far away; ``start``: the parameter at first."""

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
    """A pose: turned about the axes of the world around its own origin, and moved; its scales and shears stay.

    ``x`` is ``(6,)``: the rotation from the pose at first as axis times angle in radians, and the place of its origin in
    ``length``, so that a step of either is as large as the other's to what is seen.
    """

    frame: Tensor

    def __init__(self, start: Tensor, length: float = 1.0) -> None:
        super().__init__()
        self.length = length
        self.register_buffer("frame", start.detach()[:3, :3].clone())

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        a, b, c = x[:3].double().unbind()  # angles of many turns have no digits left in float32
        zero = torch.zeros_like(a)
        across = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)  # of the cross product
        turned = (torch.linalg.matrix_exp(across) @ self.frame.double()).to(x.dtype)
        last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=x.dtype, device=x.device)
        return torch.cat((torch.cat((turned, self.length * x[3:, None]), 1), last))

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the pose is not one of this one's, turned and moved.
        """
        from kornia.geometry.conversions import rotation_matrix_to_axis_angle

        turn = value[:3, :3].double() @ torch.linalg.inv(self.frame.double())
        if not torch.allclose(turn @ turn.T, torch.eye(3).to(turn), atol=1e-4) or torch.linalg.det(turn) < 0:
            raise ValueError("expected the pose at first, turned and moved")
        return torch.cat((rotation_matrix_to_axis_angle(turn[None])[0].to(value), value[:3, 3] / self.length))


def parametrization_of(spec: Spec, start: Tensor, rigid: bool = True, length: float = 1.0) -> Parametrization:
    """The range of a parameter that is ``start`` at first.

    ``rigid``: whether poses are turned and moved alone; ``length``: how large the scene is.
    """
    if isinstance(spec, Pose):
        return RigidMotion(start, length) if rigid or spec.angles or spec.rigid else Unbounded()
    low, high = getattr(spec, "low", None), getattr(spec, "high", None)
    above, below = getattr(spec, "above", None), getattr(spec, "below", None)
    # Of an end that belongs to the range and one that does not, the tighter one counts.
    open_low = above is not None and (low is None or above >= low)
    open_high = below is not None and (high is None or below <= high)
    low, high = above if open_low else low, below if open_high else high
    if low is None:
        return Unbounded()
    largest = float((start.double() - low).abs().max()) if start.numel() else 0.0
    if high is None or high - low > WIDE * max(largest, 1.0):
        return LowerBounded(low, math.inf if high is None else high, open_low, start)
    return Bounded(low, high, open_low, open_high)
