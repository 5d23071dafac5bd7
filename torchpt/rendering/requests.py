"""From the arguments of ``render`` to a rendering: what is asked for is checked, completed and made, on a tape or without."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from typing import Any, Unpack

import torch
from torch import Tensor

from torchpt.core.autograd import custom_vjp, is_batched, wants_gradients
from torchpt.core.errors import EdgeWarning, NoLightWarning, SceneError, warn_caller
from torchpt.images.denoiser import check_denoiser
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.layers import LAYERS, SurfaceLayer
from torchpt.ranks import together
from torchpt.rendering import Rendering, render_scene
from torchpt.rendering.graphs import reuse_rendering
from torchpt.rendering.result import denoise_rendering
from torchpt.scene import Scene
from torchpt.scene.entry import as_scene
from torchpt.scene.formats.description import settings as complete
from torchpt.scene.settings import SAMPLERS, CallArguments, CommonOptions, Settings, settings_of_call
from torchpt.scene.texel_params import update_texels, with_texel_params
from torchpt.scene.versions import AFTER, check_unchanged
from torchpt.spec import Role

__all__ = ["RenderRequest", "execute_request", "prepare_request", "prepare_trace_request"]

_FLOATS = (torch.float32, torch.float64)


@dataclass(frozen=True)
class RenderRequest:
    """A picture that was asked for: checked, complete, and not begun.

    Attributes:
        given: the scene as the caller has it.
        scene: what is rendered: the same, or one that reads texels where that has numbers.
        settings: how.
        call: what the arguments say beside settings.
        params: tensors in place of the scene's, those of its own that want gradients among them.
        versions: of the scene's own parameters, but for those that ``params`` stand for, as they were.
        rays: origins and directions ``(..., 3)`` in place of the camera's, pixels of a film of one row; None: the camera's.
    """

    given: Scene
    scene: Scene
    settings: Settings
    call: CallArguments
    params: Mapping[str, Tensor]
    versions: Mapping[str, int] = field(default_factory=dict)
    rays: tuple[Tensor, Tensor] | None = None

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the parameters that are differentiated."""
        return tuple(name for name, value in self.params.items() if wants_gradients(value))

    @property
    def differentiates_rays(self) -> bool:
        """Return True where rays are differentiated."""
        return any(wants_gradients(vectors) for vectors in self.rays or ())

    @property
    def needs_gradients(self) -> bool:
        """Return True where the picture is to carry gradients."""
        return torch.is_grad_enabled() and bool(self.wanted or self.differentiates_rays or self.scene.weights())

    def with_versions(self) -> RenderRequest:
        """The same, with what :meth:`check_unchanged` compares."""
        now = self.given.versions()
        return replace(self, versions={name: edition for name, edition in now.items() if name not in self.params})

    def check_unchanged(self, since: str) -> None:
        """Refuse to go on with another scene than it was when it was noted; ``since`` is for the error.

        Raises:
            RenderError: one of the scene's own parameters was replaced, or changed in place.
        """
        check_unchanged(self.versions, self.given.versions(), since)
        update_texels(self.scene, self.given, self.params)


def prepare_request(scene: Scene, full: bool, **options: Unpack[CommonOptions]) -> RenderRequest:
    """Return what the arguments of ``render`` ask for.

    Raises:
        SceneError: one that is not accepted.
        RenderError: a denoiser that is not there.
    """
    scene = as_scene(scene)
    call = CallArguments.of({**options, "full": full})
    _check(scene, call, options.get("device"))
    settings = complete(scene.description, settings_of_call(options))
    if not full:
        settings = _without_aovs(settings, options.get("film"))
    elif settings.film.denoise:
        check_denoiser()
    params = _parameters(scene, call.params, full)
    textured = with_texel_params(scene, params)
    textured.check_own()
    request = RenderRequest(scene, textured, settings, call, params)
    return request.with_versions() if request.needs_gradients else request


