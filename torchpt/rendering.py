"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal, TypedDict, Unpack, overload

import torch
from torch import Tensor

from torchpt import adjoint as adjoints
from torchpt.edges import Asked, add_gradients, concerns, followed, left_out, on_tape, without_gradient
from torchpt.errors import EdgeWarning, SceneError
from torchpt.format.description import settings as complete
from torchpt.forward import Progress, Rendering, Run, limited_threads
from torchpt.forward.split import stamp
from torchpt.graphs import known, opaque
from torchpt.images.denoiser import check_denoiser, denoise
from torchpt.integrators import KINDS as INTEGRATORS
from torchpt.native.modes import undisturbed
from torchpt.ranks import Group, together
from torchpt.scene import Scene
from torchpt.scene.textured import with_texels
from torchpt.settings import FILTERS, Settings
from torchpt.spec.declared import Described
from torchpt.taped import in_batch, wants_gradients

__all__ = ["Progress", "Rendering", "Wishes", "first_hit", "render", "render_scene"]


class Wishes(TypedDict, total=False):
    """The other arguments of :func:`render`, for type checkers."""

    spp: int | None
    seed: int | None
    integrator: str | Mapping[str, Any] | None
    sampler: str | Mapping[str, Any] | None
    film: Mapping[str, Any] | None
    params: Mapping[str, Tensor] | None
    time_limit: float | None
    target_error: float | None
    pilots: bool | str | None
    checkpoint: str | None
    resume: bool | None
    accel: str | None
    compile: str | bool | None
    threads: int | str | None
    max_memory: int | str | None
    device: str | torch.device | None
    dtype: torch.dtype
    adjoint: str | None
    seed_grad: int | None
    spp_grad: int | None
    edges: bool
    edge_spp: int | None
    ranks: Group | None


@overload
def render(scene: Scene, *, full: Literal[False] = False, **wishes: Unpack[Wishes]) -> Tensor: ...
@overload
def render(scene: Scene, *, full: Literal[True], **wishes: Unpack[Wishes]) -> Rendering: ...
@overload
def render(scene: Scene, *, full: bool, **wishes: Unpack[Wishes]) -> Tensor | Rendering: ...
@opaque
def render(
    scene: Scene,
    *,
    spp: int | None = None,
    seed: int | None = None,
    integrator: str | Mapping[str, Any] | None = None,
    sampler: str | Mapping[str, Any] | None = None,
    film: Mapping[str, Any] | None = None,
    params: Mapping[str, Tensor] | None = None,
    full: bool = False,
    time_limit: float | None = None,
    target_error: float | None = None,
    pilots: bool | str | None = None,
    checkpoint: str | None = None,
    resume: bool | None = None,
    accel: str | None = None,
    compile: str | bool | None = None,
    threads: int | str | None = None,
    max_memory: int | str | None = None,
    device: str | torch.device | None = None,
    dtype: torch.dtype = torch.float32,
    adjoint: str | None = None,
    seed_grad: int | None = None,
    spp_grad: int | None = None,
    edges: bool = True,
    edge_spp: int | None = None,
    ranks: Group | None = None,
) -> Tensor | Rendering:
    """Render a scene to linear RGB ``(H, W, 3)`` on the scene's device; differentiable in ``params``.

    Main arguments:
        scene: from :func:`torchpt.load`.
        spp: samples a pixel; the most of them where ``time_limit`` or ``target_error`` may end it.
        seed: any integer from 0; the same seed gives the same picture.
        params: tensors in place of ``scene.params`` by dotted name; in a material's number or colour also texels ``(H, W, C)``.
            Where one of them requires gradients, so does the picture.
        full: True returns a :class:`torchpt.Rendering`: picture, layers, error, counts and seconds as one object.

    Other arguments, all as in the scene file; ``None`` keeps the scene's own wish:
        integrator, sampler: a type or a mapping with ``type``.
        film: a mapping; ``denoise`` needs ``full``: a tensor is one picture (see :func:`torchpt.denoise`).
        time_limit, target_error: seconds of sampling, and a relMSE, that end the render.
        pilots: True: the picture knows its error (``relmse`` of a ``full`` one), by one pixel of 16 sampled twice; ``auto``:
            where ``target_error`` or ``sampler.adaptive`` ask for it.
        checkpoint, resume: a file where the state of a long render is kept, and whether to go on from it; not where gradients
            are wanted.
        accel, compile, threads, max_memory: of ``render``.
        device: must be the scene's own; load the scene on the device where it is to render.
        dtype: of the lanes. float64 is for checking derivatives; the search stays float32.
        adjoint: how gradients are taken: ``replay`` (the default) traces paths again in the backward pass and goes back along
            them vertex by vertex, so that memory grows with neither depth nor samples; ``autograd`` runs each chunk of
            pixels again under a plain tape.
        seed_grad, spp_grad: of the backward pass. By default it draws samples of its own, as many as the forward pass took:
            shared samples would bias the gradient of a squared loss.
        edges: whether silhouettes and shadow edges that move are differentiated (docs/gradients.md); False warns.
        edge_spp: samples of edges a pixel, for each of their estimators; by default as many as the backward pass takes.
        ranks: a :class:`torchpt.ranks.Group` whose processes share the work; each gets all of the picture (docs/ranks.md).

    Raises:
        SceneError: a setting or parameter that is not accepted.
        RenderError: a device, compiler or denoiser that is not there; a rank that is lost, or at something else.
    """
    numbers = {"seed_grad": (seed_grad, 0), "spp_grad": (spp_grad, 1), "edge_spp": (edge_spp, 1)}
    _check(scene, device, dtype, adjoint, numbers)
    given = {
        "spp": spp, "seed": seed, "accel": accel, "compile": compile, "threads": threads, "max_memory": max_memory,
        "time_limit": time_limit, "target_error": target_error, "pilots": pilots,
        "checkpoint": checkpoint, "resume": resume,
    }  # fmt: skip
    wishes = {"film": film, "integrator": integrator, "sampler": sampler, "render": given}
    settings = complete(scene.description, wishes)
    if not full:
        settings = _of_one_picture(settings, film)
    elif settings.film.denoise:
        check_denoiser()
    params = _given(scene, params, full)
    scene = with_texels(scene, params)
    backward = {"seed": seed_grad, "spp": spp_grad, "edges": edge_spp if edges else 0}
    rendering = _rendered(scene, settings, backward, params, dtype, adjoint or adjoints.KINDS[0], ranks)
    return rendering if full else rendering.image


