"""Find light that no sample met, which the error estimate cannot know of: it sees only how samples differ.

``picture.py`` asks after a render with an error estimate. Light is missing where the scene has none, where a delta light
(point, spot, directional) is behind glass, or where the picture stays black although surfaces reflect.

A black pixel may miss all of its true radiance r. Its squared error over ``r² + 0.01`` is below 1 for any r, so dark pixels add
at most their share of the picture to relMSE.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.engines.engine import hits, seen
from torchpt.math.vectors import Frame, dot, rows
from torchpt.paths.integrators.base import Integrator
from torchpt.paths.integrators.path import PathIntegrator, partition
from torchpt.paths.state import PathState
from torchpt.paths.wave import Wave, camera_state
from torchpt.physics.lights.records import Lights
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Geometry, Hit
from torchpt.scene.names import Names
from torchpt.scene.scene import Scene
from torchpt.search import Accel
from torchpt.search.instances import bounding_sphere

__all__ = ["MissingLight", "find_missing_light"]

#: Largest share of dark pixels at which the others still give an error estimate.
LARGEST_DARK_SHARE = 0.05
#: Number of black pixels for which one camera ray tests whether it meets a surface that reflects.
DARK_PIXELS = 256
#: Rays traced from a light, and directions traced from the surface of each dark pixel: few, as one hit is enough.
LIGHT_RAYS, SURFACE_DIRECTIONS = 512, 8
#: Angle between consecutive points of a Fibonacci lattice, in radians.
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


@dataclass(frozen=True)
class MissingLight:
    """Light that a picture lacks.

    Attributes:
        reason: why the error is not known; "" where it is.
        dark_share: share of pixels that are black although their surface reflects light.
    """

    reason: str
    dark_share: float


@torch.no_grad()
def find_missing_light(
    scene: Scene, wave: Wave, geometry: Callable[[], Geometry], picture: Tensor, relmse: float
) -> MissingLight:
    """Look for light that no sample of a picture met.

    Args:
        scene: what was rendered.
        wave: the wave of the render.
        geometry: returns the primitives that the search structure was built from.
        picture: ``(H, W, C)`` float64.
        relmse: the error estimate of the samples.
    """
    lights, names = wave.context.world.lights, Names(scene.built, wave.context.world)
    if wave.integrator.lit and (lights is None or (lights.environment is None and not bool(lights.radiance.any()))):
        return MissingLight("there is no light at all in the scene", 0.0)
    search = _Search(wave, geometry)
    if wave.integrator.lit and lights is not None:
        for row, kind in _delta_lights(lights):
            problem = _why_unreachable(search, names, lights, row, kind)
            if problem:
                return MissingLight(f"lights.{names.light(row)}: {problem}", 0.0)
    black = (picture == 0.0).all(2).reshape(-1)
    if bool(black.all()):
        return MissingLight(f"no sample met any light{_hint(wave.integrator)}", 1.0)
    dark_share = _share_of_dark_pixels(search, black)
    if dark_share > min(LARGEST_DARK_SHARE, relmse):
        reason = f"no sample met any light in {100.0 * dark_share:.2g} % of the picture"
        return MissingLight(reason + _hint(wave.integrator), dark_share)
    return MissingLight("", dark_share)


def _hint(integrator: Integrator) -> str:
    """Return what to try where paths from the camera alone find no light."""
    alone = isinstance(integrator, PathIntegrator) and integrator.light_walk() is None
    return " (integrator bdpt, whose paths start on lights too, may find some)" if alone else ""


class _Search:
    """Searches for a few rays of a render: by an LBVH in place of brute force, whose kernels must be compiled."""

    def __init__(self, wave: Wave, geometry: Callable[[], Geometry]) -> None:
        self._wave, self.geometry = wave, geometry
        self.integrator, self.world = wave.integrator, wave.context.world
        self._own: Accel | None = None

    @property
    def wave(self) -> Wave:
        """Return the wave, with an ``accel`` that needs no compilation."""
        if self._own is None:
            self._own = self._wave.accel
            if self._own.name == "brute":
                from torchpt.search.lbvh import Lbvh

                self._own = Lbvh(self.geometry())
        return replace(self._wave, accel=self._own)


def _share_of_dark_pixels(search: _Search, black: Tensor) -> float:
    """Return the share of pixels that are ``black (pixels,)`` although their first camera ray meets a surface that reflects.

    With direct light only, shadows are black and their error is known: each sample evaluated a light.
    """
    pixels, integrator = black.nonzero()[:, 0], search.integrator
    count, light_walk = len(pixels), integrator.light_walk()
    depths = [walk.limits.max_depth for walk in (integrator, light_walk) if walk is not None]
    if not count or not integrator.light or all(0 <= depth <= 2 for depth in depths):
        return 0.0
    wave = search.wave
    chosen = (
        torch.linspace(0, count - 1, min(count, DARK_PIXELS), dtype=torch.float64).round().long()
    )  # evenly among them
    state = _camera_rays(wave, pixels[chosen].to(wave.centre.device))
    hit = hits(wave, state)  # the nearest ones
    reflects = hit.prim >= 0  # (n,), True where a surface was hit
    with suppress(NotImplementedError):  # a model of the caller's own without an albedo
        albedo = seen(wave, ("albedo",), state)["albedo"]  # (3, n), a layer of the surfaces that rays hit
        reflects = albedo.abs().amax(0) > 0
    lanes = reflects.nonzero()[:, 0]
    if not len(lanes) or not _any_surface_visible(wave, rows(state, lanes), rows(hit, lanes)):
        return 0.0
    return float(reflects.double().mean()) * count / len(black)


def _camera_rays(wave: Wave, pixels: Tensor) -> PathState:
    """Return camera rays from the centre of the lens through the centres of pixels ``pixels (n,)``."""
    left, top, width, _ = wave.crop
    x, y = pixels % width + left, pixels // width + top  # on the whole film
    dtype, camera = wave.context.plan.dtype, wave.camera
    lens = torch.full((2, len(pixels)), 0.5, dtype=dtype, device=pixels.device) if camera.lens else None
    o, d = camera.rays(x.to(dtype) + 0.5, y.to(dtype) + 0.5, lens)
    key = wave.sampler.key(y * camera.resolution[0] + x, torch.zeros_like(pixels))  # for surfaces of some opacity
    return camera_state(o.expand_as(d), d, key)


def _any_surface_visible(wave: Wave, state: PathState, hit: Hit) -> bool:
    """Return True if any surface is visible from the surfaces that camera rays hit, or if one of them transmits light.

    Otherwise, as with a single ball in the sun, all paths have one vertex, and light sampling has found all there is.
    """
    world = wave.context.world
    _, lanes_by_model = partition(world, hit)
    for model, _ in lanes_by_model:
        if world.materials.models[model].transmits:
            return True
    at = interact(world, state.o, state.d, hit)
    near_normal = torch.where(dot(at.ng, state.d) < 0.0, 1.0, -1.0) * at.ng  # on the side of the camera
    lanes, count = torch.arange(len(hit.t), device=near_normal.device), len(hit.t) * SURFACE_DIRECTIONS
    for k in range(SURFACE_DIRECTIONS):
        d = _fibonacci_sphere(lanes * SURFACE_DIRECTIONS + k, count).to(near_normal.dtype)
        d = torch.where(dot(d, near_normal) < 0.0, -d, d)
        _, prim, *_ = wave.accel.intersect(offset_origin(world, at, d), d, torch.full_like(hit.t, math.inf))
        if bool((prim >= 0).any()):
            return True
    return False


def _fibonacci_sphere(k: Tensor, count: int) -> Tensor:
    """Return directions ``(3, n)`` with indices ``k (n,)`` of ``count`` on a Fibonacci lattice, float64."""
    angle, height = GOLDEN_ANGLE * k.double(), 1.0 - (2.0 * k.double() + 1.0) / count
    radius = (1.0 - height.square()).sqrt()
    return torch.stack((radius * angle.cos(), radius * angle.sin(), height))


def _delta_lights(lights: Lights) -> list[tuple[int, str]]:
    """Return row in the table of lights and kind of each delta light with power."""
    # `lights.kind` is None for a single light.
    kinds = [lights.kinds[0]] if lights.kind is None else [lights.kinds[k] for k in lights.kind.tolist()]
    intensities = lights.radiance.abs().amax(0).tolist()
    return [
        (row, kind)
        for row, kind in enumerate(kinds)
        if kind in ("point", "spot", "directional") and intensities[row] > 0
    ]


def _why_unreachable(search: _Search, names: Names, lights: Lights, row: int, kind: str) -> str:
    """Return why no path finds delta light ``row``; "" where one may.

    A path finds a delta light by light sampling at a surface that the light reaches directly and whose BSDF is not all deltas.
    """
    integrator, world = search.integrator, search.world
    cannot_be_found = f"cannot be found by integrator {integrator.name}"
    if not isinstance(integrator, PathIntegrator):
        return ""
    if integrator.merges:  # merges find it where a surface that is not all deltas is lit
        return ""
    if integrator.strategy in ("bsdf", "uniform"):
        return f"a {kind} light {cannot_be_found} with strategy {integrator.strategy}"
    models = world.materials.models
    # Smooth: a BSDF of deltas alone, such as glass. Sheer: shadow rays pass straight through.
    if not any(model.smooth and model.transmits and not model.sheer for model in models):
        return ""
    o, d = _light_rays(search, lights, row, kind)
    _, prim, *_ = search.wave.accel.intersect(o, d, torch.full_like(o[0], math.inf))
    prim = prim.long()
    slot = world.geometry.slot(prim[prim >= 0])  # surface of each hit: the index of its material and shape
    opacity = world.materials.opacity
    if opacity is not None and bool((opacity[slot] < 1.0).any()):
        return ""
    number = world.materials.key[slot + 1].long() % len(models)  # index of the model, see path.partition
    hit_models = [models[k] for k in number.tolist()]
    transmitting = [k for k, model in enumerate(hit_models) if model.transmits]
    if not transmitting or not all(model.smooth for model in hit_models):
        return ""
    shape, material = names.shape(int(slot[transmitting[0]]))
    where = f"a {kind} light {'inside' if len(hit_models) == LIGHT_RAYS else 'behind'} {shape} ({material})"
    if integrator.light_walk() is not None:
        hint = "" if integrator.merging_counts else " (vcm finds it there)"
        return f"{where} {cannot_be_found} where it is seen through glass or in a mirror{hint}"
    return f"{where} {cannot_be_found} (bdpt finds it where it is not seen through glass or in a mirror, vcm there too)"


def _light_rays(search: _Search, lights: Lights, row: int, kind: str) -> tuple[Tensor, Tensor]:
    """Return rays ``o, d (3, LIGHT_RAYS)`` float32 from a delta light, evenly distributed on a Fibonacci lattice.

    A directional light sends them along its axis from a disk outside of the scene's bounding sphere.
    """
    k = torch.arange(LIGHT_RAYS, dtype=torch.float64, device=lights.p0.device)
    angle, fraction = GOLDEN_ANGLE * k, (k + 0.5) / LIGHT_RAYS
    axis = lights.normal[:, row : row + 1].double()
    if kind == "directional":
        centre, radius = bounding_sphere(search.geometry())
        frame = Frame.about(axis)
        on_disk = fraction.sqrt() * (angle.cos() * frame.s + angle.sin() * frame.t)
        o, d = centre[:, None] + radius * (on_disk - 2.0 * axis), axis.expand(3, LIGHT_RAYS)
    else:
        d = _fibonacci_sphere(k, LIGHT_RAYS)
        if kind == "spot":
            cutoff_angle = float(lights.e1[0, row])  # radians
            height, frame = 1.0 - (1.0 - math.cos(cutoff_angle)) * fraction, Frame.about(axis)
            radius = (1.0 - height.square()).clamp_min(0.0).sqrt()
            d = radius * (angle.cos() * frame.s + angle.sin() * frame.t) + height * frame.n
        o = lights.p0[:, row : row + 1].double().expand(3, LIGHT_RAYS)
    return o.float().contiguous(), d.float().contiguous()
