"""From the arguments of ``render`` to a request for a rendering: validate and complete them.

``api.py`` and ``batches`` prepare a :class:`RenderRequest`, and ``execution.py`` executes it. Settings are the keys of a scene
file; a call's other options (``params``, ``ranks``...) are its ``CallArguments``.
Versions are counters of in-place changes, as PyTorch has them: a backward pass refuses a scene that was changed since its
forward pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Unpack
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.core.autograd import is_batched, wants_gradients
from torchpt.core.errors import SceneError
from torchpt.images.denoiser import check_denoiser
from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.paths.layers import LAYERS, SurfaceLayer
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
    with_plain_numbers,
)
from torchpt.scene.texel_params import update_texels, with_texel_params
from torchpt.scene.validation import params_as_tensors
from torchpt.scene.versions import check_unchanged
from torchpt.spec import Refused, Role
from torchpt.spec.arguments import SCENE_VALUE, arguments_of
from torchpt.spec.schema import ResultCache, scene_error

__all__ = [
    "RenderRequest",
    "RequestTemplate",
    "check_options",
    "prepare_request",
    "prepare_trace_request",
    "template_of",
]

_FLOATS = (torch.float32, torch.float64)


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
    """The part that requests of one scene and options share, checked: all but parameters and seed.

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
    options = with_plain_numbers(options)
    shared = {name: value for name, value in options.items() if name not in ("params", "seed")}
    templates, description = _templates.get(scene, (None, None))
    if templates is None or description is not scene.description:
        templates = ResultCache[RequestTemplate](most=8)
        _templates[scene] = templates, scene.description
    return templates.get(full, shared, lambda: _template_of(scene, full, shared))


#: Templates of the latest options of each scene, and the description that they were made for.
_templates: WeakKeyDictionary[Scene, tuple[ResultCache[RequestTemplate], Description]] = WeakKeyDictionary()


def _template_of(scene: Scene, full: bool, options: Mapping[str, Any]) -> RequestTemplate:
    call, settings = check_options(scene, {**options, "full": full})
    _check_device(scene, options.get("device"))
    if not full:
        settings = _without_aovs(settings, film_keys(options.get("film")))
    elif settings.film.denoise:
        check_denoiser()
    return RequestTemplate(settings, call)


def check_options(scene: Scene, options: Mapping[str, Any]) -> tuple[CallArguments, Settings]:
    """Return the two kinds of options of a call on a scene, once they are checked; ``device`` is passed over.

    Raises:
        SceneError: an argument is not accepted.
    """
    options = with_plain_numbers(options)
    call = CallArguments.of(options)
    if call.edge_guide is not None and not call.edges:
        raise SceneError("edge_guide", call.edge_guide, "None where edges is False")
    return call, complete_settings(scene.description, settings_of_call(options))


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
    # Again: without the camera's parameters more of the scene's own count.
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
            raise SceneError("params", name, f"names of scene.params such as {next(iter(scene.raw_params))}")
    given = params_as_tensors(scene, given)
    if any(
        name not in scene.raw_params or not isinstance(value, Tensor) or value.is_meta for name, value in given.items()
    ):
        scene.check(given)
    if full and any(is_batched(value) for value in given.values()):
        raise SceneError("full", True, "False under torch.func.vmap, where a render gives pictures alone")
    if not torch.is_grad_enabled():
        return given
    return {name: value for name, value in scene.raw_params.items() if getattr(value, "requires_grad", False)} | given


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
