"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchpt import adjoint as adjoints
from torchpt.errors import EdgeWarning, SceneError
from torchpt.format.description import settings as complete
from torchpt.forward import (
    BYTES_PER_LANE,
    Progress,
    Rendering,
    Run,
    chunks_of,
    lanes_for,
    limited_threads,
    make_wave,
    pixel_of,
)
from torchpt.integrators.compiled import Stages
from torchpt.records import tensors_of
from torchpt.scene import Scene
from torchpt.settings import AovIntegrator, BoxFilter, Settings
from torchpt.spec import Moves

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
        film: a mapping.
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
    if device not in (None, "auto") and not _same(device, scene.device):
        raise SceneError("device", str(device), f"the scene's own device {scene.device}; load the scene on the other")
    if dtype not in (torch.float32, torch.float64):
        raise SceneError("dtype", dtype, "torch.float32 or torch.float64")
    wishes = {
        "film": film,
        "integrator": integrator,
        "sampler": sampler,
        "render": {
            "spp": spp, "seed": seed, "accel": accel, "compile": compile, "threads": threads, "max_memory": max_memory,
        },
    }  # fmt: skip
    settings = complete(scene.description, wishes)
    if adjoint not in (None, *adjoints.KINDS):
        raise SceneError("adjoint", adjoint, " or ".join(adjoints.KINDS))
    for key, value, low in (("seed_grad", seed_grad, 0), ("spp_grad", spp_grad, 1)):
        if value is not None and (type(value) is not int or value < low):
            raise SceneError(key, value, f"a whole number >= {low}")
    scene.check(params)
    wanted = {name: value for name, value in (params or {}).items() if value.requires_grad}
    weights = scene.weights()
    if not (wanted or weights) or not torch.is_grad_enabled():
        return render_scene(scene, settings, params=params, dtype=dtype).image
    backward_seed = settings.render.seed ^ 0x5DEECE66D if seed_grad is None else seed_grad
    fixed = {name: value for name, value in (params or {}).items() if name not in wanted}
    backward_spp = settings.render.spp if spp_grad is None else spp_grad
    drawn_anew = settings.render.model_copy(update={"seed": backward_seed, "spp": backward_spp})
    again = settings.model_copy(update={"render": drawn_anew})
    if isinstance(settings.integrator, AovIntegrator):
        raise SceneError("integrator.type", "aov", "path, direct or ibl where gradients are wanted")
    names = tuple(wanted)
    attached = _moves(scene, names)
    if attached or any(scene.spec(name).moves is Moves.SHADOWS for name in names):
        warnings.warn(
            "the gradient with respect to what moves or bends rays leaves out visibility edges (silhouettes and shadow edges "
            "that move); see docs/gradients.md",
            EdgeWarning,
            stacklevel=2,
        )

    def forward(*tensors: Tensor) -> Tensor:
        given = {**fixed, **dict(zip(names, tensors, strict=True))}
        return render_scene(scene, settings, params=given, dtype=dtype).image

    def chunks(*tensors: Tensor) -> Iterator[adjoints.Chunk]:
        given = {**fixed, **dict(zip(names, tensors, strict=True))}
        return _differentiable_chunks(scene, again, given, names, dtype, attached)

    return adjoints.KINDS[adjoint or "autograd"](forward, chunks, tuple(wanted.values()), weights)


def _same(wish: str | torch.device, own: torch.device) -> bool:
    """Whether a wish for a device names the one that a scene is on."""
    try:
        device = torch.device(wish)
    except RuntimeError:
        return False
    return device.type == own.type and device.index in (None, own.index or 0)


def _moves(scene: Scene, names: Iterable[str]) -> bool:
    """Whether any of the parameters moves surfaces or the camera, or bends rays that a delta lobe sends on."""
    materials = [material for part in scene.built.parts for material in part.material.all()]
    bending = {material.name for material in materials if material.model.refracts and material.model.delta}

    def moves(name: str) -> bool:
        moved = scene.spec(name).moves
        if moved is Moves.RAYS:  # by name, or by a texture that any of them may read
            return any(name.startswith(f"{own}.") for own in bending) or bool(bending and "textures." in name)
        return moved is Moves.SURFACES

    return any(map(moves, names))


def first_hit(scene: Scene, settings: Settings, names: tuple[str, ...] = ("albedo", "normal")) -> dict[str, Tensor]:
    """Layers ``(H, W, C)`` of the first surface at one sample a pixel: a preview that is there at once."""
    film = settings.film.model_copy(update={"aovs": names, "filter": BoxFilter()})  # one sample fills no wider filter
    once = settings.render.model_copy(update={"spp": 1})
    quick = settings.model_copy(update={"film": film, "render": once, "integrator": AovIntegrator()})
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


def _differentiable_chunks(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor],
    wanted: tuple[str, ...],
    dtype: torch.dtype,
    attached: bool,
) -> Iterator[adjoints.Chunk]:
    """Chunks of pixels as differentiable functions of the tensors ``wanted``, for the backward pass."""
    assert not isinstance(settings.integrator, AovIntegrator)
    plain = {name: value.detach() for name, value in params.items()}
    with torch.no_grad():
        still = make_wave(scene, settings, plain, dtype, True, attached)
    assert still.limits is not None
    depth = still.limits.max_depth if 0 <= still.limits.max_depth < 64 else 64
    lanes = lanes_for(settings, scene.device, BYTES_PER_LANE * max(depth, 1))
    pixels = still.crop[2] * still.crop[3]
    clamp = settings.integrator.clamp

    def radiance(span: tuple[int, int, int, int], *tensors: Tensor) -> Tensor:
        given = {**plain, **dict(zip(wanted, tensors, strict=True))}
        world, _ = scene.world(dtype, given, choice=settings.light_choice)
        camera = scene.camera(settings.film, scene.merged(given), dtype)
        stages = Stages(still.stages.plan, world, pixel_of(world, camera))
        preview = still.preview
        if preview is not None and world.lights is not None:
            if any(t.requires_grad for t in tensors_of(world.lights.environment)):
                from torchpt.integrators.ibl import Preview

                preview = Preview.of(world)
        values, _ = replace(still, stages=stages, camera=camera, preview=preview).radiance(*span)
        values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
        if clamp is not None:
            values = values * (clamp / values.detach().abs().amax(0).clamp_min(clamp)).clamp_max(1.0)
        return values.sum(1) / settings.render.spp

    with limited_threads(settings.render.threads):  # while whoever asked for the chunks differentiates them
        for first, count, sample, samples, _ in chunks_of(settings, lanes, still.sampler.randomizations, pixels):
            yield adjoints.Chunk(first, count, partial(radiance, (first, count, sample, samples)))