def _given(scene: Scene, params: Mapping[str, Tensor] | None, full: bool) -> dict[str, Tensor]:
    """Parameters in place of the scene's, those of its own that want gradients among them.

    Raises:
        SceneError: an unknown name, or no tensor. All else is checked where they are plain tensors (:mod:`torchpt.taped`).
    """
    given = dict(params or {})
    if any(name not in scene.params or not isinstance(value, Tensor) for name, value in given.items()):
        scene.check(given)
    if full and any(in_batch(value) for value in given.values()):
        raise SceneError("full", True, "False under torch.func.vmap, where a render gives pictures alone")
    if not torch.is_grad_enabled():
        return given
    return {name: value for name, value in scene.params.items() if value.requires_grad} | given


def _rendered(
    scene: Scene,
    settings: Settings,
    backward: Mapping[str, int | None],
    params: Mapping[str, Tensor],
    dtype: torch.dtype,
    adjoint: str,
    ranks: Group | None,
) -> Rendering:
    """A rendering, on a tape where one is wanted, and denoised where that is; ``backward``: see :func:`_differentiable`."""
    wanted = tuple(name for name, value in params.items() if wants_gradients(value))
    if not (wanted or scene.weights()) or not torch.is_grad_enabled():
        rendering = _constant(scene, settings, params, dtype, ranks)
    else:
        seed = settings.render.seed ^ 0x5DEECE66D if backward["seed"] is None else backward["seed"]
        rendering = _differentiable(scene, settings, {**backward, "seed": seed}, params, wanted, dtype, adjoint, ranks)
    if settings.film.denoise:
        with limited_threads(settings.render.threads):
            rendering.denoised = denoise(rendering.image.detach(), **rendering.guides)
    return rendering


