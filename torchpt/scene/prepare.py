"""Build the wave and the kernels of a render, and cache what later renders of the scene can use again.

A *wave* (:class:`~torchpt.paths.wave.Wave`) is all that an engine needs: world, search, camera, integrator, sampler, film
filter. Its *stage context* is what the stages of an integrator know beside the lanes; the *plan* in it is what does not depend
on the world. *Kernels* are machine code of stages for a CPU or a GPU; without them stages run as tensor operations (*eager*).
Renders, gradients and ``torchpt info`` begin with :func:`make_wave`; only renders call :func:`kernel_engine`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchpt.core.errors import SceneError, warn_once
from torchpt.core.memory import on_low_memory, release_memory
from torchpt.core.threads import one_thread
from torchpt.core.tree import moved
from torchpt.engines import engine
from torchpt.engines.engine import ForwardDevice, KernelCaches, Kernels, Tasks
from torchpt.images.denoiser import GUIDES
from torchpt.math.vectors import dot, normalize
from torchpt.native import device_checks
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.integrators.kinds.vcm import Vcm
from torchpt.paths.integrators.path import partition
from torchpt.paths.layers import LAYERS, SurfaceLayer
from torchpt.paths.state import Plan, StageContext
from torchpt.paths.wave import Rays, Wave
from torchpt.physics.cameras import Camera
from torchpt.physics.film import Filter
from torchpt.physics.lights.emission import emission_of
from torchpt.physics.samplers import ADAPTIVE, Points, Sampler
from torchpt.physics.shapes.geometry import Geometry, Hit
from torchpt.physics.world import World
from torchpt.scene import Scene
from torchpt.scene.scene import live_scenes
from torchpt.scene.settings import Settings
from torchpt.search.instances import bounding_sphere
from torchpt.spec import Moves
from torchpt.spec.schema import ParsedParams

if TYPE_CHECKING:
    from torchpt.paths.integrators.first_surface import FirstSurface

__all__ = [
    "SceneCache",
    "describe_engine",
    "device_engine",
    "empty_cache",
    "is_small",
    "kernel_engine",
    "kernels_of",
    "make_wave",
    "own_models",
    "rebuild_with_tape",
    "scene_cache",
    "surface_layers",
    "uses_kernels",
]


# ---- Cache of a scene, shared by its renders


@dataclass
class SceneCache:
    """Objects of one scene that later renders use again.

    Attributes:
        kernels: kernels of the latest render.
        kernel_caches: machine code bound to tables, of the latest pictures and gradients.
        first_surface: integrator, world, and the ``FirstSurface`` made from them: what shades first surfaces on its own.
        without_lights: a world, and a copy of it without lights.
        with_emission: a world, and a copy of it with the rays that leave its lights.
        camera: of the latest render: key, objects whose ids are in the key, and the camera on its film.
        outlines: edges of the meshes, found by :mod:`torchpt.gradients.edges.curves`.
    """

    kernels: Kernels | None = None
    kernel_caches: KernelCaches = field(default_factory=KernelCaches)
    first_surface: tuple[Integrator, World, FirstSurface] | None = None
    without_lights: tuple[World, World] | None = None
    with_emission: tuple[World, World] | None = None
    camera: tuple[Any, Any, Camera] | None = None
    outlines: dict[str, Any] = field(default_factory=dict)


_caches: WeakKeyDictionary[Scene, SceneCache] = WeakKeyDictionary()


def scene_cache(scene: Scene) -> SceneCache:
    """Return the cache of a scene, which lives as long as the scene; its views share it."""
    return _caches.setdefault(scene.origin, SceneCache())


def _drop_kept() -> None:
    """Drop what renders have kept for later ones, but for a scene's own worlds and search structures."""
    for scene in live_scenes():
        scene.drop_pieces()
    for scene in list(_caches):
        _caches[scene] = SceneCache(outlines=_caches[scene].outlines)


on_low_memory(_drop_kept)


