"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpt import adjoint as adjoints
from torchpt.errors import EdgeWarning, SceneError
from torchpt.format.description import settings as complete
from torchpt.forward import Progress, Rendering, Run, limited_threads
from torchpt.integrators import KINDS as INTEGRATORS
from torchpt.scene import Scene
from torchpt.settings import FILTERS, Settings
from torchpt.spec.declared import Described

__all__ = ["Progress", "Rendering", "first_hit", "render", "render_scene"]


def render(
    scene: Scene,
    *,
    spp: int | None = None,
    seed: int | None = None,
    integrator: str | Mapping[str, Any] | None = None,
    sampler: str | Mapping[str, Any] | None = None,
    film: Mapping[str, Any] | None = None,
    params: Mapping[str, Tensor] | None = None,
    accel: str | None = None,
    compile: str | bool | None = None,
    threads: int | str | None = None,
    max_memory: int | str | None = None,
    device: str | torch.device | None = None,
    dtype: torch.dtype = torch.float32,
    adjoint: str | None = None,
    seed_grad: int | None = None,
    spp_grad: int | None = None,
) -> Tensor:
    """Render a scene to linear RGB ``(H, W, 3)`` on the scene's device; differentiable in ``params``.

    Main arguments:
        scene: from :func:`torchpt.load`.
        spp: samples a pixel.
        seed: any integer from 0; the same seed gives the same picture.
        params: tensors in place of ``scene.params`` by dotted name. Where one requires gradients, so does the picture.

    Other arguments, all as in the scene file; ``None`` keeps the scene's own wish:
        integrator, sampler: a type or a mapping with ``type``.
        film: a mapping; ``denoise`` is refused, as one picture comes back: see :func:`torchpt.denoise`.
        accel, compile, threads, max_memory: of ``render``.
        device: must be the scene's own; load the scene on the device where it is to render.
        dtype: of the lanes. float64 is for checking derivatives; the search stays float32.
        adjoint: how gradients are taken: ``autograd`` (the default) runs each chunk of pixels again under a tape in the
            backward pass, so memory is that of a chunk.
        seed_grad, spp_grad: of the backward pass. By default it draws samples of its own, as many as the forward pass:
            shared samples would bias the gradient of a squared loss. Visibility edges that move (silhouettes, shadow
            edges) are not differentiated; see docs/gradients.md.

    Raises:
        SceneError: a setting or parameter that is not accepted.
        RenderError: a device or compiler that is not there.
    """
    _check(scene, device, dtype, adjoint, {"seed_grad": (seed_grad, 0), "spp_grad": (spp_grad, 1)})
    wishes = {
        "film": film,
        "integrator": integrator,
        "sampler": sampler,
        "render": {
            "spp": spp, "seed": seed, "accel": accel, "compile": compile, "threads": threads, "max_memory": max_memory,
        },
    }  # fmt: skip
    settings = complete(scene.description, wishes)
    if (film or {}).get("denoise") and settings.film.denoise:
        raise SceneError(
            "film.denoise", True, "false: a tensor is one picture; hand it to torchpt.denoise with its layers"
        )
    settings = replace(settings, film=settings.film.but(denoise=False))  # the scene file's wish is about files
    scene.check(params)
    wanted = tuple(name for name, value in (params or {}).items() if value.requires_grad)
    if not (wanted or scene.weights()) or not torch.is_grad_enabled():
        return render_scene(scene, settings, params=params, dtype=dtype).image
    backward = settings.render.but(
        seed=settings.render.seed ^ 0x5DEECE66D if seed_grad is None else seed_grad,
        spp=settings.render.spp if spp_grad is None else spp_grad,
    )
    again = replace(settings, render=backward)
    return _differentiable(scene, settings, again, params or {}, wanted, dtype, adjoint or "autograd")


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
    again: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    adjoint: str,
) -> Tensor:
    """The picture on a tape from the parameters ``wanted``; the backward pass renders ``again``."""
    if not settings.integrator.light:
        radiant = ", ".join(name for name in INTEGRATORS if INTEGRATORS[name].light)
        raise SceneError("integrator.type", settings.integrator.name, f"one of {radiant} where gradients are wanted")
    attached = adjoints.attached(scene, wanted)
    if attached or adjoints.casts(scene, wanted):
        warnings.warn(
            "the gradient with respect to what moves or bends rays leaves out visibility edges (silhouettes and shadow edges "
            "that move); see docs/gradients.md",
            EdgeWarning,
            stacklevel=3,
        )
    fixed = {name: value for name, value in params.items() if name not in wanted}

    def forward(*tensors: Tensor) -> Tensor:
        given = {**fixed, **dict(zip(wanted, tensors, strict=True))}
        return render_scene(scene, settings, params=given, dtype=dtype).image

    def chunks(*tensors: Tensor) -> Iterator[adjoints.Chunk]:
        given = {**fixed, **dict(zip(wanted, tensors, strict=True))}
        return adjoints.chunks(scene, again, given, wanted, dtype, attached)

    return adjoints.KINDS[adjoint](forward, chunks, tuple(params[name] for name in wanted), scene.weights())


def first_hit(scene: Scene, settings: Settings, names: tuple[str, ...] = ("albedo", "normal")) -> dict[str, Tensor]:
    """Layers ``(H, W, C)`` of the first surface at one sample a pixel: a preview that is there at once."""
    film = settings.film.but(
        aovs=names, denoise=False, filter=Described(FILTERS["box"], {})
    )  # one sample fills no wider filter
    quick = replace(settings, film=film, integrator=INTEGRATORS["aov"](), render=settings.render.but(spp=1))
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
    """
    with torch.no_grad(), limited_threads(settings.render.threads):
        return Run(scene, settings, params, dtype).go(on_progress)
