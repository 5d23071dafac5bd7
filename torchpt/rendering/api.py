"""Render a scene: the entry points ``render`` and ``trace``, which the CLI and Python both call."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, Unpack, overload

from torch import Tensor

from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.rendering import Progress, Rendering, render_scene
from torchpt.rendering.execution import execute_request
from torchpt.rendering.graphs import as_custom_op, with_graph_break
from torchpt.rendering.requests import prepare_request, prepare_trace_request
from torchpt.scene import Scene
from torchpt.scene.settings import FILTERS, CommonOptions, Params, SeedOfCall, Settings, TraceOptions
from torchpt.spec.arguments import check_names, expand_signature
from torchpt.spec.schema import ParsedParams

__all__ = ["Progress", "Rendering", "first_hit", "render", "render_scene", "trace"]


@overload
def render(scene: Scene, *, full: Literal[False] = False, **options: Unpack[CommonOptions]) -> Tensor: ...
@overload
def render(scene: Scene, *, full: Literal[True], **options: Unpack[CommonOptions]) -> Rendering: ...
@overload
def render(scene: Scene, *, full: bool, **options: Unpack[CommonOptions]) -> Tensor | Rendering: ...
@as_custom_op
@expand_signature
def render(scene: Scene, *, full: bool = False, **options: Unpack[CommonOptions]) -> Tensor | Rendering:
    """Render a scene to linear RGB ``(H, W, 3)`` on the scene's device; differentiable in ``params``.

    Args:
        scene: from :func:`torchpt.load`.
        full: True returns a :class:`torchpt.Rendering`: picture, AOVs, error, counts and seconds in one object.
        options: settings, which win over the scene file's (None keeps the file's value), and options of this call: ``spp``,
            ``seed``, ``params`` (values in place of those of ``scene.params``; if a tensor requires gradients, so does the
            picture), ``film``, ``integrator``... :class:`torchpt.scene.settings.CommonOptions` declares them, ``help`` lists
            them, and docs/guides/ml.md has them as a table.

    Raises:
        SceneError: a setting or parameter is not accepted.
        RenderError: a device, compiler or denoiser is missing; a rank is lost, or renders something else.
        TypeError: an unknown argument.
    """
    check_names("render", options, CommonOptions, own=("full",))
    rendering = execute_request(prepare_request(scene, full=full, **options))
    return rendering if full else rendering.image


@with_graph_break
@expand_signature
def trace(
    scene: Scene,
    o: Tensor,
    d: Tensor,
    *,
    spp: int | None = 1,
    seed: SeedOfCall = 0,
    params: Params | None = None,
    **options: Unpack[TraceOptions],
) -> Tensor:
    """Return the radiance that arrives at ``o`` from ``d``, linear RGB ``(..., 3)``; differentiable in both and in ``params``.

    Random numbers are a function of the seed, the index of the ray in row-major order, and the sample. Rays in the shape of a
    picture, ``(H, W, 3)``, draw the numbers of its pixels: along a camera's own rays the result is ``render``'s, to the bit. A
    ray has no footprint, so textures are not filtered. Gradients leave out visibility edges; an :class:`torchpt.EdgeWarning`
    says so where rays, surfaces or positions of lights are differentiated.

    Args:
        scene: from :func:`torchpt.load`.
        o: origins ``(..., 3)``, float32 or float64, in the scene's world, on its device.
        d: directions ``(..., 3)``, of any length; ``o`` and ``d`` are broadcast. Gradients are those of ``d / |d|``.
        spp: samples a ray, which are averaged.
        seed: any integer from 0; the same seed gives the same numbers. None: a new one, from torch's default generator.
        params: values in place of ``scene.params`` by dotted name; parameters of the camera are refused.
        options: further options of :func:`render`, as :class:`torchpt.scene.settings.TraceOptions` declares them. The scene
            file's film and stop rules are not used.

    Raises:
        SceneError: a setting, parameter or ray is not accepted, such as a zero direction or a number that is not finite.
        RenderError: a device or compiler is missing.
        TypeError: an unknown argument.
    """
    check_names("trace", options, TraceOptions, own=("spp", "seed", "params"))
    request = prepare_trace_request(scene, o, d, spp=spp, seed=seed, params=params, **options)
    assert request.rays is not None
    o, d = request.rays
    if not o.numel():  # no rays: an empty result, on which gradients of both depend
        return (o + d).to(request.call.dtype)
    return execute_request(request).image.reshape(o.shape)


def first_hit(scene: Scene, settings: Settings, names: tuple[str, ...] = ("albedo", "normal")) -> dict[str, Tensor]:
    """Return AOVs ``(H, W, C)`` of the first surface at one sample a pixel, by name: a quick preview."""
    box = ParsedParams(FILTERS["box"], {})  # one sample fills no wider filter
    film = settings.film.but(aovs=names, denoise=False, filter=box)
    quick = replace(
        settings,
        film=film,
        integrator=INTEGRATORS["aov"](),
        render=settings.render.but(spp=1, checkpoint=None, resume=False),
    )
    return render_scene(scene, quick).layers