def empty_cache() -> None:
    """Give back the memory that renders and gradients keep for later ones; the next of each scene makes it anew.

    Freed are buffers of threads, tables and machine code bound to them, pieces of worlds, reference cycles, and what the
    allocators of Python and CUDA hold. A scene's own world and search structure stay as long as the scene.
    """
    release_memory()


# ---- The wave of a render, and its engine: tensor operations or kernels


def make_wave(
    scene: Scene,
    settings: Settings,
    params: Mapping[str, Tensor] | None,
    dtype: torch.dtype,
    *,
    tape: bool = False,
    attached: bool = False,
    like: Wave | None = None,
    rays: tuple[Tensor, Tensor] | None = None,
    edges: bool = False,
) -> Wave:
    """Build the wave of a render.

    Args:
        scene: the scene.
        settings: complete settings.
        params: tensors in place of the scene's, by name.
        dtype: dtype of the lanes.
        tape: True where autograd records the stages.
        attached: True where the geometry is differentiated.
        like: a wave that differs in the camera's parameters only; its world and search are used again.
        rays: origins and directions ``(..., 3)`` in the scene's coordinates, in place of the camera's.
        edges: True for rays of edges: they search a tree even where packets would be faster, and sample lights alone too.

    Raises:
        SceneError: a direction that is zero, a ray that is not finite, or another default dtype of torch than float32.
    """
    if torch.get_default_dtype() != torch.float32:  # products of whole numbers and numbers would have it
        expected = (
            "torch.float32; pictures and gradients in double precision are asked for by render(dtype=torch.float64)"
        )
        raise SceneError("torch.get_default_dtype", torch.get_default_dtype(), expected)
    film, spp = settings.film, settings.render.spp
    integrator = settings.integrator.counted_in(scene.space.unit)  # its lengths, in the unit of lanes
    params = params or {}
    world_params = {name: value for name, value in params.items() if not name.startswith("camera.")}
    own = not world_params  # the world is the scene's own, so objects made from it may be cached
    if like is None:
        uv = any(layer.uv for layer in surface_layers(settings).values())  # an AOV shows texture coordinates
        with one_thread() if scene.numbers <= QUICK_NUMBERS else nullcontext():
            threads = None if settings.render.threads == "auto" else int(settings.render.threads)
            world, geometry = scene.world(
                dtype,
                world_params,
                uv=uv,
                choice=settings.light_choice,
                alone=edges or settings.lights_alone,
                accel=(settings.render.accel, threads),
            )
            surfaces_move = any(
                name.startswith("shapes.") and scene.spec(name).moves is Moves.SURFACES for name in world_params
            )
            accel = scene.accel(settings.render.accel, threads, geometry if surfaces_move else None)
            if edges and accel.name == "brute":  # it tests packets of rays against all primitives; `numba` is a tree
                accel = scene.accel("numba", threads, geometry if surfaces_move else None)
        if integrator.light_walk() is not None:
            world = _with_emission(scene, world, geometry, own=own)
        if not integrator.lit:  # an integrator that does not use lights
            world = _without_lights(scene, world, own=own)
    else:
        world, accel = like.context.world, like.accel
    points = points_of(settings.sampler)
    plan = integrator.plan(points, dtype, tape=tape, attached=attached)
    camera = _camera(scene, settings, params, dtype)
    crop = film.window
    context = _context(plan, world, camera, crop, integrator)
    wave = Wave(
        context=context if rays is None else replace(context, pixel=None),  # rays have no width
        integrator=integrator,
        accel=accel,
        camera=camera,
        filter=_filter(film.filter.kind, tuple(film.filter.values.items()), scene.device),
        # `streams`: number of independent randomizations. The film's width numbers pixels alike in every crop.
        sampler=Sampler(
            kind=points, seed=settings.render.seed, randomizations=settings.streams, spp=spp, width=film.width
        ),
        crop=crop,
        centre=scene.space.shift,
        first_surface=_first_surface(scene, integrator, world, own=own) if like is None else like.first_surface,
    )
    wave = _with_radius(replace(wave, light_paths=_light_paths(wave))).at_sample(0)
    return wave if rays is None else wave.with_rays(_lane_rays(scene, *rays, dtype))


