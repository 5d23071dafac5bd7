"""Losses between noisy pictures: differentiable, for any two tensors of one shape, such as ``(H, W, 3)``.

``l1 l2 relmse smape`` compare a picture with its target, ``unbiased_squared_error`` and ``unbiased_relmse`` two independent
renders of one scene with it. A backward pass of ``torchpt.render`` draws its own samples, so the gradient of a loss that is
quadratic in the picture is unbiased with one render. Its *value* is biased by the variance of the noise; two renders remove
that. docs/guides/ml.md has the details.
"""

from __future__ import annotations

from torch import Tensor

from torchpt.images.metrics import FLOOR, relative, symmetric

__all__ = ["l1", "l2", "relmse", "smape", "unbiased_relmse", "unbiased_squared_error"]


def _check_pictures(*pictures: Tensor) -> None:
    """Raise unless all pictures are floating tensors of one shape, so that none is broadcast."""
    for picture in pictures:
        if not isinstance(picture, Tensor):
            hint = "; hand over its .image" if hasattr(picture, "image") else ""
            raise TypeError(f"expected a picture as a tensor, got {type(picture).__name__}{hint}")
        if not picture.is_floating_point():
            raise TypeError(
                f"expected a picture of floating numbers, linear as renders are, got one of {picture.dtype}"
            )
    shapes = {tuple(picture.shape) for picture in pictures}
    if len(shapes) > 1:
        raise ValueError(f"pictures differ in shape: {', '.join(map(str, sorted(shapes)))}")


def l2(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``(x - t)²``.

    Raises:
        ValueError: the shapes differ (all losses raise it).
        TypeError: not a floating tensor, for example a :class:`torchpt.Rendering` (all losses raise it).
    """
    _check_pictures(image, target)
    return (image - target).square().mean()


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``|x - t|``. For a noisy picture its gradient points to the median of a pixel, not to its mean."""
    _check_pictures(image, target)
    return (image - target).abs().mean()


def relmse(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``(x - t)² / (t² + floor)``: dark pixels count as much as bright ones.

    The denominator has the target alone, so this is quadratic in the picture (Rousselle et al. 2011, section 4.2).
    """
    _check_pictures(image, target)
    return relative((image - target).square(), target, floor).mean()


def smape(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``|x - t| / (|x| + |t| + floor)``: bounded, so fireflies count little; biased for noisy pictures."""
    _check_pictures(image, target)
    return symmetric(image, target, floor).mean()


def unbiased_squared_error(a: Tensor, b: Tensor, target: Tensor) -> Tensor:
    """Return the mean of ``(a - t)(b - t)`` of two renders of one scene with different seeds.

    As the renders are independent, its expectation is ``(E x - t)²``, and its gradient is an unbiased estimate of the gradient
    of that. It may be negative.
    """
    _check_pictures(a, b, target)
    return ((a - target) * (b - target)).mean()


def unbiased_relmse(a: Tensor, b: Tensor, target: Tensor, scale: Tensor | None = None, floor: float = FLOOR) -> Tensor:
    """Return the mean of ``(a - t)(b - t) / (s² + floor)`` of two renders of one scene with different seeds.

    Args:
        a: one render.
        b: another one, with another seed.
        target: the target.
        scale: ``s``, by default the target, without a gradient. If the target is a noisy render, pass a less noisy picture or
            other samples, such as the denoised target: the target's noise in the denominator would bias the weights of pixels.
        floor: keeps black pixels finite.
    """
    scale = target if scale is None else scale
    _check_pictures(a, b, target, scale)
    return relative((a - target) * (b - target), scale.detach(), floor).mean()
