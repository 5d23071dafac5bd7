"""Losses between pictures that carry noise: differentiable, for any two tensors of one shape, such as ``(H, W, 3)``.

``l1 l2 relmse smape`` compare a picture with its target, ``unbiased_squared_error`` and ``unbiased_relmse`` two independent
renders of one scene with it. Which of them have gradients without bias is a matter of the samples behind the pictures, and
docs/guides/ml.md says it in full. In short: a backward pass of ``torchpt.render`` draws its own samples, so the gradient of a
loss that is quadratic in the picture has no bias with one render. Its *value* has: noise adds its variance. Two renders take
that away.
"""

from __future__ import annotations

from torch import Tensor

from torchpt.images.metrics import FLOOR, relative, symmetric

__all__ = ["l1", "l2", "relmse", "smape", "unbiased_relmse", "unbiased_squared_error"]


def _same(*pictures: Tensor) -> None:
    """Refuse pictures that torch would stretch over each other, and what is no picture."""
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
    """Mean of ``(x - t)²``.

    Raises:
        ValueError: pictures of two shapes (so do all of these).
        TypeError: no tensor, such as a whole :class:`torchpt.Rendering`, or one of whole numbers (so do all of these).
    """
    _same(image, target)
    return (image - target).square().mean()


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean of ``|x - t|``. Of a noisy picture its gradient points to the median of a pixel, not to its mean."""
    _same(image, target)
    return (image - target).abs().mean()


def relmse(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Mean of ``(x - t)² / (t² + floor)`` (Rousselle et al. 2011, section 4.2): dark pixels count as much as bright ones.

    The target is the denominator, so this is quadratic in the picture.
    """
    _same(image, target)
    return relative((image - target).square(), target, floor).mean()


def smape(image: Tensor, target: Tensor, floor: float = FLOOR) -> Tensor:
    """Mean of ``|x - t| / (|x| + |t| + floor)``: bounded, so that fireflies count little; of noisy pictures it is biased."""
    _same(image, target)
    return symmetric(image, target, floor).mean()


def unbiased_squared_error(a: Tensor, b: Tensor, target: Tensor) -> Tensor:
    """Mean of ``(a - t)(b - t)`` of two renders of one scene with different seeds.

    As they are independent, its expectation is ``(E x - t)²``, and that of its gradient the gradient of this. It may be
    negative.
    """
    _same(a, b, target)
    return ((a - target) * (b - target)).mean()


def unbiased_relmse(a: Tensor, b: Tensor, target: Tensor, scale: Tensor | None = None, floor: float = FLOOR) -> Tensor:
    """Mean of ``(a - t)(b - t) / (s² + floor)`` of two renders of one scene with different seeds.

    Args:
        a: one render.
        b: another, with another seed.
        target: what they are to become.
        scale: ``s``, by default the target, without a gradient. Where the target itself is a noisy render, hand one that has
            less noise or other samples, such as ``torchpt.denoise``'s: its own noise in the denominator would weight pixels by
            whether their target came out dark.
        floor: keeps black pixels finite.
    """
    scale = target if scale is None else scale
    _same(a, b, target, scale)
    return relative((a - target) * (b - target), scale.detach(), floor).mean()
