"""From a scene to what an engine runs: what all waves of a render share, and what a scene keeps for the next one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.core.errors import SceneError, warn_once
from torchpt.engines import engine
from torchpt.engines.engine import Kernels, Tasks
from torchpt.images.denoiser import GUIDES
from torchpt.math.vectors import dot, normalize
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.layers import LAYERS, SurfaceLayer
from torchpt.paths.state import Plan, StageContext
from torchpt.paths.wave import Rays, Wave
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Filter
from torchpt.physics.samplers import ADAPTIVE, Points, Sampler
from torchpt.physics.world import World
from torchpt.scene import Scene
from torchpt.scene.settings import Settings
from torchpt.spec import Moves
from torchpt.spec.schema import ParsedParams

if TYPE_CHECKING:
    from torchpt.paths.integrators.first_surface import FirstSurface

__all__ = [
    "SceneCache",
    "describe_engine",
    "kernel_engine",
    "kernels_of",
    "make_wave",
    "own_models",
    "rebuild_with_tape",
    "scene_cache",
    "surface_layers",
    "uses_kernels",
]


# ---- What renders of a scene leave for the next one


@dataclass
class SceneCache:
    """Of one scene.

    Attributes:
        kernels: of its latest render by the compiled loop.
        first: the integrator and the world that this was made of, and what happens at first surfaces.
        without_lights: a world, and the same without lights.
        camera: the latest one on a film, with what it was made of.
        outlines: the edges of its meshes, as :mod:`torchpt.gradients.edges.curves` finds them.
    """

    kernels: Kernels | None = None
    first: tuple[Integrator, World, FirstSurface] | None = None
    without_lights: tuple[World, World] | None = None
    camera: tuple[Any, Camera] | None = None
    outlines: dict[str, Any] = field(default_factory=dict)


_scenes: WeakKeyDictionary[Scene, SceneCache] = WeakKeyDictionary()


def scene_cache(scene: Scene) -> SceneCache:
    """Return what is kept for a scene, as long as the scene is; views of it share it."""
    return _scenes.setdefault(scene.origin, SceneCache())


# ---- What all waves of a render share, and how they run: as tensor operations, or as the compiled loop


def make_wave(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor] | None,
    dtype: torch.dtype,
    tape: bool = False,
    attached: bool = False,
    like: Wave | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
    packets: bool = True,
) -> Wave:
    """Everything that the waves of a render share; see :class:`Plan` for ``tape`` and ``attached``.

    ``like``: a wave of the same scene, settings and parameters, but for those of the camera: what it reads is read again.
    ``rays``: origins and directions ``(..., 3)`` in the scene's coordinates, in place of the camera's.
    ``packets``: False where a tree is to be searched even if packets would be quicker.

    Raises:
        SceneError: a direction that is zero, or a ray that is not finite.
    """
    film, spp = settings.film, settings.render.spp
    integrator = settings.integrator.counted_in(scene.space.unit)
    params = params or {}
    shaping = {name: value for name, value in params.items() if not name.startswith("camera.")}
    own = not shaping  # the world is the scene's own, and what is made of it may be kept
    if like is None:
        uv = any(layer.uv for layer in surface_layers(settings).values())
        world, geometry = scene.world(dtype, shaping, uv, settings.light_choice)
        threads = None if settings.render.threads == "auto" else int(settings.render.threads)
        moved = any(name.startswith("shapes.") and scene.spec(name).moves is Moves.SURFACES for name in shaping)
        accel = scene.accel(settings.render.accel, threads, geometry if moved else None)
        if accel.name == "brute" and not packets:
            accel = scene.accel("numba", threads, geometry if moved else None)
        if not integrator.lit:
            world = _without_lights(scene, world, own)
    else:
        world, accel = like.context.world, like.accel
    points = points_of(settings.sampler)
    plan = integrator.plan(points, dtype, tape, attached)
    camera = _camera(scene, settings, params, dtype)
    crop = film.crop or (0, 0, film.width, film.height)
    context = _context(plan, world, camera, crop, integrator)
    wave = Wave(
        context=context if rays is None else replace(context, pixel=None),  # rays have no width
        integrator=integrator,
        accel=accel,
        camera=camera,
        filter=_filter(film.filter.kind, tuple(film.filter.values.items()), scene.device),
        sampler=Sampler(points, settings.render.seed, settings.streams, spp, film.width),
        crop=crop,
        centre=scene.space.shift,
        first=_first(scene, integrator, world, own) if like is None else like.first,
    )
    return wave if rays is None else wave.with_rays(_lane_rays(scene, *rays, dtype))


def _lane_rays(scene: Scene, o: Tensor, d: Tensor, dtype: torch.dtype) -> Rays:
    """Return rays ``(..., 3)`` of the scene's coordinates as lanes have them, differentiable."""
    o, d = (x.reshape(-1, 3).T.double() for x in (o, d))
    origin = ((o - scene.space.centre[:, None]) / scene.space.unit).to(dtype).contiguous()
    _check_rays(
        "o", o, torch.isfinite(origin).all(0), f"an origin that is finite in {str(dtype).removeprefix('torch.')}"
    )
    _check_rays("d", d, torch.isfinite(d).all(0) & (d != 0).any(0), "a direction that is finite and not zero")
    unit = normalize(d)
    # What is of unit length up to rounding keeps its bits.
    near = (dot(d, d) - 1.0).abs() < 8.0 * torch.finfo(dtype).eps
    unit = unit + torch.where(near, d - unit, 0.0).detach()
    return Rays(origin, unit.to(dtype).contiguous())


