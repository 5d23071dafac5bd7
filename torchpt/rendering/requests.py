"""From the arguments of ``render`` to a rendering: validate and complete them, then render, with autograd where needed.

``api.py`` and ``batches`` prepare a :class:`RenderRequest` and execute it. Settings are the keys of a scene file; a call's
other options (``params``, ``ranks``...) are its ``CallArguments``.
Versions are counters of in-place changes, as PyTorch has them: a backward pass refuses a scene that was changed since its
forward pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, Unpack
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.core.autograd import Backward, custom_vjp, is_batched, wants_gradients
from torchpt.core.errors import EdgeWarning, NoLightWarning, RenderError, SceneError, warn_caller
from torchpt.images.denoiser import check_denoiser
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.layers import LAYERS, SurfaceLayer
from torchpt.ranks import together
from torchpt.rendering import Rendering, render_scene
from torchpt.rendering.graphs import reuse_rendering
from torchpt.rendering.result import denoise_rendering
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.formats.description import Description
from torchpt.scene.formats.description import settings as complete_settings
from torchpt.scene.settings import (
    SAMPLERS,
    CallArguments,
    CommonOptions,
    Params,
    RenderOptions,
    SeedOfCall,
    Settings,
    film_keys,
    seed_number,
    settings_of_call,
)
from torchpt.scene.texel_params import update_texels, with_texel_params
from torchpt.scene.validation import params_as_tensors
from torchpt.scene.versions import AFTER, check_unchanged
from torchpt.spec import Refused, Role
from torchpt.spec.arguments import SCENE_VALUE, arguments_of
from torchpt.spec.schema import ResultCache, scene_error

__all__ = [
    "RenderRequest",
    "RequestTemplate",
    "execute_request",
    "prepare_request",
    "prepare_trace_request",
    "template_of",
]

_FLOATS = (torch.float32, torch.float64)
#: Flips bits of a seed, so that backward passes by default draw other numbers than forward passes. (The multiplier of drand48.)
_BACKWARD_SEED = 0x5DEECE66D


@dataclass(frozen=True)
class RenderRequest:
    """A validated request for one picture.

    Attributes:
        caller_scene: the scene that the caller passed.
        scene: the scene to render: the same, or a copy that reads texels where ``params`` replace numbers by images.
        settings: the complete settings.
        call: options of this call that are no settings.
        params: tensors in place of the scene's, and those of the scene's own that require gradients.
        versions: versions of the scene's other parameters when the request was made.
        rays: origins and directions ``(..., 3)``, the pixels of a film of one row; None: the camera's rays.
    """

    caller_scene: Scene
    scene: Scene
    settings: Settings
    call: CallArguments
    params: Mapping[str, Tensor]
    versions: Mapping[str, int] = field(default_factory=dict)
    rays: tuple[Tensor, Tensor] | None = None

    @property
    def differentiated(self) -> tuple[str, ...]:
        """Names of the parameters that are differentiated."""
        return tuple(name for name, value in self.params.items() if wants_gradients(value))

    @property
    def differentiates_rays(self) -> bool:
        """Return True if gradients with respect to rays are needed."""
        return any(wants_gradients(vectors) for vectors in self.rays or ())

    @property
    def needs_gradients(self) -> bool:
        """Return True if the picture requires gradients."""
        return torch.is_grad_enabled() and bool(self.differentiated or self.differentiates_rays or self.scene.weights())

    def with_versions(self) -> RenderRequest:
        """Return a copy that records versions of parameters for :meth:`check_unchanged`."""
        now = self.caller_scene.versions()
        return replace(self, versions={name: version for name, version in now.items() if name not in self.params})

    def check_unchanged(self, since: str) -> None:
        """Raise if the scene changed since its versions were recorded; ``since`` is a phrase for the error.

        Raises:
            RenderError: a parameter of the scene was replaced, or changed in place.
        """
        check_unchanged(self.versions, self.caller_scene.versions(), since)
        update_texels(self.scene, self.caller_scene, self.params)


@dataclass(frozen=True)
class RequestTemplate:
    """What the requests of one scene and options share, checked: all but parameters and seed.

    Attributes:
        settings: the complete settings, with the seed of the options or of the scene file.
        call: options of the call that are no settings, without parameters.
    """

    settings: Settings
    call: CallArguments

    def request(self, scene: Scene, params: Params | None, seed: SeedOfCall) -> RenderRequest:
        """Return the request of a picture.

        Args:
            scene: the scene.
            params: tensors in place of the scene's, by name.
            seed: ``SCENE_VALUE``: that of the settings; None: a new one.

        Raises:
            SceneError: parameters or seed are not accepted.
        """
        settings, full = self.settings, bool(self.call.full)
        if seed is not SCENE_VALUE:
            number = _read_argument("seed", seed_number(seed), "render.seed")
            if number != settings.render.seed:
                settings = replace(settings, render=settings.render.but(seed=number))
        given = _parameters(scene, _read_argument("params", params, "params"), full)
        textured = with_texel_params(scene, given)
        textured.check_own()
        request = RenderRequest(scene, textured, settings, self.call, given)
        return request.with_versions() if request.needs_gradients else request


def template_of(scene: Scene, full: bool, options: Mapping[str, Any]) -> RequestTemplate:
    """Return the template of requests; the latest ones of a scene are kept. ``params`` and ``seed`` are passed over.

    Raises:
        SceneError: an argument is not accepted.
        RenderError: the denoiser is missing.
    """
    shared = {name: value for name, value in options.items() if name not in ("params", "seed")}
    templates, description = _templates.get(scene, (None, None))
    if templates is None or description is not scene.description:
        templates = ResultCache[RequestTemplate](most=8)
        _templates[scene] = templates, scene.description
    return templates.get(full, shared, lambda: _template_of(scene, full, shared))


#: Templates of the latest options of each scene, and the description that they were made for.
_templates: WeakKeyDictionary[Scene, tuple[ResultCache[RequestTemplate], Description]] = WeakKeyDictionary()


def _template_of(scene: Scene, full: bool, options: Mapping[str, Any]) -> RequestTemplate:
    call = CallArguments.of({**options, "full": full})
    _check_device(scene, options.get("device"))
    settings = complete_settings(scene.description, settings_of_call(options))
    if not full:
        settings = _without_aovs(settings, film_keys(options.get("film")))
    elif settings.film.denoise:
        check_denoiser()
    return RequestTemplate(settings, call)


def _read_argument(name: str, value: Any, key: str) -> Any:
    """Return a checked argument of :func:`torchpt.render`; ``key``: of the error."""
    try:
        return arguments_of(RenderOptions)[name].read(value)
    except Refused as error:
        raise scene_error(error, key=key, value=value, file=None) from None


def prepare_request(scene: Scene, full: bool, **options: Unpack[CommonOptions]) -> RenderRequest:
    """Return the request that arguments of ``render`` make.

    Raises:
        SceneError: an argument is not accepted.
        RenderError: the denoiser is missing.
    """
    scene = as_scene(scene)
    seed = options.get("seed", SCENE_VALUE)
    return template_of(scene, full, options).request(scene, options.get("params"), seed)


def prepare_trace_request(scene: Scene, o: Tensor, d: Tensor, **options: Unpack[CommonOptions]) -> RenderRequest:
    """Return the request that arguments of ``trace`` make: a picture whose pixels are the rays.

    Raises:
        SceneError: an argument is not accepted.
    """
    as_scene(scene)
    o, d = _broadcast_rays(scene, o, d)
    options["edges"] = False
    request = prepare_request(scene, full=False, **options)
    settings, sampler = request.settings, request.settings.sampler
    if not settings.integrator.light:
        names_with_light = ", ".join(name for name, kind in INTEGRATORS.items() if kind.light and not kind.splats)
        raise SceneError(
            "integrator.type", settings.integrator.name, f"one of {names_with_light}: along rays there is light alone"
        )
    if settings.integrator.splats:
        raise SceneError("integrator.type", settings.integrator.name, "one without splats, which rays have no film for")
    if sampler.kind.of_film:  # its points are spread over the pixels of a film
        others = ", ".join(name for name in SAMPLERS if not SAMPLERS[name].of_film)
        raise SceneError("sampler.type", sampler.name, f"one of {others}: rays have no places on a film")
    requested = options.get("sampler")
    if isinstance(requested, Mapping) and requested.get("adaptive"):
        raise SceneError("sampler.adaptive", True, "false: rays have the same number of samples")
    if seen := [name for name in options.get("params") or {} if name.startswith("camera.")]:
        raise SceneError("params", seen[0], "none of the camera's, which rays do not come from")
    # The scene file's film and stop rules are for pictures, not for rays.
    settings = replace(
        settings,
        film=settings.film.but(width=d.numel() // 3, height=1, crop=None, aovs=(), denoise=False),
        sampler=replace(sampler, values={key: value for key, value in sampler.values.items() if key != "adaptive"}),
        render=settings.render.without(Role.ENDS | Role.FILES).but(pilots=False),
    )
    params = {name: value for name, value in request.params.items() if not name.startswith("camera.")}
    request = replace(request, settings=settings, params=params, rays=(o, d))
    return request.with_versions() if request.needs_gradients else request


def _broadcast_rays(scene: Scene, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return origins and directions of rays, broadcast to one shape ``(..., 3)``.

    Raises:
        SceneError: not two tensors of floats on the scene's device that broadcast.
    """
    for key, vectors in (("o", o), ("d", d)):
        description = (vectors.dtype, tuple(vectors.shape)) if isinstance(vectors, Tensor) else vectors
        if not isinstance(vectors, Tensor) or vectors.dtype not in _FLOATS or vectors.shape[-1:] != (3,):
            raise SceneError(key, description, "a tensor (..., 3) of float32 or float64")
        if vectors.device != scene.device:
            raise SceneError(key, str(vectors.device), f"a tensor on the scene's device {scene.device}")
    try:
        o, d = torch.broadcast_tensors(o, d)
    except RuntimeError:
        shapes = tuple(o.shape), tuple(d.shape)
        raise SceneError("o, d", shapes, "shapes (..., 3) that are one when they are broadcast") from None
    return o, d


