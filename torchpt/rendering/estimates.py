"""``torchpt.gradient``: a gradient by independent passes, with its standard errors and counts."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
from torchpt.core.errors import SceneError
from torchpt.core.threads import outside_inference_mode
from torchpt.rendering.api import render
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.selection import matching_names
from torchpt.scene.settings import SeedOfCall, base_seed, seed_number

__all__ = ["GradientEstimate", "gradient"]

#: Ways to combine passes.
COMBINE = ("mean", "median")
#: Options that passes set by themselves.
_OWN = ("params", "spp", "seed", "spp_grad", "seed_grad", "full")
#: Odd multiplier that gives passes seeds of their own, any constant.
_STRIDE = 0x9E3779B1


@dataclass(frozen=True, eq=False)
class GradientEstimate:
    """A gradient, and how exact it is.

    Attributes:
        loss: value of the loss; None where a cotangent was given.
        gradients: by name of the parameter, in the shape of its value.
        standard_errors: of each number of the gradients, the noise of the picture that the loss was taken of included; those of
            the mean, also where ``combine`` is ``median``.
        passes: number of independent passes.
        spp: samples a pixel of each pass.
        clipped: number of gradients, of a parameter in a pass, that ``grad_clip`` made shorter.
        not_finite: number of gradients, likewise, that were not finite and were left out.
    """

    loss: float | None
    gradients: dict[str, Tensor]
    standard_errors: dict[str, Tensor]
    passes: int
    spp: int
    clipped: int
    not_finite: int

    def relative_error(self) -> float:
        """Return the norm of all standard errors over the norm of all gradients; inf where the gradient is 0."""
        error, size = (
            torch.cat([x.double().flatten() for x in values.values()]).norm()
            for values in (self.standard_errors, self.gradients)
        )
        return float(error / size) if size > 0 else float("inf")


def gradient(
    scene: Scene,
    loss: Callable[[Tensor], Tensor] | Tensor,
    params: Mapping[str, Any] | Iterable[str] | str,
    *,
    spp: int = 64,
    passes: int = 8,
    seed: SeedOfCall = 0,
    combine: str = "mean",
    grad_clip: float | None = None,
    **options: Any,
) -> GradientEstimate:
    """Return the gradient of a loss of the picture, with its standard errors, by independent passes.

    The mean over passes has no bias for the cotangent that it is taken of. That of a loss which is not linear varies with the
    noise of the picture. This noise is part of the standard errors, rather too large than too small, as it is taken of pictures
    of fewer samples; it costs as many samples as the picture has, and half as many passes more.
    Outliers move the mean as much as they are large; two ways to combine passes are moved less, and are biased toward what most
    passes say, the more so the more skew their distribution is: ``combine="median"`` takes the median of the passes, number by
    number (each of which is a mean over its samples: a median of means), and ``grad_clip`` shortens gradients that are long
    beside those of the other passes. Both errors fall as passes get more samples.

    Under ``torch.no_grad`` and in inference mode it does the same: what it returns needs no gradients.

    Args:
        scene: from :func:`torchpt.load`.
        loss: function of the picture ``(H, W, 3)`` that returns a number; it is taken of a picture of ``spp`` samples a pixel,
            and, to know its noise, of others; or the cotangent of the picture, ``(H, W, 3)``.
        params: values in place of ``scene.params`` by name, or names of these, also one name, and patterns such as
            ``materials.*.reflectance``; all are differentiated.
        spp: samples a pixel of the picture, and of all passes together.
        passes: number of independent passes, at least 2. Each takes ``spp / passes`` samples a pixel, rounded up.
        seed: see :func:`torchpt.render`.
        combine: ``mean`` or ``median``.
        grad_clip: longest gradient of a parameter in a pass, in units of the median length over passes, unless that is 0; None:
            any.
        options: further options of :func:`torchpt.render`. An ``edge_guide`` learns from pass to pass, so the first ones vary
            more, which ``median`` and ``grad_clip`` do not know.

    Raises:
        SceneError: a setting or parameter is not accepted, or all passes of a parameter have gradients that are not finite.
        TypeError: an option that passes set by themselves, or an unknown one.
    """
    for name in _OWN:
        if name in options:
            raise TypeError(f"gradient takes no {name} among its options: it has arguments of its own for that")
    for name, value, low in (("spp", spp, 1), ("passes", passes, 2)):
        if not isinstance(value, int) or value < low:
            raise SceneError(name, value, f"a whole number >= {low}")
    if combine not in COMBINE:
        raise SceneError("combine", combine, " or ".join(COMBINE))
    if grad_clip is not None and not (isinstance(grad_clip, int | float) and grad_clip > 0):
        raise SceneError("grad_clip", grad_clip, "a number above 0, or None")
    if not isinstance(loss, Tensor) and not callable(loss):
        raise SceneError("loss", loss, "a function of the picture, or a tensor of its shape")
    first = base_seed(seed_number(seed))
    share = -(-spp // passes)
    with outside_inference_mode(), torch.enable_grad():
        values = {name: _leaf(value) for name, value in _named(scene, params).items()}
        if not values:
            raise SceneError("params", params, "at least one name of scene.params")
        independent = _Passes(scene, values, share, first, options)
        found, changes = None, list[Tensor]()
        if not isinstance(loss, Tensor):
            with torch.no_grad():
                picture = render(scene, params=values, spp=spp, seed=first, **options)
            found, cotangent = _cotangent(loss, picture)
            changes = _changes(loss, cotangent, independent.pictures(passes, number=passes + 1))
        else:
            cotangent = loss
        each = independent.gradients([cotangent] * passes, number=1)
        noise = independent.gradients(changes, number=2 * passes + 1)
    not_finite = sum(passes - len(each[name]) + len(changes) - len(noise[name]) for name in each)
    for name, grads in each.items():
        if len(grads) < 2:
            raise SceneError(name, "gradients that are not finite", "at least two passes with finite ones")
    gradients, errors, clipped = {}, {}, 0
    with outside_inference_mode():
        for name, grads in each.items():
            shorter, count = _clipped(grads, grad_clip)
            stack = torch.stack(shorter)
            whole = stack.mean(0) if combine == "mean" else _median(stack)
            gradients[name] = whole.to(values[name])
            variance = stack.var(0) / len(shorter)
            if noise[name]:
                variance = variance + torch.stack(noise[name]).square().mean(0)
            errors[name] = variance.sqrt().to(values[name])
            clipped += count
    return GradientEstimate(found, gradients, errors, passes, share, clipped, not_finite)


@dataclass(frozen=True)
class _Passes:
    """Independent renders, each with a seed of its own, by its number.

    Attributes:
        scene: the scene.
        values: of the parameters.
        spp: samples a pixel of a render.
        seed: of the whole.
        options: further options of ``render``.
    """

    scene: Scene
    values: Mapping[str, Tensor]
    spp: int
    seed: int
    options: Mapping[str, Any]

    def _seed(self, number: int) -> int:
        return (self.seed + number * _STRIDE) % (1 << 32)

    def pictures(self, count: int, number: int) -> Iterator[Tensor]:
        """Yield pictures ``(H, W, 3)``; ``number``: of the first."""
        for own in range(number, number + count):
            with torch.no_grad():
                yield render(self.scene, params=self.values, spp=self.spp, seed=self._seed(own), **self.options)

    def gradients(self, cotangents: Iterable[Tensor], number: int) -> dict[str, list[Tensor]]:
        """Return gradients by name for cotangents of the picture, without those that are not finite.

        Args:
            cotangents: one a render.
            number: of the first render.

        Raises:
            SceneError: a cotangent of another shape than the picture's.
        """
        each: dict[str, list[Tensor]] = {name: [] for name in self.values}
        for own, cotangent in enumerate(cotangents, number):
            leaves = {name: value.clone().requires_grad_() for name, value in self.values.items()}
            seeds = {"spp": 1, "seed": self.seed, "spp_grad": self.spp, "seed_grad": self._seed(own)}
            picture = render(self.scene, params=leaves, **seeds, **self.options)
            if cotangent.shape != picture.shape:
                shape = f"a tensor of shape {tuple(cotangent.shape)}"
                raise SceneError("loss", shape, f"one of the picture's, {tuple(picture.shape)}")
            grads = gradients_of([picture], list(leaves.values()), [cotangent.to(picture)])
            for name, grad in zip(leaves, grads, strict=True):
                grad = torch.zeros_like(leaves[name]) if grad is None else grad
                if bool(torch.isfinite(grad).all()):
                    each[name].append(grad.double())
        return each


def _changes(loss: Callable[[Tensor], Tensor], cotangent: Tensor, pictures: Iterator[Tensor]) -> list[Tensor]:
    """Return changes of the cotangent that are as large as its noise: differences of those of halves of some pictures.

    Args:
        loss: function of a picture.
        cotangent: of a picture of as many samples as all of ``pictures`` have.
        pictures: independent ones ``(H, W, 3)``, two at least.

    Returns:
        Half as many as pictures, of different halves; none where the cotangent does not vary, as of linear losses.
    """
    first = next(pictures)
    if torch.equal(_cotangent(loss, first)[1], cotangent):
        return []
    stack = torch.stack([first, *pictures])
    count, half = len(stack), len(stack) // 2
    generator = torch.Generator().manual_seed(count)
    # The difference of means over a and b pictures has the variance 1/a + 1/b of a single one's, the mean of all 1 / (a + b).
    factor = (half * (count - half)) ** 0.5 / count
    changes = []
    for _ in range(half):
        order = torch.randperm(count, generator=generator).to(stack.device)
        one, other = (_cotangent(loss, stack[part].mean(0))[1] for part in (order[:half], order[half:]))
        changes.append((one - other) * factor)
    return changes


def _named(scene: Scene, params: Any) -> Mapping[str, Any]:
    """Return values by name; names and patterns alone stand for the scene's own values.

    Raises:
        SceneError: neither, or a name or pattern that matches nothing.
    """
    if isinstance(params, Mapping):
        return params
    if not isinstance(params, Iterable) or isinstance(params, Tensor):
        raise SceneError("params", params, "values by name, or names and patterns of scene.params")
    names = params if isinstance(params, str) else tuple(params)
    return {name: scene.params[name] for name in matching_names(as_scene(scene), names, "params")}


def _leaf(value: Any) -> Tensor:
    """Return a value as a tensor without history."""
    tensor = value.detach() if isinstance(value, Tensor) else torch.as_tensor(value)
    return tensor if tensor.is_floating_point() else tensor.float()


def _cotangent(loss: Callable[[Tensor], Tensor], picture: Tensor) -> tuple[float, Tensor]:
    """Return the value of a loss, and its derivative by the picture."""
    picture = picture.detach().requires_grad_()
    with torch.enable_grad():
        value = loss(picture)
    cotangent, found = None, "a tensor that does not depend on the picture"
    if not isinstance(value, Tensor):
        found = value
    elif value.numel() != 1:
        found = f"a tensor of shape {tuple(value.shape)}"
    elif value.requires_grad:
        (cotangent,) = torch.autograd.grad(value, picture, allow_unused=True)
    if cotangent is None:
        raise SceneError(
            "loss", found, "a function that returns a single number as a tensor, differentiable in the picture"
        )
    return float(value.detach()), cotangent


def _clipped(grads: list[Tensor], most: float | None) -> tuple[list[Tensor], int]:
    """Return gradients none of which is longer than ``most`` times the median length, and how many were."""
    if most is None:
        return grads, 0
    lengths = [float(grad.norm()) for grad in grads]
    limit = most * statistics.median(lengths)
    if limit == 0:  # most passes found nothing, which says nothing of how long the others may be
        return grads, 0
    shorter = [grad * (limit / length) if length > limit else grad for grad, length in zip(grads, lengths, strict=True)]
    return shorter, sum(length > limit for length in lengths)


def _median(values: Tensor) -> Tensor:
    """Return the median over the first axis; of an even number the mean of the two in the middle."""
    ordered, half = values.sort(0).values, len(values) // 2
    return ordered[half] if len(values) % 2 else 0.5 * (ordered[half - 1] + ordered[half])
