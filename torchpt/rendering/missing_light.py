"""Light that a picture lacks: what no sample met has no known error.

A pixel without any light may be off by all that it should hold. Its squared error over ``r² + 0.01`` is below 1, whatever the
true radiance r is, so that dark pixels add at most their share of the picture to relMSE.
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
from torchpt.paths.integrators.path import PathIntegrator, partition
from torchpt.paths.state import PathState
from torchpt.paths.wave import Wave, camera_state
from torchpt.physics.lights.records import Lights
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Geometry, Hit
from torchpt.scene.names import Names
from torchpt.scene.scene import Scene
from torchpt.search import Accel
from torchpt.search.bounds import primitive_bounds

__all__ = ["MissingLight", "find_missing_light"]

#: Share of the picture that may be dark for the rest to tell the error.
DARK = 0.05
#: Dark pixels of which one camera ray each is asked whether it meets anything that reflects.
DARK_PIXELS = 256
#: Rays from a light that are asked what they meet first; and from each dark pixel's surface, what is in sight.
RAYS, DIRECTIONS = 512, 8


@dataclass(frozen=True)
class MissingLight:
    """Light that a picture lacks.

    Attributes:
        reason: why its error is not known; "" where it is.
        dark: share of its pixels that hold no light, although what they show reflects some.
    """

    reason: str
    dark: float


@torch.no_grad()
def find_missing_light(
    scene: Scene, wave: Wave, geometry: Callable[[], Geometry], picture: Tensor, relmse: float
) -> MissingLight:
    """Look for light that a picture lacks.

    Args:
        scene: what was rendered.
        wave: of the render.
        geometry: the primitives as the search sees them.
        picture: ``(H, W, C)`` float64.
        relmse: what the samples tell of its error.
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
        return MissingLight("no sample met any light", 1.0)
    dark = _dark_share(search, black)
    if dark > min(DARK, relmse):
        return MissingLight(f"no sample met any light in {100.0 * dark:.2g} % of the picture", dark)
    return MissingLight("", dark)


class _Search:
    """A few rays of a render; a structure whose kernels the render does not need itself is not compiled for them."""

    def __init__(self, wave: Wave, geometry: Callable[[], Geometry]) -> None:
        self._wave, self.geometry = wave, geometry
        self.integrator, self.world = wave.integrator, wave.context.world
        self._own: Accel | None = None

    @property
    def wave(self) -> Wave:
        """The wave, whose ``accel`` may be asked."""
        if self._own is None:
            self._own = self._wave.accel
            if self._own.name == "brute":
                from torchpt.search.lbvh import Lbvh

                self._own = Lbvh(self.geometry())
        return replace(self._wave, accel=self._own)


def _dark_share(search: _Search, black: Tensor) -> float:
    """Share of all pixels that are ``black (pixels,)`` although their first camera ray meets what reflects.

    Shadows of direct light are black, and known to be: each sample asked a light for what it would bring.
    """
    places, integrator = black.nonzero()[:, 0], search.integrator
    count = len(places)
    if not count or not integrator.light or 0 <= integrator.limits.max_depth <= 2:
        return 0.0
    wave = search.wave
    asked = places[torch.linspace(0, count - 1, min(count, DARK_PIXELS), dtype=torch.float64).round().long()].to(
        wave.centre.device
    )
    state = _camera_rays(wave, asked)
    hit = hits(wave, state)
    reflects = hit.prim >= 0
    with suppress(NotImplementedError):  # a model of the caller's own without an albedo
        reflects = seen(wave, ("albedo",), state)["albedo"].abs().amax(0) > 0
    on = reflects.nonzero()[:, 0]
    if not len(on) or not _any_surface_visible(wave, rows(state, on), rows(hit, on)):
        return 0.0
    return float(reflects.double().mean()) * count / len(black)


def _camera_rays(wave: Wave, places: Tensor) -> PathState:
    """Rays from the middle of the lens through the middles of pixels ``places (n,)`` of the picture."""
    x0, y0, width, _ = wave.crop
    x, y = places % width + x0, places // width + y0
    dtype, camera = wave.context.plan.dtype, wave.camera
    lens = torch.full((2, len(places)), 0.5, dtype=dtype, device=places.device) if camera.lens else None
    o, d = camera.rays(x.to(dtype) + 0.5, y.to(dtype) + 0.5, lens)
    key = wave.sampler.key(y * camera.resolution[0] + x, torch.zeros_like(places))  # for surfaces of some opacity
    return camera_state(o.expand_as(d), d, key)