def _parameters(scene: Scene, params: Params | None, full: bool) -> dict[str, Tensor]:
    """Return tensors in place of the scene's parameters, and those of its own that require gradients.

    Raises:
        SceneError: an unknown name, or a value that is no tensor with data. Values are checked later, outside of transforms
            of ``torch.func`` (:mod:`torchpt.core.autograd`).
    """
    given: dict[Any, Any] = dict(params or {})
    for name in given:
        if not isinstance(name, str):
            raise SceneError("params", name, f"names of scene.params such as {next(iter(scene.params))}")
    given = params_as_tensors(scene, given)
    if any(name not in scene.params or not isinstance(value, Tensor) or value.is_meta for name, value in given.items()):
        scene.check(given)
    if full and any(is_batched(value) for value in given.values()):
        raise SceneError("full", True, "False under torch.func.vmap, where a render gives pictures alone")
    if not torch.is_grad_enabled():
        return given
    return {name: value for name, value in scene.params.items() if getattr(value, "requires_grad", False)} | given


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

    def render(params: Mapping[str, Tensor], rays: tuple[Tensor, ...]) -> Rendering:
        if rendered:
            return rendered.pop()
        with nullcontext() if call.ranks is None else call.ranks.together():
            scene.check(params)
        pair = _rays_or_none(rays)
        return reuse_rendering(
            lambda: render_scene(scene, settings, params=params, dtype=call.dtype, ranks=call.ranks, rays=pair)
        )

    if request.needs_gradients:
        rendering = _differentiable(request, render, share)
    elif request.params or request.rays is not None:
        rendering = _constant(request, render)
    else:
        rendering = render({}, ())
    if settings.film.denoise:
        denoise_rendering(rendering, settings)
    if rendering.relmse_unknown:
        warn_caller(f"the picture's error is not known: {rendering.relmse_unknown}", NoLightWarning)
    return rendering


