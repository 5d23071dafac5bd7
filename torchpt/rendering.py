"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypedDict, Unpack, overload

import torch
from torch import Tensor

from torchpt import adjoint as adjoints
from torchpt.edges import Asked, add_gradients, concerns, followed, left_out, on_tape, without_gradient
from torchpt.errors import EdgeWarning, SceneError
from torchpt.format.description import settings as complete
from torchpt.forward import Progress, Rendering, Run, limited_threads
from torchpt.images.denoiser import check_denoiser, denoise
from torchpt.integrators import KINDS as INTEGRATORS
from torchpt.scene import Scene
from torchpt.settings import FILTERS, Settings
from torchpt.spec.declared import Described

__all__ = [
    "Common", "Order", "Progress", "Rendering", "Wishes", "first_hit", "ordered", "render", "render_scene", "rendered",
]  # fmt: skip


class Common(TypedDict, total=False):
    """Arguments of :func:`render` that are the same for all pictures of a batch, for type checkers."""

    spp: int | None
    integrator: str | Mapping[str, Any] | None
    sampler: str | Mapping[str, Any] | None
    film: Mapping[str, Any] | None
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


class Wishes(Common, total=False):
    """The other arguments of :func:`render`, for type checkers."""

    seed: int | None
    params: Mapping[str, Tensor] | None