#: Camera rays, along each side of the picture, whose hits tell how wide pixels are where surfaces are seen.
_PILOT_SIDE = 32
#: Radius of merges that nobody gave, in pixels.
_RADIUS_IN_PIXELS = 2.0


def _with_radius(wave: Wave) -> Wave:
    """Return the wave with the radius of merges, where its integrator merges and nobody gave one: two pixels wide.

    The width of a pixel is the median over camera rays on a grid of the picture, at the surfaces that they hit; where some of
    these scatter light, of those alone. Where nothing is hit, that of pixels which show all of the scene. The radius has two
    digits, so that other processors round to the same.
    """
    integrator = wave.integrator
    if not isinstance(integrator, Vcm) or integrator.radius is not None:
        return wave
    x0, y0, width, height = wave.crop
    dtype, device = wave.context.plan.dtype, wave.centre.device
    across = (torch.arange(_PILOT_SIDE, device=device, dtype=dtype) + 0.5) / _PILOT_SIDE
    x, y = torch.meshgrid(x0 + across * width, y0 + across * height, indexing="ij")
    x, y = x.reshape(-1), y.reshape(-1)
    with torch.no_grad():
        lens = torch.full((2, len(x)), 0.5, dtype=dtype, device=device) if wave.camera.lens else None
        o, d = wave.camera.rays(x, y, lens)
        next_o, next_d = wave.camera.rays(x + 1.0, y, lens)
        o = o.expand_as(d).contiguous()
        hit = Hit(*wave.accel.intersect(o, d.contiguous(), torch.full_like(x, math.inf)))
        wide = (
            (next_o - o).square().sum(0).sqrt() if wave.camera.parallel else (next_d - d).square().sum(0).sqrt() * hit.t
        )
        seen = (hit.prim >= 0) & torch.isfinite(wide)
        models, merged = wave.context.world.materials.models, torch.zeros_like(seen)
        for model, lanes in partition(wave.context.world, hit)[1]:
            merged[lanes] = not models[model].smooth
        wide = wide[seen & merged if bool((seen & merged).any()) else seen]
    width_of_pixel, emission = 0.0, wave.context.world.emission
    if len(wide):
        width_of_pixel = float(wide.double().median())
    elif emission is not None:
        width_of_pixel = 2.0 * float(emission.sphere.radius) / max(width, height)
    radius = float(f"{_RADIUS_IN_PIXELS * width_of_pixel:.1e}") or 1.0  # any, where nothing emits
    return replace(wave, integrator=integrator.but(radius=radius))


#: Xor mask that gives light paths a seed of their own, any constant below 2^63.
_LIGHT_SEED = 0x3C6EF372FE94F82B


def _light_paths(wave: Wave) -> Wave | None:
    """Return the wave of light paths beside the samples of a wave; None: its integrator has none, or nothing emits.

    Raises:
        SceneError: light paths cannot be joined to the camera.
    """
    integrator, world = wave.integrator.light_walk(), wave.context.world
    if integrator is None:
        return None
    if type(wave.camera).connect is Camera.connect:
        expected = f"a camera whose kind defines `connect`, beside integrator.type={wave.integrator.name}"
        raise SceneError("camera.type", wave.camera.name, expected)
    if world.emission is None:
        return None
    plan = integrator.plan(wave.context.plan.sampler, wave.context.plan.dtype)
    # Their vertices sample no light, and emission that they meet counts nothing.
    context = replace(wave.context, plan=plan, world=replace(world, lights=None), filter=wave.filter)
    sampler = replace(wave.sampler, seed=wave.sampler.seed ^ _LIGHT_SEED)
    return replace(wave, context=context, integrator=integrator, sampler=sampler, first_surface=None)