def _of_one_picture(settings: Settings, film: Mapping[str, Any] | None) -> Settings:
    """Settings of a render that returns a tensor; a scene file's wishes for layers and to denoise are for files.

    Raises:
        SceneError: such a wish of the caller's own.
    """
    if (film or {}).get("aovs") and settings.integrator.light:  # else the picture is a layer
        raise SceneError("film.aovs", settings.film.aovs, "none, or full=True: a tensor is one picture, without layers")
    if (film or {}).get("denoise") and settings.film.denoise:
        expected = "false, or full=True: a tensor is one picture; hand it to torchpt.denoise with its layers"
        raise SceneError("film.denoise", True, expected)
    return replace(settings, film=settings.film.but(denoise=False))


def _check(
    scene: Scene,
    device: str | torch.device | None,
    dtype: torch.dtype,
    adjoint: str | None,
    numbers: Mapping[str, tuple[int | None, int]],
) -> None:
    """Refuse arguments of :func:`render` that are no settings; ``numbers`` are whole, with the least of each."""
    if device not in (None, "auto") and not _same(device, scene.device):
        raise SceneError("device", str(device), f"the scene's own device {scene.device}; load the scene on the other")
    if dtype not in (torch.float32, torch.float64):
        raise SceneError("dtype", dtype, "torch.float32 or torch.float64")
    if adjoint not in (None, *adjoints.KINDS):
        raise SceneError("adjoint", adjoint, " or ".join(adjoints.KINDS))
    for key, (value, low) in numbers.items():
        if value is not None and (type(value) is not int or value < low):
            raise SceneError(key, value, f"a whole number >= {low}")


def _same(wish: str | torch.device, own: torch.device) -> bool:
    """Whether a wish for a device names the one that a scene is on."""
    try:
        device = torch.device(wish)
    except RuntimeError:
        return False
    return device.type == own.type and device.index in (None, own.index or 0)


def _differentiable(
    scene: Scene,
    settings: Settings,
    backward: Mapping[str, int | None],
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    adjoint: str,
    ranks: Group | None,
) -> Rendering:
    """A rendering whose picture is on a tape from the parameters ``wanted``.

    ``backward`` has the backward pass's own seed, its samples a pixel and its samples of edges a pixel (0: none); None: as
    many as the forward pass took.
    """
    if not settings.integrator.light:
        radiant = ", ".join(name for name in INTEGRATORS if INTEGRATORS[name].light)
        raise SceneError("integrator.type", settings.integrator.name, f"one of {radiant} where gradients are wanted")
    if settings.render.checkpoint is not None:
        raise SceneError("render.checkpoint", settings.render.checkpoint, "null where gradients are wanted")
    attached = adjoints.attached(scene, wanted)
    if concerns(scene, wanted):
        _warn_of_edges(scene, settings, backward["edges"] == 0)
    for name in without_gradient(scene, wanted):
        said = f"{name} changes the picture by jumps alone, which are not differentiated: its gradient is 0"
        warnings.warn(said, EdgeWarning, stacklevel=5)
    names = (*wanted, *(name for name in params if name not in wanted))
    made: list[Rendering] = []
    taken: list[int] = []

    def given_by(*tensors: Tensor) -> dict[str, Tensor]:
        return dict(zip(names, tensors, strict=True))

    def forward(*tensors: Tensor) -> Tensor:
        made.append(_checked(scene, settings, given_by(*tensors), dtype, ranks))
        return made[-1].image

    def backward_pass(cotangent: Tensor, *tensors: Tensor) -> list[Tensor | None]:
        with together(ranks, "the loss", lambda: cotangent.detach().cpu().contiguous().numpy().tobytes()):
            return gradients(cotangent, *tensors)

    def gradients(cotangent: Tensor, *tensors: Tensor) -> list[Tensor | None]:
        given, of_edges = given_by(*tensors), edges_taken()
        # One pass that is a derivative of the very estimator takes its own samples again.
        render = again().render
        exact = render.seed == settings.render.seed and render.spp == taken[0]
        held = not exact and adjoints.suits(scene, settings, wanted)
        found = adjoints.gradients(scene, again(), given, wanted, dtype, attached, adjoint, cotangent, held, ranks)
        if of_edges and concerns(scene, wanted):
            _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
            moved = add_gradients(
                scene, again(1), given, wanted, dtype, cotangent.T.reshape(height, width, 3), of_edges, held, ranks
            )
            found[: len(wanted)] = [a if b is None else a + b for a, b in zip(found, moved, strict=False)]
        return [*found[: len(wanted)], *(None for _ in names[len(wanted) :]), *found[len(wanted) :]]

    def again(spp: int | None = None) -> Settings:
        spp = spp or backward["spp"] or taken[0]
        return replace(settings, render=settings.render.but(seed=backward["seed"], spp=spp))

    def edges_taken() -> int:
        return 0 if backward["edges"] == 0 else backward["edges"] or backward["spp"] or taken[0]

    def asked() -> Asked:
        return Asked(scene, again(), wanted, dtype, edges_taken())

    tensors = tuple(params[name] for name in names)
    image = adjoints.on_tape(forward, backward_pass, tensors, scene.weights())
    rendering = made[-1]
    made.clear()  # the tape keeps the closures, which are not to keep pictures
    taken.append(max(rendering.spp, 1))
    layers = followed(settings)
    if layers:
        values = {name: rendering.layers[name] for name in layers}
        rendering.layers |= on_tape(values, tensors, asked, given_by)
    return replace(rendering, image=image)