def _check_rays(key: str, given: Tensor, good: Tensor, expected: str) -> None:
    """Refuse the first of some vectors ``(3, N)`` that is not ``good (N,)``.

    Raises:
        SceneError: names it.
    """
    bad = (~good).nonzero()
    if len(bad):
        raise SceneError(f"{key}, ray {int(bad[0])}", given[:, int(bad[0])].tolist(), expected)


def _camera(scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype) -> Camera:
    """The camera on the film; the latest one where it was made of the same."""
    merged, film = scene.merged(params), settings.film
    if torch.is_grad_enabled():
        return scene.camera(film, merged, dtype)
    given = [value for name, value in merged.items() if name.startswith("camera.")]
    if any(value.is_inference() for value in given):
        return scene.camera(film, merged, dtype)
    # By identity: what the ids are of is held beside them, so that they stay their own.
    held = (scene.description.camera, *given)
    made_of = ([id(value) for value in held], [value._version for value in given], film.width, film.height, dtype)
    keeper = scene_cache(scene)
    if keeper.camera is None or keeper.camera[0][0] != made_of:
        keeper.camera = (made_of, held), scene.camera(film, merged, dtype)
    return keeper.camera[1]


@lru_cache(maxsize=64)
def _filter(kind: type[Filter], values: tuple[tuple[str, Any], ...], device: torch.device) -> Filter:
    """A filter; renders of the same read the same tensors."""
    return kind(dict(values), device)


def rebuild_with_tape(wave: Wave, scene: Scene, settings: Settings, params: Mapping[str, Tensor]) -> Wave:
    """An eager wave whose world and camera follow ``params`` under a tape, of one of the same parameters detached.

    The search structure stays.
    """
    uv = any(layer.uv for layer in surface_layers(settings).values())
    world, _ = scene.world(wave.context.plan.dtype, params, uv, settings.light_choice)
    if not wave.integrator.lit:
        world = replace(world, lights=None)
    camera = scene.camera(settings.film, scene.merged(params), wave.context.plan.dtype)
    context = _context(wave.context.plan, world, camera, wave.crop, wave.integrator)
    return replace(wave, context=context, camera=camera, first=None if wave.first is None else wave.first.again(world))


def points_of(sampler: ParsedParams) -> Points:
    """Return where the points lie, of the settings of a sampler."""
    return sampler.kind(**{key: value for key, value in sampler.values.items() if key not in ADAPTIVE})


