"""Derivatives of a picture, as autograd asks for them: gradients, JVPs and products with the Hessian."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from torchpt import gradients
from torchpt.core.autograd import Backward, custom_vjp
from torchpt.core.errors import EdgeWarning, RenderError, SceneError, warn_caller
from torchpt.gradients import edges
from torchpt.gradients.second import hessian_products, jvp
from torchpt.ranks import together
from torchpt.rendering import Rendering
from torchpt.rendering.forward_layers import with_derivatives
from torchpt.rendering.requests import RenderRequest
from torchpt.scene.settings import Settings
from torchpt.scene.versions import AFTER

__all__ = ["differentiable_rendering", "second_derivatives"]

#: Flips bits of a seed, so that backward passes by default draw other numbers than forward passes. (The multiplier of drand48.)
_BACKWARD_SEED = 0x5DEECE66D

#: Renders given parameters, and no or two tensors of rays, without gradients.
RenderWithoutGradients = Callable[[Mapping[str, Tensor], tuple[Tensor, ...]], Rendering]


def differentiable_rendering(
    request: RenderRequest,
    render: RenderWithoutGradients,
    share: Callable[[Backward, tuple[Tensor, ...]], Backward] | None,
) -> Rendering:
    """Return a rendering whose picture has gradients with respect to parameters and rays; ``render`` makes it without.

    ``share``: as for :func:`~torchpt.rendering.execution.execute_request`.
    """
    _check_differentiable(request.settings)
    derivatives = _Derivatives(request)
    tensors = derivatives.tensors
    made: list[Rendering] = []

    def forward(*given: Tensor) -> tuple[Tensor]:
        made.append(render(*derivatives.split(given)))
        derivatives.spp = max(made[-1].spp, 1)
        return (made[-1].image,)

    backward = derivatives.backward if share is None else share(derivatives.backward, tensors)
    (image,) = custom_vjp(forward, backward, tensors, request.scene.weights(), derivatives.second)
    rendering = made[-1]
    made.clear()  # autograd keeps the closure alive: it must not hold pictures
    followed = edges.followed(request.settings)
    values = {name: rendering.layers[name] for name in followed}
    make = partial(edges.differentiable, values, tensors, derivatives.of_layers, derivatives.params)
    return replace(rendering, image=image, layers=with_derivatives(rendering.layers, followed, make))


def _check_differentiable(settings: Settings) -> None:
    """Raise SceneError for settings of which pictures have no gradients."""
    integrator = settings.integrator
    if not integrator.light or integrator.light_walk() is not None:
        raise SceneError("integrator.type", integrator.name, gradients.integrators_with_gradients())
    if settings.render.checkpoint is not None:
        raise SceneError("render.checkpoint", settings.render.checkpoint, "null where gradients are wanted")


class _Derivatives:
    """The derivatives of a picture, as autograd asks for them.

    Warns of what they leave out.

    Args:
        request: of the picture.

    Attributes:
        tensors: parameters, those that are differentiated first, and behind them the rays, if there are any.
        spp: samples a pixel of the picture; 0 before it is rendered.
    """

    def __init__(self, request: RenderRequest) -> None:
        self._request, self._wanted = request, request.differentiated
        self._names = (*self._wanted, *(name for name in request.params if name not in self._wanted))
        self.tensors = (*(request.params[name] for name in self._names), *(request.rays or ()))
        self.spp = 0
        scene, settings, call = request.scene, request.settings, request.call
        self._seed = settings.render.seed ^ _BACKWARD_SEED if call.seed_grad is None else call.seed_grad
        # Geometry is differentiated: directions and distances along paths need derivatives.
        self._attached = request.differentiates_rays or gradients.attached(scene, self._wanted)
        moves_edges = edges.concerns(scene, self._wanted)
        self._edges = call.edges and moves_edges
        if self._attached or moves_edges:
            _warn_of_edges(edges.left_out(scene, settings, request.params), all_edges=not call.edges)
        for name in edges.without_gradient(scene, self._wanted, request.params):
            said = f"{name} changes the picture by jumps alone, which are not differentiated: its gradient is 0"
            warn_caller(said, EdgeWarning)

    def params(self, *tensors: Tensor) -> dict[str, Tensor]:
        """Return the parameters by name, from tensors in the order of :attr:`tensors`."""
        return dict(zip(self._names, tensors, strict=False))  # without the rays, which follow

    def split(self, tensors: tuple[Tensor, ...]) -> tuple[dict[str, Tensor], tuple[Tensor, ...]]:
        """Return the parameters by name, and the rays, from tensors in the order of :attr:`tensors`."""
        return self.params(*tensors), tensors[len(self._names) :]

    def backward(self, cotangents: tuple[Tensor, ...], *tensors: Tensor) -> list[Tensor | None]:
        """Return the gradients of ``tensors``; ``cotangents``: of the picture alone."""
        cotangent = cotangents[0].reshape(-1, 3).T  # (3, H W)
        self._request.check_unchanged(AFTER)
        call = self._request.call

        def content() -> bytes:
            return cotangent.detach().cpu().contiguous().numpy().tobytes() + repr(call.edge_guide).encode()

        with together(call.ranks, "the loss" if call.edge_guide is None else "the loss, and edge_guide", content):
            return self._gradients(cotangent, *tensors)

    def _gradients(self, cotangent: Tensor, *tensors: Tensor) -> list[Tensor | None]:
        """Return the gradients of ``tensors`` for the cotangent ``(3, H W)``: of the interior, and of edges."""
        request, wanted = self._request, self._wanted
        scene, call, differentiates_rays = request.scene, request.call, request.differentiates_rays
        (given, rays), settings = self.split(tensors), self._settings()
        # A backward pass with the seed and samples of the forward pass is the exact derivative of its estimator.
        exact = settings.render.seed == request.settings.render.seed and settings.render.spp == self.spp
        # Otherwise first hits may be held in place while the camera moves (gradients/camera.py).
        film_space = not exact and gradients.film_space_applies(scene, request.settings, wanted)
        grads = gradients.gradients(
            scene,
            settings,
            given,
            wanted,
            dtype=call.dtype,
            attached=self._attached,
            method=call.adjoint,
            cotangent=cotangent,
            film_space=film_space,
            ranks=call.ranks,
            rays=(rays[0], rays[1]) if rays else None,
            differentiates_rays=differentiates_rays,
        )
        if self._edges:
            _, _, width, height = request.settings.film.window
            on_film = cotangent.T.reshape(height, width, 3)
            of_edges = edges.add_gradients(
                scene,
                self._settings(1),
                given,
                wanted,
                call.dtype,
                on_film,
                self._edge_spp(),
                film_space,
                call.ranks,
                call.edge_guide,
            )
            grads[: len(wanted)] = [a if b is None else a + b for a, b in zip(grads, of_edges, strict=False)]
        no_grads = [None] * (len(tensors) - len(wanted) - (2 if differentiates_rays else 0))
        return [*grads[: len(wanted)], *no_grads, *grads[len(wanted) :]]

    def second(
        self, tangents: Sequence[Tensor | None], cotangents: tuple[Tensor, ...] | None, *tensors: Tensor
    ) -> list[Tensor | None]:
        """Return JVPs and products with the Hessian, as :data:`torchpt.core.autograd.Second` asks for them."""
        request = self._request
        return second_derivatives(request, self.spp, self._settings(), self._names, tangents, cotangents, tensors)

    def of_layers(self) -> edges.Asked:
        """Return what the backward pass of layers is to do."""
        self._request.check_unchanged(AFTER)
        request = self._request
        return edges.Asked(request.scene, self._settings(), self._wanted, request.call.dtype, self._edge_spp())

    def _settings(self, spp: int | None = None) -> Settings:
        """Return the settings of the backward pass: its seed, and its samples a pixel."""
        settings, spp = self._request.settings, spp or self._request.call.spp_grad or self.spp
        return replace(settings, render=settings.render.but(seed=self._seed, spp=spp))

    def _edge_spp(self) -> float:
        """Return the samples a pixel for visibility edges; 0: none."""
        call = self._request.call
        if not call.edges:
            return 0
        _, _, width, height = self._request.settings.film.window
        return call.edge_spp or edges.samples_for(
            self._request.scene, self._wanted, call.spp_grad or self.spp, width * height
        )


def second_derivatives(
    request: RenderRequest,
    spp: int,
    backward: Settings,
    names: Sequence[str],
    tangents: Sequence[Tensor | None],
    cotangents: tuple[Tensor, ...] | None,
    tensors: tuple[Tensor, ...],
) -> list[Tensor | None]:
    """Return JVPs and Hessian products of a picture, as :data:`torchpt.core.autograd.Second` asks for them.

    JVPs are of the picture's own samples. Products of both, as in the Hessian of a squared loss, are then of samples that do
    not depend on each other, and have no bias.

    Args:
        request: of the picture.
        spp: samples a pixel of the picture.
        backward: settings of the backward pass.
        names: of ``tensors``, without the rays, which follow.
        tangents: of the tensors; None for 0.
        cotangents: of the picture; None: the JVP alone is wanted.
        tensors: parameters and rays.
    """
    request.check_unchanged(AFTER)
    scene, settings, dtype = request.scene, request.settings, request.call.dtype
    if len(tensors) > len(names):
        raise RenderError(
            "trace has no forward-mode and no second derivatives: take the difference of two calls of one seed"
        )
    if request.call.ranks is not None:
        raise SceneError("ranks", "a group", "none, for forward mode and second derivatives")
    params = dict(zip(names, tensors, strict=True))
    given = {name: tangent for name, tangent in zip(names, tangents, strict=False) if tangent is not None}
    forward = replace(settings, render=settings.render.but(spp=spp))
    pixels = jvp(scene, forward, params, given, dtype)
    _, _, width, height = settings.film.window
    image = pixels.T.reshape(height, width, 3).to(torch.float32)
    if cotangents is None:
        return [image]
    wanted = [name for name in names if name in given or name in request.differentiated]
    given = {name: given.get(name, torch.zeros_like(params[name])) for name in wanted}
    products = hessian_products(scene, backward, params, given, dtype, cotangents[0].reshape(-1, 3).T)
    return [image, *(products.get(name) for name in names)]


def _warn_of_edges(missing: Sequence[str], *, all_edges: bool) -> None:
    """Warn of the visibility edges that a gradient leaves out: all (``all_edges``), or those in ``missing``."""
    edges = "all visibility edges (silhouettes and shadow edges that move)"
    if not all_edges:
        if not missing:
            return
        edges = f"some edges: {'; '.join(missing)}"
    warn_caller(f"the gradient leaves out {edges}; see docs/explanations/gradients.md", EdgeWarning)
