"""Execute requests: render them, with autograd where gradients are wanted."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from torch import Tensor

from torchpt.core.autograd import Backward, custom_vjp, is_transformed, under_transforms
from torchpt.core.errors import NoLightWarning, RenderError, SceneError, warn_caller
from torchpt.rendering import Rendering, render_scene
from torchpt.rendering.graphs import reuse_rendering
from torchpt.rendering.requests import RenderRequest
from torchpt.rendering.result import denoise_rendering

__all__ = ["execute_request"]


def execute_request(
    request: RenderRequest,
    rendered: list[Rendering] | None = None,
    share: Callable[[Backward, tuple[Tensor, ...]], Backward] | None = None,
) -> Rendering:
    """Render a request: with autograd where it requires gradients, denoised where its film asks for that.

    Args:
        request: the request.
        rendered: a list with the rendering that was already made without gradients; it is removed from the list.
        share: called with the backward pass and the tensors that autograd calls it with, returns the one to use.

    Raises:
        SceneError: a parameter is not accepted.
    """
    scene, settings, call = request.scene, request.settings, request.call
    if settings.film.denoise and any(map(is_transformed, request.params.values())):
        raise SceneError("film.denoise", True, "false under transforms of torch.func: their pictures cannot be read")

    def render(params: Mapping[str, Tensor], rays: tuple[Tensor, ...]) -> Rendering:
        if rendered:
            return rendered.pop()
        with nullcontext() if call.ranks is None else call.ranks.together():
            scene.check(params)
        pair = (rays[0], rays[1]) if rays else None
        return reuse_rendering(
            lambda: render_scene(scene, settings, params=params, dtype=call.dtype, ranks=call.ranks, rays=pair)
        )

    if request.needs_gradients:
        from torchpt.rendering.derivatives import differentiable_rendering

        rendering = differentiable_rendering(request, render, share)
    elif request.params or request.rays is not None:
        rendering = _constant(request, render)
    else:
        rendering = render({}, ())
    if settings.film.denoise:
        denoise_rendering(rendering, settings)
    if rendering.relmse_unknown:
        warn_caller(f"the picture's error is not known: {rendering.relmse_unknown}", NoLightWarning)
    return rendering


def _constant(
    request: RenderRequest, render: Callable[[Mapping[str, Tensor], tuple[Tensor, ...]], Rendering]
) -> Rendering:
    """Return a rendering without gradients; parameters and rays may be wrapped by transforms of ``torch.func``."""
    params, made, settings = request.params, list[Rendering](), request.settings
    spp: list[int] = []  # of the picture

    def forward(*tensors: Tensor) -> tuple[Tensor]:
        made.append(render(dict(zip(params, tensors, strict=False)), tensors[len(params) :]))
        spp.append(max(made[-1].spp, 1))
        return (made[-1].image,)

    def second(
        tangents: Sequence[Tensor | None], cotangents: tuple[Tensor, ...] | None, *given: Tensor
    ) -> list[Tensor | None]:
        from torchpt.rendering.derivatives import second_derivatives

        return second_derivatives(request, spp[-1], settings, list(params), tangents, cotangents, given)

    def backward(*_: Any) -> Sequence[Tensor | None]:
        # Autograd gets here from a JVP alone: parameters of a constant do not require gradients.
        raise RenderError(
            "render has no derivatives of a JVP by its tangent where the parameter is a constant:"
            " take torch.func.vjp of the picture"
        )

    tensors = (*params.values(), *(request.rays or ()))
    (image,) = custom_vjp(forward, backward, tensors, (), second)
    rendering = made[-1]
    made.clear()  # autograd keeps the closure alive: it must not hold pictures
    rendering = replace(rendering, image=image)
    if rendering.layers and under_transforms():
        from torchpt.rendering.forward_layers import constant_layers

        rendering.layers = constant_layers(rendering.layers, settings, tensors, backward)
    return rendering