def _with_emission(scene: Scene, world: World, geometry: Geometry, *, own: bool) -> World:
    """Return the world with the rays that leave its lights, cached with the scene where the world is the scene's ``own``."""
    if world.lights is None:
        return world
    cache = scene_cache(scene)
    if own and cache.with_emission is not None and cache.with_emission[0] is world:
        return cache.with_emission[1]
    emission = emission_of(world.lights, *bounding_sphere(geometry))
    found = replace(world, emission=emission)
    if own:
        cache.with_emission = world, found
    return found


def _lane_rays(scene: Scene, o: Tensor, d: Tensor, dtype: torch.dtype) -> Rays:
    """Convert rays ``(..., 3)`` in the scene's coordinates to ``(3, N)`` in those of lanes, differentiable."""
    o, d = (vectors.reshape(-1, 3).T.double() for vectors in (o, d))
    origin = ((o - scene.space.centre[:, None]) / scene.space.unit).to(dtype).contiguous()
    _check_rays(
        "o", o, torch.isfinite(origin).all(0), f"an origin that is finite in {str(dtype).removeprefix('torch.')}"
    )
    _check_rays("d", d, torch.isfinite(d).all(0) & (d != 0).any(0), "a direction that is finite and not zero")
    unit = normalize(d)
    # Directions of unit length up to rounding keep their bits; their gradients are still those of `normalize`.
    is_unit = (dot(d, d) - 1.0).abs() < 8.0 * torch.finfo(dtype).eps  # a few roundings
    unit = unit + torch.where(is_unit, d - unit, 0.0).detach()
    return Rays(origin, unit.to(dtype).contiguous())


def _check_rays(key: str, given: Tensor, good: Tensor, expected: str) -> None:
    """Raise for the first of the vectors ``given (3, N)`` where ``good (N,)`` is False.

    Raises:
        SceneError: names the ray and its value.
    """
    bad = (~good).nonzero()
    if len(bad):
        raise SceneError(f"{key}, ray {int(bad[0])}", given[:, int(bad[0])].tolist(), expected)


def _camera(scene: Scene, settings: Settings, params: Mapping[str, Tensor], dtype: torch.dtype) -> Camera:
    """Return the camera on the film, from the cache where parameters, film and dtype are the same."""
    merged, film = scene.merged(params), settings.film
    tensors = [value for name, value in merged.items() if name.startswith("camera.")]
    taped = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
    if taped or any(value.is_inference() for value in tensors):  # torch counts no versions of these
        return scene.camera(film, merged, dtype)
    # Keyed by id; the objects are stored too, since an id is unique only while its object lives.
    objects = (scene.description.camera, *tensors)
    key = ([id(value) for value in objects], [value._version for value in tensors], film.width, film.height, dtype)
    cache = scene_cache(scene)
    if cache.camera is not None:
        cached_key, _, camera = cache.camera
        if cached_key == key:
            return camera
    camera = scene.camera(film, merged, dtype)
    cache.camera = key, objects, camera
    return camera


@lru_cache(maxsize=64)
def _filter(kind: type[Filter], values: tuple[tuple[str, Any], ...], device: torch.device) -> Filter:
    """Return a filter, cached so that renders with equal filters share their tensors."""
    return kind(dict(values), device)


def rebuild_with_tape(wave: Wave, scene: Scene, settings: Settings, params: Mapping[str, Tensor]) -> Wave:
    """Return an eager wave with world and camera rebuilt from ``params``, so that autograd records how they depend on them.

    Args:
        wave: made from the same values, detached. Its search structure is used again.
        scene: the scene.
        settings: complete settings.
        params: tensors in place of the scene's, by name.
    """
    uv = any(layer.uv for layer in surface_layers(settings).values())
    world, _ = scene.world(
        wave.context.plan.dtype, params, uv=uv, choice=settings.light_choice, alone=settings.lights_alone
    )
    if not wave.integrator.lit:
        world = replace(world, lights=None)
    camera = scene.camera(settings.film, scene.merged(params), wave.context.plan.dtype)
    context = _context(wave.context.plan, world, camera, wave.crop, wave.integrator)
    return replace(
        wave,
        context=context,
        camera=camera,
        first_surface=None
        if wave.first_surface is None
        else moved(wave.first_surface.again(moved(world, torch.device("cpu"))), scene.device),  # for another world
    )