def _without_aovs(settings: Settings, film: Mapping[str, Any] | None) -> Settings:
    """Return settings without AOVs and denoising, which a tensor cannot hold; a scene file may ask for them.

    Raises:
        SceneError: the caller asks for them.
    """
    if (film or {}).get("aovs") and settings.integrator.light:  # else the picture is a layer
        raise SceneError("film.aovs", settings.film.aovs, "none, or full=True: a tensor is one picture, without layers")
    if (film or {}).get("denoise") and settings.film.denoise:
        expected = "false, or full=True: a tensor is one picture; hand it to torchpt.denoise with its layers"
        raise SceneError("film.denoise", True, expected)
    aovs = settings.film.aovs
    if settings.integrator.light:  # variance stays: it decides how samples are drawn
        aovs = tuple(name for name in aovs if not issubclass(LAYERS[name], SurfaceLayer))
    return replace(settings, film=settings.film.but(denoise=False, aovs=aovs))


def _check_device(scene: Scene, device: str | torch.device | None) -> None:
    """Raise SceneError for another device than the scene's."""
    if device not in (None, "auto") and not _same_device(device, scene.device):
        raise SceneError("device", str(device), f"the scene's own device {scene.device}; load the scene on the other")


def _same_device(requested: str | torch.device, own: torch.device) -> bool:
    """Return True if ``requested`` names device ``own``."""
    try:
        device = torch.device(requested)
    except RuntimeError:
        return False
    return device.type == own.type and device.index in (None, own.index or 0)