@dataclass(frozen=True)
class Order:
    """A picture that was asked for: checked, complete, and not begun.

    Attributes:
        scene: what is rendered.
        settings: how.
        params: tensors in place of the scene's.
        backward: the backward pass's own seed, its samples a pixel and its samples of edges a pixel (0: none); None: as the
            forward pass.
        dtype: of the lanes.
        adjoint: how gradients are taken.
    """

    scene: Scene
    settings: Settings
    params: Mapping[str, Tensor]
    backward: Mapping[str, int | None]
    dtype: torch.dtype
    adjoint: str

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the parameters that are differentiated."""
        return tuple(name for name, value in self.params.items() if value.requires_grad)

    @property
    def taped(self) -> bool:
        """Whether the picture is to carry gradients."""
        return torch.is_grad_enabled() and bool(self.wanted or self.scene.weights())


@overload
def render(scene: Scene, *, full: Literal[False] = False, **wishes: Unpack[Wishes]) -> Tensor: ...
@overload
def render(scene: Scene, *, full: Literal[True], **wishes: Unpack[Wishes]) -> Rendering: ...
@overload
def render(scene: Scene, *, full: bool, **wishes: Unpack[Wishes]) -> Tensor | Rendering: ...
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
) -> Tensor | Rendering:
    """Render a scene to linear RGB ``(H, W, 3)`` on the scene's device; differentiable in ``params``.

    Main arguments:
        scene: from :func:`torchpt.load`.
        spp: samples a pixel; the most of them where ``time_limit`` or ``target_error`` may end it.
        seed: any integer from 0; the same seed gives the same picture.
        params: tensors in place of ``scene.params`` by dotted name. Where one of them requires gradients, so does the picture.
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

    Raises:
        SceneError: a setting or parameter that is not accepted.
        RenderError: a device, compiler or denoiser that is not there.
    """
    order = ordered(
        scene, full, spp=spp, seed=seed, integrator=integrator, sampler=sampler, film=film, params=params,
        time_limit=time_limit, target_error=target_error, pilots=pilots, checkpoint=checkpoint, resume=resume, accel=accel,
        compile=compile, threads=threads, max_memory=max_memory, device=device, dtype=dtype, adjoint=adjoint,
        seed_grad=seed_grad, spp_grad=spp_grad, edges=edges, edge_spp=edge_spp,
    )  # fmt: skip
    rendering = rendered(order)
    return rendering if full else rendering.image


#: Of the arguments of :func:`render`, those that the block ``render`` of a scene file has too.
_OF_RENDER = (
    "spp", "seed", "accel", "compile", "threads", "max_memory", "time_limit", "target_error", "pilots", "checkpoint", "resume",
)  # fmt: skip


def ordered(scene: Scene, full: bool, **wishes: Unpack[Wishes]) -> Order:
    """What the arguments of :func:`render` ask for.

    Raises:
        SceneError: one that is not accepted.
        RenderError: a denoiser that is not there.
    """
    dtype, adjoint, film = wishes.get("dtype", torch.float32), wishes.get("adjoint"), wishes.get("film")
    backward = {"seed": wishes.get("seed_grad"), "spp": wishes.get("spp_grad"), "edges": wishes.get("edge_spp")}
    numbers = {"seed_grad": (backward["seed"], 0), "spp_grad": (backward["spp"], 1), "edge_spp": (backward["edges"], 1)}
    _check(scene, wishes.get("device"), dtype, adjoint, numbers)
    if not wishes.get("edges", True):
        backward["edges"] = 0
    given = {name: wishes.get(name) for name in _OF_RENDER}
    blocks = {"film": film, "integrator": wishes.get("integrator"), "sampler": wishes.get("sampler"), "render": given}
    settings = complete(scene.description, blocks)
    if not full:
        settings = _of_one_picture(settings, film)
    elif settings.film.denoise:
        check_denoiser()
    params = wishes.get("params")
    if torch.is_grad_enabled():
        params = {name: value for name, value in scene.params.items() if value.requires_grad} | dict(params or {})
    scene.check(params)
    return Order(scene, settings, params or {}, backward, dtype, adjoint or adjoints.KINDS[0])


def rendered(order: Order, made: list[Rendering] | None = None) -> Rendering:
    """The rendering that was asked for, on a tape where one is wanted, and denoised where that is.

    ``made``: a list of the rendering alone, without gradients, where it is there already; it is taken out.
    """
    scene, settings = order.scene, order.settings

    def render(params: Mapping[str, Tensor]) -> Rendering:
        return made.pop() if made else render_scene(scene, settings, params=params, dtype=order.dtype)

    if order.taped:
        seed = settings.render.seed ^ 0x5DEECE66D if order.backward["seed"] is None else order.backward["seed"]
        rendering = _differentiable(
            scene,
            settings,
            {**order.backward, "seed": seed},
            order.params,
            order.wanted,
            order.dtype,
            order.adjoint,
            render,
        )
    else:
        rendering = render(order.params)
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
    render: Callable[[Mapping[str, Tensor]], Rendering],
) -> Rendering:
    """A rendering whose picture is on a tape from the parameters ``wanted``; ``backward``: see :class:`Order`.

    ``render`` makes it without.
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
        warnings.warn(said, EdgeWarning, stacklevel=4)
    fixed = {name: value for name, value in params.items() if name not in wanted}
    made: list[Rendering] = []
    taken: list[int] = []

    def given_by(*tensors: Tensor) -> dict[str, Tensor]:
        return {**fixed, **dict(zip(wanted, tensors, strict=True))}

    def forward(*tensors: Tensor) -> Tensor:
        made.append(render(given_by(*tensors)))
        return made[-1].image

    def backward_pass(cotangent: Tensor, *tensors: Tensor) -> list[Tensor]:
        given, of_edges = given_by(*tensors), edges_taken()
        # One pass that is a derivative of the very estimator takes its own samples again.
        own = again().render
        exact = own.seed == settings.render.seed and own.spp == taken[0]
        held = not exact and adjoints.suits(scene, settings, wanted)
        found = adjoints.gradients(scene, again(), given, wanted, dtype, attached, adjoint, cotangent, held)
        if of_edges and concerns(scene, wanted):
            _, _, width, height = settings.film.crop or (0, 0, settings.film.width, settings.film.height)
            moved = add_gradients(
                scene, again(1), given, wanted, dtype, cotangent.T.reshape(height, width, 3), of_edges, held
            )
            found[: len(wanted)] = [a if b is None else a + b for a, b in zip(found, moved, strict=False)]
        return found

    def again(spp: int | None = None) -> Settings:
        spp = spp or backward["spp"] or taken[0]
        return replace(settings, render=settings.render.but(seed=backward["seed"], spp=spp))

    def edges_taken() -> int:
        return 0 if backward["edges"] == 0 else backward["edges"] or backward["spp"] or taken[0]

    def asked() -> Asked:
        return Asked(scene, again(), wanted, dtype, edges_taken())

    tensors = tuple(params[name] for name in wanted)
    image = adjoints.on_tape(forward, backward_pass, tensors, scene.weights())
    rendering = made.pop()  # the tape keeps the closures, which are not to keep pictures
    taken.append(max(rendering.spp, 1))
    names = followed(settings)
    if names:
        values = {name: rendering.layers[name] for name in names}
        rendering.layers |= on_tape(values, tensors, asked, given_by)
    return replace(rendering, image=image)


def _warn_of_edges(scene: Scene, settings: Settings, every: bool) -> None:
    """Say which visibility edges (``every`` one, or those of this scene that are not done) a gradient leaves out."""
    edges = "all visibility edges (silhouettes and shadow edges that move)"
    if not every:
        missing = left_out(scene, settings)
        if not missing:
            return
        edges = f"some edges: {'; '.join(missing)}"
    warnings.warn(f"the gradient leaves out {edges}; see docs/gradients.md", EdgeWarning, stacklevel=5)


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
) -> Rendering:
    """Render with complete settings.

    Args:
        scene: what.
        settings: how.
        on_progress: called after every chunk; returning True stops early with the picture so far.
        params: tensors in place of the scene's, without gradients.
        dtype: of the lanes.

    Raises:
        SceneError: settings that this scene cannot be rendered with.
        RenderError: with ``integrator.strict``, the first sample that is not finite.
        AssetError: a checkpoint that is damaged, or of another render.
        OutputError: a checkpoint that cannot be written, or that is there although nobody wishes to go on from it.
    """
    with torch.no_grad(), limited_threads(settings.render.threads):
        return Run(scene, settings, params, dtype).go(on_progress)