def prepare_trace_request(scene: Scene, o: Tensor, d: Tensor, **options: Unpack[CommonOptions]) -> RenderRequest:
    """Return what the arguments of ``trace`` ask for: a picture whose pixels are the rays.

    Raises:
        SceneError: one that is not accepted.
    """
    as_scene(scene)
    o, d = _broadcast(scene, o, d)
    options["edges"] = False
    request = prepare_request(scene, False, **options)
    settings, sampler = request.settings, request.settings.sampler
    if not settings.integrator.light:
        radiant = ", ".join(name for name in INTEGRATORS if INTEGRATORS[name].light)
        raise SceneError(
            "integrator.type", settings.integrator.name, f"one of {radiant}: along rays there is light alone"
        )
    if settings.integrator.splats:
        raise SceneError("integrator.type", settings.integrator.name, "one without splats, which rays have no film for")
    if sampler.kind.of_film:
        others = ", ".join(name for name in SAMPLERS if not SAMPLERS[name].of_film)
        raise SceneError("sampler.type", sampler.name, f"one of {others}: rays have no places on a film")
    wished = options.get("sampler")
    if isinstance(wished, Mapping) and wished.get("adaptive"):
        raise SceneError("sampler.adaptive", True, "false: rays have the same number of samples")
    if seen := [name for name in options.get("params") or {} if name.startswith("camera.")]:
        raise SceneError("params", seen[0], "none of the camera's, which rays do not come from")
    # What a scene file says of its picture, and of when that is done, is not meant for rays.
    settings = replace(
        settings,
        film=settings.film.but(width=d.numel() // 3, height=1, crop=None, aovs=(), denoise=False),
        sampler=replace(sampler, values={key: value for key, value in sampler.values.items() if key != "adaptive"}),
        render=settings.render.without(Role.ENDS | Role.FILES).but(pilots=False),
    )
    params = {name: value for name, value in request.params.items() if not name.startswith("camera.")}
    request = replace(request, settings=settings, params=params, rays=(o, d))
    return request.with_versions() if request.needs_gradients else request


def _broadcast(scene: Scene, o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Return origins and directions of rays in one shape ``(..., 3)``.

    Raises:
        SceneError: no such tensors, or on another device than the scene.
    """
    for key, vectors in (("o", o), ("d", d)):
        form = (vectors.dtype, tuple(vectors.shape)) if isinstance(vectors, Tensor) else vectors
        if not isinstance(vectors, Tensor) or vectors.dtype not in _FLOATS or vectors.shape[-1:] != (3,):
            raise SceneError(key, form, "a tensor (..., 3) of float32 or float64")
        if vectors.device != scene.device:
            raise SceneError(key, str(vectors.device), f"a tensor on the scene's device {scene.device}")
    try:
        o, d = torch.broadcast_tensors(o, d)
    except RuntimeError:
        shapes = tuple(o.shape), tuple(d.shape)
        raise SceneError("o, d", shapes, "shapes (..., 3) that are one when they are broadcast") from None
    return o, d


def _parameters(scene: Scene, params: Mapping[str, Tensor] | None, full: bool) -> dict[str, Tensor]:
    """Return parameters in place of the scene's, those of its own that want gradients among them.

    Raises:
        SceneError: an unknown name, or no tensor that holds numbers. All else is checked where they are plain tensors
            (:mod:`torchpt.core.autograd`).
    """
    given = dict(params or {})
    if any(name not in scene.params or not isinstance(value, Tensor) or value.is_meta for name, value in given.items()):
        scene.check(given)
    if full and any(is_batched(value) for value in given.values()):
        raise SceneError("full", True, "False under torch.func.vmap, where a render gives pictures alone")
    if not torch.is_grad_enabled():
        return given
    return {name: value for name, value in scene.params.items() if getattr(value, "requires_grad", False)} | given


def execute_request(request: RenderRequest, made: list[Rendering] | None = None) -> Rendering:
    """The rendering that was asked for, on a tape where one is wanted, and denoised where that is.

    ``made``: a list of the rendering alone, without gradients, where it is there already; it is taken out.

    Raises:
        SceneError: a parameter that is not accepted.
    """
    scene, settings, call = request.scene, request.settings, request.call

    def render(params: Mapping[str, Tensor], rays: tuple[Tensor, ...]) -> Rendering:
        if made:
            return made.pop()
        with nullcontext() if call.ranks is None else call.ranks.together():
            scene.check(params)
        given = _pair(rays)
        return reuse_rendering(
            lambda: render_scene(scene, settings, params=params, dtype=call.dtype, ranks=call.ranks, rays=given)
        )

    if request.needs_gradients:
        rendering = _differentiable(request, render)
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
    """Settings of a render that returns a tensor; a scene file's wishes for layers and to denoise are for files.

    Raises:
        SceneError: such a wish of the caller's own.
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


def _check(scene: Scene, call: CallArguments, device: str | torch.device | None) -> None:
    """Refuse arguments of :func:`render` that do not fit the scene."""
    for name in call.params or {}:
        if not isinstance(name, str):
            raise SceneError("params", name, f"names of scene.params such as {next(iter(scene.params))}")
    if device not in (None, "auto") and not _same_device(device, scene.device):
        raise SceneError("device", str(device), f"the scene's own device {scene.device}; load the scene on the other")


def _same_device(requested: str | torch.device, own: torch.device) -> bool:
    """Return True where a wish for a device names the one that a scene is on."""
    try:
        device = torch.device(requested)
    except RuntimeError:
        return False
    return device.type == own.type and device.index in (None, own.index or 0)


def _pair(rays: tuple[Tensor, ...]) -> tuple[Tensor, Tensor] | None:
    """Return origins and directions of rays; None where there are none."""
    return (rays[0], rays[1]) if rays else None


#: Makes a rendering of parameters and rays, without a tape.
_Make = Callable[[Mapping[str, Tensor], tuple[Tensor, ...]], Rendering]


def _differentiable(request: RenderRequest, render: _Make) -> Rendering:
    """Return a rendering whose picture is on a tape from the parameters and rays wanted; ``render`` makes it without."""
    from torchpt import gradients as adjoint
    from torchpt.gradients import edges

    scene, settings, call, params = request.scene, request.settings, request.call, request.params
    wanted, dtype, ranks = request.wanted, call.dtype, call.ranks
    seed = settings.render.seed ^ 0x5DEECE66D if call.seed_grad is None else call.seed_grad
    if not settings.integrator.light:
        radiant = ", ".join(name for name in INTEGRATORS if INTEGRATORS[name].light)
        raise SceneError("integrator.type", settings.integrator.name, f"one of {radiant} where gradients are wanted")
    if settings.render.checkpoint is not None:
        raise SceneError("render.checkpoint", settings.render.checkpoint, "null where gradients are wanted")
    differentiates_rays = request.differentiates_rays
    attached = differentiates_rays or adjoint.attached(scene, wanted)
    if differentiates_rays or edges.concerns(scene, wanted):
        _warn_of_edges(edges.left_out(scene, settings), not call.edges)
    for name in edges.without_gradient(scene, wanted):
        said = f"{name} changes the picture by jumps alone, which are not differentiated: its gradient is 0"
        warn_caller(said, EdgeWarning)
    names = (*wanted, *(name for name in params if name not in wanted))
    made: list[Rendering] = []
    taken: list[int] = []

    def given_by(*tensors: Tensor) -> dict[str, Tensor]:
        return dict(zip(names, tensors, strict=False))  # rays follow

    def forward(*tensors: Tensor) -> tuple[Tensor]:
        made.append(render(given_by(*tensors), tensors[len(names) :]))
        return (made[-1].image,)

    def backward_pass(cotangents: tuple[Tensor, ...], *tensors: Tensor) -> list[Tensor | None]:
        cotangent = cotangents[0].reshape(-1, 3).T  # (3, H W)
        request.check_unchanged(AFTER)
        with together(ranks, "the loss", lambda: cotangent.detach().cpu().contiguous().numpy().tobytes()):
            return gradients(cotangent, *tensors)

    def gradients(cotangent: Tensor, *tensors: Tensor) -> list[Tensor | None]:
        given, of_edges = given_by(*tensors), edges_taken()
        # One pass that is a derivative of the very estimator takes its own samples again.
        own = again().render
        exact = own.seed == settings.render.seed and own.spp == taken[0]
        held = not exact and adjoint.film_space_applies(scene, settings, wanted)
        rays = _pair(tensors[len(names) :])
        found = adjoint.gradients(
            scene,
            again(),
            given,
            wanted,
            dtype,
            attached,
            call.adjoint,
            cotangent,
            held,
            ranks,
            rays,
            differentiates_rays,
        )
        if of_edges and edges.concerns(scene, wanted):
            _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
            moved = edges.add_gradients(
                scene, again(1), given, wanted, dtype, cotangent.T.reshape(height, width, 3), of_edges, held, ranks
            )
            found[: len(wanted)] = [a if b is None else a + b for a, b in zip(found, moved, strict=False)]
        still = [None] * (len(tensors) - len(wanted) - (2 if differentiates_rays else 0))
        return [*found[: len(wanted)], *still, *found[len(wanted) :]]

    def again(spp: int | None = None) -> Settings:
        spp = spp or call.spp_grad or taken[0]
        return replace(settings, render=settings.render.but(seed=seed, spp=spp))

    def edges_taken() -> int:
        return (call.edge_spp or call.spp_grad or taken[0]) if call.edges else 0

    def asked() -> edges.Asked:
        request.check_unchanged(AFTER)
        return edges.Asked(scene, again(), wanted, dtype, edges_taken())

    tensors = (*(params[name] for name in names), *(request.rays or ()))
    (image,) = custom_vjp(forward, backward_pass, tensors, scene.weights())
    rendering = made[-1]
    made.clear()  # the tape keeps the closures, which are not to keep pictures
    taken.append(max(rendering.spp, 1))
    layers = edges.followed(settings)
    if layers:
        values = {name: rendering.layers[name] for name in layers}
        rendering.layers |= edges.differentiable(values, tensors, asked, given_by)
    return replace(rendering, image=image)


def _constant(request: RenderRequest, render: _Make) -> Rendering:
    """Return a rendering without gradients, of parameters and rays that may still be those of a transform of ``torch.func``."""
    params, made = request.params, list[Rendering]()

    def forward(*tensors: Tensor) -> tuple[Tensor]:
        made.append(render(dict(zip(params, tensors, strict=False)), tensors[len(params) :]))
        return (made[-1].image,)

    (image,) = custom_vjp(forward, lambda *_: (), (*params.values(), *(request.rays or ())), ())
    return replace(made[-1], image=image)


def _warn_of_edges(missing: Sequence[str], every: bool) -> None:
    """Say which visibility edges (``every`` one, or those that are ``missing``) a gradient leaves out."""
    edges = "all visibility edges (silhouettes and shadow edges that move)"
    if not every:
        if not missing:
            return
        edges = f"some edges: {'; '.join(missing)}"
    warn_caller(f"the gradient leaves out {edges}; see docs/explanations/gradients.md", EdgeWarning)