def _rays_or_none(rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor] | None:
    """Return origins and directions of rays; None for none."""
    return (rays[0], rays[1]) if rays else None


#: Renders given parameters, and no or two tensors of rays, without gradients.
_RenderWithoutGradients = Callable[[Mapping[str, Tensor], tuple[Tensor, ...]], Rendering]


def _differentiable(
    request: RenderRequest,
    render: _RenderWithoutGradients,
    share: Callable[[Backward, tuple[Tensor, ...]], Backward] | None,
) -> Rendering:
    """Return a rendering whose picture has gradients with respect to parameters and rays; ``render`` makes it without.

    ``share``: as for :func:`execute_request`.
    """
    from torchpt import gradients as adjoint
    from torchpt.gradients import edges

    scene, settings, call, params = request.scene, request.settings, request.call, request.params
    wanted, dtype, ranks = request.differentiated, call.dtype, call.ranks
    seed = settings.render.seed ^ _BACKWARD_SEED if call.seed_grad is None else call.seed_grad
    if not settings.integrator.light:
        names_with_light = ", ".join(name for name in INTEGRATORS if INTEGRATORS[name].light)
        raise SceneError(
            "integrator.type", settings.integrator.name, f"one of {names_with_light} where gradients are wanted"
        )
    if settings.render.checkpoint is not None:
        raise SceneError("render.checkpoint", settings.render.checkpoint, "null where gradients are wanted")
    differentiates_rays = request.differentiates_rays
    # Geometry is differentiated: directions and distances along paths need derivatives.
    attached = differentiates_rays or adjoint.attached(scene, wanted)
    if differentiates_rays or edges.concerns(scene, wanted):
        _warn_of_edges(edges.left_out(scene, settings), all_edges=not call.edges)
    for name in edges.without_gradient(scene, wanted):
        said = f"{name} changes the picture by jumps alone, which are not differentiated: its gradient is 0"
        warn_caller(said, EdgeWarning)
    names = (*wanted, *(name for name in params if name not in wanted))  # of the tensors, before the rays
    # Lists of one, which the closures below fill and read.
    made: list[Rendering] = []
    forward_spp: list[int] = []

    def params_of(*tensors: Tensor) -> dict[str, Tensor]:
        return dict(zip(names, tensors, strict=False))  # without the rays, which follow

    def forward(*tensors: Tensor) -> tuple[Tensor]:
        made.append(render(params_of(*tensors), tensors[len(names) :]))
        return (made[-1].image,)

    def backward_pass(cotangents: tuple[Tensor, ...], *tensors: Tensor) -> list[Tensor | None]:
        cotangent = cotangents[0].reshape(-1, 3).T  # (3, H W)
        request.check_unchanged(AFTER)
        with together(ranks, "the loss", lambda: cotangent.detach().cpu().contiguous().numpy().tobytes()):
            return gradients(cotangent, *tensors)

    def gradients(cotangent: Tensor, *tensors: Tensor) -> list[Tensor | None]:
        given, edge_spp = params_of(*tensors), edge_samples()
        # A backward pass with the seed and samples of the forward pass is the exact derivative of its estimator.
        backward = backward_settings().render
        exact = backward.seed == settings.render.seed and backward.spp == forward_spp[0]
        # Otherwise first hits may be held in place while the camera moves (gradients/camera.py).
        film_space = not exact and adjoint.film_space_applies(scene, settings, wanted)
        rays = _rays_or_none(tensors[len(names) :])
        grads = adjoint.gradients(
            scene,
            backward_settings(),
            given,
            wanted,
            dtype,
            attached=attached,
            method=call.adjoint,
            cotangent=cotangent,
            film_space=film_space,
            ranks=ranks,
            rays=rays,
            differentiates_rays=differentiates_rays,
        )
        if edge_spp and edges.concerns(scene, wanted):
            width, height = film_size()
            on_film = cotangent.T.reshape(height, width, 3)
            edge_grads = edges.add_gradients(
                scene, backward_settings(spp=1), given, wanted, dtype, on_film, edge_spp, film_space, ranks
            )
            grads[: len(wanted)] = [a if b is None else a + b for a, b in zip(grads, edge_grads, strict=False)]
        no_grads = [None] * (len(tensors) - len(wanted) - (2 if differentiates_rays else 0))
        return [*grads[: len(wanted)], *no_grads, *grads[len(wanted) :]]

    def backward_settings(spp: int | None = None) -> Settings:
        """Return the settings of the backward pass: its seed, and its samples a pixel."""
        spp = spp or call.spp_grad or forward_spp[0]
        return replace(settings, render=settings.render.but(seed=seed, spp=spp))

    def film_size() -> tuple[int, int]:
        """Return the width and the height of the picture."""
        _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
        return width, height

    def edge_samples() -> float:
        """Return the samples a pixel for visibility edges; 0: none."""
        if not call.edges:
            return 0
        return call.edge_spp or edges.samples_for(
            scene, wanted, call.spp_grad or forward_spp[0], math.prod(film_size())
        )

    def edge_request() -> edges.Asked:
        request.check_unchanged(AFTER)
        return edges.Asked(scene, backward_settings(), wanted, dtype, edge_samples())

    tensors = (*(params[name] for name in names), *(request.rays or ()))

    def second(
        tangents: Sequence[Tensor | None], cotangents: tuple[Tensor, ...] | None, *given: Tensor
    ) -> list[Tensor | None]:
        spp = forward_spp[0] if forward_spp else max(made[-1].spp, 1)
        return _second(request, spp, backward_settings(call.spp_grad or spp), names, tangents, cotangents, given)

    backward = backward_pass if share is None else share(backward_pass, tensors)
    (image,) = custom_vjp(forward, backward, tensors, scene.weights(), second)
    rendering = made[-1]
    made.clear()  # autograd keeps the closures alive: they must not hold pictures
    forward_spp.append(max(rendering.spp, 1))
    layers = edges.followed(settings)
    if layers:
        values = {name: rendering.layers[name] for name in layers}
        rendering.layers |= edges.differentiable(values, tensors, edge_request, params_of)
    return replace(rendering, image=image)