def _constant(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype, ranks: Group | None
) -> Rendering:
    """A rendering without gradients, of parameters that may still be those of a transform of ``torch.func``."""
    made: list[Rendering] = []

    def forward(*tensors: Tensor) -> Tensor:
        made.append(_checked(scene, settings, dict(zip(params, tensors, strict=True)), dtype, ranks))
        return made[-1].image

    if not params:
        return _checked(scene, settings, params, dtype, ranks)
    image = adjoints.on_tape(forward, lambda *_: (), tuple(params.values()), ())
    return replace(made[-1], image=image)


def _checked(
    scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype, ranks: Group | None
) -> Rendering:
    scene.check(params)
    return known(lambda: render_scene(scene, settings, params=params, dtype=dtype, ranks=ranks))


def _warn_of_edges(scene: Scene, settings: Settings, every: bool) -> None:
    """Say which visibility edges (``every`` one, or those of this scene that are not done) a gradient leaves out."""
    edges = "all visibility edges (silhouettes and shadow edges that move)"
    if not every:
        missing = left_out(scene, settings)
        if not missing:
            return
        edges = f"some edges: {'; '.join(missing)}"
    warnings.warn(f"the gradient leaves out {edges}; see docs/gradients.md", EdgeWarning, stacklevel=6)


def first_hit(scene: Scene, settings: Settings, names: tuple[str, ...] = ("albedo", "normal")) -> dict[str, Tensor]:
    """Layers ``(H, W, C)`` of the first surface at one sample a pixel: a preview that is there at once."""
    film = settings.film.but(
        aovs=names, denoise=False, filter=Described(FILTERS["box"], {})
    )  # one sample fills no wider filter
    quick = replace(
        settings,
        film=film,
        integrator=INTEGRATORS["aov"](),
        render=settings.render.but(spp=1, checkpoint=None, resume=False),
    )
    return render_scene(scene, quick).layers


def render_scene(
    scene: Scene,
    settings: Settings,
    on_progress: Callable[[Progress], bool | None] | None = None,
    params: Mapping[str, Tensor] | None = None,
    dtype: torch.dtype = torch.float32,
    ranks: Group | None = None,
) -> Rendering:
    """Render with complete settings.

    Args:
        scene: what.
        settings: how.
        on_progress: called after every chunk; returning True stops early with the picture so far.
        params: tensors in place of the scene's, without gradients.
        dtype: of the lanes.
        ranks: those that share the work; each gets all of the picture.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
        RenderError: with ``integrator.strict``, the first sample that is not finite.
        AssetError: a checkpoint that is damaged, or of another render.
        OutputError: a checkpoint that cannot be written, or that is there although nobody wishes to go on from it.
    """
    with undisturbed(scene.device), limited_threads(settings.render.threads):
        with together(ranks, "what is rendered", lambda: stamp(scene, settings, params, dtype)):
            return Run(scene, settings, params, dtype, ranks).go(on_progress)
