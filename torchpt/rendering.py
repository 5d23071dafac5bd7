"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal, Unpack, overload

import torch
from torch import Tensor

from torchpt.forward import Progress, Rendering, render_scene
from torchpt.graphs import opaque, outside
from torchpt.integrators import KINDS as INTEGRATORS
from torchpt.integrators.base import Integrator
from torchpt.orders import Wishes, ordered, ordered_along, rendered
from torchpt.ranks import Group
from torchpt.scene import Scene
from torchpt.settings import FILTERS, Settings
from torchpt.spec.declared import Described

__all__ = ["Progress", "Rendering", "Wishes", "first_hit", "render", "render_scene", "trace"]


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
    integrator: str | Mapping[str, Any] | Integrator | None = None,
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
    order = ordered(
        scene, full, spp=spp, seed=seed, integrator=integrator, sampler=sampler, film=film, params=params,
        time_limit=time_limit, target_error=target_error, pilots=pilots, checkpoint=checkpoint, resume=resume, accel=accel,
        compile=compile, threads=threads, max_memory=max_memory, device=device, dtype=dtype, adjoint=adjoint,
        seed_grad=seed_grad, spp_grad=spp_grad, edges=edges, edge_spp=edge_spp, ranks=ranks,
    )  # fmt: skip
    rendering = rendered(order)
    return rendering if full else rendering.image


@outside
def trace(
    scene: Scene,
    o: Tensor,
    d: Tensor,
    *,
    spp: int | None = 1,
    seed: int | None = 0,
    integrator: str | Mapping[str, Any] | Integrator | None = None,
    sampler: str | Mapping[str, Any] | None = None,
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
    """Return the radiance that arrives at ``o`` from ``d``, linear RGB ``(..., 3)``; differentiable in both and in ``params``.

    Random numbers are a function of the seed, of a ray's number in row-major order, and of the sample. Rays that stand as
    pixels do, ``(H, W, 3)``, have those of the pixels: along a camera's own rays this is ``render``, to the bit. A ray has no
    width, so textures are looked up at points. Gradients leave out visibility edges, and say so by an
    :class:`torchpt.EdgeWarning` where rays, surfaces or places of lights are differentiated.

    Main arguments:
        scene: from :func:`torchpt.load`.
        o: origins ``(..., 3)``, float32 or float64, in the scene's world, on its device.
        d: directions from there ``(..., 3)``, of any length; ``o`` and ``d`` are broadcast. The derivative is that of
            ``d / |d|``.
        spp: samples a ray, which are averaged.
        seed: any integer from 0; the same seed gives the same numbers.
        params: tensors in place of ``scene.params`` by dotted name, but for those of the camera.

    Other arguments, all as of :func:`render`:
        integrator, sampler, accel, compile, threads, max_memory, device, dtype, adjoint, seed_grad, spp_grad.
        What a scene file says of its film, and of when a picture is done, does not count here.

    Raises:
        SceneError: a setting, parameter or ray that is not accepted: a direction that is zero, numbers that are not finite.
        RenderError: a device or compiler that is not there.
    """
    order = ordered_along(
        scene, o, d, spp=spp, seed=seed, integrator=integrator, sampler=sampler, params=params, accel=accel, compile=compile,
        threads=threads, max_memory=max_memory, device=device, dtype=dtype, adjoint=adjoint, seed_grad=seed_grad,
        spp_grad=spp_grad,
    )  # fmt: skip
    assert order.rays is not None
    o, d = order.rays
    return rendered(order).image.reshape(o.shape) if o.numel() else (o + d).to(dtype)


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