def _second(
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
    from torchpt.gradients import second

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
    pixels = second.jvp(scene, forward, params, given, dtype)
    _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
    image = pixels.T.reshape(height, width, 3).to(torch.float32)
    if cotangents is None:
        return [image]
    wanted = [name for name in names if name in given or name in request.differentiated]
    given = {name: given.get(name, torch.zeros_like(params[name])) for name in wanted}
    products = second.hessian_products(scene, backward, params, given, dtype, cotangents[0].reshape(-1, 3).T)
    return [image, *(products.get(name) for name in names)]


def _constant(request: RenderRequest, render: _RenderWithoutGradients) -> Rendering:
    """Return a rendering without gradients; parameters and rays may be wrapped by transforms of ``torch.func``."""
    params, made, settings = request.params, list[Rendering](), request.settings

    def forward(*tensors: Tensor) -> tuple[Tensor]:
        made.append(render(dict(zip(params, tensors, strict=False)), tensors[len(params) :]))
        return (made[-1].image,)

    def second(
        tangents: Sequence[Tensor | None], cotangents: tuple[Tensor, ...] | None, *given: Tensor
    ) -> list[Tensor | None]:
        return _second(request, max(made[-1].spp, 1), settings, list(params), tangents, cotangents, given)

    def backward(*_: Any) -> Sequence[Tensor | None]:
        # Autograd gets here from a JVP alone: parameters of a constant do not require gradients.
        raise RenderError(
            "render has no derivatives of a JVP by its tangent where the parameter is a constant:"
            " take torch.func.vjp of the picture"
        )

    (image,) = custom_vjp(forward, backward, (*params.values(), *(request.rays or ())), (), second)
    return replace(made[-1], image=image)


def _warn_of_edges(missing: Sequence[str], *, all_edges: bool) -> None:
    """Warn of the visibility edges that a gradient leaves out: all (``all_edges``), or those in ``missing``."""
    edges = "all visibility edges (silhouettes and shadow edges that move)"
    if not all_edges:
        if not missing:
            return
        edges = f"some edges: {'; '.join(missing)}"
    warn_caller(f"the gradient leaves out {edges}; see docs/explanations/gradients.md", EdgeWarning)