def points_of(sampler: ParsedParams) -> Points:
    """Return the sampler that the settings describe; options of adaptive sampling are not part of it."""
    return sampler.kind(**{key: value for key, value in sampler.values.items() if key not in ADAPTIVE})


def surface_layers(settings: Settings) -> dict[str, type[SurfaceLayer]]:
    """Return the AOVs of first surfaces that a render needs, by name; the denoiser's guides come last."""
    names = (*(settings.film.aovs or settings.integrator.layers), *(GUIDES if settings.film.denoise else ()))
    if not names:
        return {}
    layers = {name: LAYERS[name] for name in names}
    return {name: layer for name, layer in layers.items() if issubclass(layer, SurfaceLayer)}


def _first_surface(scene: Scene, integrator: Integrator, world: World, *, own: bool) -> FirstSurface | None:
    """Return the integrator's ``FirstSurface``, cached with the scene where the world is the scene's ``own``."""

    def first_on_host(world: World) -> FirstSurface | None:
        """Return the shading, computed on the host as the world was; None where the integrator has none of its own."""
        if type(integrator).first is Integrator.first:
            return None
        return moved(integrator.first(moved(world, torch.device("cpu"))), scene.device)

    if not own or torch.is_grad_enabled():
        return first_on_host(world)
    cache = scene_cache(scene)
    if cache.first_surface is not None:
        cached_integrator, cached_world, first_surface = cache.first_surface
        if cached_integrator == integrator and cached_world is world:
            return first_surface
    first_surface = first_on_host(world)
    if first_surface is not None:
        cache.first_surface = integrator, world, first_surface
    return first_surface


def _without_lights(scene: Scene, world: World, *, own: bool) -> World:
    """Return the world without lights, cached with the scene where the world is the scene's ``own``."""
    if not own:
        return replace(world, lights=None)
    cache = scene_cache(scene)
    if cache.without_lights is not None:
        lit_world, unlit_world = cache.without_lights
        if lit_world is world:
            return unlit_world
    unlit_world = replace(world, lights=None)
    cache.without_lights = world, unlit_world
    return unlit_world


def _context(
    plan: Plan, world: World, camera: Camera, crop: tuple[int, int, int, int], integrator: Integrator
) -> StageContext:
    """Return the stage context of a render; only integrators that splat, to any pixel, know the camera and the crop."""
    context = StageContext(plan=plan, world=world, pixel=_pixel_of(world, camera))
    return replace(context, camera=camera, crop=crop) if integrator.splats else context


def _pixel_of(world: World, camera: Camera) -> Tensor | None:
    """Return the camera's footprint for filtered textures; None where no texture is filtered."""
    if not world.textures.filtered:
        return None
    pixel = moved(camera, torch.device("cpu")).pixel()  # on the host, as the camera was
    return moved(pixel, world.geometry.p0.device)


#: Most samples of a small render: up to here torch uses one thread for a tensor with a number a sample.
SMALL_SAMPLES = 1 << 15
#: Most numbers of the parameters of a scene of small renders.
SMALL_NUMBERS = 1 << 18
#: Most numbers of a scene's parameters up to which torch builds its tables in one thread. It takes about as long as several
#: where they are idle, and a tenth of it where other processes use them: these then wait for each other in each operation.
QUICK_NUMBERS = 1 << 25


def is_small(scene: Scene, settings: Settings) -> bool:
    """Return True for a render whose tensors are so small that torch is faster in one thread."""
    film = settings.film
    _, _, width, height = film.window
    return width * height * settings.render.spp <= SMALL_SAMPLES and scene.numbers <= SMALL_NUMBERS