def surface_layers(settings: Settings) -> dict[str, type[SurfaceLayer]]:
    """The layers of first surfaces that are wanted, by name; those for the denoiser alone come last."""
    names = (*(settings.film.aovs or settings.integrator.layers), *(GUIDES if settings.film.denoise else ()))
    if not names:
        return {}
    layers = {name: LAYERS[name] for name in names}
    return {name: layer for name, layer in layers.items() if issubclass(layer, SurfaceLayer)}


def _first(scene: Scene, integrator: Integrator, world: World, own: bool) -> FirstSurface | None:
    """Return what happens at first surfaces; kept with the scene, unless the world is not the scene's ``own``."""
    if not own or torch.is_grad_enabled():
        return integrator.first(world)
    keeper = scene_cache(scene)
    if keeper.first is not None and keeper.first[0] == integrator and keeper.first[1] is world:
        return keeper.first[2]
    first = integrator.first(world)
    if first is not None:
        keeper.first = integrator, world, first
    return first


def _without_lights(scene: Scene, world: World, own: bool) -> World:
    """The world without lights; one of the scene's ``own`` is kept with it."""
    if not own:
        return replace(world, lights=None)
    keeper = scene_cache(scene)
    if keeper.without_lights is None or keeper.without_lights[0] is not world:
        keeper.without_lights = world, replace(world, lights=None)
    return keeper.without_lights[1]


def _context(
    plan: Plan, world: World, camera: Camera, crop: tuple[int, int, int, int], integrator: Integrator
) -> StageContext:
    """Return what the stages of a render read beside their lanes."""
    context = StageContext(plan, world, _pixel_of(world, camera))
    return replace(context, camera=camera, crop=crop) if integrator.splats else context


def _pixel_of(world: World, camera: Camera) -> Tensor | None:
    """Return what textures filtered by the pixel's footprint need of the camera; None where there are none."""
    return camera.pixel() if world.textures.filtered else None


def uses_kernels(settings: Settings, device: torch.device, dtype: torch.dtype) -> bool:
    """Return True where a render runs as kernels, False where it runs as tensor operations.

    Raises:
        SceneError: ``render.compile`` is ``on`` where there are no kernels.
    """
    if settings.render.compile == "off":
        return False
    missing = ""
    if device.type != "cpu":
        missing = f"kernels run on a CPU; this scene is on {device}"
    elif dtype != torch.float32:
        missing = f"kernels compute in float32; this render is in {str(dtype).removeprefix('torch.')}"
    if missing and settings.render.compile == "on":
        raise SceneError("render.compile", "on", f"auto or off ({missing})")
    return not missing


def own_models(scene: Scene, wave: Wave) -> list[int]:
    """Return the numbers of the models that are the caller's own: no kernel may be made of them."""
    models = wave.context.world.materials.models
    return [k for k, model in enumerate(models) if any(model is mine for mine in scene.own_models)]


def kernels_of(scene: Scene, wave: Wave, before: Kernels | None = None) -> Kernels:
    """Return the kernels of a wave of a scene, see :func:`torchpt.engines.engine.kernels_of`."""
    return engine.kernels_of(wave, own_models(scene, wave), before)


def describe_engine(scene: Scene, settings: Settings) -> dict[str, Any]:
    """Tell how a render of the scene would run: as the compiled loop, and how that searches, or as tensor operations."""
    with torch.no_grad():
        if not uses_kernels(settings, scene.device, torch.float32):
            return {"stages": "eager, by tensor operations"}
        return engine.describe_kernels(kernels_of(scene, make_wave(scene, settings, None, torch.float32)))


def kernel_engine(scene: Scene, wave: Wave, eager: list[str], threads: int | None = None) -> Tasks:
    """Return the compiled loop of a render on ``threads`` (None: as many as torch's), whose kernels are kept with the scene.

    Materials without kernels join ``eager``.
    """
    keeper = scene_cache(scene)
    kernels = keeper.kernels = kernels_of(scene, wave, keeper.kernels)
    for number, reason in kernels.eager.items():
        name = str(wave.context.world.materials.models[number])
        eager.append(f"{name}: {reason}")
        warn_once(f"torchpt: the material model {name} runs by tensor operations, as no kernel can be made of {reason}")
    return engine.forward_kernels(kernels, threads, wave.integrator.strict)
