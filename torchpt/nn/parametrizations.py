"""Map unconstrained numbers to the ranges of parameters, so that an optimizer may take any step.

``renderer.py`` chooses a map for each parameter by its spec, the declaration of its range (:func:`parametrization_of`). ``x``
are the numbers that are optimized, ``low`` and ``high`` the ends of the range.

================  ======================================  =============================================================
map               range                                   parameter
================  ======================================  =============================================================
``Bounded``       two ends: albedos, roughnesses, angles  ``low + (high - low) ((1 + 2 e) sigmoid(x) - e)``, clamped
``LowerBounded``  one end: radiances, radii, indices      ``low + s (softplus(x) - e)``, clamped
``Unbounded``     none: points, directions, vertices      ``x``
``RigidMotion``   poses                                   ``exp(w)`` times the initial pose, at ``l t``; ``x = (w, t)``
================  ======================================  =============================================================

In a rigid motion ``w`` is a rotation as axis times angle, ``exp(w)`` its matrix, ``l`` a length of the scene, ``t`` a position.

A plain sigmoid never reaches 0 or 1, and is flat near them: an albedo of 0 would be ``x`` of minus infinity, and stay there.
So it is stretched by ``e = 0.05`` at each closed end, which is then reached at a finite ``x`` with a sixth of the slope in
the middle. Beyond an end the parameter is clamped, and only gradients that lead back pass (a projected gradient). Open ends
(a radius above 0) are not stretched. ``s`` is the mean distance of the initial value from ``low`` (1 if that is 0), so that a
step of ``x`` is relative to the parameter's scale, for a lamp of 0.01 as for one of 1,000.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from torchpt.spec import Pose, Spec

__all__ = ["Bounded", "LowerBounded", "Parametrization", "RigidMotion", "Unbounded", "parametrization_of"]

#: Overshoot of a closed end, as a share of the range.
OVERSHOOT = 0.05
#: Closest distance to an open end, as a share of the range.
OPEN_END_MARGIN = 1e-6
#: A range that is wider than the initial value by more than this factor counts as one without an upper end: a sigmoid would be
#: flat there.
OPEN_ENDED_FACTOR = 100.0


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
    """A range between two ends; ``open_low`` and ``open_high``: True for an end that is excluded.

    A *share* is the parameter's place in the range: 0 at ``low``, 1 at ``high``.
    """

    def __init__(self, low: float, high: float, *, open_low: bool, open_high: bool) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.overshoot_low, self.overshoot_high = (0.0 if open_end else OVERSHOOT for open_end in (open_low, open_high))
        self.lowest_share, self.highest_share = (
            (OPEN_END_MARGIN if open_low else 0.0),
            1.0 - (OPEN_END_MARGIN if open_high else 0.0),
        )

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share: Any = _ProjectedClamp.apply(
            (1.0 + self.overshoot_low + self.overshoot_high) * x.sigmoid() - self.overshoot_low,
            self.lowest_share,
            self.highest_share,
        )
        return self.low + (self.high - self.low) * share

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        share = ((value.double() - self.low) / (self.high - self.low)).clamp(self.lowest_share, self.highest_share)
        return ((share + self.overshoot_low) / (1.0 + self.overshoot_low + self.overshoot_high)).logit().to(value)


class LowerBounded(Parametrization):
    """A range above an end, and up to a distant one; ``start``: initial value of the parameter."""

    scale: Tensor

    def __init__(self, low: float, high: float, *, open_low: bool, start: Tensor) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.overshoot_low, self.lowest_share = (0.0, OPEN_END_MARGIN) if open_low else (OVERSHOOT, 0.0)
        scale = (start.double() - low).abs().mean()
        self.register_buffer("scale", (scale if scale > 0 else torch.ones_like(scale)).to(start))

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        above: Any = _ProjectedClamp.apply(nn.functional.softplus(x) - self.overshoot_low, self.lowest_share, math.inf)
        value: Any = _ProjectedClamp.apply(self.low + self.scale * above, -math.inf, self.high)
        return value

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        # The inverse of softplus is log(exp(y) - 1), written so that neither large nor small y lose digits.
        y = ((value.double() - self.low) / self.scale.double()).clamp(min=self.lowest_share) + self.overshoot_low
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
        self.register_buffer("frame", start.detach()[:3, :3].clone())  # rotation, scale and shear of the initial pose

    def forward(self, x: Tensor) -> Tensor:
        """See :class:`Parametrization`."""
        # Rodrigues' rotation: the exponential of the cross-product matrix of axis times angle.
        a, b, c = x[:3].double().unbind()  # large angles lose their digits in float32
        zero = torch.zeros_like(a)
        cross_matrix = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero]).reshape(3, 3)
        rotated = (torch.linalg.matrix_exp(cross_matrix) @ self.frame.double()).to(x.dtype)
        last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=x.dtype, device=x.device)
        return torch.cat((torch.cat((rotated, self.length * x[3:, None]), 1), last))

    def inverse(self, value: Tensor) -> Tensor:
        """See :class:`Parametrization`.

        Raises:
            ValueError: the pose is no rigid motion of the initial one.
        """
        from kornia.geometry.conversions import rotation_matrix_to_axis_angle

        rotation = value[:3, :3].double() @ torch.linalg.inv(self.frame.double())
        if (
            not torch.allclose(rotation @ rotation.T, torch.eye(3).to(rotation), atol=1e-4)
            or torch.linalg.det(rotation) < 0
        ):
            raise ValueError("expected the pose at first, turned and moved")
        return torch.cat((rotation_matrix_to_axis_angle(rotation[None])[0].to(value), value[:3, 3] / self.length))


def parametrization_of(spec: Spec, start: Tensor, *, rigid: bool = True, length: float = 1.0) -> Parametrization:
    """Return the map for a parameter.

    Args:
        spec: declaration of the parameter.
        start: its initial value.
        rigid: True: poses move rigidly. False: only those whose spec says that they must keep angles or lengths.
        length: size of the scene, the unit of a pose's position.
    """
    if isinstance(spec, Pose):
        return RigidMotion(start, length) if rigid or spec.angles or spec.rigid else Unbounded()
    low, high = getattr(spec, "low", None), getattr(spec, "high", None)
    above, below = getattr(spec, "above", None), getattr(spec, "below", None)  # open ends
    # Of a closed and an open end, the tighter one counts.
    open_low = above is not None and (low is None or above >= low)
    open_high = below is not None and (high is None or below <= high)
    low, high = above if open_low else low, below if open_high else high
    if low is None:
        return Unbounded()
    largest = float((start.double() - low).abs().max()) if start.numel() else 0.0
    if high is None or high - low > OPEN_ENDED_FACTOR * max(largest, 1.0):
        return LowerBounded(low, math.inf if high is None else high, open_low=open_low, start=start)
    return Bounded(low, high, open_low=open_low, open_high=open_high)