def uses_kernels(settings: Settings, device: torch.device, dtype: torch.dtype) -> bool:
    """Return True where a render runs as kernels, False where it runs as tensor operations.

    Kernels run on a CPU; on a CUDA device where they have passed their check, or where ``render.compile`` is ``on``.

    Raises:
        SceneError: ``render.compile`` is ``on`` where there are no kernels.
    """
    if settings.render.compile == "off":
        return False
    missing = ""
    if dtype != torch.float32:
        missing = f"kernels compute in float32; this render is in {str(dtype).removeprefix('torch.')}"
    elif reason := engine.why_no_kernels(device):
        missing = f"{reason}; this scene is on {device}"
    elif device.type != "cpu" and settings.integrator.merging_counts:
        missing = f"integrator {settings.integrator.name} has kernels on a CPU alone; this scene is on {device}"
    if settings.render.compile == "on":
        if missing:
            raise SceneError("render.compile", "on", f"auto or off ({missing})")
        return True
    return not missing and (device.type == "cpu" or _has_passed(device))


def _has_passed(device: torch.device) -> bool:
    """Return True if kernels have passed their check on a CUDA device."""
    result = device_checks.last_check(device)
    return result is not None and result.passed


def own_models(scene: Scene, wave: Wave) -> list[int]:
    """Return the indices, in the world's table of models, of those that the caller wrote."""
    models = wave.context.world.materials.models
    return [index for index, model in enumerate(models) if any(model is own for own in scene.own_models)]


def kernels_of(scene: Scene, wave: Wave, before: Kernels | None = None) -> Kernels:
    """Return the kernels of a scene's wave; ``before``: those of an earlier wave, used again where they fit."""
    return engine.kernels_of(wave, own_models(scene, wave), before, scene_cache(scene).kernel_caches)


def describe_engine(scene: Scene, settings: Settings) -> dict[str, Any]:
    """Describe how a render of the scene would run: by kernels, with their search, or by tensor operations."""
    with torch.no_grad():
        if not uses_kernels(settings, scene.device, torch.float32):
            return {"stages": "eager, by tensor operations"}
        wave = make_wave(scene, settings, params=None, dtype=torch.float32)
        on_cpu = scene.device.type == "cpu"
        kernels = kernels_of(scene, wave) if on_cpu else device_engine(scene, wave, settings, []).kernels
        return engine.describe_kernels(kernels)


def kernel_engine(scene: Scene, wave: Wave, eager: list[str], threads: int | None = None) -> Tasks:
    """Return the kernel engine of a render; its kernels are cached with the scene.

    Args:
        scene: the scene.
        wave: the wave of the render.
        eager: gets the names of models that cannot be compiled, each with the reason.
        threads: number of threads; None: torch's number.
    """
    cache = scene_cache(scene)
    kernels = cache.kernels = kernels_of(scene, wave, cache.kernels)
    _warn_of_eager_models(wave, kernels, eager)
    return engine.forward_kernels(kernels, threads, wave.integrator.strict)


def device_engine(scene: Scene, wave: Wave, settings: Settings, eager: list[str]) -> ForwardDevice:
    """Return the engine of kernels of a render on a CUDA device; its kernels are cached with the scene.

    Args:
        scene: the scene.
        wave: the wave of the render.
        settings: complete settings.
        eager: gets the names of models that cannot be compiled, each with the reason.
    """
    cache = scene_cache(scene)
    by_kernels = settings.render.search_by_kernels
    forward = engine.forward_device(wave, own_models(scene, wave), by_kernels, cache.kernels)
    cache.kernels = forward.kernels
    _warn_of_eager_models(wave, forward.kernels, eager)
    return forward


def _warn_of_eager_models(wave: Wave, kernels: Kernels, eager: list[str]) -> None:
    """Warn of models that cannot be compiled, and append them to ``eager``."""
    for number, reason in kernels.eager.items():
        name = str(wave.context.world.materials.models[number])
        eager.append(f"{name}: {reason}")
        warn_once(f"torchpt: the material model {name} runs by tensor operations, as no kernel can be made of {reason}")
