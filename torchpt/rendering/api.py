"""The one entry: a scene and settings in, a picture out. The CLI and ``torchpt.render`` both come through here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, Unpack, overload

from torch import Tensor

from torchpt.paths.integrators import KINDS as INTEGRATORS
from torchpt.rendering import Progress, Rendering, render_scene
from torchpt.rendering.graphs import as_custom_op, with_graph_break
from torchpt.rendering.requests import execute_request, prepare_request, prepare_trace_request
from torchpt.scene import Scene
from torchpt.scene.settings import FILTERS, CommonOptions, Settings, TraceOptions
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
        full: True returns a :class:`torchpt.Rendering`: picture, layers, error, counts and seconds as one object.
        options: settings, which win over the scene file's (None keeps the scene's own wish), and what is said of this call
            probe_estimate, as :class:`torchpt.scene.settings.CommonOptions` declares them: ``spp``, ``seed``, ``params`` (tensors in
            place of those of ``scene.params``: where one requires gradients, so does the picture), ``film``, ``integrator``...
            ``help`` lists them, and docs/guides/ml.md has them as a table.

    Raises:
        SceneError: a setting or parameter that is not accepted.
        RenderError: a device, compiler or denoiser that is not there; a rank that is lost, or at something else.
        TypeError: an argument that there is not.
    """
    check_names("render", options, CommonOptions, ("full",))
    rendering = execute_request(prepare_request(scene, full, **options))
    return rendering if full else rendering.image


@with_graph_break
@expand_signature
def trace(
    scene: Scene,
    o: Tensor,
    d: Tensor,
    *,
    spp: int | None = 1,
    seed: int | None = 0,
    params: Mapping[str, Tensor] | None = None,
    **options: Unpack[TraceOptions],
) -> Tensor:
    """Return the radiance that arrives at ``o`` from ``d``, linear RGB ``(..., 3)``; differentiable in both and in ``params``.

    Random numbers are a function of the seed, of a ray's number in row-major order, and of the sample. Rays that stand as
    pixels do, ``(H, W, 3)``, have those of the pixels: along a camera's own rays this is ``render``, to the bit. A ray has no
    width, so textures are looked up at points. Gradients leave out visibility edges, and say so by an
    :class:`torchpt.EdgeWarning` where rays, surfaces or places of lights are differentiated.

    Args:
        scene: from :func:`torchpt.load`.
        o: origins ``(..., 3)``, float32 or float64, in the scene's world, on its device.
        d: directions from there ``(..., 3)``, of any length; ``o`` and ``d`` are broadcast. The derivative is that of
            ``d / |d|``.
        spp: samples a ray, which are averaged.
        seed: any integer from 0; the same seed gives the same numbers.
        params: tensors in place of ``scene.params`` by dotted name, but for those of the camera.
        options: others, as of :func:`render`: those that :class:`torchpt.scene.settings.TraceOptions` declares. What a scene
            file says of its film, and of when a picture is done, does not count here.

    Raises:
        SceneError: a setting, parameter or ray that is not accepted: a direction that is zero, numbers that are not finite.
        RenderError: a device or compiler that is not there.
        TypeError: an argument that there is not.
    """
    check_names("trace", options, TraceOptions, ("spp", "seed", "params"))
    request = prepare_trace_request(scene, o, d, spp=spp, seed=seed, params=params, **options)
    assert request.rays is not None
    o, d = request.rays
    return execute_request(request).image.reshape(o.shape) if o.numel() else (o + d).to(request.call.dtype)


def first_hit(scene: Scene, settings: Settings, names: tuple[str, ...] = ("albedo", "normal")) -> dict[str, Tensor]:
    """Layers ``(H, W, C)`` of the first surface at one sample a pixel: a preview that is there at once."""
    film = settings.film.but(
        aovs=names, denoise=False, filter=ParsedParams(FILTERS["box"], {})
    )  # one sample fills no wider filter
    quick = replace(
        settings,
        film=film,
        integrator=INTEGRATORS["aov"](),
        render=settings.render.but(spp=1, checkpoint=None, resume=False),
    )
    return render_scene(scene, quick).layers