def _any_surface_visible(wave: Wave, state: PathState, hit: Hit) -> bool:
    """Return True where anything can be seen from the surfaces that camera rays meet, or light passes them.

    Else, as behind a single ball in the sun, no path goes on, and what the lights were asked for is all there is.
    """
    world = wave.context.world
    for model, _ in partition(world, hit)[1]:
        if world.materials.models[model].transmits:
            return True
    at = interact(world, state.o, state.d, hit)
    near = torch.where(dot(at.ng, state.d) < 0.0, 1.0, -1.0) * at.ng
    for k in range(DIRECTIONS):
        d = _sphere(torch.arange(len(hit.t), device=near.device) * DIRECTIONS + k, len(hit.t) * DIRECTIONS).to(
            near.dtype
        )
        d = torch.where(dot(d, near) < 0.0, -d, d)
        prim = wave.accel.intersect(offset_origin(world, at, d), d, torch.full_like(hit.t, math.inf))[1]
        if bool((prim >= 0).any()):
            return True
    return False


def _sphere(k: Tensor, count: int) -> Tensor:
    """Directions ``(3, n)`` number ``k (n,)`` of ``count`` on a Fibonacci lattice, float64."""
    turn, height = math.pi * (3.0 - math.sqrt(5.0)) * k.double(), 1.0 - (2.0 * k.double() + 1.0) / count
    radius = (1.0 - height.square()).sqrt()
    return torch.stack((radius * turn.cos(), radius * turn.sin(), height))


def _delta_lights(lights: Lights) -> list[tuple[int, str]]:
    """Rows of the lights that no ray meets by chance, and their kinds; those without power are none."""
    kinds = [lights.kinds[0]] if lights.kind is None else [lights.kinds[k] for k in lights.kind.tolist()]
    bright = lights.radiance.abs().amax(0).tolist()
    return [
        (row, kind) for row, kind in enumerate(kinds) if kind in ("point", "spot", "directional") and bright[row] > 0
    ]


def _why_unreachable(search: _Search, names: Names, lights: Lights, row: int, kind: str) -> str:
    """Return why no path finds a light that no ray meets by chance; "" where one may.

    A path takes its light at a surface that the light shines on directly, and only where that scatters: polished ones have
    no direction to spare for it.
    """
    integrator, world = search.integrator, search.world
    cannot = f"cannot be found by integrator {integrator.name}"
    if not isinstance(integrator, PathIntegrator):
        return ""
    if integrator.strategy in ("bsdf", "uniform"):
        return f"a {kind} light {cannot} with strategy {integrator.strategy}"
    models = world.materials.models
    if not any(model.smooth and model.transmits and not model.sheer for model in models):
        return ""
    o, d = _rays(search, lights, row, kind)
    prim = search.wave.accel.intersect(o, d, torch.full_like(o[0], math.inf))[1].long()
    slot = world.geometry.slot(prim[prim >= 0])
    opacity = world.materials.opacity
    if opacity is not None and bool((opacity[slot] < 1.0).any()):
        return ""
    number = world.materials.key[slot + 1].long() % len(models)  # see path.partition
    met = [models[k] for k in number.tolist()]
    passing = [k for k, model in enumerate(met) if model.transmits]
    if not passing or not all(model.smooth for model in met):
        return ""
    shape, material = names.shape(int(slot[passing[0]]))
    return f"a {kind} light {'inside' if len(met) == RAYS else 'behind'} {shape} ({material}) {cannot}"


def _rays(search: _Search, lights: Lights, row: int, kind: str) -> tuple[Tensor, Tensor]:
    """Rays ``o, d (3, RAYS)`` along which a light shines, evenly: on a Fibonacci lattice."""
    k = torch.arange(RAYS, dtype=torch.float64, device=lights.p0.device)
    turn, share = math.pi * (3.0 - math.sqrt(5.0)) * k, (k + 0.5) / RAYS
    axis = lights.normal[:, row : row + 1].double()
    if kind == "directional":
        low, high = (box.double() for box in primitive_bounds(search.geometry()))
        low, high = low.amin(1, keepdim=True), high.amax(1, keepdim=True)
        reach = 0.5 * (high - low).norm()
        frame = Frame.about(axis)
        aside = share.sqrt() * (turn.cos() * frame.s + turn.sin() * frame.t)
        o, d = 0.5 * (low + high) + reach * (aside - 2.0 * axis), axis.expand(3, RAYS)
    else:
        d = _sphere(k, RAYS)
        if kind == "spot":
            height, frame = 1.0 - (1.0 - math.cos(float(lights.e1[0, row]))) * share, Frame.about(axis)
            radius = (1.0 - height.square()).clamp_min(0.0).sqrt()
            d = radius * (turn.cos() * frame.s + turn.sin() * frame.t) + height * frame.n
        o = lights.p0[:, row : row + 1].double().expand(3, RAYS)
    return o.float().contiguous(), d.float().contiguous()
